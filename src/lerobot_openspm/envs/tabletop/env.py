"""The tabletop as a Gymnasium environment, observed and acted on like LeRobot's LIBERO."""

import json
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from scipy.spatial.transform import Rotation

from lerobot_openspm.envs.recording import pose_names, pose_vector
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.anywhere import sample_anywhere
from lerobot_openspm.envs.tabletop.experts import expert_solves
from lerobot_openspm.envs.tabletop.placement import Layout, LayoutError, sample_layout, sample_with_second
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import ANY_TASK, SUCCESS_HOLD_STEPS, select_tasks

STATE_NAMES = ("x", "y", "z", "axis_angle_x", "axis_angle_y", "axis_angle_z", "finger_left", "finger_right")
ACTION_NAMES = (
    "delta_x",
    "delta_y",
    "delta_z",
    "delta_axis_angle_x",
    "delta_axis_angle_y",
    "delta_axis_angle_z",
    "gripper",
)
OBJECT_POSE_NAMES = tuple(pose_names(scene.OBJECT_NAMES))
MIN_IMAGE_SIZE, MAX_IMAGE_SIZE = 128, 256
RENDER_SIZE = 256
# Layouts of objects anywhere are drawn until they show which one is meant and the expert solves one.
MAX_DRAWS = 50
# Share of an object that some camera shows where an instruction tells it from another one.
MIN_SHOWN = 0.5


def axis_angle(rotation: np.ndarray) -> np.ndarray:
    """Axis-angle of a rotation as LIBERO writes it: near (pi, 0, 0) for a hand pointing down, past pi too.

    The quaternion's x is kept positive, so that the vector does not jump while the hand points down or level.

    Args:
        rotation: (3, 3), R_world_ee.

    Returns:
        (3,) axis times angle, angle in [0, 2 pi].
    """
    quat_xyzw = Rotation.from_matrix(rotation).as_quat()
    if quat_xyzw[0] < 0:
        quat_xyzw = -quat_xyzw
    norm = float(np.linalg.norm(quat_xyzw[:3]))
    if norm < 1e-9:
        return np.zeros(3)
    return quat_xyzw[:3] / norm * 2.0 * np.arctan2(norm, quat_xyzw[3])


