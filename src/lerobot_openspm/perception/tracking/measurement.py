"""The paper's observation covariance ``R_t`` of a pose estimate, from what the estimate rests on.

What the fit itself says of its covariance is scaled by a factor that depends on the confidence of the
segmentation, the area that was seen, the share of the object in sight, the consistency between the views and
the quality of the reconstruction. The mapping is log-linear. Its weights were fitted to the errors of poses
along episodes in the simulators, by maximum likelihood (``benchmarks/measurement_noise.py``).
"""

from __future__ import annotations

import numpy as np

from lerobot_openspm.geometry.se3 import Array
from lerobot_openspm.types import PoseEstimate, Support

# Of the factor's logarithm on variances: constant, confidence, area, share in sight, consistency, quality.
# Patches are in sight or not, and their yaw is not measured.
POSITION_WEIGHTS = {"shape": (0.7, 0.0, 0.1, 3.4, 1.1, 10.2), "patches": (-0.1, 12.0, 1.3, 0.0, 1.0, 0.0)}
YAW_WEIGHTS = {"shape": (-1.4, 0.4, 0.6, 1.3, 2.8, 6.2), "patches": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}
# Objects are taken to stand upright, as level as a table is, and no estimate is better than this.
LEVEL_RAD, FLOOR_M, FLOOR_RAD = 0.02, 5e-4, 5e-3
TYPICAL_AREA_PX = 1000.0


def features(estimate: PoseEstimate, support: Support) -> Array:
    """What the factor is a function of ``(6,)``: minus the logarithms of shares and of the area."""
    shares = (estimate.confidence, estimate.visible, support.consistency, support.quality)
    confidence, visible, consistency, quality = (float(-np.log(np.clip(share, 0.05, 1))) for share in shares)
    area = float(-np.log(max(support.area_px, 1.0) / TYPICAL_AREA_PX))
    return np.array([1.0, confidence, area, visible, consistency, quality])


def measurement_covariance(estimate: PoseEstimate) -> Array:
    """``R_t`` ``(6, 6)`` over position and orientation error, world axes."""
    scale = np.ones(4)
    if (support := estimate.support) is not None:
        row = features(estimate, support)
        scale[:3] = np.exp(0.5 * row @ np.array(POSITION_WEIGHTS[support.kind]))
        scale[3] = np.exp(0.5 * row @ np.array(YAW_WEIGHTS[support.kind]))
    R = np.diag([0.0, 0.0, 0.0, LEVEL_RAD**2, LEVEL_RAD**2, 0.0])
    R[np.ix_([0, 1, 2, 5], [0, 1, 2, 5])] = scale[:, None] * estimate.covariance * scale
    R[[0, 1, 2, 5], [0, 1, 2, 5]] += np.array([FLOOR_M**2] * 3 + [FLOOR_RAD**2])
    return R
