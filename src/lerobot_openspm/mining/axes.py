"""The lines along which drawers slide and about which knobs turn, from how demonstrations moved them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.memory.entry import AXIS_KINDS, Anchor, Axis
from lerobot_openspm.mining.anchors import Demonstration, Role, roles

# The direction of a smaller motion, in metres or radians, is noise.
MIN_AMOUNT = {"slide": 0.02, "turn": np.deg2rad(10)}


def constrained_axes(
    demonstrations: Sequence[Demonstration], anchors: Mapping[Role, Anchor]
) -> list[dict[Role, Axis]]:
    """Axes of the constrained key poses of one task, per demonstration.

    The direction, in the anchor's frame, is the demonstrations' median; the amount is each one's own.
    """
    motions: list[dict[Role, Array]] = [_motions(one, anchors) for one in demonstrations]
    gathered: dict[Role, list[Array]] = defaultdict(list)
    for motion in motions:
        for role, vector in motion.items():
            gathered[role].append(vector)
    directions = {role: _unit(np.median([_unit(v) for v in vs], axis=0)) for role, vs in gathered.items()}
    return [
        {
            role: Axis(AXIS_KINDS[role[1]], directions[role], float(vector @ directions[role]))
            for role, vector in motion.items()
        }
        for motion in motions
    ]


def _motions(demonstration: Demonstration, anchors: Mapping[Role, Anchor]) -> dict[Role, Array]:
    """Displacement, or rotation vector, of the hand on the way to each constrained key pose."""
    found: dict[Role, Array] = {}
    named = list(zip(roles(demonstration.key_poses), demonstration.key_poses, strict=True))
    for (_, before), (role, pose) in pairwise(named):
        anchor, kind = anchors.get(role), AXIS_KINDS.get(pose.phase)
        if kind is None or anchor is None:
            continue
        start, end = (demonstration.in_frame(anchor, one) for one in (before, pose))
        if start is None or end is None:
            continue
        slide = end[:3, 3] - start[:3, 3]
        vector = slide if kind == "slide" else se3.log_so3(end[:3, :3] @ start[:3, :3].T)
        if float(np.linalg.norm(vector)) >= MIN_AMOUNT[kind]:
            found[role] = vector
    return found


def _unit(vector: Array) -> Array:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
