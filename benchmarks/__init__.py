"""Takes every published figure, one module each: ``python -m benchmarks.NAME``."""

from lerobot_openspm.envs.gl_backend import set_default_gl_backend

# mujoco reads it once, when it is imported.
set_default_gl_backend()
