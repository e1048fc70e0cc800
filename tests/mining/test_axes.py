"""Drawers slide along an axis and knobs turn about one: the demonstrations show it, the hand follows it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import hand_pose

from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import parse_instruction
from lerobot_openspm.memory.entry import Anchor, Axis
from lerobot_openspm.mining.anchors import Demonstration, consensus
from lerobot_openspm.mining.axes import constrained_axes
from lerobot_openspm.mining.key_poses import KeyPose


def key_pose(T, phase, contact):
    return KeyPose(10 * contact, T, phase, 1.0, True, 0.02, 10, phase == "grasp", contact)


def demonstration(rng, phase, yaw, amount):
    """The cabinet stands turned by `yaw`; its drawer slides along its x axis, its knob turns about z."""
    T_world_obj = se3.from_yaw([*rng.uniform(-0.1, 0.1, 2), 0.0], yaw)
    grasp = T_world_obj @ hand_pose(0.1, 0.0, 0.2) @ se3.transform(np.eye(3), rng.normal(0, 0.002, 3))
    local = se3.inverse(T_world_obj) @ grasp
    if phase == "open":
        moved = se3.transform(local[:3, :3], local[:3, 3] + [amount, 0.0, 0.0])
    else:
        moved = se3.transform(se3.exp_so3(np.array([0.0, 0.0, amount])) @ local[:3, :3], local[:3, 3])
    noise = se3.transform(np.eye(3), rng.normal(0, 0.002, 3))
    poses = (key_pose(grasp, "grasp", 0), key_pose(T_world_obj @ moved @ noise, phase, 1))
    return Demonstration(poses, {"cabinet": T_world_obj})


@pytest.mark.parametrize(
    ("instruction", "phase", "kind", "amounts", "direction"),
    [
        ("open the top drawer of the cabinet", "open", "slide", (0.15, 0.12, 0.16), (1.0, 0.0, 0.0)),
        ("turn on the cabinet", "turn", "turn", (1.0, 0.9, 1.2), (0.0, 0.0, 1.0)),
        ("turn on the cabinet", "turn", "turn", (-1.0, -0.9, -1.2), (0.0, 0.0, -1.0)),
    ],
)
def test_the_direction_is_common_and_the_amount_each_ones_own(instruction, phase, kind, amounts, direction):
    rng = np.random.default_rng(0)
    shown = [demonstration(rng, phase, yaw, a) for yaw, a in zip((0.4, -0.3, 1.1), amounts, strict=True)]
    anchors = consensus(shown, parse_instruction(instruction))
    found = constrained_axes(shown, anchors)
    for axes, amount in zip(found, amounts, strict=True):
        ((role, axis),) = axes.items()
        assert role[1] == phase
        assert axis.kind == kind
        assert_allclose(axis.direction, direction, atol=0.03)
        assert_allclose(np.linalg.norm(axis.direction), 1)
        assert_allclose(axis.amount, abs(amount), atol=0.01)


def test_what_hardly_moved_shows_no_axis():
    shown = [demonstration(np.random.default_rng(0), "open", 0.0, 0.01)]
    anchors = consensus(shown, parse_instruction("open the top drawer of the cabinet"))
    assert constrained_axes(shown, anchors) == [{}]


def test_a_hand_follows_a_slide_without_turning_and_a_turn_without_moving():
    T = hand_pose(0.1, 0.2, 0.3, 0.4)
    slid = Axis("slide", np.array([0.0, -1.0, 0.0]), 0.15).follow(T)
    assert_allclose(slid[:3, 3], [0.1, 0.05, 0.3])
    assert_allclose(slid[:3, :3], T[:3, :3])
    turned = Axis("turn", np.array([0.0, 0.0, 1.0]), 0.5).follow(T)
    assert_allclose(turned, hand_pose(0.1, 0.2, 0.3, 0.9), atol=1e-12)


def test_anchors_without_the_object_in_the_scene_are_left_out():
    shown = demonstration(np.random.default_rng(0), "open", 0.0, 0.15)
    bare = Demonstration(shown.key_poses, {})
    anchors = {(1, "open", 0): Anchor("cabinet", "cabinet")}
    assert constrained_axes([bare], anchors) == [{}]
