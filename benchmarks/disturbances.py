"""What can go wrong on the tabletop: objects are displaced or dropped, cameras moved."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from benchmarks.worlds import TabletopWorld
from lerobot_openspm.envs.tabletop import placement as layout
from lerobot_openspm.envs.tabletop import scene
from lerobot_openspm.envs.tabletop.simulator import TabletopSimulator
from lerobot_openspm.envs.tabletop.tasks import TASKS
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.camera import Camera
from lerobot_openspm.language.instruction import parse_instruction

MAX_TRIES = 10_000
MAX_CAMERA_SHIFT_M, MAX_CAMERA_TURN_DEG = 0.10, 10.0


# Tasks in which something is grasped, and what.
GRASPED = {
    name: next(object_ for object_ in scene.MOVABLE_NAMES if object_ in sub_task.target.split())
    for name, task in TASKS.items()
    for sub_task in parse_instruction(task.instruction)
    if sub_task.operation == "put"
}


@dataclass
class Disturbance:
    """Moves the object that is to be grasped 5 to 15 cm away, once.

    Attributes:
        world: Where.
        kind: ``"displaced"`` moves it as the hand comes near it for the first time; ``"dropped"`` takes it
            out of the hand after it was lifted.
        rng: Decides how near or how high, and where to.
        step: When it happened; None while it has not.
    """

    world: TabletopWorld
    kind: str
    rng: np.random.Generator
    step: int | None = None

    def __post_init__(self) -> None:
        self._name = GRASPED[self.world.env.task]
        simulator = self.world.env.simulator
        self._start = simulator.object_poses()[self._name]
        self._near_m = self.rng.uniform(0.16, 0.30)
        self._lifted_m = self.rng.uniform(0.03, 0.08)

    def __call__(self, step: int) -> None:
        """Interfere if the moment has come."""
        if self.step is None and self._is_time():
            self.world.env.simulator.put(self._name, self._elsewhere())
            self.step = step

    def _is_time(self) -> bool:
        simulator = self.world.env.simulator
        at, hand = simulator.object_poses()[self._name][:3, 3], simulator.ee_pose()[:3, 3]
        held = "hand" in simulator.touching(self._name)
        if self.kind == "dropped":
            return held and bool(at[2] - self._start[2, 3] > self._lifted_m)
        return not held and bool(np.linalg.norm(at - hand) < self._near_m)

    def _elsewhere(self) -> np.ndarray:
        """A free place on the table, 5 to 15 cm away as seen from above, turned as before."""
        simulator = self.world.env.simulator
        poses = simulator.object_poses()
        placed = {name: layout.Placement(T[0, 3], T[1, 3], float(se3.yaw_of(T))) for name, T in poses.items()}
        here = placed[self._name]
        for _ in range(MAX_TRIES):
            distance, angle = self.rng.uniform(0.05, 0.15), self.rng.uniform(0, 2 * math.pi)
            there = layout.Placement(
                here.x + distance * math.cos(angle), here.y + distance * math.sin(angle), here.yaw
            )
            if layout.is_admissible({**placed, self._name: there}):
                return se3.from_yaw([there.x, there.y, self._start[2, 3]], there.yaw)
        raise layout.LayoutError(f"no free place for the {self._name} within 15 cm in {MAX_TRIES} tries")


def move_cameras(
    simulator: TabletopSimulator, cameras: Mapping[str, Camera], rng: np.random.Generator
) -> dict[str, Camera]:
    """Put the cameras that are fixed in the world up to 10 cm and 10 degrees elsewhere.

    Returns:
        The calibration of where they are now.
    """
    moved = dict(cameras)
    for key, camera in cameras.items():
        if camera.mount != "world":
            continue
        axis, way = rng.standard_normal((2, 3))
        turn = np.deg2rad(rng.uniform(0, MAX_CAMERA_TURN_DEG)) * axis / np.linalg.norm(axis)
        shift = rng.uniform(0, MAX_CAMERA_SHIFT_M) * way / np.linalg.norm(way)
        T_world_cam = se3.apply_increment(camera.T_mount_cam, np.concatenate([shift, turn]))
        simulator.place_camera(key.rsplit(".", 1)[1], T_world_cam)
        moved[key] = replace(camera, T_mount_cam=T_world_cam)
    return moved
