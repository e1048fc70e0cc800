import dataclasses

import numpy as np
import pytest

from lerobot_openspm.perception.tracking.measurement import measurement_covariance
from lerobot_openspm.types import PoseEstimate, Support

GOOD = PoseEstimate(
    "found", np.eye(4), np.diag([1e-6, 2e-6, 0.0, 1e-4]), 1.0, 1.0, Support("shape", 1000.0, 1.0, 0.95)
)


def variances(estimate):
    R = measurement_covariance(estimate)
    np.testing.assert_allclose(R, R.T)
    assert np.linalg.eigvalsh(R).min() > 0
    return np.diag(R)


@pytest.mark.parametrize("kind", ["shape", "patches"])
@pytest.mark.parametrize(
    ("worse", "value"),
    [("confidence", 0.7), ("visible", 0.6), ("area_px", 200.0), ("consistency", 0.6), ("quality", 0.8)],
)
def test_the_less_an_estimate_rests_on_the_less_it_counts(kind, worse, value):
    support = dataclasses.replace(GOOD.support, kind=kind)
    good = dataclasses.replace(GOOD, support=support)
    if worse in ("confidence", "visible"):
        poor = dataclasses.replace(good, **{worse: value})
    else:
        poor = dataclasses.replace(good, support=dataclasses.replace(support, **{worse: value}))
    assert (variances(poor)[[0, 1, 5]] >= variances(good)[[0, 1, 5]]).all()


def test_every_ground_of_the_paper_matters_for_shapes():
    poorer = {
        "visible": dataclasses.replace(GOOD, visible=0.6),
        "area_px": dataclasses.replace(GOOD, support=dataclasses.replace(GOOD.support, area_px=200.0)),
        "consistency": dataclasses.replace(GOOD, support=dataclasses.replace(GOOD.support, consistency=0.6)),
        "quality": dataclasses.replace(GOOD, support=dataclasses.replace(GOOD.support, quality=0.8)),
        "confidence": dataclasses.replace(GOOD, confidence=0.6),
    }
    for name, poor in poorer.items():
        assert (variances(poor) / variances(GOOD)).max() > 1.02, name


def test_without_grounds_the_covariance_is_the_estimates_own():
    exact = dataclasses.replace(GOOD, support=None, covariance=np.diag([4e-6, 4e-6, 4e-6, 1e-4]))
    np.testing.assert_allclose(variances(exact)[[0, 1, 2, 5]], [4.25e-6] * 3 + [1.25e-4])
