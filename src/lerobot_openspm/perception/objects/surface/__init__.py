"""Objects known by their surface: coloured points, seen from all around in the demonstrations."""
