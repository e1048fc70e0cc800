from dataclasses import replace

import pytest
from tests.memory.builders import entry, key_pose, pick_and_place
from tests.memory.memories import a_memory
from tests.memory.old_format import save_version_4

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.memory import read_memory
from lerobot_openspm.memory.old_versions import sub_tasks_of_phases

PUT = ["approach", "grasp", "lift", "pre-place", "place", "release"]
OPEN = ["approach", "approach", "grasp", "open", "release", "retreat"]


@pytest.mark.parametrize(
    ("phases", "n", "expected"),
    [
        (PUT, 1, [0] * 6),
        ([*PUT, "retreat", "retreat"], 2, [0] * 8),
        ([*OPEN, *PUT], 2, [0] * 6 + [1] * 6),
        ([*PUT, *PUT, "retreat"], 2, [0] * 6 + [1] * 7),
        (["approach", "push", "retreat", "approach", "push"], 2, [0, 0, 0, 1, 1]),
        (["approach", "grasp", "turn", "release", "retreat", *PUT, *OPEN], 3, [0] * 5 + [1] * 6 + [2] * 6),
        # An instruction that names fewer than were shown.
        ([*PUT, *PUT], 1, [0] * 12),
    ],
)
def test_a_sub_task_ends_with_the_hand_letting_go_and_leaving(phases, n, expected):
    assert sub_tasks_of_phases(phases, n) == expected


def test_the_sub_tasks_of_an_old_memorys_key_poses_are_derived(tmp_path):
    instruction = "open the top drawer and put the bowl on the plate"
    T = se3.transform(se3.exp_so3([0.1, 0.2, 0.3]), [0.1, 0.0, 0.2])
    opening = [key_pose("cabinet", T, phase) for phase in OPEN]
    putting = [replace(pose, sub_task=1) for pose in pick_and_place()]
    made = entry(instruction, [*opening, *putting])
    save_version_4(a_memory(entries=(made,)), tmp_path)
    loaded = read_memory(tmp_path).entries[0]
    assert [pose.sub_task for pose in loaded.key_poses] == [0] * 6 + [1] * 8
