import pytest
from tests.memory.builders import entry

from lerobot_openspm.control.state import TRANSITIONS, EpisodeState, Status

FINAL = {Status.NO_PROGRESS, Status.NOT_UNDERSTOOD, Status.CAMERA_FAULT}


def test_every_status_has_its_transitions_and_only_the_final_ones_have_none():
    assert set(TRANSITIONS) == set(Status)
    assert {status for status, following in TRANSITIONS.items() if not following} == FINAL


def test_every_status_can_be_reached_from_the_start_and_every_one_but_the_final_ones_can_end():
    reached, new = set(), {Status.WAITING}
    while new:
        reached |= new
        new = set().union(*(TRANSITIONS[status] for status in new)) - reached
    assert reached == set(Status)
    assert all(TRANSITIONS[status] & (FINAL | {Status.RUNNING}) for status in set(Status) - FINAL)


@pytest.mark.parametrize("final", sorted(FINAL))
def test_nothing_follows_the_end_of_an_episode(final: Status):
    state = EpisodeState(Status.RUNNING)
    state.go(final)
    state.go(final)
    with pytest.raises(RuntimeError, match=f"from {final} to running"):
        state.go(Status.RUNNING)


PLATE, BOX = entry(source="local/demos#0"), entry("put the box in the bowl", source="local/demos#1")


def fared(success, used, ended, now, n_parts=2):
    """Successes by source, of parts that ended with some verdicts and one that is carried out now."""
    state = EpisodeState(
        parts=((),) * n_parts,
        part=len(ended),
        used=tuple((one,) for one in used),
        verdicts=ended,
        verdict=now,
    )
    return {one.source: done for one, done in state.entry_successes(success)}


@pytest.mark.parametrize(
    ("success", "ended", "now", "expected"),
    [
        (True, (None,), None, [True, True]),
        (False, (True,), False, [True, False]),  # the second part was seen to fail
        (False, (True,), None, [True, False]),  # nobody saw how it ended
        (False, (None,), True, [False, True]),
        (False, (None,), None, [False, False]),
        (False, (True,), True, [False, False]),  # what was seen of one of them is wrong
    ],
)
def test_a_failure_counts_for_the_parts_that_were_not_seen_to_be_done(success, ended, now, expected):
    found = fared(success, (PLATE, BOX), ended, now)
    assert found == {PLATE.source: expected[0], BOX.source: expected[1]}


def test_a_part_that_was_never_begun_is_not_held_against_the_one_that_was_seen_to_be_done():
    assert fared(False, (PLATE,), (True,), None) == {PLATE.source: True}
    assert fared(False, (PLATE,), (), True, n_parts=1) == {PLATE.source: False}


def test_an_entry_that_was_used_for_two_parts_counts_once_and_by_the_worse_one():
    assert fared(False, (PLATE, PLATE), (True,), False) == {PLATE.source: False}
    assert len(EpisodeState(used=((PLATE,), (PLATE,))).entry_successes(success=True)) == 1


def test_what_was_put_together_counts_for_the_grasp_and_for_the_place():
    state = EpisodeState(Status.DONE, parts=((),), used=((PLATE, BOX),), verdict=True)
    assert {one.source: done for one, done in state.entry_successes(True)} == {
        PLATE.source: True,
        BOX.source: True,
    }
