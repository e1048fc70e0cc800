"""An object is learned from scenes in which another one just like it stands."""

from dataclasses import replace

import numpy as np
import pytest
from tests.perception.drawn_world import SHAPES, draw_pose, render

from lerobot_openspm.geometry import se3
from lerobot_openspm.mining.objects import place_touched
from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.pipeline import detect
from lerobot_openspm.types import ContactCue, DemonstrationScene

BESIDE_M = 0.2


def two_cups(rng: np.random.Generator) -> tuple[np.ndarray, DemonstrationScene]:
    """The place of the cup that the hand grasped, and the demonstration; it cannot be seen what was moved."""
    while True:
        cup, other = (draw_pose(rng, (-0.12, -0.2), (0.12, 0.2)) for _ in range(2))
        if np.linalg.norm((cup - other)[:2, 3]) > BESIDE_M:
            break
    grasp = se3.apply(cup, np.array([[0.03, 0.0, 0.05]]))[0] + rng.normal(0, 0.004, 3)
    views = render([(SHAPES["cup"], cup), (SHAPES["cup"], other)])
    return cup, DemonstrationScene(views, (ContactCue("cup", grasp, "grasp"),))


@pytest.mark.parametrize("seed", range(2))
def test_a_cup_is_learned_beside_another_cup_and_found_where_the_hand_took_it(seed: int):
    rng = np.random.default_rng(seed)
    drawn = [two_cups(rng) for _ in range(8)]
    learned = learn_objects([scene for _, scene in drawn], np.random.default_rng(0))
    assert learned.left_out == {}
    cup = learned.models["cup"]
    assert cup.yaw_period == 0
    assert np.linalg.norm(cup.points[:, :2], axis=1).max() == pytest.approx(0.04, abs=0.008)
    for T, scene in drawn:
        found = place_touched(cup, detect(scene.views, {"cup": cup})["cup"], scene.cues)
        assert found is not None
        assert np.linalg.norm((found - T)[:2, 3]) < 0.01


def test_what_looks_like_the_table_is_learned_neither_way():
    rng = np.random.default_rng(2)
    scenes = [two_cups(rng)[1] for _ in range(6)]
    blank = [
        replace(
            one,
            views={
                name: replace(view, image=np.broadcast_to(view.image[-1:, -1:], view.image.shape).copy())
                for name, view in one.views.items()
            },
        )
        for one in scenes
    ]
    learned = learn_objects(blank, np.random.default_rng(0))
    assert learned.models == {}
    assert set(learned.left_out) == {"cup"}
