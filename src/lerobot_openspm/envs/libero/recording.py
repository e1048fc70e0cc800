"""Recording LIBERO's experts in the layout of the public LIBERO dataset."""

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lerobot_openspm.envs.libero.calibration import calibration_document
from lerobot_openspm.envs.libero.experts import expert_actions
from lerobot_openspm.envs.libero.simulator import CAMERAS, OBJECTS, LiberoSimulator, tasks
from lerobot_openspm.envs.recording import (
    OBJECT_POSES,
    Names,
    RecordedEpisode,
    Recorder,
    pose_names,
    pose_vector,
)

# An expert that takes longer than the policy may is no use as a demonstration.
MAX_STEPS = 300
# LIBERO ends an episode when its goal first holds, often in mid-motion: a demonstration that ended there too
# would tell a policy to stop at the very threshold.
STEPS_AFTER_SUCCESS = 10


class LiberoSource:
    """The suite libero_goal, see `Source`."""

    robot_type = "panda"
    cameras = tuple(CAMERAS)

    @property
    def names(self) -> Mapping[str, Names]:
        """See `Source`."""
        # The public dataset's names. Its "roll, pitch, yaw" are an axis-angle.
        return {
            "observation.state": {"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper", "gripper"]},
            "action": {"motors": ["x", "y", "z", "roll", "pitch", "yaw", "gripper"]},
            OBJECT_POSES: pose_names(OBJECTS),
        }

    def tasks(self, selection: str) -> list[str]:
        """See `Source`."""
        known = list(tasks())
        if selection in ("all", "libero_goal"):
            return known
        names = [name.strip() for name in selection.split(",")]
        if unknown := [name for name in names if name not in known]:
            raise ValueError(
                f"libero_goal has no tasks {unknown}, expected all or some of {', '.join(known)}"
            )
        return names

    def all_tasks(self) -> Sequence[str]:
        """See `Source`."""
        return list(tasks())

    def record(self, task: str, seed: int, height: int, width: int) -> RecordedEpisode:
        """See `Source`. The episode goes on a little beyond success, as people's do."""
        if height != width:
            raise ValueError(f"LIBERO's images are recorded square, got {height} x {width}")
        simulator = _simulator(task, height)
        simulator.reset(seed)
        recorder, steps_left = Recorder(), MAX_STEPS
        success = False
        for action in expert_actions(simulator, task, np.random.default_rng(seed)):
            columns = {
                "observation.state": simulator.state(),
                "action": action,
                OBJECT_POSES: pose_vector(simulator.object_poses()),
            }
            recorder.add(simulator.images(), columns)
            steps_left -= 1
            if simulator.step(action) and not success:
                success, steps_left = True, min(steps_left, STEPS_AFTER_SUCCESS)
            if steps_left == 0:
                break
        status = "success" if success else "failed"
        return recorder.episode(task, simulator.instruction, seed, success, status)

    def calibration(self, height: int, width: int) -> dict[str, Any]:
        """See `Source`."""
        return calibration_document(height, width)


@functools.lru_cache(maxsize=1)
def _simulator(task: str, image_size: int) -> LiberoSimulator:
    return LiberoSimulator(task, image_size)
