"""What an entry teaches by its parts, and by which entries an instruction is carried out."""

from dataclasses import replace

import numpy as np
import pytest
from tests.memory.builders import entry, hand_pose, key_pose, pick_and_place, planned

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.compose import parts, sub_task_index
from lerobot_openspm.types import SubTask

DRAWER = "open the top drawer and put the bowl inside"


def opened(sub_task=0):
    """Approach a handle, take it, pull, let go, leave."""
    T = hand_pose(0.15, 0.0, 0.1)
    phases = (("approach", False), ("grasp", True), ("open", True), ("release", False), ("retreat", False))
    return [key_pose("cabinet", T, phase, closed, sub_task=sub_task) for phase, closed in phases]


def drawer_entry(instruction=DRAWER, **changes):
    key_poses = (*opened(), *(replace(pose, sub_task=1) for pose in pick_and_place("bowl", "cabinet")))
    return entry(instruction, **{"key_poses": key_poses, **changes})


def test_an_entry_with_two_sub_tasks_teaches_both():
    whole = drawer_entry(quality=0.7, source="local/demos#3")
    opening, putting = parts(whole)
    assert opening.key.sub_tasks == (SubTask("open", "cabinet", "top drawer"),)
    assert putting.key.sub_tasks == (SubTask("put", "bowl", "top drawer", "in", "cabinet"),)
    assert opening.key.phases == ("approach", "grasp", "open", "release", "retreat")
    assert [pose.phase for pose in putting.key_poses] == [p.phase for p in whole.key_poses[5:]]
    for part, objects in ((opening, ["cabinet"]), (putting, ["bowl", "cabinet"])):
        assert sorted(part.object_poses) == objects
        assert set(part.objects) <= set(part.object_poses)
        assert {pose.sub_task for pose in part.key_poses} == {0}
        assert (part.quality, part.source) == (0.7, "local/demos#3")
    for part, poses in ((opening, whole.key_poses[:5]), (putting, whole.key_poses[5:])):
        for own, pose in zip(part.key_poses, poses, strict=True):
            np.testing.assert_array_equal(own.T_obj_ee, pose.T_obj_ee)


def test_an_entry_with_one_sub_task_is_its_own_part():
    one = entry()
    assert parts(one) == (one,)
    assert parts(one)[0] is one


def test_contacts_at_an_object_that_is_not_named_make_no_part():
    T = hand_pose(0.0, 0.0, 0.1)
    elsewhere = [replace(pose, anchor=key_pose("bowl", T, "open").anchor) for pose in opened()]
    whole = drawer_entry()
    odd = drawer_entry(key_poses=(*elsewhere, *whole.key_poses[5:]))
    assert [part.key.sub_tasks[0].operation for part in parts(odd)] == ["put"]
    # A way through free space is left out instead.
    leaving = (*whole.key_poses[:4], elsewhere[4], *whole.key_poses[5:])
    opening, _ = parts(drawer_entry(key_poses=leaving))
    assert opening.key.phases == ("approach", "grasp", "open", "release")
    assert opening.objects == ("cabinet",)


@pytest.mark.parametrize(
    ("contact", "phase", "expected"),
    [
        (0, "approach", 0),
        (1, "release", 0),
        (2, "retreat", 0),
        (2, "approach", 1),
        (3, "release", 1),
        (4, "retreat", 1),
        (5, "grasp", 1),
        (0, "retreat", 0),
    ],
)
def test_a_sub_task_takes_two_transitions_and_leaving_is_part_of_it(contact, phase, expected):
    assert sub_task_index(contact, phase, 2) == expected


def languages(instruction, *entries):
    return [[one.entry.language for one in part] for part in planned(instruction, entries)]


PLATE, STOVE = (
    entry("put the bowl on the plate"),
    entry("turn on the stove", opened(), {"cabinet": np.eye(4)}),
)


def test_an_instruction_is_carried_out_by_entries_of_its_parts_in_its_order():
    both = "put the bowl on the plate and turn on the stove"
    assert languages(both, STOVE, PLATE) == [["put the bowl on the plate"], ["turn on the stove"]]
    other = "turn on the stove and put the bowl on the plate"
    assert languages(other, STOVE, PLATE) == [["turn on the stove"], ["put the bowl on the plate"]]


