"""The MuJoCo side of the tabletop: physics, the hand's bounded drive, contacts and true poses."""

# mujoco ships no stubs for its compiled part.
# pyright: reportAttributeAccessIssue=false

import copy
import functools
import math

import numpy as np
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.motions import DOWN
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.mjcf import build_mjcf
from lerobot_openspm.envs.tabletop.placement import Placement
from lerobot_openspm.envs.tabletop.rendering import Renderer, mujoco
from lerobot_openspm.geometry.se3 import transform

CONTROL_PERIOD_S = 0.05
# The target moves in this many equal parts per control step, so that the hand is pulled smoothly.
TARGET_PARTS = 5
STEPS_PER_PART = round(CONTROL_PERIOD_S / scene.TIMESTEP_S / TARGET_PARTS)
MAX_STEP_M = 0.02
MAX_STEP_RAD = 0.15
# How far the target may lead the hand: it bounds the force and keeps a blocked hand from winding up.
MAX_LEAD_M = 0.03
MAX_LEAD_RAD = 0.30
WORKSPACE_LOW = np.array([-0.40, -0.46, 0.010])
WORKSPACE_HIGH = np.array([0.50, 0.46, 0.58])
SETTLE_STEPS = 120
FINGER_OPEN_M = scene.FINGER_TRAVEL
# Beyond closed, so that the position drive keeps pressing on whatever is between the fingers.
FINGER_CLOSED_M = -0.02
# What objects stand on is small, out of sight, and drawn by no camera.
FEET_GROUP = 4
HAND_BODIES = ("hand", "finger_left", "finger_right")


@functools.cache
def compiled_model(others: tuple[str, ...] = ()) -> mujoco.MjModel:
    """Compile a scene once per process; every simulator works on its own copy."""
    return mujoco.MjModel.from_xml_string(build_mjcf(others))


def _bounded(vector: np.ndarray, limit: float) -> np.ndarray:
    length = float(np.linalg.norm(vector))
    return vector if length <= limit else vector * (limit / length)


