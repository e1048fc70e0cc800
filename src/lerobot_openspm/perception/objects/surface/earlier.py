"""What earlier looks showed of an object where it is expected now."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import Look
from lerobot_openspm.perception.objects.surface.compare import score_at
from lerobot_openspm.perception.objects.surface.shown import visible_share
from lerobot_openspm.perception.objects.surface.sight import Sight, Surface

# Earlier looks that found an object less than so far from where it is expected tell of it, metres.
STILL_M = 0.03
# Where other things stood before it when it was found, fixed cameras showed less of it, but at least this
# share of the typical agreement. A camera that has this share of its points in the picture should show it.
LEAST_SHOWN_SHARE, IN_VIEW_SHARE = 0.25, 0.5
# Of what the hand leaves less than this share to be seen, nothing tells that it is gone.
COVERED_SHARE = 0.5

# The views of a look as surfaces are compared with them.
SightsOf = Callable[[Look], dict[str, Sight]]


def sights_before(look: Look, name: str, T_expected: Array, sights_of: SightsOf) -> dict[str, Sight]:
    """The views of earlier looks in which an object was found where it is expected."""
    return {
        f"{camera}, earlier look {i}": sight
        for i, earlier, _ in _found_there(look, name, T_expected)
        for camera, sight in sights_of(earlier).items()
    }


def share_if_there(
    look: Look, name: str, surface: Surface, typical_agreement: float, T_expected: Array, sights_of: SightsOf
) -> float:
    """The share of the typical agreement that an object should show which is still where it is expected.

    What stood before it when it was found by fixed cameras hides as much of it from them now. 1 where there
    was no such look, where they showed too little of it to tell, and where a camera of the hand should show
    it now. 0 where the hand hides most of it.
    """
    points = se3.apply(T_expected, surface.coloured)
    covered = replace(look, hidden={camera: sight.hidden for camera, sight in sights_of(look).items()})
    if visible_share(covered, points) < COVERED_SHARE:
        return 0.0
    hand = {camera: view for camera, view in look.views.items() if view.camera.mount == "ee"}
    if hand and replace(covered, views=hand).seen_share(points) > IN_VIEW_SHARE:
        return 1.0
    for _, earlier, T in _found_there(look, name, T_expected):
        fixed = {camera for camera, view in earlier.views.items() if view.camera.mount != "ee"}
        sights = {c: one for c, one in sights_of(earlier).items() if c in fixed & look.views.keys()}
        if sights:
            pose = np.array([*T[:3, 3], se3.yaw_of(T)])
            share = score_at(surface, sights, pose) / typical_agreement
            return share if LEAST_SHOWN_SHARE < share < 1 else 1.0
    return 1.0


def _found_there(look: Look, name: str, T_expected: Array) -> Iterator[tuple[int, Look, Array]]:
    """Earlier looks, their numbers, and where ``(4, 4)`` they found an object about where it is expected."""
    for i, earlier in enumerate(look.before):
        T = earlier.poses.get(name)
        if T is not None and np.linalg.norm(T[:3, 3] - T_expected[:3, 3]) < STILL_M:
            yield i, earlier.look, T
