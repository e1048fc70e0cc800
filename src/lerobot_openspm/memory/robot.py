"""What the memory knows of the robot that gave the demonstrations."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.arm import Arm
from lerobot_openspm.geometry.se3 import Array


@dataclass(frozen=True)
class RobotModel:
    """What the demonstrations tell of the robot, so that nothing about it is written into the code.

    Attributes:
        close_command: Gripper command that closes.
        open_command: Gripper command that opens.
        open_width: Opening of the open gripper, in the units of the state.
        metres_per_action: Displacement per unit of commanded position increment and step.
        radians_per_action: Rotation per unit of commanded rotation increment and step.
        metres_per_step: Usual speed of the moving hand, rotation included as in :func:`se3.distance`.
        workspace: Lowest and highest hand position ``(2, 3)`` in the world.
        arm: Its kinematics; None where they are not known.
    """

    close_command: float
    open_command: float
    open_width: float
    metres_per_action: float
    radians_per_action: float
    metres_per_step: float
    workspace: Array
    arm: Arm | None = None

    def covering(self, other: RobotModel) -> RobotModel:
        """This robot with the workspace of both, and the newer one's arm if it has one.

        Raises:
            MemoryFormatError: The other one's gripper takes other commands, so it is another robot.
        """
        # Gains are not compared: a task that never turns the hand tells nothing of how it turns.
        for name in ("close_command", "open_command"):
            ours, theirs = getattr(self, name), getattr(other, name)
            if not np.isclose(ours, theirs, rtol=0.2, atol=1e-3):
                raise MemoryFormatError(
                    f"the dataset's {name} is {theirs:.4g}, the memory's {ours:.4g}: it was recorded with "
                    "another robot or controller and cannot be appended; use --policy.memory_update=rebuild"
                )
        low = np.minimum(self.workspace[0], other.workspace[0])
        high = np.maximum(self.workspace[1], other.workspace[1])
        return replace(self, workspace=np.stack([low, high]), arm=other.arm or self.arm)

    def closed(self, gripper_commands: Array) -> NDArray[np.bool_]:
        """Which of the commands ``(...)`` close the gripper."""
        middle = (self.close_command + self.open_command) / 2
        return np.asarray((gripper_commands - middle) * (self.close_command - middle) > 0)

    @property
    def gains(self) -> Array:
        """How far the hand moves per unit of each of the six numbers ``(6,)`` of an action."""
        return np.array([self.metres_per_action] * 3 + [self.radians_per_action] * 3)

    def moved(self, T_world_ee: Array, action: Array) -> Array:
        """Where an action ``(7,)`` takes a hand pose ``(4, 4)``."""
        return se3.apply_increment(T_world_ee, action[:6] * self.gains)

    def command(self, closed: bool) -> float:
        """The gripper command that closes or opens."""
        return self.close_command if closed else self.open_command
