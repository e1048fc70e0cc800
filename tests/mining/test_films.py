"""How many demonstrations perception sees all of, and not only two frames."""

from collections import Counter
from types import SimpleNamespace

import pytest

from lerobot_openspm.mining.objects import learn_scenes


class NoPictures:
    """Demonstrations whose cameras show nothing."""

    def views(self, episode, frame, cameras):
        return {}


@pytest.mark.parametrize(
    ("n_tasks", "n_each", "filmed"), [(1, 12, 10), (3, 12, 10), (3, 4, 4), (10, 10, 3), (40, 2, 1)]
)
def test_some_demonstrations_of_every_task_are_filmed_and_about_thirty_in_all(n_tasks, n_each, filmed):
    tasks = [f"task {i % n_tasks}" for i in range(n_tasks * n_each)]
    episodes = [SimpleNamespace(task=task) for task in tasks]
    mined = [SimpleNamespace(episode=episode, key_poses=(), sub_tasks=()) for episode in episodes]
    scenes = learn_scenes(NoPictures(), mined, {})
    counts = Counter(task for task, scene in zip(tasks, scenes, strict=True) if scene.film is not None)
    assert counts == dict.fromkeys(tasks, filmed)
