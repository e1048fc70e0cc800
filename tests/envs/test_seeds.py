import pytest

from lerobot_openspm.envs.seeds import (
    DEMO_SEED_START,
    DEMO_SEEDS,
    EVALUATION_SEEDS,
    TUNING_SEED_START,
    TUNING_SEEDS,
    require_demo_seeds,
)


def test_ranges_never_overlap():
    ranges = [EVALUATION_SEEDS, DEMO_SEEDS, TUNING_SEEDS]
    for i, a in enumerate(ranges):
        for b in ranges[i + 1 :]:
            assert max(a.start, b.start) >= min(a.stop, b.stop)
    assert EVALUATION_SEEDS.start == 0
    assert (
        (DEMO_SEEDS.start, TUNING_SEEDS.start)
        == (DEMO_SEED_START, TUNING_SEED_START)
        == (1_000_000, 2_000_000)
    )


@pytest.mark.parametrize(("first", "count"), [(0, 1), (999_999, 2), (1_999_999, 2), (2_000_000, 1)])
def test_demonstrations_only_take_demonstration_seeds(first, count):
    with pytest.raises(ValueError, match="demonstration seeds"):
        require_demo_seeds(first, count)
