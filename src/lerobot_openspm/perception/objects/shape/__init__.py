"""Objects known by the shape of their masks."""
