"""Chooses MuJoCo's rendering backend before mujoco is imported, and says what is missing for it."""

import os
import sys

EGL_PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgles2"


class RenderingUnavailableError(RuntimeError):
    """MuJoCo cannot create an offscreen renderer on this machine."""


def set_default_gl_backend() -> None:
    """Ask for EGL on a Linux machine without a display, unless MUJOCO_GL says otherwise.

    mujoco reads the variable once, when it is imported: call this before.
    """
    if sys.platform.startswith("linux") and not os.environ.get("MUJOCO_GL") and not os.environ.get("DISPLAY"):
        os.environ["MUJOCO_GL"] = "egl"


def rendering_error(cause: BaseException) -> RenderingUnavailableError:
    """Wrap whatever the OpenGL stack raised into one error that says what to install."""
    return RenderingUnavailableError(
        f"MuJoCo cannot create an offscreen renderer (MUJOCO_GL={os.environ.get('MUJOCO_GL', 'unset')}): "
        f"{type(cause).__name__}: {cause}. On Debian or Ubuntu: apt-get install {EGL_PACKAGES}, "
        "then run again with MUJOCO_GL=egl."
    )
