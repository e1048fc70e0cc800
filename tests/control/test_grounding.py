import dataclasses

import numpy as np
import pytest
from tests.control.acting import HAND, Perception, controller, observe, planning_context
from tests.memory.builders import entry

from lerobot_openspm.control.grounding import Grounding, demonstrations, references
from lerobot_openspm.control.state import Status
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.compose import Candidate
from lerobot_openspm.memory.entry import MemoryEntry, RetrievalKey
from lerobot_openspm.types import Detections, PoseEstimate, Reference, SubTask

NEXT_TO_RACK = Reference("next to", ("rack",))


def at(x, y):
    return se3.from_yaw([x, y, 0.0], 0.0)


CONTEXT = planning_context()
RACK = at(0.3, 0.3)
NEAR, FAR = at(0.3, 0.18), at(0.0, -0.2)


def seen(T, *others, status=None):
    status = status or ("ambiguous" if others else "found")
    return PoseEstimate(status, T, 1e-6 * np.eye(4), 1.0, others=tuple(others))


def look(grounding, bowl, object_poses=None):
    return grounding.sort_out({"bowl": bowl, "rack": seen(RACK)}, object_poses or {})["bowl"]


@pytest.mark.parametrize("bowl", [seen(NEAR, FAR), seen(FAR, NEAR), seen(FAR, NEAR, status="found")])
def test_the_one_that_the_instruction_tells_is_meant(bowl):
    meant = look(Grounding({"bowl": NEXT_TO_RACK}), bowl)
    assert meant.status == "found"
    np.testing.assert_array_equal(meant.T_world_obj, NEAR)


def test_a_landmark_may_have_been_seen_before():
    estimates = {"bowl": seen(FAR, NEAR)}
    meant = Grounding({"bowl": NEXT_TO_RACK}).sort_out(estimates, {"rack": RACK})["bowl"]
    np.testing.assert_array_equal(meant.T_world_obj, NEAR)


def test_without_a_word_about_it_or_its_landmark_it_stays_ambiguous():
    assert look(Grounding(), seen(FAR, NEAR)).status == "ambiguous"
    assert look(Grounding(), seen(FAR, NEAR, status="found")).status == "ambiguous"
    assert look(Grounding(), seen(FAR)).status == "found"
    estimates = {"bowl": seen(FAR, NEAR)}
    assert Grounding({"bowl": NEXT_TO_RACK}).sort_out(estimates, {})["bowl"].status == "ambiguous"


def test_two_that_fit_as_well_as_one_another_stay_ambiguous():
    mirrored = at(0.3, 0.42)
    assert look(Grounding({"bowl": NEXT_TO_RACK}), seen(NEAR, mirrored)).status == "ambiguous"


def test_the_other_one_is_never_taken_for_it_afterwards():
    grounding = Grounding({"bowl": NEXT_TO_RACK})
    look(grounding, seen(NEAR, FAR))
    assert look(grounding, seen(FAR)).status == "not_found"  # the meant one is behind the hand
    moved = at(0.1, 0.1)
    for bowl in (seen(moved), seen(FAR, moved), seen(moved, FAR)):
        again = look(grounding, bowl)
        assert again.status == "found"
        np.testing.assert_array_equal(again.T_world_obj, moved)


def test_what_the_next_part_means_is_told_anew():
    grounding = Grounding()
    assert grounding.hear({"bowl": NEXT_TO_RACK}) == frozenset()
    look(grounding, seen(NEAR, FAR))
    assert grounding.hear({"bowl": NEXT_TO_RACK}) == frozenset()
    assert look(grounding, seen(FAR)).status == "not_found"
    assert grounding.hear({"bowl": Reference("left")}) == {"bowl"}
    left = look(grounding, seen(NEAR, FAR))
    np.testing.assert_array_equal(left.T_world_obj, FAR)  # -y is left, seen from opposite the robot


