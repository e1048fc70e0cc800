"""All kinds of objects, and what is done with objects of whatever kind."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import NamedTuple

from numpy.random import Generator

from lerobot_openspm.errors import DatasetError
from lerobot_openspm.perception.objects.base import Examples, KnownObject, ShapeBackend
from lerobot_openspm.perception.objects.box.learn import BOX
from lerobot_openspm.perception.objects.patches.learn import PATCHES
from lerobot_openspm.perception.objects.shape.learn import SHAPE
from lerobot_openspm.perception.objects.surface.learn import SURFACE
from lerobot_openspm.types import DemonstrationScene, Segmenter, Shape

UNTRIED = "no kind of object fits what was asked for"
# In the order in which they are asked to learn: each gets the objects that those before it left.
KINDS = {kind.name: kind for kind in (SURFACE, PATCHES, SHAPE, BOX)}


class LearnedObjects(NamedTuple):
    """What learning makes of contact cues.

    Attributes:
        models: Objects by name.
        left_out: By name, why the others could not be learned.
    """

    models: dict[str, KnownObject]
    left_out: dict[str, str]


def learn_objects(
    scenes: Sequence[DemonstrationScene],
    rng: Generator,
    known: Collection[KnownObject] = (),
    segmenter: Segmenter | None = None,
    source: Shape = "demonstrations",
    shapes: ShapeBackend | None = None,
    told_apart: Collection[str] = (),
) -> LearnedObjects:
    """Learn every object that some scene's contact cues name and that is not known.

    Args:
        scenes: First frames and contact cues of the demonstrations of all tasks.
        rng: Chooses among the demonstrations of an object where there are more than needed.
        known: Objects that are known already; none of the new ones is one of them.
        segmenter: Finds the objects' masks; by default the demonstrations teach their colours and patches.
        source: With a segmenter, "box" learns the boxes around the objects and "demonstrations" their shapes;
            without one, there is only the latter. "sam3d" learns boxes of the sizes that `shapes` tells.
        shapes: Tells the sizes of objects, for "sam3d".
        told_apart: Names that instructions tell from others of their kind: pictures may show several.

    Raises:
        DatasetError: No scene has a contact cue.
    """
    named = {cue.name for scene in scenes for cue in scene.cues}
    if not named:
        raise DatasetError(
            "no demonstration shows a grasp, contact or release; perception has nothing to learn from"
        )
    names = sorted(named - {one.name for one in known})
    examples = Examples(names, scenes, known, rng, segmenter, source, shapes, told_apart)
    learned: dict[str, KnownObject] = {}
    for kind in KINDS.values():
        left = [name for name in names if name not in learned]
        learned |= kind.learn(replace(examples, names=left))
    why = {name: examples.left_out.get(name, [UNTRIED]) for name in names if name not in learned}
    return LearnedObjects(learned, {name: "; ".join(dict.fromkeys(told)) for name, told in why.items()})
