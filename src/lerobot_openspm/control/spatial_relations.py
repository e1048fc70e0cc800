"""Which of several objects of one name is meant: told from where they are, and from nothing else.

Left, right, front and back are said by a person who stands opposite the robot: the robot looks along the
world's +x and the person along -x, so left is -y, right is +y, front (near the person) is +x, and back is -x.
LIBERO says it that way too; its camera ``agentview`` and the tabletop's ``front`` look as the person does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np

from lerobot_openspm.errors import InstructionError
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import Reference

# The second best has to be this much worse than the best, in metres, for the best to be meant.
MARGIN_M = 0.02
# What is this near the middle of something, as seen from above, is on or in it and not next to it.
WITHIN_M = 0.05
# What stands on something is not lower than it, up to the error of a height.
HEIGHT_ERROR_M = 0.01
# How much a metre to the side counts beside a metre of distance, beyond half a right angle.
SIDEWAYS_SHARE = 3.0

# What is said to be next to, on, in, under or between things is nearer than this to them, ...
FAR_M = 0.5
# ... and what is said to be on one side of something is not this far on the other.
OPPOSITE_M = 0.1
# The only one that is seen is another than the one that demonstrations show if it is this far from there.
FAR_FROM_SHOWN_M = 0.15

_SIDES = {"right": (0.0, 1.0), "left": (0.0, -1.0), "back": (-1.0, 0.0), "front": (1.0, 0.0)}
_ALIASES = {
    "left of": "left", "right of": "right", "front of": "front", "in front of": "front", "behind": "back",
    "center": "middle",
}  # fmt: skip


def choose(reference: Reference, candidates: Sequence[Array], landmarks: Mapping[str, Array]) -> int | None:
    """Tell which of several objects a reference means.

    Args:
        reference: Where the object is said to be.
        candidates: Poses ``T_world_obj`` ``(4, 4)`` of the objects of its name; z is up, origins at the
            middle of what they stand on.
        landmarks: Poses ``T_world_obj`` ``(4, 4)`` by name of the objects that the reference may name.

    Returns:
        Index of the candidate; that of the only one whatever is said of it. None where no candidate is
        there, another one is there as well up to :data:`MARGIN_M`, or a landmark was not found.

    Raises:
        InstructionError: The relation is none of those that can be told.
    """
    relation = _ALIASES.get(reference.relation, reference.relation)
    cost = _COSTS.get((relation, len(reference.landmarks)))
    if cost is None:
        known = sorted(f"{name} ({count} landmarks)" for name, count in _COSTS)
        raise InstructionError(
            f"cannot tell which object is {reference.relation!r} of {len(reference.landmarks)} landmarks; "
            f"expected one of {', '.join(known)}; say it by one of these"
        )
    if len(candidates) == 1:
        return 0
    if not candidates or any(name not in landmarks for name in reference.landmarks):
        return None
    places = np.stack(candidates)[:, :3, 3]
    marks = np.array([landmarks[name][:3, 3] for name in reference.landmarks]).reshape(-1, 3)
    costs = cost(places, marks, 0.0)
    best = int(np.argmin(costs))
    # The best fulfils what is said; the others do not even nearly, or are clearly worse.
    others = np.delete(cost(places, marks, MARGIN_M), best)
    is_clear = np.isfinite(costs[best]) and others.min() - costs[best] >= MARGIN_M
    return best if is_clear else None


def contradicts(reference: Reference, T_world_obj: Array, landmarks: Mapping[str, Array]) -> bool:
    """Whether an object plainly is not where it is said to be; not where its landmarks were not found.

    The arguments are those of :func:`choose`, for one object.
    """
    relation = _ALIASES.get(reference.relation, reference.relation)
    if not reference.landmarks or any(name not in landmarks for name in reference.landmarks):
        return False
    place = T_world_obj[None, :3, 3]
    marks = np.array([landmarks[name][:3, 3] for name in reference.landmarks])
    if relation in _SIDES:
        return float((place - marks)[0, :2] @ np.array(_SIDES[relation])) < -OPPOSITE_M
    if relation == "between" and len(marks) == 2:
        return float(_between(place, marks, 0.0)[0]) > FAR_M
    return relation in ("next to", "on", "in", "under") and float(_near_middle(place, marks, 0.0)[0]) > FAR_M


def choose_as_shown(
    name: str,
    candidates: Sequence[Array],
    objects: Mapping[str, Array],
    shown: Sequence[Mapping[str, Array]],
) -> int | None:
    """Tell which of several objects of one name stands where demonstrations of an instruction show it.

    Where it stood is compared relative to the other objects that a demonstration shows and that are found
    here, along the world's axes as in :func:`choose`; in the world where demonstrations show nothing else.

    Args:
        name: Their name.
        candidates: Poses ``T_world_obj`` ``(4, 4)`` of the objects of that name.
        objects: Poses ``T_world_obj`` ``(4, 4)`` by name of what else is found here.
        shown: For each demonstration, poses ``T_world_obj`` ``(4, 4)`` by name at its start.

    Returns:
        Index of the candidate. None where the second best is not worse than the best by :data:`MARGIN_M`, by
        half of what the best is off, and by what the demonstrations themselves differ; or where no
        demonstration shows the object, or nothing is found that they show it beside.
    """
    if len(candidates) == 1:
        return 0
    expected = _where_shown(name, objects, shown)
    if not expected or not candidates:
        return None
    away, spread = _away_from_shown(candidates, expected)
    costs = away.mean(axis=1)
    best = int(np.argmin(costs))
    margin = max(MARGIN_M, spread, float(costs[best]) / 2)
    return best if np.delete(costs, best).min() - costs[best] >= margin else None


def is_far_from_shown(
    name: str, T_world_obj: Array, objects: Mapping[str, Array], shown: Sequence[Mapping[str, Array]]
) -> bool:
    """Whether an object plainly is not where demonstrations show the one that is meant.

    It is far from there by all the other objects that were shown: one of these may have been moved. The
    arguments are those of :func:`choose_as_shown`, for one object.
    """
    expected = _where_shown(name, objects, shown)
    if not expected:
        return False
    away, spread = _away_from_shown([T_world_obj], expected)
    return bool((away[0] > FAR_FROM_SHOWN_M + spread).all())


def _away_from_shown(candidates: Sequence[Array], expected: Sequence[Array]) -> tuple[Array, float]:
    """How far candidates are from where one was shown, by each of k other objects.

    Returns:
        Metres ``(n, k)``, and how far demonstrations are from one another in the mean, metres.
    """
    places = np.stack(candidates)[:, :2, 3]
    middles: list[Array] = [np.median(one, axis=0) for one in expected]
    spread = sum(_median_distance(*pair) for pair in zip(expected, middles, strict=True)) / len(expected)
    return np.linalg.norm(places[:, None] - np.stack(middles), axis=-1), spread


def _where_shown(
    name: str, objects: Mapping[str, Array], shown: Sequence[Mapping[str, Array]]
) -> list[Array]:
    """Where demonstrations show an object: places ``(k, 2)`` here by each other object that it is beside."""
    shown = [one for one in shown if name in one]
    beside = sorted({mark for one in shown for mark in one} - {name})
    if not beside:
        return [np.stack([one[name][:2, 3] for one in shown])] if shown else []
    return [
        np.stack([objects[mark][:2, 3] + (one[name] - one[mark])[:2, 3] for one in shown if mark in one])
        for mark in beside
        if mark in objects
    ]


def _median_distance(places: Array, middle: Array) -> float:
    away: Array = np.linalg.norm(places - middle, axis=1)
    return float(np.median(away))


# Each relation gives costs (n,) in metres of candidates (n, 3), given landmarks (k, 3). The least is meant.
# An infinite cost excludes a candidate, even if it lay more favourably by `slack` metres.


def _furthest(places: Array, marks: Array, slack: float, way: Array) -> Array:
    """The one that is furthest in a direction ``(2,)``."""
    return -places[:, :2] @ way


def _at_side(places: Array, marks: Array, slack: float, way: Array) -> Array:
    """The nearest one on one side of the landmark: within half a right angle of a direction ``(2,)``."""
    offset = places[:, :2] - marks[0, :2]
    along = offset @ way
    across = np.abs(offset @ np.array([way[1], -way[0]]))
    sideways = SIDEWAYS_SHARE * np.maximum(across - along, 0.0)
    return np.where(along >= MARGIN_M - slack, np.linalg.norm(offset, axis=1) + sideways, np.inf)


def _middle(places: Array, marks: Array, slack: float) -> Array:
    """The one that is nearest to all others; of two, neither."""
    apart = np.linalg.norm(places[:, None, :2] - places[None, :, :2], axis=-1)
    return apart.sum(axis=1)


def _near_middle(places: Array, marks: Array, slack: float) -> Array:
    """The one that is nearest to the middle of the landmark, as seen from above."""
    return np.linalg.norm(places[:, :2] - marks[0, :2], axis=1)


def _between(places: Array, marks: Array, slack: float) -> Array:
    """The one that makes the way between two landmarks longer by least."""
    legs = np.linalg.norm(places[:, None, :2] - marks[None, :, :2], axis=-1).sum(axis=1)
    return legs - float(np.linalg.norm(marks[0, :2] - marks[1, :2]))


def _next_to(places: Array, marks: Array, slack: float) -> Array:
    """The nearest one that is not on or in the landmark."""
    away = _near_middle(places, marks, slack)
    return np.where(away < WITHIN_M - slack, np.inf, away)


def _above(places: Array, marks: Array, slack: float) -> Array:
    """The nearest one, as seen from above, that is not lower than the landmark."""
    too_low = places[:, 2] < marks[0, 2] - HEIGHT_ERROR_M - slack
    return np.where(too_low, np.inf, _near_middle(places, marks, slack))


def _below(places: Array, marks: Array, slack: float) -> Array:
    """The nearest one, as seen from above, that is not higher than the landmark."""
    too_high = places[:, 2] > marks[0, 2] + HEIGHT_ERROR_M + slack
    return np.where(too_high, np.inf, _near_middle(places, marks, slack))


# By relation and number of landmarks.
_COSTS: dict[tuple[str, int], Callable[[Array, Array, float], Array]] = {
    **{(side, 0): partial(_furthest, way=np.array(way)) for side, way in _SIDES.items()},
    **{(side, 1): partial(_at_side, way=np.array(way)) for side, way in _SIDES.items()},
    ("middle", 0): _middle,
    ("middle", 1): _near_middle,
    ("between", 2): _between,
    ("next to", 1): _next_to,
    ("on", 1): _above,
    ("in", 1): _above,
    ("under", 1): _below,
}
