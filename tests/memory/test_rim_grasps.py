"""A round thing that was never grasped is taken by its rim, as another round one was by its own."""

from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import DOWN, entry, hand_pose, key_pose, pick_and_place, planned

from lerobot_openspm.control.transfer import transfer
from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.language.instruction import read_task
from lerobot_openspm.memory.compose import plan_parts
from lerobot_openspm.memory.entry import Anchor
from lerobot_openspm.memory.looks import Looks
from lerobot_openspm.types import Symmetry

BOWL, PLATE = (0.05, 0.06), (0.07, 0.02)  # radius and height of the rims


def ring(radius, height):
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), np.full(60, height)], axis=1)


ROUND = Symmetry(np.zeros(2), 0.0)
LOOKS = Looks(
    {
        "bowl": np.concatenate([ring(*BOWL), ring(0.03, 0.0)]),
        "plate": np.concatenate([ring(*PLATE), ring(0.03, 0.0)]),
    },
    {"bowl": ROUND, "plate": ROUND},
)
# The fingers open across the rim on the side of y, 1 cm below its top.
AT_RIM = se3.transform(DOWN, np.array([0.0, BOWL[0], BOWL[1] - 0.01]))


def by_the_rim(T_grasp=AT_RIM, opening=0.004):
    above = se3.from_yaw([0.0, 0.0, 0.1], 0.0) @ T_grasp
    _, _, _, _, *placing = pick_and_place("bowl", "stove")
    return entry(
        "put the bowl on the stove",
        (
            key_pose("bowl", above, "approach"),
            key_pose("bowl", T_grasp, "grasp", closed=True, opening=opening),
            key_pose("bowl", above, "lift", closed=True, opening=opening),
            *placing,
        ),
        {"bowl": se3.from_yaw([0.1, 0.2, 0.0], 0.4), "stove": se3.from_yaw([0.4, 0.0, 0.0], 0.0)},
    )


PUSHED = entry(
    "push the plate to the front of the stove",
    (
        key_pose("plate", hand_pose(-0.1, 0.0, 0.02), "approach"),
        key_pose("stove", hand_pose(-0.2, 0, 0.02), "push"),
    ),
    {"plate": se3.from_yaw([-0.1, 0.0, 0.0], -0.7), "stove": np.eye(4)},
)
ASKED = read_task("put the plate on the stove")


def carried_out(bowl, looks=LOOKS):
    return plan_parts("put the plate on the stove", ASKED, [bowl, PUSHED], looks=looks)


def test_the_hand_is_at_the_other_rim_as_it_was_at_the_one_shown():
    bowl = by_the_rim()
    ((only,),) = carried_out(bowl)
    assert only.sources == (bowl, bowl)
    assert (only.entry.key.sub_tasks[0].target, only.entry.carried) == ("plate", {0: "plate"})
    shown = transfer(bowl, bowl.object_poses, {}, hand_pose(0, 0, 0.3))
    poses = {"plate": PUSHED.object_poses["plate"], "stove": np.eye(4)}
    targets = transfer(only.entry, poses, {}, hand_pose(0, 0, 0.3))
    at, shown_at = ({one.key_pose.phase: one.T_world_ee for one in all_} for all_ in (targets, shown))
    out = at["grasp"][:3, 3] - poses["plate"][:3, 3]
    shown_out = shown_at["grasp"][:3, 3] - bowl.object_poses["bowl"][:3, 3]
    assert np.linalg.norm(out[:2]) == pytest.approx(PLATE[0], abs=1e-3)
    assert out[2] == pytest.approx(PLATE[1] - 0.01, abs=1e-6)
    assert np.allclose(out[:2] / np.linalg.norm(out[:2]), shown_out[:2] / np.linalg.norm(shown_out[:2]))
    assert np.allclose(at["grasp"][:3, :3], shown_at["grasp"][:3, :3])


def test_it_is_carried_higher_because_its_far_side_hangs_down():
    ((only,),) = carried_out(by_the_rim())
    lift = next(one for one in only.entry.key_poses if one.phase == "lift")
    grasp = next(one for one in only.entry.key_poses if one.phase == "grasp")
    assert lift.T_obj_ee[2, 3] - grasp.T_obj_ee[2, 3] == pytest.approx(0.1 + PLATE[0], abs=1e-3)


@pytest.mark.parametrize(
    "bowl",
    [
        by_the_rim(opening=0.04),  # around something thick
        by_the_rim(se3.transform(DOWN, np.array([0.0, 0.01, 0.05]))),  # at its middle
        by_the_rim(AT_RIM @ se3.from_yaw([0.0, 0.0, 0.0], np.pi / 2)),  # along the rim, not across it
        by_the_rim(se3.from_yaw([0.0, 0.0, 0.03], 0.0) @ AT_RIM),  # above it
    ],
)
def test_other_grasps_are_none_by_the_rim(bowl):
    with pytest.raises(InstructionError, match="no demonstration takes hold of the plate"):
        carried_out(bowl)


def test_what_is_not_known_to_be_round_has_no_rim():
    corners = Looks(LOOKS.points, {"bowl": ROUND, "plate": replace(ROUND, turn=np.pi)})
    for looks in (corners, Looks(LOOKS.points, {"bowl": ROUND}), Looks({}, LOOKS.symmetries)):
        with pytest.raises(InstructionError, match="no demonstration takes hold of the plate"):
            carried_out(by_the_rim(), looks)
    with pytest.raises(InstructionError, match="no demonstration takes hold of the plate"):
        planned("put the plate on the stove", [by_the_rim(), PUSHED])


def test_of_two_round_things_that_fit_equally_it_is_asked_back_which():
    pushes = [
        entry(
            f"push the {color} plate to the front of the stove",
            tuple(
                replace(one, anchor=Anchor(f"{color} plate", f"{color} plate"))
                if one.anchor.place == "plate"
                else one
                for one in PUSHED.key_poses
            ),
            {f"{color} plate": PUSHED.object_poses["plate"], "stove": np.eye(4)},
        )
        for color in ("red", "white")
    ]
    names = {"bowl": "bowl", "red plate": "plate", "white plate": "plate"}
    looks = Looks({name: LOOKS.points[one] for name, one in names.items()}, dict.fromkeys(names, ROUND))
    known = [by_the_rim(), *pushes]
    with pytest.raises(InstructionError, match="which one is meant, the red plate or the white plate"):
        plan_parts("put the plate on the stove", ASKED, known, looks=looks)
    ((one, *_),) = plan_parts("…", read_task("put the white plate on the stove"), known, looks=looks)
    assert one.entry.key.sub_tasks[0].target == "white plate"
