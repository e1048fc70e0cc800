"""Whether objects hardly move between demonstrations, told by where the hand touched them.

That an object hardly moves is never taken from a few scenes that happen to agree. The hand's repeated
touches tell how likely it is, all places and both axes taken together. So do the other objects' touches, and
how the objects are known that were learned before: in one place most objects stand still, in another most
are moved about.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

import numpy as np
from scipy.cluster.hierarchy import fclusterdata
from scipy.spatial.distance import pdist
from scipy.stats import chi2

from lerobot_openspm.perception.objects.base import KnownObject
from lerobot_openspm.types import ContactCue, DemonstrationScene

# The hand's target moves with the object; if its standard deviation along an axis is below this, patches do.
# It is that of a uniform distribution within 3 cm of the middle, about as far as a patch is sought.
MAX_STD_M = 0.03 / np.sqrt(3)
# From this probability on, an object counts as one that hardly moves.
LIKELY = 0.5
# Where tasks begin with an object at different places, these are so far apart at least, metres, each is shown
# so often, and this share of the demonstrations begin at one of them.
APART_M, MIN_SHOWN, AT_PLACES_SHARE = 0.05, 3, 0.8


def hardly_moving(
    names: Sequence[str], scenes: Sequence[DemonstrationScene], known: Collection[KnownObject] = ()
) -> dict[str, float]:
    """Probability by name that an object hardly moves between demonstrations, given all touches.

    Two or three places that agree are weak evidence, so each object begins with what the others tell: of a
    beta distribution, counting every other object that tells anything, and one of either kind.

    Args:
        names: The objects.
        scenes: First frames of all demonstrations, with cues at the objects.
        known: Other objects, which are known by patches where they hardly moved.
    """
    touches = {name: [cue for scene in scenes for cue in scene.cues if cue.name == name] for name in names}
    told = {name: p for name, cues in touches.items() if (p := _hardly_moves(cues)) is not None}
    before = [float(model.patches is not None) for model in known if model.name not in names]
    found = {}
    for name in names:
        others = [*before, *(p for other, p in told.items() if other != name)]
        prior = (1 + sum(others)) / (2 + len(others))
        own = told.get(name, 0.5)
        found[name] = own * prior / (own * prior + (1 - own) * (1 - prior))
    return found


def often_at(name: str, scenes: Sequence[DemonstrationScene]) -> list[DemonstrationScene]:
    """The demonstrations in which an object is where it is shown most often, if it has a few such places.

    Each task may begin with it elsewhere, or with one of a kind at each of a few places. None of them where
    it is moved about, or is always at one place.
    """
    own = [(scene, cue) for scene in scenes if (cue := _first_touch(name, scene)) is not None]
    groups = [group for place in places_of(cue for _, cue in own) for group in _apart(place)]
    groups = [group for group in groups if len(group) >= MIN_SHOWN]
    groups = [group for group in groups if (_hardly_moves(group) or 0.0) >= LIKELY]
    if len(groups) < 2 or sum(map(len, groups)) < AT_PLACES_SHARE * len(own):
        return []
    middles = [np.mean([cue.point_world[:2] for cue in group], axis=0) for group in groups]
    if pdist(np.stack(middles)).max() < APART_M:
        return []
    often = max(groups, key=len)
    return [scene for scene, cue in own if any(cue is one for one in often)]


def _first_touch(name: str, scene: DemonstrationScene) -> ContactCue | None:
    return next((cue for cue in scene.cues if cue.name == name), None)


def _apart(cues: Sequence[ContactCue]) -> list[list[ContactCue]]:
    """Cues in groups that are some distance apart."""
    if len(cues) < 2:
        return [list(cues)]
    touched = np.stack([cue.point_world[:2] for cue in cues])
    labels = fclusterdata(touched, APART_M, criterion="distance", method="single")
    return [[cue for cue, own in zip(cues, labels, strict=True) if own == i] for i in np.unique(labels)]


def _hardly_moves(cues: Iterable[ContactCue]) -> float | None:
    """Probability, by the touches of one object alone, that its standard deviation is small.

    The variance's posterior given n independent deviations is an inverse chi-squared distribution, where
    nothing is known of its scale beforehand (Gelman et al., Bayesian Data Analysis, section 2.6). Kept
    strictly between 0 and 1; None where no place was touched twice.
    """
    places = places_of(cues)
    points = [np.stack([cue.point_world[:2] for cue in place]) for place in places]
    degrees = 2 * sum(len(own) - 1 for own in points)
    if degrees == 0:
        return None
    squares = sum(float(((own - own.mean(axis=0)) ** 2).sum()) for own in points)
    return float(np.clip(chi2.sf(squares / MAX_STD_M**2, degrees), 1e-6, 1 - 1e-6))


def places_of(cues: Iterable[ContactCue]) -> list[list[ContactCue]]:
    """Contact cues grouped by the place on the object that they touch."""
    groups: dict[tuple[str, str], list[ContactCue]] = {}
    for cue in cues:
        groups.setdefault((cue.kind, cue.place), []).append(cue)
    return list(groups.values())
