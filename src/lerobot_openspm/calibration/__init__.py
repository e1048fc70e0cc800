"""Estimating a camera's pose, and its focal length, from demonstrations: the hand's known poses against images."""
