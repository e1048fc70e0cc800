"""Measurements behind ``openspm bench``. They see the simulator's truth; the policy they measure does not."""
