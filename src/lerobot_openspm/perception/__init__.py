"""Objects learned from the demonstrations' own images, and found again in new ones. Knows no simulator."""
