"""A camera that fails: gone without, then waited for, then given up."""

import pytest
from tests.control.acting import HAND, STEP_S, Perception, controller, observe, watch
from tests.memory.builders import entry

from lerobot_openspm.control.scene import BLIND_S, GIVE_UP_S, LOOK_AGAIN_S
from lerobot_openspm.control.state import Status
from lerobot_openspm.types import Fault


def test_a_broken_camera_is_gone_without_for_half_a_second_then_held_still_for_then_given_up(caplog):
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    seconds = 0.0
    while one.state.status in (Status.RUNNING, Status.PAUSED) and seconds < 5:
        perception.faults = {"observation.images.front": Fault("is black or blank", seconds)}
        watch(one, perception, HAND, 1)
        # The clock runs in the camera watch; here it is looked at as soon as there is a fault to see.
        held_still = one.state.status in (Status.PAUSED, Status.CAMERA_FAULT)
        assert held_still == (seconds >= BLIND_S) or seconds < LOOK_AGAIN_S
        seconds += STEP_S
    assert seconds == pytest.approx(GIVE_UP_S + STEP_S)
    assert one.state.status is Status.CAMERA_FAULT
    assert "observation.images.front" in caplog.text
    assert one.executor.next_action(HAND).tolist() == [0.0] * 6 + [-1.0]
    perception.faults = {}
    watch(one, perception, HAND, 50)
    assert one.state.status is Status.CAMERA_FAULT, "a person has to look at it first"


def test_a_camera_that_recovers_in_time_is_forgiven():
    perception, one = Perception(entry().object_poses), controller()
    observe(one, HAND, perception)
    perception.faults = {"observation.images.front": Fault("is frozen", 1.0)}
    watch(one, perception, HAND, 6)
    assert one.state.status is Status.PAUSED
    perception.faults = {}
    watch(one, perception, HAND, 6)
    assert one.state.status is Status.RUNNING