def test_what_was_demonstrated_as_a_whole_wins():
    whole = drawer_entry()
    alone = entry("open the top drawer", opened(), {"cabinet": np.eye(4)})
    assert languages(DRAWER, alone, whole) == [[DRAWER]]
    # So does the longest run of an instruction that goes on.
    longer = f"{DRAWER}, and then turn on the stove"
    assert languages(longer, alone, whole, STOVE) == [[DRAWER], ["turn on the stove"]]


def test_a_part_of_something_else_is_experience_too_and_remembers_its_source():
    whole = drawer_entry()
    ((only,),) = planned("open the top drawer of the cabinet", [whole, PLATE])
    assert only.sources[0] is whole
    assert only.semantic == pytest.approx(1)
    assert only.entry.key.phases == ("approach", "grasp", "open", "release", "retreat")
    first, second = planned("open the top drawer and put the bowl on the plate", [whole, PLATE])
    assert first[0].sources[0] is whole
    assert second[0].sources[0] is second[0].entry is PLATE


def test_a_part_without_experience_is_named():
    with pytest.raises(InstructionError) as caught:
        planned("put the bowl on the plate and put the mug on the plate", [PLATE, drawer_entry()])
    message = str(caught.value)
    assert message.startswith("'put the mug on the plate' is a part of")
    assert "open the top drawer of the cabinet; put the bowl in the top drawer of the cabinet" in message


@pytest.mark.parametrize("instruction", ["put the mug on the plate", "dance", "turn off the stove"])
def test_a_single_instruction_without_experience_is_refused_as_ever(instruction):
    with pytest.raises(InstructionError, match=instruction):
        planned(instruction, [PLATE, STOVE])
    with pytest.raises(InstructionError):
        planned("put the bowl on the plate and turn on the stove", [])


def test_what_may_mean_different_things_is_asked_back_alone_and_as_a_part():
    cabinet = {"cabinet": np.eye(4)}
    top = entry("open the top drawer of the cabinet", opened(), cabinet)
    middle = entry("open the middle drawer of the cabinet", opened(), cabinet)
    for instruction in ("open the drawer", "open the drawer and turn on the stove"):
        with pytest.raises(InstructionError, match="did you mean"):
            planned(instruction, [top, middle, STOVE])
        assert planned(instruction, [top, STOVE])[0][0].sources[0] is top


def test_parts_can_be_carried_over_to_a_scene():
    from lerobot_openspm.control.transfer import transfer

    opening, _ = parts(drawer_entry())
    object_poses = {"cabinet": se3.from_yaw([0.3, 0.1, 0.0], 0.4)}
    targets = transfer(opening, object_poses, {}, hand_pose(0, 0, 0.3))
    np.testing.assert_allclose(targets[0].T_world_ee, object_poses["cabinet"] @ opening.key_poses[0].T_obj_ee)


WIPE, SINK = "wipe the table with the sponge", "put the sponge in the sink"


def test_what_the_grammar_cannot_read_is_carried_out_sentence_by_sentence():
    entries = [entry(WIPE, source="wipe"), entry(SINK, source="sink")]
    for asked in (f"{WIPE}, and then {SINK}", f"Please {WIPE}. Then {SINK}!", f"{WIPE} and {SINK}"):
        chain = planned(asked, entries)
        assert [[one.sources[0].source for one in part] for part in chain] == [["wipe"], ["sink"]]
    chain = planned(f"{SINK} and {WIPE}", entries)
    assert [[one.sources[0].source for one in part] for part in chain] == [["sink"], ["wipe"]]
    for asked in (f"sing, then {SINK}", f"{WIPE} and then sing", f"do not {WIPE}, then {SINK}"):
        with pytest.raises(InstructionError, match="it knows"):
            planned(asked, entries)


def test_an_instruction_kept_by_its_words_is_one_part_however_much_it_moved():
    shown = entry("set the table")
    two = replace(shown, key=replace(shown.key, sub_tasks=shown.key.sub_tasks * 2))
    ((one,),) = planned("please set the table", [two])
    assert (one.entry, one.asked, one.semantic) == (two, two.key.sub_tasks, 1.0)
    assert parts(two) == (two,)


def test_what_all_demonstrations_did_before_is_done_before():
    whole = drawer_entry()
    opened_first, put = planned("put the bowl in the top drawer of the cabinet", [whole, PLATE])
    assert [one.entry.key.sub_tasks[0].operation for one in opened_first] == ["open"]
    assert [one.entry.key.sub_tasks[0].landmark for one in put] == ["cabinet"]
    # Who opens it asks for no more.
    assert len(planned("open the top drawer and put the bowl in the top drawer", [whole, PLATE])) <= 2


