"""Episodes drawn by hand: paths of a hand, fingers that close around something, human pauses and noise."""

import numpy as np
from tests.memory.builders import DOWN

from lerobot_openspm.geometry import se3
from lerobot_openspm.mining.signals import Episode

OPEN, HELD = 0.08, 0.03
METRES_PER_ACTION, RADIANS_PER_ACTION = 0.01, 0.1
SPEED = 0.01  # metres a step
FINGER_SPEED = 0.0125  # metres a step


class Drawer:
    """Draws an episode leg by leg and notes the frames that matter."""

    def __init__(self, position, yaw=0.0, close_command=1.0):
        self.close_command = close_command
        self.closed, self.held = False, HELD
        self.position, self.yaw = np.array(position, float), yaw
        self.poses, self.openings, self.commands = [self._pose()], [OPEN], []

    @property
    def frame(self):
        return len(self.poses) - 1

    def _pose(self):
        return se3.from_yaw(self.position, self.yaw) @ se3.transform(DOWN, np.zeros(3))

    def _step(self):
        goal = self.held if self.closed else OPEN
        last = self.openings[-1]
        self.openings.append(last + np.clip(goal - last, -FINGER_SPEED, FINGER_SPEED))
        self.commands.append(self.close_command if self.closed else -self.close_command)
        self.poses.append(self._pose())

    def move(self, position, yaw=None, speed=SPEED):
        goal, turn = np.array(position, float), (self.yaw if yaw is None else yaw) - self.yaw
        length = np.linalg.norm(goal - self.position) + 0.1 * abs(turn)
        n = max(1, int(np.ceil(length / speed)))
        start, heading = self.position, self.yaw
        for k in range(1, n + 1):
            self.position, self.yaw = start + k / n * (goal - start), heading + k / n * turn
            self._step()
        return self.frame

    def wait(self, n):
        for _ in range(n):
            self._step()
        return self.frame

    def grip(self, closed, n=10, held=HELD):
        self.closed, self.held = closed, held
        return self.wait(n)

    def episode(self, index=0, task="put the bowl on the plate", from_index=0, noise=0.0, seed=0):
        T = np.stack(self.poses)
        rng = np.random.default_rng(seed)
        if noise:
            T = se3.apply_increment(T, rng.normal(size=(len(T), 6)) * ([noise] * 3 + [noise * 5] * 3))
        steps = se3.increment(np.stack(self.poses)[:-1], np.stack(self.poses)[1:])
        gains = [METRES_PER_ACTION] * 3 + [RADIANS_PER_ACTION] * 3
        actions = np.column_stack([steps / gains, self.commands])
        actions = np.vstack([actions, [*np.zeros(6), self.commands[-1]]])
        return Episode(index, task, from_index, T, np.array(self.openings), actions)


def pick_and_place(bowl=(0.1, -0.2), plate=(0.05, 0.2), yaw=0.0, pause=0, detour=False, **drawer):
    """Above the bowl, down, grasp, up, above the plate, down, release, up; with the frames of each."""
    d = Drawer([0.0, 0.0, 0.3], **drawer)
    at = {}
    if detour:
        d.move([-0.2, 0.1, 0.35])
    d.wait(pause)
    at["above"] = d.move([*bowl, 0.14], yaw)
    d.wait(pause)
    at["arrive"] = d.move([*bowl, 0.02])
    d.wait(pause)
    at["touch"] = d.frame
    at["grasp"] = d.grip(True)
    at["lift"] = d.move([*bowl, 0.16])
    d.wait(pause)
    at["pre-place"] = d.move([*plate, 0.16])
    d.wait(pause)
    d.move([*plate, 0.05])
    at["place"] = d.frame
    d.wait(pause)
    at["let go"] = d.frame
    at["release"] = d.grip(False)
    at["retreat"] = d.move([*plate, 0.2])
    return d, at


def push(plate=(0.1, -0.1), **drawer):
    """Closes the fingers in the air, sinks behind the plate, pushes it, rises."""
    d = Drawer([0.0, 0.0, 0.3], **drawer)
    at = {"close": d.wait(6)}
    d.grip(True, held=0.0)
    d.move([plate[0], plate[1], 0.15])
    at["approach"] = d.move([plate[0], plate[1], 0.02])
    at["push"] = d.move([plate[0], plate[1] + 0.15, 0.02])
    at["retreat"] = d.move([plate[0], plate[1] + 0.15, 0.2])
    return d, at


def pull(handle=(0.2, 0.0, 0.12), length=0.15):
    """Takes a handle, pulls it level, lets go, backs off."""
    d = Drawer([-0.1, 0.0, 0.3])
    x, y, z = handle
    d.move([x - 0.1, y, z])
    at = {"approach": d.move([x, y, z])}
    at["grasp"] = d.grip(True)
    at["open"] = d.move([x - length, y, z])
    at["release"] = d.grip(False)
    at["retreat"] = d.move([x - length - 0.12, y, z + 0.1])
    return d, at


def turn(knob=(0.1, 0.1, 0.05), angle=np.pi / 2):
    """Takes a knob from above, turns it, lets go, rises."""
    d = Drawer([0.0, -0.1, 0.3])
    x, y, z = knob
    d.move([x, y, z + 0.12])
    at = {"approach": d.move([x, y, z])}
    at["grasp"] = d.grip(True)
    at["turn"] = d.move([x, y, z], yaw=angle)
    at["release"] = d.grip(False)
    at["retreat"] = d.move([x, y, z + 0.15])
    return d, at
