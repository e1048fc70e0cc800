"""The embedded MuJoCo tabletop: scene, ten tasks, scripted experts. Importing this package does not import mujoco."""
