import numpy as np
import pytest
from tests.perception.objects.surface.filmed import demonstration

from lerobot_openspm.perception.objects.kinds import learn_objects


@pytest.fixture(scope="session")
def models():
    """The block and the cup as they are learned from six films."""
    rng = np.random.default_rng(1)
    return learn_objects([demonstration(rng) for _ in range(6)], np.random.default_rng(0)).models
