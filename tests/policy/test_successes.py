"""What the policy is told of how its episodes ended changes the entries that it acted by."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tests.policy.conftest import Frame, batch_of

from lerobot_openspm.control.state import Status
from lerobot_openspm.errors import OpenSPMError
from lerobot_openspm.memory.io import read_memory
from lerobot_openspm.modeling_openspm import OpenSPMPolicy


def trials(policy: OpenSPMPolicy) -> dict[str, tuple[int, int]]:
    """Trials and successes by source, of entries that have any."""
    return {e.source: (e.trials, e.successes) for e in policy.require_memory().entries if e.trials}


def test_successes_change_the_entries_that_were_acted_by_and_are_saved(
    policy: OpenSPMPolicy, recorded: list[list[Frame]], tmp_path: Path
):
    policy.select_action(batch_of([recorded[0][0], recorded[3][0], recorded[4][0]]))
    used = [one.controller.state.used for one in policy.episodes]
    assert [len(entries) for entries in used] == [1, 1, 1]
    (bowl,), (stove,) = used[0][0], used[1][0]
    policy.report_successes([False, True, None])
    assert trials(policy) == {bowl.source: (1, 0), stove.source: (1, 1)}
    quality = {e.source: e.quality for e in policy.require_memory().entries}
    assert quality[bowl.source] < bowl.quality
    assert stove.quality < quality[stove.source]
    # An episode counts once; what was not known may follow later.
    policy.report_successes([True, False, True])
    policy.report_successes([True, False, False])
    third = used[2][0][0].source
    expected = {bowl.source: (1, 0), stove.source: (1, 1)}
    tried, succeeded = expected.get(third, (0, 0))
    expected[third] = (tried + 1, succeeded + 1)
    assert trials(policy) == expected
    policy.save_pretrained(tmp_path)
    saved = {e.source: (e.trials, e.successes) for e in read_memory(tmp_path).entries if e.trials}
    assert saved == expected


def test_without_a_word_from_outside_what_the_policy_saw_itself_counts(
    policy: OpenSPMPolicy, recorded: list[list[Frame]]
):
    policy.select_action(batch_of([recorded[0][0], recorded[3][0], recorded[4][0]]))
    assert policy.successes == [None, None, None]
    policy.report_successes()
    assert trials(policy) == {}
    seen, missed = (policy.episodes[i].controller.state.used[0][0].source for i in (0, 1))
    for episode, verdict in zip(policy.episodes[:2], (True, False), strict=True):
        episode.controller.executor.stop(Status.DONE)
        episode.controller.state.verdict = verdict
    assert policy.successes == [True, False, None]
    policy.report_successes()
    assert trials(policy) == {seen: (1, 1), missed: (1, 0)}


def test_the_next_episodes_choose_by_what_was_learned(policy: OpenSPMPolicy, recorded: list[list[Frame]]):
    frame = batch_of([recorded[0][0]])
    chosen = []
    for _ in range(12):
        policy.reset()
        policy.select_action(frame)
        chosen.append(policy.episodes[0].controller.state.used[0][0].source)
        policy.report_successes([False])
    # What goes on failing is left for another demonstration of the same task.
    assert len(set(chosen)) > 1
    assert sum(tried for tried, _ in trials(policy).values()) == 12


def test_successes_of_episodes_that_do_not_run_are_refused(
    load: Callable[..., OpenSPMPolicy], recorded: list[list[Frame]]
):
    policy = load()
    with pytest.raises(OpenSPMError, match="got 1 successes, but 0 episodes are running"):
        policy.report_successes([True])
    policy.select_action(batch_of([recorded[0][0]]))
    with pytest.raises(OpenSPMError, match="got 2 successes, but 1 episodes are running"):
        policy.report_successes([True, False])
    policy.reset()
    policy.report_successes([])
    assert trials(policy) == {}


def test_a_failure_counts_for_the_part_that_failed_and_not_for_the_one_that_was_seen_to_be_done(
    policy: OpenSPMPolicy, recorded: list[list[Frame]]
):
    policy.select_action(batch_of([recorded[0][0], recorded[3][0]]))
    done, failed = (policy.episodes[i].controller.state for i in (0, 1))
    done.parts, done.used = done.parts + failed.parts, done.used + failed.used
    done.begin_next_part(1.0)
    done.verdicts = (True,)
    policy.report_successes([False, None])
    assert trials(policy) == {done.used[0][0].source: (1, 1), done.used[1][0].source: (1, 0)}
