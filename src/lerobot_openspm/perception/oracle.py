"""Object poses that a simulator tells, in the form that perception gives them (oracle ablation only)."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.perception.objects.base import KnownObject


def decode_object_poses(values: Array, names: Sequence[str]) -> dict[str, Array]:
    """Read position and quat_wxyz ``(n * 7,)``; names are ``<object>`` or ``<object>.<component>``.

    Objects whose numbers are all zero are not in the scene, and left out.
    """
    objects = list(dict.fromkeys(name.rsplit(".", 1)[0] for name in names))
    rows = np.asarray(values, float).reshape(len(objects), 7)
    present = np.abs(rows).max(axis=1) > 0
    quat_xyzw = rows[present][:, [4, 5, 6, 3]]
    T = se3.transform(se3.matrix_from_quat_xyzw(quat_xyzw), rows[present, :3])
    return dict(zip(itertools.compress(objects, present), T, strict=True))


def name_simulator_poses(
    poses: Mapping[str, Array], nouns: Sequence[str], models: Mapping[str, KnownObject]
) -> dict[str, Array]:
    """Simulator poses under the nouns of the instructions: "bottle" is the "wine bottle".

    A name in several words, such as "cookie_box", is that of a noun with all of them. The name with most
    words counts, and of those the first.

    The yaw of a body of revolution is dropped, as perception, which cannot see it, does.
    """
    named = {}
    for noun in nouns:
        fitting = [name for name in poses if set(name.split("_")) <= set(noun.split())]
        match = max(fitting, key=lambda name: name.count("_"), default=None)
        if match is None:
            continue
        T = poses[match]
        turns = noun not in models or models[noun].yaw_period > 0
        named[noun] = T if turns else se3.transform(np.eye(3), T[:3, 3])
    return named
