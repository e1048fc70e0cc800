from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from tests.memory.builders import entry, key_pose, pick_and_place
from tests.memory.memories import SLIDE

from lerobot_openspm.geometry import se3
from lerobot_openspm.memory.merging import mean_pose, merge, merge_near_duplicates
from lerobot_openspm.memory.quality import PRIOR_TRIALS, with_success


def shifted(steps, source="local/demos#0", **changes):
    """An entry whose key poses are all moved by one increment."""
    moved = [replace(pose, T_obj_ee=se3.apply_increment(pose.T_obj_ee, np.array(steps))) for pose in POSES]
    return entry(key_poses=moved, source=source, **changes)


POSES = pick_and_place()


def noisy(n, rng, std=0.002):
    steps = rng.normal(0, std, (n, 6)) * [1, 1, 1, 10, 10, 10]
    return [shifted(step, f"local/demos#{i}") for i, step in enumerate(steps)], steps


def test_near_duplicates_become_one_entry_with_their_mean_and_spread():
    entries, steps = noisy(40, np.random.default_rng(0))
    result = merge_near_duplicates(entries, 0.05, 0.5)
    assert [e.source for e in result.superseded] == [e.source for e in entries]
    (merged,) = result.entries
    assert merged.source == ", ".join(f"local/demos#{i}" for i in range(40))
    assert merged.version == 2
    for pose, original in zip(merged.key_poses, POSES, strict=True):
        # The mean of small increments, to first order.
        found = se3.increment(original.T_obj_ee, pose.T_obj_ee)
        assert_allclose(found, steps.mean(axis=0), atol=2e-4)
        assert_allclose(pose.covariance, np.cov(steps.T), atol=3e-5)
        assert se3.is_rigid(pose.T_obj_ee, tolerance=1e-12)


@pytest.mark.parametrize("steps", [[0.02, 0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0.2]])
def test_what_lies_further_apart_is_left_alone(steps):
    entries = (shifted([0] * 6), shifted(steps, "local/demos#1"))
    result = merge_near_duplicates(entries, 0.01, 0.1)
    assert result.entries == entries
    assert result.superseded == ()
    assert len(merge_near_duplicates(entries, 0.03, 0.3).entries) == 1


def test_every_two_of_what_is_merged_are_close():
    """A chain of entries, each close to the next, is no reason to merge its ends."""
    chain = [shifted([0.004 * i, 0, 0, 0, 0, 0], f"local/demos#{i}") for i in range(6)]
    result = merge_near_duplicates(chain, 0.009, 0.1)
    assert [e.source.count("#") for e in result.entries] == [3, 3]


def test_only_entries_of_one_structure_are_merged_and_each_stays_in_its_place():
    other = entry("put the bowl on the stove", source="local/demos#9")
    open_hand = entry(key_poses=[replace(p, closed=False) for p in POSES], source="local/demos#8")
    near = shifted([0.001, 0, 0, 0, 0, 0], "local/demos#1")
    result = merge_near_duplicates([other, shifted([0] * 6), open_hand, near], 0.01, 0.1)
    assert [e.source for e in result.entries] == [
        "local/demos#9", "local/demos#0, local/demos#1", "local/demos#8",
    ]  # fmt: skip
    assert len(merge_near_duplicates([shifted([0] * 6), near], 0.01, 0.1, "open the drawer").entries) == 2


def test_merging_step_by_step_is_merging_at_once():
    entries, _ = noisy(6, np.random.default_rng(1))
    at_once = merge(entries)
    step_by_step = merge([merge(entries[:4]), merge(entries[4:])])
    for one, other in zip(at_once.key_poses, step_by_step.key_poses, strict=True):
        assert_allclose(one.T_obj_ee, other.T_obj_ee, atol=1e-6)
        # Increments from another mean differ to second order.
        assert_allclose(one.covariance, other.covariance, atol=2e-6)


def test_outcomes_are_pooled():
    won = with_success(shifted([0] * 6, quality=0.8), True)
    lost = with_success(with_success(shifted([0] * 6, quality=0.4), False), False)
    merged = merge([won, lost])
    assert (merged.trials, merged.successes) == (3, 1)
    assert merged.quality == pytest.approx((0.6 * PRIOR_TRIALS + 1) / (PRIOR_TRIALS + 3))


def test_axes_are_averaged():
    T = np.eye(4)
    turned = se3.exp_so3([0.02, 0, 0]) @ SLIDE.direction
    axes = (SLIDE, replace(SLIDE, direction=turned, amount=0.17))
    merged = merge([entry("open the top drawer", [key_pose("cabinet", T, "open", axis=a)]) for a in axes])
    axis = merged.key_poses[0].axis
    assert axis.amount == pytest.approx(0.16)
    assert_allclose(axis.direction, se3.exp_so3([0.01, 0, 0]) @ SLIDE.direction, atol=1e-9)


def test_the_mean_of_poses_is_where_increments_balance():
    rng = np.random.default_rng(2)
    T = se3.transform(se3.exp_so3(rng.normal(0, 0.3, (9, 3))), rng.normal(0, 0.1, (9, 3)))
    weights = rng.uniform(1, 3, 9)
    mean = mean_pose(T, weights)
    assert_allclose(weights @ se3.increment(mean, T), np.zeros(6), atol=1e-9)