def test_references_are_told_by_the_names_of_the_entry():
    asked = SubTask("put", "bowl", "", "on", "dish", Reference("next to", ("shelf",)), Reference("left"))
    entry = MemoryEntry(
        RetrievalKey((SubTask("put", "black bowl", "", "on", "plate"),), ()), "", (), 1.0, 1, ""
    )
    known = {"shelf": "rack"}
    assert references(Candidate(entry, 1.0, (entry,), (asked,)), lambda name: known.get(name, name)) == {
        "black bowl": NEXT_TO_RACK,
        "plate": Reference("left"),
    }


def test_the_objects_that_others_are_told_by_may_go_by_other_names():
    context = dataclasses.replace(
        CONTEXT, yaw_periods=dict.fromkeys(("bowl", "cream cheese box", "wine bottle", "plate"), 0.0)
    )
    said = {
        "box": "cream cheese box",
        "cream cheese": "cream cheese box",
        "bottle": "wine bottle",
        "moon": "moon",
    }
    assert {name: context.object_meant(name) for name in said} == said


def test_the_center_of_the_table_is_the_middle_of_where_the_hand_was():
    grounding = Grounding({"bowl": Reference("center", ("table",))})
    low, high = CONTEXT.robot.workspace
    middle, side = at(*(low + high)[:2] / 2 + 0.03), at(*high[:2])
    estimates = {"bowl": seen(side, middle)}
    np.testing.assert_array_equal(grounding.sort_out(estimates, CONTEXT.surfaces)["bowl"].T_world_obj, middle)


# Where nobody knows the landmark, the demonstrations of that instruction choose.


def shown(*offsets, plate=(0.1, 0.1)):
    """Demonstrations in which the bowl stood at offsets from the plate."""
    return tuple({"bowl": at(plate[0] + x, plate[1] + y), "plate": at(*plate)} for x, y in offsets)


BESIDE_PLATE = shown((0.0, -0.2), (0.01, -0.19), (-0.01, -0.2))


def look_beside_plate(grounding, bowl, plate=(0.1, 0.1)):
    return grounding.sort_out({"bowl": bowl, "plate": seen(at(*plate))}, {})["bowl"]


def test_where_nobody_knows_the_landmark_the_demonstrations_choose():
    grounding = Grounding({"bowl": NEXT_TO_RACK}, {"bowl": BESIDE_PLATE})
    meant, other = at(0.11, -0.11), at(-0.2, 0.2)
    for bowl in (seen(meant, other), seen(other, meant), seen(other, meant, status="found")):
        found = look_beside_plate(Grounding({"bowl": NEXT_TO_RACK}, {"bowl": BESIDE_PLATE}), bowl)
        assert found.status == "found"
        np.testing.assert_array_equal(found.T_world_obj, meant)
    look_beside_plate(grounding, seen(meant, other))
    assert look_beside_plate(grounding, seen(other)).status == "not_found"


def test_words_that_can_be_decided_are_never_overruled():
    # The demonstrations would have it where FAR is.
    grounding = Grounding({"bowl": NEXT_TO_RACK}, {"bowl": ({"bowl": FAR},)})
    np.testing.assert_array_equal(look(grounding, seen(FAR, NEAR)).T_world_obj, NEAR)


@pytest.mark.parametrize("plate", [(0.1, 0.1), (0.1, 0.25), None])
def test_the_center_of_the_table_is_where_demonstrations_of_those_words_show_it(plate):
    where = Reference("center", ("table",))
    low, high = CONTEXT.robot.workspace
    meant, in_the_middle = at(0.13, -0.13), at(*(low + high)[:2] / 2)
    estimates = {"bowl": seen(in_the_middle, meant)} | ({"plate": seen(at(*plate))} if plate else {})
    # Wherever the plate is now that they show beside it.
    for shown_before, expected in (({"bowl": BESIDE_PLATE}, meant), ({}, in_the_middle)):
        grounding = Grounding({"bowl": where}, shown_before, frozenset(CONTEXT.surfaces))
        found = grounding.sort_out(estimates, CONTEXT.surfaces)["bowl"]
        np.testing.assert_array_equal(found.T_world_obj, expected)


