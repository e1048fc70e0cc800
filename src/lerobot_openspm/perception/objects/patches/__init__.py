"""Objects known by patches of the demonstrations' images."""