class TabletopEnv(gym.Env):
    """One task on the tabletop.

    Observation: "pixels" (front, side, wrist: upright uint8 RGB), "agent_pos" (8,) float32 as `STATE_NAMES`.
    If asked for, also "object_poses" (49,) float32, the simulator's true poses, for oracle ablations only;
    "masks.<camera>" (1, H, W) int32, the simulator's own segmentation with the numbers of
    `scene.OBJECT_LABELS`, for ablations of the segmentation only; "depth.<camera>" (1, H, W) float32, metres
    along the optical axis.
    Action: (7,) in [-1, 1], as in `TabletopSimulator.apply`; 20 actions a second.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 (Gymnasium's)

    def __init__(
        self,
        task: str = "bowl_on_plate",
        episode_length: int | None = None,
        observation_height: int = 256,
        observation_width: int = 256,
        object_poses: bool = False,
        masks: bool = False,
        depth: bool = False,
        episode_log: str | None = None,
        render_mode: str = "rgb_array",
    ) -> None:
        super().__init__()
        for label, size in (
            ("observation_height", observation_height),
            ("observation_width", observation_width),
        ):
            if not MIN_IMAGE_SIZE <= size <= MAX_IMAGE_SIZE:
                raise ValueError(f"{label} must lie in [{MIN_IMAGE_SIZE}, {MAX_IMAGE_SIZE}], got {size}")
        if episode_length is not None and episode_length <= 0:
            raise ValueError(f"episode_length must be positive, got {episode_length}")
        (self.task,) = select_tasks(task)
        self.task_description = ANY_TASK[self.task].instruction
        self._max_episode_steps = episode_length or ANY_TASK[self.task].max_steps
        self.render_mode = render_mode
        self._size = (observation_height, observation_width)
        self._with_object_poses = object_poses
        self._with_masks, self._with_depth = masks, depth
        self._episode_log = episode_log
        self._seed: int | None = None
        self._simulator: TabletopSimulator | None = None
        self._steps = 0
        self._held = 0
        image = spaces.Box(0, 255, (*self._size, 3), np.uint8)
        entries: dict[str, spaces.Space] = {
            "pixels": spaces.Dict(dict.fromkeys(scene.CAMERA_NAMES, image)),
            "agent_pos": spaces.Box(-np.inf, np.inf, (len(STATE_NAMES),), np.float32),
        }
        if object_poses:
            entries["object_poses"] = spaces.Box(-np.inf, np.inf, (len(OBJECT_POSE_NAMES),), np.float32)
        layer = (1, *self._size)
        for name in scene.CAMERA_NAMES:
            if masks:
                entries[f"masks.{name}"] = spaces.Box(0, len(scene.OBJECT_NAMES), layer, np.int32)
            if depth:
                entries[f"depth.{name}"] = spaces.Box(0, np.inf, layer, np.float32)
        self.observation_space = spaces.Dict(entries)
        self.action_space = spaces.Box(-1.0, 1.0, (len(ACTION_NAMES),), np.float32)

    @property
    def simulator(self) -> TabletopSimulator:
        """The physics behind this environment; made on first use, in the process that uses it."""
        if self._simulator is None:
            setting = ANY_TASK[self.task].setting
            self._simulator = TabletopSimulator(setting.others if setting is not None else ())
        return self._simulator

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[dict, dict[str, Any]]:
        """Draw a new layout from the seed; the options are those of Gymnasium and are not used."""
        super().reset(seed=seed)
        self._seed = seed
        self.simulator.reset(self._sample_layout())
        self._steps = self._held = 0
        return self._observe(), self._info("running")

    def _sample_layout(self) -> Layout:
        task, rng = ANY_TASK[self.task], self.np_random
        if task.setting is None:
            return sample_layout(rng, task.has_room)
        if not task.setting.is_anywhere:
            return sample_with_second(rng, task.setting.twin, task.setting.is_clear)
        # Which of two is meant is told by looking, and what stands in the way between two places by trying.
        for _ in range(MAX_DRAWS):
            layout = sample_anywhere(rng, task.setting, task.parts)
            self.simulator.reset(layout)
            told = (task.setting.twin, scene.second(task.setting.twin))
            is_told = min(self.simulator.shown_share(name) for name in told) >= MIN_SHOWN
            if is_told and expert_solves(self.simulator, self.task):
                return layout
        raise LayoutError(
            f"none of {MAX_DRAWS} layouts of {self.task} can be told and is solved by its expert"
        )

    def step(self, action: np.ndarray) -> tuple[dict, float, bool, bool, dict[str, Any]]:
        """Apply one action and render; see :meth:`advance`."""
        reward, terminated, truncated, info = self.advance(action)
        return self._observe(), reward, terminated, truncated, info

    def advance(self, action: np.ndarray) -> tuple[float, bool, bool, dict[str, Any]]:
        """Apply one action, rendering nothing; success has to hold for `SUCCESS_HOLD_STEPS` steps in a row.

        Returns:
            Reward, terminated, truncated and info, as Gymnasium means them.

        Raises:
            ValueError: The action has the wrong shape or is not finite.
        """
        action = np.asarray(action, dtype=np.float64)
        if action.shape != (len(ACTION_NAMES),) or not np.isfinite(action).all():
            raise ValueError(
                f"action must be {len(ACTION_NAMES)} finite numbers, got shape {action.shape}: {action}"
            )
        self.simulator.apply(np.clip(action, -1.0, 1.0))
        self._steps += 1
        if self.simulator.is_unstable():
            return 0.0, True, False, self._info("unstable")
        self._held = self._held + 1 if ANY_TASK[self.task].is_done(self.simulator) else 0
        if self._held >= SUCCESS_HOLD_STEPS:
            return 1.0, True, False, self._info("success")
        truncated = self._steps >= self._max_episode_steps
        return 0.0, False, truncated, self._info("time_limit" if truncated else "running")

    def _info(self, status: str) -> dict[str, Any]:
        if status != "running" and self._episode_log is not None:
            self._append_to_log(status)
        return {"is_success": status == "success", "status": status, "unstable": status == "unstable"}

    def _append_to_log(self, status: str) -> None:
        """One JSON object a line: lerobot-eval keeps success alone, not steps nor how an episode ended."""
        line = {
            "task": self.task,
            "seed": self._seed,
            "steps": self._steps,
            "success": status == "success",
            "status": status,
        }
        # A single write in append mode, so that the lines of several processes never mix.
        with open(self._episode_log, "ab", buffering=0) as log:  # type: ignore[arg-type]
            log.write((json.dumps(line) + "\n").encode())

    def _observe(self) -> dict[str, Any]:
        observation: dict[str, Any] = {
            "pixels": {name: self.simulator.render(name, *self._size) for name in scene.CAMERA_NAMES},
            "agent_pos": self.state(),
        }
        if self._with_object_poses:
            observation["object_poses"] = self.object_pose_vector()
        for name in scene.CAMERA_NAMES:
            if self._with_masks:
                observation[f"masks.{name}"] = self.simulator.render_labels(name, *self._size)[None]
            if self._with_depth:
                observation[f"depth.{name}"] = self.simulator.render_depth(name, *self._size)[None]
        return observation

    def state(self) -> np.ndarray:
        """(8,) float32, as in `STATE_NAMES`: ee position (m), ee axis-angle (rad), finger positions (m)."""
        pose = self.simulator.ee_pose()
        return np.concatenate(
            [pose[:3, 3], axis_angle(pose[:3, :3]), self.simulator.finger_positions()]
        ).astype(np.float32)

    def object_pose_vector(self) -> np.ndarray:
        """(49,) float32, as in `OBJECT_POSE_NAMES`: position (m) and quat_wxyz (w >= 0) per object."""
        return pose_vector(self.simulator.object_poses()).astype(np.float32)

    def render(self) -> np.ndarray:
        """The front view, 256 x 256 RGB."""
        return self.simulator.render("front", RENDER_SIZE, RENDER_SIZE)

    def close(self) -> None:
        """Free the renderers; the environment can be reset again afterwards."""
        if self._simulator is not None:
            self._simulator.close()
            self._simulator = None
