"""Sizes of objects by SAM 3D Objects, in a process of its own."""
