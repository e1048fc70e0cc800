"""An arm's kinematics in a memory."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from tests.geometry.test_arm import LIBERO
from tests.memory.builders import robot
from tests.memory.memories import a_memory
from tests.memory.memory_files import edit_header

from lerobot_openspm.errors import MemoryFormatError
from lerobot_openspm.geometry.arm import load_arm
from lerobot_openspm.memory.io import read_memory, write_memory


@pytest.fixture
def with_arm(request, tmp_path):
    """A saved memory of a robot whose arm is known."""
    arm = load_arm(request.config.rootpath / LIBERO)
    write_memory(a_memory(robot=robot(arm=arm)), tmp_path)
    return tmp_path, arm


def test_an_arm_is_remembered(with_arm):
    folder, arm = with_arm
    read = read_memory(folder).robot.arm
    assert read is not None
    angles = np.linspace(-1.0, 1.0, 7) - 0.5
    assert_array_equal(read.ee_pose(angles), arm.ee_pose(angles))


@pytest.mark.parametrize(
    ("field", "value", "told"),
    [
        ("limits", [1.0, -1.0], "the lower limit first"),
        ("axis", [0.0, 0.0, 0.0], "a unit vector"),
        ("T_before_joint", np.full((4, 4), 0.5).tolist(), "not rigid"),
        ("limits", [1.0], r"length >= 2 - at `\$\.robot\.arm\.joints\[0\]\.limits"),
    ],
)
def test_an_arm_that_is_none_is_refused(with_arm, field, value, told):
    folder, _ = with_arm
    edit_header(folder, lambda header: header["robot"]["arm"]["joints"][0].update({field: value}))
    with pytest.raises(MemoryFormatError, match=told):
        read_memory(folder)


def test_joints_that_hardly_turn_stop_the_hand_and_not_the_program(with_arm):
    folder, arm = with_arm
    stiff = {"limits": [0.5, 0.5 + 1e-12]}
    edit_header(folder, lambda header: [one.update(stiff) for one in header["robot"]["arm"]["joints"]])
    read = read_memory(folder).robot.arm
    assert read is not None
    ((metres, radians),) = read.misses([arm.ee_pose(np.zeros(7) - 0.3)], read.ee_pose(read.middle))
    assert metres > 0.1
    assert radians > 0.1
