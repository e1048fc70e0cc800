"""Estimating a camera's pose and focal length from demonstrations: the hand's poses against images."""