def test_only_the_center_of_a_surface_is_told_by_where_it_was_shown():
    meant, other = at(0.0, 0.02), at(0.11, -0.11)  # nearest to the plate, and where it was shown
    for said in (Reference("on", ("plate",)), Reference("center", ("plate",))):
        grounding = Grounding({"bowl": said}, {"bowl": BESIDE_PLATE}, frozenset(CONTEXT.surfaces))
        found = look_beside_plate(grounding, seen(other, meant), (0.0, 0.0))
        np.testing.assert_array_equal(found.T_world_obj, meant)


def test_without_what_they_show_it_beside_the_demonstrations_do_not_choose():
    grounding = Grounding({"bowl": NEXT_TO_RACK}, {"bowl": BESIDE_PLATE})
    assert grounding.sort_out({"bowl": seen(NEAR, FAR)}, {})["bowl"].status == "ambiguous"


def test_what_the_demonstrations_show_is_looked_for():
    grounding = Grounding({"bowl": NEXT_TO_RACK}, {"bowl": BESIDE_PLATE})
    assert set(grounding.landmarks) == {"rack", "bowl", "plate"}


def spoken(where, poses=None, **changes):
    told = SubTask("put", "bowl", "", "on", "plate", where)
    made = entry(object_poses=poses or {"bowl": NEAR, "plate": FAR}, **changes)
    return dataclasses.replace(made, key=dataclasses.replace(made.key, sub_tasks=(told,)))


def test_only_demonstrations_of_that_very_instruction_count_and_only_for_unknown_landmarks():
    same, more = spoken(NEXT_TO_RACK, {"bowl": NEAR}), spoken(NEXT_TO_RACK, {"bowl": FAR})
    others = (spoken(Reference("next to", ("cup",))), spoken(Reference("on", ("rack",))), spoken(None))
    asked = same.key.sub_tasks
    candidates = [Candidate(one, 1.0, (one,), asked) for one in (same, *others, more)]
    found = demonstrations(candidates, str, {"bowl", "plate"})
    assert found == {"bowl": (same.object_poses, more.object_poses)}
    assert demonstrations(candidates, str, {"bowl", "plate", "rack"}) == {}


def test_what_the_next_part_says_replaces_what_was_shown():
    grounding = Grounding()
    grounding.hear({"bowl": NEXT_TO_RACK}, {"bowl": BESIDE_PLATE})
    grounding.hear({"cup": Reference("left")}, {})
    assert grounding.shown == {"bowl": BESIDE_PLATE}
    grounding.hear({"bowl": Reference("left")}, {})
    assert grounding.shown == {}


class TwoBowls(Perception):
    """Sees two bowls that look alike."""

    def _estimate(self, name):
        one = super()._estimate(name)
        if name != "bowl":
            return one
        return dataclasses.replace(one, status="ambiguous", others=(self.object_poses["second bowl"],))


def test_an_instruction_with_an_unknown_landmark_is_acted_by_on_the_one_that_was_shown():
    where = Reference("next to", ("ramekin",))
    instruction = "put the bowl next to the ramekin on the plate"
    known = {"bowl": at(0.0, -0.15), "plate": at(0.1, 0.1)}
    made = spoken(where, known, instruction="put the bowl on the plate")
    made = dataclasses.replace(made, language=instruction)
    one = controller(made, instruction=instruction)
    meant = at(0.02, -0.16)
    perception = TwoBowls({"bowl": at(-0.25, 0.15), "second bowl": meant, "plate": at(0.11, 0.1)})
    observe(one, HAND, perception)
    assert one.state.status is Status.RUNNING
    np.testing.assert_allclose(one.state.plan.object_poses["bowl"], meant)


