"""The bundled tabletop."""
