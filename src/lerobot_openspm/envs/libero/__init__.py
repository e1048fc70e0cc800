"""Demonstrations on LIBERO: its simulator with the true poses, scripted experts, recording."""
