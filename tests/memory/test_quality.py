import pytest
from tests.memory.builders import entry

from lerobot_openspm.memory.quality import PRIOR_TRIALS, pooled_quality, prior_quality, with_success


def after(quality, outcomes):
    rated = entry(quality=quality)
    for success in outcomes:
        rated = with_success(rated, success)
    return rated


def test_an_outcome_is_one_more_observation():
    won, lost = after(0.6, [True]), after(0.6, [False])
    assert (won.trials, won.successes, lost.trials, lost.successes) == (1, 1, 1, 0)
    assert won.quality == pytest.approx((0.6 * PRIOR_TRIALS + 1) / (PRIOR_TRIALS + 1))
    assert lost.quality == pytest.approx(0.6 * PRIOR_TRIALS / (PRIOR_TRIALS + 1))


def test_the_order_of_outcomes_does_not_matter_and_none_is_forgotten():
    one, other = after(0.8, [True, False, False, True]), after(0.8, [False, True, True, False])
    assert one.quality == pytest.approx(other.quality)
    assert one.quality == pytest.approx(pooled_quality(0.8, 4, 2))
    assert prior_quality(one) == pytest.approx(0.8)


def test_quality_stays_within_0_and_1_and_ends_at_the_rate_of_success():
    assert after(1.0, [True] * 50).quality == 1
    assert after(0.0, [False] * 50).quality == 0
    assert after(1.0, [False] * 500).quality == pytest.approx(0, abs=0.01)
    assert after(0.9, [True, False] * 500).quality == pytest.approx(0.5, abs=0.01)


def test_nothing_else_changes():
    before = entry(quality=0.7)
    rated = with_success(before, True)
    assert rated.key_poses is before.key_poses
    assert (rated.version, rated.source, rated.language) == (before.version, before.source, before.language)