class TabletopSimulator:
    """One tabletop. Instances share nothing but the compiled model, of which each has its own copy.

    Args:
        others: Names of what stands there beside the tasks' objects: distractors, and second objects.

    Attributes:
        movable: Names of all objects that can be moved, those others among them.
    """

    def __init__(self, others: tuple[str, ...] = ()) -> None:
        self.model: mujoco.MjModel = copy.copy(compiled_model(others))
        self.data = mujoco.MjData(self.model)
        self.movable = (*scene.MOVABLE_NAMES, *others)
        fingers = ("finger_left", "finger_right")
        bodies = ("hand", *scene.OBJECT_NAMES, *self.movable, *scene.DRAWER_NAMES, "knob", *fingers)
        joints = ("hand", *fingers, "knob", *self.movable, *scene.DRAWER_NAMES)
        self._body = {n: self.model.body(n).id for n in bodies}
        self._qpos = {n: int(self.model.joint(n).qposadr[0]) for n in joints}
        self._dof = {n: int(self.model.joint(n).dofadr[0]) for n in joints}
        self._hand_bodies = {self._body[n] for n in HAND_BODIES}
        self._renderer = Renderer(self.model, self._label_geoms())
        self._target_position = np.array(scene.HOME_POSITION)
        self._target_rotation = DOWN.copy()

    def reset(self, layout: dict[str, Placement]) -> None:
        """Place every object, put the hand home with open fingers and let the scene settle."""
        mujoco.mj_resetData(self.model, self.data)
        for name, at in layout.items():
            quat_wxyz = (math.cos(at.yaw / 2), 0.0, 0.0, math.sin(at.yaw / 2))
            if name in self.movable:
                start = self._qpos[name]
                self.data.qpos[start : start + 7] = (at.x, at.y, 0.0, *quat_wxyz)
            else:
                self.model.body_pos[self._body[name]] = (at.x, at.y, 0.0)
                self.model.body_quat[self._body[name]] = quat_wxyz
        hand = self._qpos["hand"]
        self.data.qpos[hand : hand + 7] = (*scene.HOME_POSITION, 0.0, 1.0, 0.0, 0.0)
        self.data.qpos[self._qpos["finger_left"]] = FINGER_OPEN_M
        self.data.qpos[self._qpos["finger_right"]] = -FINGER_OPEN_M
        self._target_position = np.array(scene.HOME_POSITION)
        self._target_rotation = DOWN.copy()
        self._drive_fingers(closing=False)
        self._write_target(self._target_position, self._target_rotation)
        mujoco.mj_step(self.model, self.data, SETTLE_STEPS)
        mujoco.mj_forward(self.model, self.data)

    def apply(self, action: np.ndarray) -> None:
        """Advance one control step (0.05 s).

        Args:
            action: (7,) in [-1, 1]: world-frame position increment in units of 0.02 m, world-frame rotation
                vector in units of 0.15 rad (left-multiplied), gripper (positive closes, else opens).
        """
        before = self._target_position, Rotation.from_matrix(self._target_rotation)
        self._integrate_target(np.asarray(action, dtype=np.float64))
        self._drive_fingers(closing=bool(action[6] > 0))
        turn = (Rotation.from_matrix(self._target_rotation) * before[1].inv()).as_rotvec()
        for part in range(1, TARGET_PARTS + 1):
            share = part / TARGET_PARTS
            position = before[0] + share * (self._target_position - before[0])
            self._write_target(position, (Rotation.from_rotvec(share * turn) * before[1]).as_matrix())
            mujoco.mj_step(self.model, self.data, STEPS_PER_PART)
        # Positions, contacts and the camera poses as of now, not as of one physics step ago.
        mujoco.mj_forward(self.model, self.data)

    def _integrate_target(self, action: np.ndarray) -> None:
        ee = self.ee_pose()
        position = self._target_position + action[:3] * MAX_STEP_M
        position = ee[:3, 3] + _bounded(position - ee[:3, 3], MAX_LEAD_M)
        self._target_position = np.clip(position, WORKSPACE_LOW, WORKSPACE_HIGH)
        actual = Rotation.from_matrix(ee[:3, :3])
        wanted = Rotation.from_rotvec(action[3:6] * MAX_STEP_RAD) * Rotation.from_matrix(
            self._target_rotation
        )
        lead = _bounded((wanted * actual.inv()).as_rotvec(), MAX_LEAD_RAD)
        self._target_rotation = (Rotation.from_rotvec(lead) * actual).as_matrix()

    def _write_target(self, position: np.ndarray, rotation: np.ndarray) -> None:
        self.data.mocap_pos[0] = position
        mujoco.mju_mat2Quat(self.data.mocap_quat[0], np.ascontiguousarray(rotation).reshape(9))

    def _drive_fingers(self, closing: bool) -> None:
        goal = FINGER_CLOSED_M if closing else FINGER_OPEN_M
        self.data.ctrl[:] = (goal, -goal)

    def ee_pose(self) -> np.ndarray:
        """T_world_ee, (4, 4): the point between the fingertips; z out of the hand, fingers open along y."""
        return self._pose("hand")

    def object_poses(self) -> dict[str, np.ndarray]:
        """T_world_obj, (4, 4), per name in `scene.OBJECT_NAMES`."""
        return {name: self._pose(name) for name in scene.OBJECT_NAMES}

    def _pose(self, body: str) -> np.ndarray:
        index = self._body[body]
        return transform(self.data.xmat[index].reshape(3, 3), self.data.xpos[index])

    def finger_positions(self) -> np.ndarray:
        """(2,) metres: left is positive, right negative, as in LIBERO; (0.04, -0.04) is open.

        The joints' stops are soft: fingers that press on nothing go a little beyond, which reads as closed.
        """
        left, right = (float(self.data.qpos[self._qpos[name]]) for name in ("finger_left", "finger_right"))
        return np.array([max(left, 0.0), min(right, 0.0)])

    def put(self, name: str, T_world_obj: np.ndarray) -> None:
        """Put a movable object somewhere else at once, at rest: somebody moved it, or it slipped and fell."""
        start = self._qpos[name]
        x, y, z, w = Rotation.from_matrix(T_world_obj[:3, :3]).as_quat()
        self.data.qpos[start : start + 7] = (*T_world_obj[:3, 3], w, x, y, z)
        self.data.qvel[self._dof[name] : self._dof[name] + 6] = 0.0
        mujoco.mj_forward(self.model, self.data)

    def place_camera(self, name: str, T_world_cam: np.ndarray) -> None:
        """Put a camera that is fixed in the world elsewhere; the pose is OpenCV's (4, 4): x right, y down."""
        index = self.model.camera(name).id
        R_world_mujoco = T_world_cam[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        self.model.cam_pos[index] = T_world_cam[:3, 3]
        self.model.cam_quat[index] = np.roll(Rotation.from_matrix(R_world_mujoco).as_quat(), 1)
        mujoco.mj_forward(self.model, self.data)

    def joint_position(self, name: str) -> float:
        """Metres a drawer is pulled out, or radians the knob is turned."""
        return float(self.data.qpos[self._qpos[name]])

    def is_at_rest(self, name: str, linear: float = 0.02, angular: float = 0.4) -> bool:
        """Whether an object, a drawer or the knob moves slower than `linear` m/s and `angular` rad/s."""
        start = self._dof[name]
        if name not in self.movable:
            return abs(self.data.qvel[start]) < (angular if name == "knob" else linear)
        velocity = self.data.qvel[start : start + 6]
        return bool(np.linalg.norm(velocity[:3]) < linear and np.linalg.norm(velocity[3:]) < angular)

    def touching(self, name: str) -> set[str]:
        """Names of the bodies in contact with body `name`; "hand" is palm or fingers, "world" the table."""
        own = {self._body[name]}
        touched = set()
        for contact in self.data.contact:
            a, b = self.model.geom_bodyid[contact.geom1], self.model.geom_bodyid[contact.geom2]
            if contact.dist < 0.0005 and (a in own or b in own):
                other = int(b if a in own else a)
                touched.add("hand" if other in self._hand_bodies else self.model.body(other).name)
        return touched

    def is_unstable(self) -> bool:
        """Whether the state is not finite, or MuJoCo warned: of a bad state, or of contacts left out."""
        warned = any(warning.number > 0 for warning in self.data.warning)
        return warned or not bool(np.isfinite(self.data.qpos).all() and np.isfinite(self.data.qvel).all())

    def render(self, camera: str, height: int, width: int) -> np.ndarray:
        """A camera's upright RGB image, (height, width, 3) uint8."""
        return self._renderer.image(self.data, camera, height, width)

    def render_labels(self, camera: str, height: int, width: int) -> np.ndarray:
        """Number of the object that each pixel shows, (height, width) int32, as in `scene.OBJECT_LABELS`.

        Drawers and their handles are the cabinet's, the knob is the stove's; 0 is the hand and the room.
        """
        return self._renderer.labels(self.data, camera, height, width)

    def shown_share(self, name: str) -> float:
        """Share of an object's geoms whose middle the camera that shows most of them sees."""
        geoms = np.flatnonzero(self.model.geom_bodyid == self._body[name])
        geoms = geoms[self.model.geom_group[geoms] != FEET_GROUP]
        return max(
            float(np.mean([self._is_shown(camera, int(geom)) for geom in geoms]))
            for camera in scene.CAMERA_NAMES
        )

    def _is_shown(self, camera: str, geom: int) -> bool:
        index = self.model.camera(camera).id
        origin, at = self.data.cam_xpos[index], self.data.geom_xpos[geom]
        p_cam = self.data.cam_xmat[index].reshape(3, 3).T @ (at - origin)  # MuJoCo's cameras look along -z
        half = math.tan(math.radians(float(self.model.cam_fovy[index])) / 2)
        if p_cam[2] >= 0 or np.abs(p_cam[:2]).max() > -half * p_cam[2]:
            return False
        hit = np.full(1, -1, np.int32)
        groups = np.array([1, 1, 1, 1, 0, 1], np.uint8)
        mujoco.mj_ray(self.model, self.data, origin, at - origin, groups, 1, -1, hit)
        return bool(hit[0] >= 0) and self.model.geom_bodyid[hit[0]] == self.model.geom_bodyid[geom]

    def render_depth(self, camera: str, height: int, width: int) -> np.ndarray:
        """Distance along the optical axis of what each pixel shows, (height, width) float32 metres."""
        return self._renderer.depth(self.data, camera, height, width)

    def _label_geoms(self) -> np.ndarray:
        """Number of each geom's object, (ngeom,); drawers and knob hang on their objects."""
        labels = np.zeros(self.model.ngeom, np.int32)
        roots = self.model.body_rootid[self.model.geom_bodyid]
        for name, number in scene.OBJECT_LABELS.items():
            labels[roots == self._body[name]] = number
        for name in self.movable:
            labels[roots == self._body[name]] = scene.OBJECT_LABELS.get(scene.kind(name), 0)
        return labels

    def close(self) -> None:
        """Free what OpenGL holds."""
        self._renderer.close()
