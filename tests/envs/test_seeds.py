import pytest

from lerobot_openspm.envs.seeds import require_demo_seeds


@pytest.mark.parametrize(("first", "count"), [(0, 1), (999_999, 2), (1_999_999, 2), (2_000_000, 1)])
def test_demonstrations_only_take_demonstration_seeds(first, count):
    with pytest.raises(ValueError, match="demonstration seeds"):
        require_demo_seeds(first, count)