def test_what_some_demonstration_did_without_is_no_condition():
    whole = drawer_entry()
    (_, only) = planned("put the bowl in the top drawer of the cabinet", [whole])
    alone = replace(only[0].entry, source="local/demos#9")
    assert len(planned("put the bowl in the top drawer of the cabinet", [whole, alone])) == 1


BOX = entry("put the box in the basket", source="local/demos#1")


def operations(instruction, *entries):
    return [part[0].entry.key.sub_tasks[0].operation for part in planned(instruction, entries)]


def test_which_of_two_drawers_a_box_goes_into_is_asked_back_before_one_is_opened():
    middle = drawer_entry(DRAWER.replace("top", "middle"))
    with pytest.raises(InstructionError, match="the middle drawer of the cabinet or the top drawer"):
        planned("put the box in the drawer of the cabinet", [drawer_entry(), middle, BOX])
    assert operations("put the box in the drawer of the cabinet", drawer_entry(), BOX) == ["open", "put"]
    opening, putting = planned("put the box in the middle drawer", [drawer_entry(), middle, BOX])
    drawers = opening[0].entry.key.sub_tasks[0].part, putting[0].entry.key.sub_tasks[0].part
    assert drawers == ("middle drawer", "middle drawer")


def test_a_microwave_is_opened_before_something_goes_in_and_a_stove_is_not_turned_on():
    T = hand_pose(0.15, 0.0, 0.1)
    for thing, done, phase, relation, expected in (
        ("microwave", "open", "open", "in", ["open", "put"]),
        ("stove", "turn on", "turn", "on", ["put"]),
    ):
        phases = ((phase, True), ("release", False), ("retreat", False))
        first = [key_pose(thing, T, "grasp", True), *(key_pose(thing, T, *one) for one in phases)]
        second = [replace(pose, sub_task=1) for pose in pick_and_place("mug", thing)]
        said = f"put the mug {relation} the {thing}"
        poses = {"mug": np.eye(4), thing: np.eye(4)}
        whole = entry(f"{done} the {thing} and {said}", [*first, *second], poses)
        assert operations(said, whole) == expected


def test_what_was_closed_is_opened_again_before_something_goes_in():
    known = (
        drawer_entry(),
        BOX,
        entry("close the top drawer of the cabinet", opened(), {"cabinet": np.eye(4)}),
    )
    ending = "close the top drawer and put the box in the top drawer"
    expected = ["open", "put", "close", "open", "put"]
    assert operations(f"put the bowl in the top drawer, {ending}", *known) == expected
    assert operations(f"open the top drawer, {ending}", *known) == ["open", "close", "open", "put"]
    # What the words leave open is opened as the drawer that was shown, and once.
    assert operations("open the drawer and put the box in the top drawer", *known) == ["open", "put"]


def test_what_is_put_into_a_drawer_that_was_shown_open_waits_until_one_that_was_closed_is_opened():
    both = "put the bowl in the top drawer of the cabinet and close it"
    poses = (*pick_and_place("bowl", "cabinet"), *opened(1))
    known = entry(both, poses, {"bowl": np.eye(4), "cabinet": np.eye(4)}), BOX
    opening = entry("open the top drawer of the cabinet", opened(), {"cabinet": np.eye(4)})
    box = "put the box in the top drawer"
    assert operations(box, *known) == ["put"]
    for before in ("close the top drawer", both):
        asked = f"{before} and {box}"
        with pytest.raises(InstructionError, match=r"unless it comes after .open the top drawer"):
            planned(asked, known)
        first = "put" if before == both else "close"
        assert operations(asked, *known, opening) == [first, "open", "put"]
    assert operations(f"close the top drawer, open it and {box}", *known, opening) == ["close", "open", "put"]


def test_where_demonstrations_do_different_things_before_it_is_asked_back():
    other = drawer_entry(
        "close the top drawer of the cabinet and put the bowl in the top drawer of the cabinet"
    )
    asked = "put the bowl in the top drawer of the cabinet"
    with pytest.raises(InstructionError, match=r"different things before it: 'open .*' and 'close .*'; say"):
        planned(asked, [drawer_entry(), other])
    assert planned(f"open the top drawer and {asked}", [drawer_entry(), other])
