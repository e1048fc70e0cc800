"""Fixtures of the tabletop's tests: small images, closed when the test ends."""

import pytest

from lerobot_openspm.envs.tabletop.env import TabletopEnv


@pytest.fixture
def make_env():
    """Make environments with small images, closed when the test ends."""
    made: list[TabletopEnv] = []

    def make(task: str = "bowl_on_plate", **arguments) -> TabletopEnv:
        made.append(TabletopEnv(task, **{"observation_height": 128, "observation_width": 128, **arguments}))
        return made[-1]

    yield make
    for env in made:
        env.close()
