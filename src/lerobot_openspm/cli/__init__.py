"""The `openspm` commands: argument parsing and printing only."""
