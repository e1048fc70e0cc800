"""A drawn block and cup on a table, filmed by a hand that passes over them."""

import numpy as np
from tests.perception.drawn_world import DISTRACTOR, SHAPES, hand_camera, render

from lerobot_openspm.geometry import se3
from lerobot_openspm.types import ContactCue, DemonstrationScene, Moment

HOME = (-0.05, 0.0, 0.45)
MIDDLES = {"block": (0.02, -0.15, 0.0), "cup": (0.0, 0.15, 0.0), "distractor": (-0.02, 0.0, 0.0)}


def looking_down(x, y, z, tilt=0.0):
    """``T_world_ee`` of a hand whose camera looks down, leaning back by ``tilt`` radians."""
    c, s = np.cos(tilt), np.sin(tilt)
    axes = np.array([[0.0, -1.0, 0.0], [-c, 0.0, -s], [s, 0.0, -c]]).T
    return se3.transform(axes, np.array([x, y, z]))


def views_at(poses, T_world_ee):
    return render(
        [(SHAPES.get(name, DISTRACTOR), T) for name, T in poses.items()], None, hand_camera(T_world_ee)
    )


def demonstration(rng, touched=("cup", "block"), aside_m=0.0, cup_by=(0.0, 0.0, 0.0), task=""):
    """The hand comes from one side to the cup, grasps it, and carries it over the block.

    Or it touches the distractor; only what is named is told to have been touched. The block begins so far
    from its usual place, along the table, and the cup by so much from its own.
    """
    poses = {
        name: se3.from_yaw([x + dx, y + dy, 0.0], yaw)
        for (name, (x, y, yaw)), (dx, dy) in zip(
            MIDDLES.items(), rng.uniform(-0.012, 0.012, (3, 2)), strict=True
        )
    }
    poses["block"][0, 3] += aside_m
    poses["cup"][:3, 3] += cup_by
    grasp = poses["cup"][:3, 3] + [0.03, 0.0, 0.05] + rng.normal(0, 0.002, 3)
    release = poses["block"][:3, 3] + [0, 0, 0.12] + rng.normal(0, 0.002, 3)
    touch = poses["distractor"][:3, 3] + [0.02, 0.0, 0.04]
    cues = (
        ContactCue("cup", grasp, "grasp", task),
        ContactCue("block", release, "release", task),
        ContactCue("distractor", touch, "contact", task),
    )
    places = [
        (
            *(rng.uniform(-0.25, 0.2), rng.uniform(-0.25, 0.25), rng.uniform(0.25, 0.45)),
            rng.uniform(-0.5, 0.5),
        )
        for _ in range(16)
    ]

    def film():
        moments = [Moment(views_at(poses, looking_down(*HOME)), frozenset())]
        for place in places:
            seen = views_at(poses, looking_down(*place))
            moments.append(Moment({"hand": seen["hand"]}, frozenset()))
        return moments

    told = tuple(cue for cue in cues if cue.name in touched)
    return DemonstrationScene(views_at(poses, looking_down(*HOME)), told, None, film)


def moved(x, y, yaw):
    return {"block": se3.from_yaw([x, y, 0.0], yaw), "distractor": se3.from_yaw([-0.18, 0.17, 0.0], 0.0)}
