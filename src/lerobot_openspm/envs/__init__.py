"""The embedded MuJoCo tabletop: scene, ten tasks, scripted experts. Importing this does not import mujoco."""
