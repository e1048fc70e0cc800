import math

import numpy as np
import pytest

from lerobot_openspm.envs.tabletop import placement as layouts
from lerobot_openspm.envs.tabletop import scene

LAYOUTS = [layouts.sample_layout(np.random.default_rng(seed)) for seed in range(100)]


def test_every_object_stays_within_its_range():
    for layout in LAYOUTS:
        assert tuple(layout) == scene.OBJECT_NAMES
        for name, at in layout.items():
            reach = layouts.FIXTURE_RANGE if name in layouts.FIXTURES else layouts.OBJECT_RANGE
            nominal = layouts.NOMINAL_XY[name]
            assert abs(at.x - nominal[0]) <= reach
            assert abs(at.y - nominal[1]) <= reach
            if name in layouts.FIXTURES:
                assert abs(at.yaw) <= layouts.FIXTURE_YAW_RANGE


def test_starts_cover_their_range():
    for name in scene.MOVABLE_NAMES:
        xs, ys = (np.array([getattr(layout[name], axis) for layout in LAYOUTS]) for axis in "xy")
        assert np.ptp(xs) > 0.16
        assert np.ptp(ys) > 0.16


def test_footprints_keep_a_gap():
    loose = [name for name in scene.OBJECT_NAMES if name not in layouts.FIXTURES]
    for layout in LAYOUTS:
        for i, a in enumerate(loose):
            for b in loose[i + 1 :]:
                for xa, ya, ra in layouts.footprint_discs(a, layout[a]):
                    for xb, yb, rb in layouts.footprint_discs(b, layout[b]):
                        assert math.hypot(xa - xb, ya - yb) >= ra + rb + layouts.GAP


def test_same_generator_same_layout():
    assert layouts.sample_layout(np.random.default_rng(7)) == layouts.sample_layout(np.random.default_rng(7))


def test_a_crowded_table_says_so(monkeypatch):
    monkeypatch.setattr(layouts, "is_admissible", lambda layout: False)
    monkeypatch.setattr(layouts, "MAX_TRIES", 10)
    with pytest.raises(layouts.LayoutError, match="10 tries"):
        layouts.sample_layout(np.random.default_rng(0))


def test_local_and_world_are_inverse():
    at = layouts.Placement(0.3, -0.1, 0.7)
    assert at.to_local(*at.to_world(0.2, 0.05)) == pytest.approx((0.2, 0.05))
