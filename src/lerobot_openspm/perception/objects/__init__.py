"""Kinds of objects: how each is learned, found and written down."""
