"""SE(3), cameras and vector layouts. Knows nothing of LeRobot or MuJoCo."""
