"""Images of LIBERO's scenes, equal to robosuite's in every bit and cheaper.

LIBERO compiles a new model at every reset, and robosuite then uploads its meshes and 143 MB of textures anew.
Scenes of one task differ in where things stand, not in what they look like, so one upload serves them all.
robosuite also draws everything for every camera, the robot's pedestal as much as the bowl; here, geoms that a
camera cannot see, directly or in a mirror, are left out.
"""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import os
from typing import Any

import mujoco
import numpy as np

MAX_GEOMS = 1000
# robosuite hides the group of the collision shapes; this one is hidden by MuJoCo's default.
COLLISION_GROUP, HIDDEN_GROUP = 0, 5
# Geoms are kept that come this near to what a camera sees.
MARGIN_M = 0.01
# What MuJoCo uploads of a model; where two models have it in common, it is uploaded once. Textures are told
# apart by their files and sizes: comparing their 143 MB would take as long as another upload.
UPLOADED = (
    "mesh_vert",
    "mesh_face",
    "mesh_normal",
    "mesh_texcoord",
    "tex_pathadr",
    "tex_adr",
    "tex_height",
    "tex_width",
    "mat_texid",
    "mat_texuniform",
    "mat_texrepeat",
    "hfield_data",
)


class Renderer:
    """Draws the scenes of one LIBERO task."""

    def __init__(self) -> None:
        # Mesa's software driver takes a thread per core, which several processes would contend for.
        os.environ.setdefault("LP_NUM_THREADS", "1")
        # LIBERO's environments draw by robosuite's choice of OpenGL (EGL, OSMesa, GLFW), and so does this.
        from robosuite.utils.binding_utils import GLContext  # pyright: ignore[reportMissingImports]

        self._opengl = GLContext(max_width=0, max_height=0)
        self._size = 0
        self._model: Any = None
        self._context: Any = None
        self._scene: Any = None
        self._option = mujoco.MjvOption()
        self._option.geomgroup[COLLISION_GROUP] = 0
        self._perturbation = mujoco.MjvPerturb()

    def image(self, model: Any, data: Any, camera: str, size: int) -> np.ndarray:
        """One camera's image (size, size, 3) uint8 as OpenGL makes it, the lowest row first.

        Args:
            model: MuJoCo's model; what is drawn of another model than before is uploaded first.
            data: MuJoCo's data, whose positions are up to date.
            camera: The camera's name in the model.
            size: Height and width in pixels.
        """
        # OpenGL draws into the context made current last, which is another one's where there are several.
        self._opengl.make_current()
        self._upload(model, size)
        index = model.camera(camera).id
        seen, mirrored = visible_geoms(model, data, index)
        self._update_scene(model, data, index, seen)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = mirrored
        viewport, image = mujoco.MjrRect(0, 0, size, size), np.empty((size, size, 3), np.uint8)
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(image, None, viewport, self._context)
        return image

    def _upload(self, model: Any, size: int) -> None:
        if model is self._model and size <= self._size:
            return
        if self._context is None or size > self._size or not _look_alike(model, self._model):
            self._free_context()
            self._size = max(self._size, size)
            buffer = model.vis.global_
            buffer.offwidth = max(buffer.offwidth, self._size)
            buffer.offheight = max(buffer.offheight, self._size)
            self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_150)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, maxgeom=MAX_GEOMS)
        self._model = model

    def _update_scene(self, model: Any, data: Any, camera: int, seen: np.ndarray) -> None:
        """Fill the scene with some geoms alone, for which the model's groups are changed and changed back."""
        view = mujoco.MjvCamera()
        view.type, view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, camera
        groups = model.geom_group.copy()
        model.geom_group[~seen] = HIDDEN_GROUP
        try:
            everything = mujoco.mjtCatBit.mjCAT_ALL
            mujoco.mjv_updateScene(
                model, data, self._option, self._perturbation, view, everything, self._scene
            )
        finally:
            model.geom_group[:] = groups

    def _free_context(self) -> None:
        if self._context is not None:
            self._context.free()
            self._context = None

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._opengl.make_current()
        self._free_context()
        self._opengl.free()


def _look_alike(one: Any, other: Any) -> bool:
    """Whether two models have the same meshes, textures and materials, and the same fog and shadows."""
    return (one.paths, one.stat.extent) == (other.paths, other.stat.extent) and all(
        np.array_equal(getattr(one, name), getattr(other, name)) for name in UPLOADED
    )


def visible_geoms(model: Any, data: Any, camera: int) -> tuple[np.ndarray, bool]:
    """Which geoms a camera with a square image may see, and whether any mirror.

    Geoms are taken for their bounding spheres, so some are kept that cannot be seen.

    Args:
        model: MuJoCo's model.
        data: Its data, whose positions are up to date.
        camera: The camera's number.

    Returns:
        Mask (ngeom,), and whether a mirror may be seen.
    """
    T_world_eye = data.cam_xpos[camera], data.cam_xmat[camera].reshape(3, 3)
    half_angle = np.radians(model.cam_fovy[camera]) / 2
    # Planes have no bounding sphere.
    radii = np.where(model.geom_rbound > 0, model.geom_rbound, np.inf) + MARGIN_M
    seen = _in_pyramid(data.geom_xpos, radii, *T_world_eye, half_angle)
    flat = np.isin(model.geom_type, (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX))
    shiny = (model.geom_matid >= 0) & (model.mat_reflectance[model.geom_matid] > 0)
    mirrors = np.flatnonzero(flat & shiny & seen)
    for mirror in mirrors:
        seen = seen | _in_mirror(model, data, mirror, data.geom_xpos, radii, T_world_eye[0])
    return seen, len(mirrors) > 0


def _in_pyramid(
    centers: np.ndarray, radii: np.ndarray, eye: np.ndarray, R_world_eye: np.ndarray, half_angle: float
) -> np.ndarray:
    """Which spheres reach into a camera's field of view; it looks along its -z, MuJoCo's convention."""
    x, y, z = ((centers - eye) @ R_world_eye).T
    reach = np.minimum(-np.abs(x), -np.abs(y)) * np.cos(half_angle) - z * np.sin(half_angle)
    return (reach > -radii) & (-z > -radii)


def _in_mirror(
    model: Any, data: Any, mirror: int, centers: np.ndarray, radii: np.ndarray, eye: np.ndarray
) -> np.ndarray:
    """Which spheres' mirror images reach into the cone from the eye around the mirror."""
    normal = data.geom_xmat[mirror].reshape(3, 3)[:, 2]
    middle, radius = data.geom_xpos[mirror], radii[mirror]
    is_box = model.geom_type[mirror] == mujoco.mjtGeom.mjGEOM_BOX
    face = middle + normal * (model.geom_size[mirror, 2] if is_box else 0.0)
    images = centers - 2 * ((centers - face) @ normal)[:, None] * normal
    axis, distance = (middle - eye) / np.linalg.norm(middle - eye), float(np.linalg.norm(middle - eye))
    if radius >= distance:
        return np.ones(len(centers), bool)
    angle = np.arcsin(radius / distance)
    along = (images - eye) @ axis
    across = np.linalg.norm(images - eye - along[:, None] * axis, axis=1)
    return across * np.cos(angle) - along * np.sin(angle) < radii
