"""What is noted of episodes, and failed ones sorted by that, by the first rule that fits."""

import numpy as np
import pytest
from benchmarks.episodes import Episode
from benchmarks.libero.failures import KINDS, Grips, counts, failure_kind
from tests.control.acting import HAND, Perception, controller, observe, watch
from tests.memory.builders import entry

PHASES = ["approach", "grasp", "lift", "place", "release"]


@pytest.mark.parametrize(
    ("noted", "off_mm", "expected"),
    [
        ({"status": "not_understood", "contacts": {"plate": 12.0}}, None, "words"),
        ({"status": "object_not_found"}, 30.0, "perception"),
        ({"status": "object_lost", "gripped": False}, 1.0, "perception"),
        ({"status": "camera_fault"}, None, "perception"),
        ({"status": "infeasible"}, 1.0, "reach"),
        ({"status": "no_progress", "gripped": False, "contacts": {"plate": 0.0}}, 25.0, "perception"),
        ({"status": "no_progress", "gripped": True, "contacts": {"plate": 30.0}}, 15.0, "placing"),
        ({"status": "no_progress", "gripped": False, "contacts": {"plate": 0.0}}, 15.0, "grasp"),
        ({"status": "no_progress", "gripped": False}, 15.0, "grasp"),
        ({"status": "running", "gripped": True}, None, "placing"),
        ({"status": "done", "gripped": None}, None, "placing"),
        ({"status": "done"}, 0.0, "placing"),
    ],
)
def test_the_first_rule_that_fits_counts(noted, off_mm, expected):
    assert failure_kind({"contacts": {}, **noted}, off_mm) == expected


def test_every_kind_is_counted():
    assert counts(["grasp", "words", "grasp"]) == {**dict.fromkeys(KINDS, 0), "grasp": 2, "words": 1}


def test_a_grasp_holds_once_the_key_pose_after_it_is_passed():
    grips = Grips()
    assert grips.told() is None
    for index, held in ((0, False), (1, False), (2, False), (3, True), (1, True)):
        grips.note(0, PHASES, index)
        assert grips.told() is held


def test_all_grasps_of_the_present_part_have_to_hold():
    grips = Grips()
    grips.note(0, PHASES * 2, 6)
    assert grips.told() is False
    grips.note(0, PHASES * 2, 8)
    assert grips.told() is True
    grips.note(1, PHASES, 2)
    assert grips.told() is False
    grips.note(2, ["approach", "push"], 1)
    assert grips.told() is None


def test_every_part_has_its_own_attempts_and_seconds_the_last_one_too():
    one = controller()
    observe(one, HAND, Perception(entry().object_poses))
    one.state.attempts = 2
    watch(one, Perception(entry().object_poses), HAND, 10)
    one.state.begin_next_part(one.scene.time_s)
    watch(one, Perception(entry().object_poses), HAND, 6)
    parts = Episode(False, np.zeros((3, 7)), one).told()["parts"]
    assert parts == [{"attempts": 2, "seconds": 0.5}, {"attempts": 0, "seconds": pytest.approx(0.3)}]
