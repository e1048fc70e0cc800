"""Whether an object hardly moves is a matter of evidence: two or three scenes that agree are little of it."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.perception.builders import model
from tests.perception.drawn_world import demonstration, draw_poses

from lerobot_openspm.perception.objects.kinds import learn_objects
from lerobot_openspm.perception.objects.patches.model import PatchModel
from lerobot_openspm.perception.objects.patches.stillness import hardly_moving, often_at
from lerobot_openspm.perception.objects.surface.backdrop import Backdrop, Colour
from lerobot_openspm.perception.objects.surface.model import SurfaceModel
from lerobot_openspm.perception.objects.surface.sight import Surface
from lerobot_openspm.types import ContactCue, DemonstrationScene

# How far to either side of the middle objects stand, along both axes.
NEAR_M, FAR_M = 0.007, 0.06


def scenes(sides_m: dict[str, float], touches: int, places: int = 1) -> list[DemonstrationScene]:
    """Scenes in which every object is touched, in turn on one side of its middle and on the other."""
    return [
        DemonstrationScene(
            {},
            tuple(
                ContactCue(
                    name, np.array([(-1) ** i * side, (-1) ** i * side, 0.1]), "grasp", f"{name} {place}"
                )
                for name, side in sides_m.items()
            ),
        )
        for place in range(places)
        for i in range(touches)
    ]


def test_a_few_scenes_that_agree_are_not_believed_where_everything_else_moves():
    others: dict[str, float] = dict.fromkeys(["bowl", "plate", "box", "rack"], FAR_M)
    sides_m = {"cabinet": NEAR_M, **others}
    few = hardly_moving(list(sides_m), scenes(sides_m, touches=2))
    assert max(few.values()) == few["cabinet"] < 0.5
    many = hardly_moving(list(sides_m), scenes(sides_m, touches=10))
    assert many["cabinet"] > 0.99
    assert all(many[name] < 0.01 for name in others)


def test_a_few_are_enough_where_everything_else_stands_still():
    sides_m: dict[str, float] = dict.fromkeys(["cabinet", "bowl", "plate", "box", "rack"], NEAR_M)
    assert min(hardly_moving(list(sides_m), scenes(sides_m, touches=2)).values()) > 0.75


def test_places_that_are_touched_twice_count_together():
    """The cabinet of the tabletop: two touches each of four places, none of which tells much."""
    alone = hardly_moving(["cabinet"], scenes({"cabinet": 0.021}, touches=2))["cabinet"]
    together = hardly_moving(["cabinet"], scenes({"cabinet": 0.021}, touches=2, places=4))["cabinet"]
    assert 0.0 < together < 0.1 * alone


def test_where_one_place_lies_of_another_says_nothing():
    apart = scenes({"cabinet": NEAR_M}, touches=1, places=6)
    assert hardly_moving(["cabinet"], apart) == {"cabinet": 0.5}


def touched_at(*middles: tuple[float, int], side: float = NEAR_M) -> list[DemonstrationScene]:
    """Scenes in which a bowl is touched about some places, each so often."""
    return [
        DemonstrationScene({}, (ContactCue("bowl", np.array([x + away, away, 0.1]), "grasp"),))
        for x, touches in middles
        for away in np.linspace(-side, side, touches)
    ]


def test_what_tasks_begin_with_at_a_few_places_is_learned_where_it_is_shown_most_often():
    shown = touched_at((0.0, 8), (0.2, 10), (0.4, 9))
    assert hardly_moving(["bowl"], shown)["bowl"] < 0.01
    assert often_at("bowl", shown) == shown[8:18]
    thrown_off = touched_at((0.0, 8), (0.2, 10), (0.4, 9), (0.7, 1))
    assert often_at("bowl", thrown_off) == thrown_off[8:18]


@pytest.mark.parametrize(
    "shown",
    [
        touched_at((0.0, 10)),
        touched_at((0.0, 4), (0.2, 1)),
        touched_at((0.0, 10), (0.3, 10), side=FAR_M),
        touched_at((0.0, 8), *((0.2 + 0.1 * i, 1) for i in range(8))),
    ],
    ids=["one place", "too few touches", "moved about each place", "moved about the table"],
)
def test_no_place_is_where_it_is_shown_most_often(shown: list[DemonstrationScene]):
    assert often_at("bowl", shown) == []


def test_a_task_begins_with_it_elsewhere_however_near_the_next_one_is():
    """As the bowls of LIBERO-Spatial: four tasks, 4 cm from one to the next, and one that moves it about."""
    places = [replace(scene.cues[0], place=f"task {i}")
              for i, n in enumerate((5, 6, 5, 5)) for scene in touched_at((0.04 * i, n))]  # fmt: skip
    about = [replace(scene.cues[0], place="task 4") for scene in touched_at((0.3, 4), side=FAR_M)]
    shown = [DemonstrationScene({}, (cue,)) for cue in [*places, *about]]
    assert often_at("bowl", shown) == shown[5:11]


def patches(name: str) -> PatchModel:
    return PatchModel(name, (), 0.0, 1.0)


def surface(name: str) -> SurfaceModel:
    shape = Surface(np.zeros((1, 3)), np.ones((1, 3)), np.zeros((1, 2, 3), np.float32), 0.004)
    backdrop = Backdrop(Colour(np.zeros(3), np.eye(3)), 0.0, np.array([[-1.0, -1.0], [1.0, 1.0]]))
    return SurfaceModel(name, shape, backdrop, 0.0, 0.9, 0.3, patches(name))


@pytest.mark.parametrize("known_by", [patches, surface])
def test_what_is_known_already_tells_how_it_is_here(known_by: Callable[[str], PatchModel | SurfaceModel]):
    once = scenes({"rack": NEAR_M}, touches=1)
    still = [known_by(name) for name in ("bowl", "plate", "stove")]
    moved = [model(name) for name in ("bowl", "plate", "stove")]
    assert hardly_moving(["rack"], once, still)["rack"] == pytest.approx(0.8)
    assert hardly_moving(["rack"], once, moved)["rack"] == pytest.approx(0.2)


def test_a_movable_object_that_stood_still_in_a_few_scenes_is_learned_by_its_shape():
    # Of many scenes, the two in which the block stood nearest to one place; the cup moved between them.
    at = np.stack([draw_poses(np.random.default_rng(seed))["block"][:2, 3] for seed in range(40)])
    between = np.linalg.norm(at[:, None] - at[None], axis=2) + np.eye(len(at))
    assert between.min() < 0.01
    pair = np.unravel_index(int(between.argmin()), between.shape)
    alike = [demonstration(np.random.default_rng(int(seed))) for seed in pair]
    alike = [replace(s, cues=tuple(replace(h, place=h.name) for h in s.cues)) for s in alike]
    known = [replace(model("bowl"), name=name) for name in ("bowl", "plate")]
    models = learn_objects(alike, np.random.default_rng(0), known).models
    assert "block" in models
    assert not isinstance(models["block"], PatchModel)
