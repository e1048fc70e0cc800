"""Images, segmentation and depth of the tabletop, by MuJoCo's offscreen renderer."""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

import atexit
import weakref
from typing import Any

import numpy as np

from lerobot_openspm.envs.gl_backend import rendering_error, set_default_gl_backend

set_default_gl_backend()

# After the choice of the backend: mujoco loads it on import, and fails there when its libraries are missing.
try:
    import mujoco
except (ImportError, AttributeError, OSError, RuntimeError) as error:
    raise rendering_error(error) from error


class Renderer:
    """Draws one model; its OpenGL contexts are made on first use, one for each image size.

    Every method raises RenderingUnavailableError where the OpenGL stack of the machine is incomplete.

    Args:
        model: MuJoCo's model.
        geom_labels: Number of each geom's object, (ngeom,).
    """

    def __init__(self, model: mujoco.MjModel, geom_labels: np.ndarray) -> None:
        self._model, self._geom_labels = model, geom_labels
        self._renderers: dict[tuple[int, int], Any] = {}

    def image(self, data: mujoco.MjData, camera: str, height: int, width: int) -> np.ndarray:
        """RGB image, (height, width, 3) uint8."""
        return np.ascontiguousarray(self._looking_through(data, camera, height, width).render())

    def labels(self, data: mujoco.MjData, camera: str, height: int, width: int) -> np.ndarray:
        """Number of the object that each pixel shows, (height, width) int32; 0 where it is none."""
        renderer = self._looking_through(data, camera, height, width)
        renderer.enable_segmentation_rendering()
        try:
            geoms, kinds = np.moveaxis(renderer.render(), -1, 0)
        finally:
            renderer.disable_segmentation_rendering()
        is_geom = kinds == mujoco.mjtObj.mjOBJ_GEOM
        return np.where(is_geom, self._geom_labels[np.where(is_geom, geoms, 0)], 0).astype(np.int32)

    def depth(self, data: mujoco.MjData, camera: str, height: int, width: int) -> np.ndarray:
        """Distance along the optical axis of what each pixel shows, (height, width) float32 metres."""
        renderer = self._looking_through(data, camera, height, width)
        renderer.enable_depth_rendering()
        try:
            return np.array(renderer.render())
        finally:
            renderer.disable_depth_rendering()

    def _looking_through(self, data: mujoco.MjData, camera: str, height: int, width: int) -> Any:
        renderer = self._renderers.get((height, width))
        if renderer is None:
            renderer = self._renderers[(height, width)] = _make_renderer(self._model, height, width)
            # mujoco shuts EGL down at exit; registered after that hook, this one runs before it.
            atexit.register(_close_at_exit, weakref.ref(self))
        renderer.update_scene(data, camera=camera)
        return renderer

    def close(self) -> None:
        """Free the OpenGL contexts."""
        while self._renderers:
            self._renderers.popitem()[1].close()


def _close_at_exit(reference: "weakref.ref[Renderer]") -> None:
    renderer = reference()
    if renderer is not None:
        renderer.close()


def _make_renderer(model: mujoco.MjModel, height: int, width: int) -> Any:
    try:
        renderer = mujoco.Renderer(model, height, width)
    except (RuntimeError, ImportError, AttributeError, OSError, mujoco.FatalError) as error:
        raise rendering_error(error) from error
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
    renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
    return renderer
