import pytest

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
