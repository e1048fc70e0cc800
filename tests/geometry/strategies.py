"""Hypothesis strategies for points, rotations and rigid transforms."""

import numpy as np
from hypothesis import strategies as st

from lerobot_openspm.geometry import se3


@st.composite
def vectors(draw: st.DrawFn, low: float = -2.0, high: float = 2.0) -> np.ndarray:
    return np.array([draw(st.floats(low, high, allow_subnormal=False)) for _ in range(3)])


@st.composite
def unit_vectors(draw: st.DrawFn) -> np.ndarray:
    vector = draw(vectors(-1.0, 1.0).filter(lambda v: np.linalg.norm(v) > 0.1))
    return vector / np.linalg.norm(vector)


@st.composite
def rotvecs(draw: st.DrawFn, max_angle: float = np.pi - 1e-3) -> np.ndarray:
    """Rotation vectors up to `max_angle`, the smallest and the largest angles among them."""
    edges = st.sampled_from([0.0, 1e-12, 1e-8, 1e-5, max_angle])
    return draw(unit_vectors()) * draw(st.one_of(edges, st.floats(0.0, max_angle)))


@st.composite
def transforms(draw: st.DrawFn) -> np.ndarray:
    return se3.transform(se3.exp_so3(draw(rotvecs())), draw(vectors()))