def test_an_episode_takes_what_was_shown_for_the_center_of_the_table():
    where = Reference("center", ("table",))
    known = {"bowl": at(0.0, -0.15), "plate": at(0.1, 0.1)}
    made = dataclasses.replace(
        spoken(where, known, instruction="put the bowl on the plate"),
        language="put the bowl from the center of the table on the plate",
    )
    one = controller(made, instruction=made.language)
    low, high = CONTEXT.robot.workspace
    middle = at(*(low + high)[:2] / 2)
    observe(one, HAND, TwoBowls({**known, "bowl": middle, "second bowl": known["bowl"]}))
    np.testing.assert_array_equal(one.scene.detections.estimates["bowl"].T_world_obj, known["bowl"])


# The only one of its kind.


@pytest.mark.parametrize(
    ("where", "place", "status"),
    [
        (NEXT_TO_RACK, (0.3, 0.1), "found"),
        (NEXT_TO_RACK, (-0.8, 0.3), "not_found"),
        (Reference("on", ("rack",)), (0.3, -0.4), "not_found"),
        (
            Reference("left of", ("rack",)),
            (0.3, 0.35),
            "found",
        ),  # a little to the right, as seen from opposite
        (Reference("left of", ("rack",)), (0.3, 0.15), "found"),
        (Reference("left of", ("rack",)), (0.3, 0.45), "not_found"),
        (Reference("next to", ("shelf",)), (-0.8, 0.3), "found"),  # nobody sees the shelf
        (Reference("left"), (-0.8, 0.3), "found"),
    ],
)
def test_the_only_one_is_meant_unless_it_plainly_is_elsewhere(where, place, status):
    grounding = Grounding({"bowl": where})
    assert look(grounding, seen(at(*place))).status == status
    told = {} if status == "found" else {"bowl": f"is not {where.relation} the {where.landmarks[0]}"}
    assert grounding.elsewhere == told


@pytest.mark.parametrize(("away_m", "status"), [(0.0, "found"), (0.12, "found"), (0.2, "not_found")])
def test_the_only_one_is_meant_unless_it_is_far_from_where_demonstrations_show_the_one_that_is_meant(
    away_m, status
):
    where, plate = Reference("next to", ("ramekin",)), at(0.2, 0.1)  # nobody knows the ramekin
    grounding = Grounding({"bowl": where}, {"bowl": BESIDE_PLATE})
    there = at(0.2 - away_m, -0.1)
    assert grounding.sort_out({"bowl": seen(there)}, {"plate": plate})["bowl"].status == status
    words = "is far from where the bowl next to the ramekin was shown"
    assert grounding.elsewhere == ({} if status == "found" else {"bowl": words})


def test_the_only_one_is_meant_where_nothing_is_found_that_demonstrations_show():
    grounding = Grounding({"bowl": Reference("next to", ("ramekin",))}, {"bowl": BESIDE_PLATE})
    assert grounding.sort_out({"bowl": seen(at(2.0, 2.0))}, {})["bowl"].status == "found"


@pytest.mark.parametrize(
    ("moved", "displaced", "status"),
    [
        (("box",), (), "found"),
        (("box", "plate"), (), "not_found"),
        (("box", "plate"), ("box", "plate"), "found"),
    ],
)
def test_what_was_moved_itself_tells_little_of_where_it_was_shown(moved, displaced, status):
    marks = {"plate": (0.1, 0.1), "box": (0.3, -0.1)}
    shown_there = tuple(
        {"bowl": at(0.1, -0.1), **{k: at(*place) for k, place in marks.items()}} for _ in "123"
    )
    now = {name: seen(at(x + 0.4 * (name in moved), y)) for name, (x, y) in marks.items()}
    grounding = Grounding({"bowl": Reference("next to", ("ramekin",))}, {"bowl": shown_there})
    meant = grounding.sort_out({"bowl": seen(at(0.1, -0.1)), **now}, {}, displaced)["bowl"]
    assert meant.status == status


def test_the_center_of_the_table_stays_where_it_is_for_the_only_one_too():
    where = Reference("center", ("table",))
    grounding = Grounding({"bowl": where}, {"bowl": BESIDE_PLATE}, frozenset({"table"}))
    moved = {"table": at(0.0, 0.0), "plate": at(0.4, 0.1)}
    assert grounding.sort_out({"bowl": seen(at(0.1, -0.1))}, moved)["bowl"].status == "found"


def test_the_only_one_between_two_is_not_far_behind_both():
    grounding = Grounding({"bowl": Reference("between", ("rack", "cup"))})
    marks = {"cup": at(0.0, 0.0)}
    assert look(grounding, seen(at(0.9, 0.9)), marks).status == "not_found"
    assert look(grounding, seen(at(0.1, 0.2)), marks).status == "found"


def test_once_it_is_told_it_may_be_carried_away():
    grounding = Grounding({"bowl": NEXT_TO_RACK})
    assert look(grounding, seen(NEAR)).status == "found"
    assert look(grounding, seen(at(-0.8, 0.3))).status == "found"


@pytest.mark.parametrize("foot", [np.zeros(3), np.array([0.06, -0.04, -0.3])])
def test_words_are_told_by_what_things_stand_on_wherever_their_frames_are(foot):
    # One bowl stands on the rack's shelf, the other one beside it and nearer to the rack's frame.
    on, beside = se3.from_yaw([0.3, 0.3, 0.05], 0.0), at(0.3, 0.18)
    rack = RACK @ se3.transform(np.eye(3), -foot)
    grounding = Grounding({"bowl": Reference("on", ("rack",))}, feet={"rack": foot})
    meant = grounding.sort_out({"bowl": seen(beside, on), "rack": seen(rack)}, {})["bowl"]
    np.testing.assert_array_equal(meant.T_world_obj, on)


def test_feet_are_the_middle_at_the_lowest_height():
    corners = np.stack(np.meshgrid([0.1, 0.3], [-0.1, 0.1], [-0.2, 0.5], indexing="ij"), -1).reshape(-1, 3)
    context = dataclasses.replace(CONTEXT, points={"rack": corners})
    np.testing.assert_allclose(context.feet["rack"], [0.2, 0.0, -0.2])


def test_nothing_is_far_from_the_table():
    grounding = Grounding({"bowl": Reference("on", ("table",))}, surfaces=frozenset(CONTEXT.surfaces))
    assert look(grounding, seen(at(2.0, 0.0)), CONTEXT.surfaces).status == "found"


def test_an_episode_says_that_the_only_one_is_not_the_one_that_is_meant():
    one = controller(instruction="put the bowl next to the plate on the plate")
    observe(one, HAND, Perception({"bowl": at(-0.9, 0.0), "plate": at(0.2, 0.0)}))
    assert one.state.status is Status.OBJECT_NOT_FOUND
    assert one.state.refusal.startswith("the only bowl that was found is not next to the plate")


def test_an_episode_says_that_the_words_do_not_tell_like_objects_apart():
    one, poses = controller(), entry().object_poses
    look = one.advance(HAND)
    estimates = {"bowl": seen(poses["bowl"], FAR, status="found"), "plate": seen(poses["plate"])}
    one.take_in(look, Detections(estimates, {}), HAND)
    assert one.state.status is Status.OBJECT_NOT_FOUND
    assert one.state.refusal.startswith("cannot tell which bowl is meant")


def test_of_several_that_are_asked_for_each_is_taken_once():
    grounding = Grounding(several=frozenset({"bowl"}))
    first = look(grounding, seen(NEAR, FAR))
    assert (first.status, first.others) == ("found", ())
    np.testing.assert_array_equal(first.T_world_obj, NEAR)
    np.testing.assert_array_equal(look(grounding, seen(FAR, NEAR)).T_world_obj, NEAR)
    put = at(-0.3, 0.0)
    grounding.next_of("bowl", put)
    np.testing.assert_array_equal(look(grounding, seen(put, FAR)).T_world_obj, FAR)
    np.testing.assert_array_equal(grounding.not_meant["bowl"], [put])
    # The last one is done too: there is no other.
    grounding.next_of("bowl", at(-0.3, 0.2))
    assert look(grounding, seen(at(-0.3, 0.2), put)).status == "not_found"
    assert grounding.elsewhere == {"bowl": "has been seen to already"}
