"""The paper's Kalman filter over an object's pose, for any number of objects at once.

The state of one object is the paper's: position, velocity, local orientation error, angular velocity, twelve
numbers. Orientation lives on the manifold: the error is a small rotation about the reference orientation, in
the axes of the frame the filter works in; a prediction adds to it, and every update moves it into the
reference and sets it to zero. It is written as twice the Gibbs vector, axis times twice the tangent of half
the angle, which for the angles that errors have is the rotation vector and is quicker to come by. Everything
is batched over objects ``(n, ...)``; nothing in here knows of images.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lerobot_openspm.geometry import se3
from lerobot_openspm.geometry.se3 import Array

STATE = 12
# Mahalanobis distance, squared, that one in a thousand measurements of six numbers exceeds.
GATE = 22.46

# Measured are position and orientation error. Products with constant matrices take the place of index lists
# and sums throughout, which in NumPy take longer than a whole step of the filter may.
H = np.zeros((6, STATE))
H[[0, 1, 2, 3, 4, 5], [0, 1, 2, 6, 7, 8]] = 1.0
EYE_3, EYE_12 = np.eye(3), np.eye(STATE)
# Flattened cross-product matrices of the axes, and that of half the orientation error within the state.
SKEW = np.array([[0.0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]])
HALF_SKEW = np.zeros((3, STATE, STATE))
HALF_SKEW[:, 6:9, 6:9] = 0.5 * SKEW.reshape(3, 3, 3)
HALF_SKEW = HALF_SKEW.reshape(3, STATE * STATE)
AXIS, TRACE = 2 * SKEW.T, EYE_3.reshape(9, 1)
# Half a turn, whose trace is -1 and whose axis cannot be read off, comes out as a huge error and no zero.
ALMOST_ONE, ALMOST_NONE = 1 + 1e-15, 1e-12


class Motion(NamedTuple):
    """One step of the motion model: at constant velocity, but for white accelerations.

    Attributes:
        dt_s: Its length in seconds.
        F: ``F_t`` ``(12, 12)``.
        Q: ``Q_t`` ``(12, 12)``.
    """

    dt_s: float
    F: Array
    Q: Array


def motion(dt_s: float, linear: float, angular: float) -> Motion:
    """The motion model over ``dt_s`` seconds.

    Args:
        dt_s: Seconds.
        linear: Spectral density of the acceleration, metres per second and root second.
        angular: ... of the angular acceleration, radians per second and root second.
    """
    pair = np.array([[1.0, dt_s], [0.0, 1.0]])
    noise = np.array([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]])
    Q = np.zeros((STATE, STATE))
    Q[:6, :6] = np.kron(linear**2 * noise, EYE_3)
    Q[6:, 6:] = np.kron(angular**2 * noise, EYE_3)
    F = np.asarray(np.kron(np.eye(2), np.kron(pair, EYE_3)), float)
    return Motion(dt_s, F, Q)


class Belief(NamedTuple):
    """What is known of ``n`` objects.

    Attributes:
        position: ``p`` ``(n, 3)``, metres.
        rotation: Reference orientation ``(n, 3, 3)``.
        error: Orientation error ``(n, 3)``, which turns the reference into the orientation.
        velocity: ``(n, 3)``, metres per second.
        angular_velocity: ``(n, 3)``, radians per second, in the axes of the filter's frame.
        covariance: ``P`` ``(n, 12, 12)`` over position, velocity, orientation error, angular velocity.
    """

    position: Array
    rotation: Array
    error: Array
    velocity: Array
    angular_velocity: Array
    covariance: Array

    @property
    def T(self) -> Array:
        """Poses ``(n, 4, 4)``."""
        return se3.transform(_turned(self.error) @ self.rotation, self.position)


class Innovation(NamedTuple):
    """How a measurement compared with the prediction.

    Attributes:
        squared: Normalised innovation squared ``(n,)``; chi-squared with six degrees of freedom.
        accepted: Whether it passed the gate ``(n,)``.
    """

    squared: Array
    accepted: NDArray[np.bool_]


def begin(T: Array, R: Array, velocity_std: float = 0.0, angular_velocity_std: float = 0.0) -> Belief:
    """Beliefs from first measurements.

    Args:
        T: Poses ``(n, 4, 4)``.
        R: Their covariances ``(n, 6, 6)`` over position and orientation error.
        velocity_std: Of a velocity taken to be zero, metres per second.
        angular_velocity_std: Of an angular velocity taken to be zero, radians per second.
    """
    rates = np.repeat([0.0, velocity_std**2, 0.0, angular_velocity_std**2], 3)
    zero = np.zeros((len(T), 3))
    return Belief(T[:, :3, 3].copy(), T[:, :3, :3].copy(), zero, zero, zero, H.T @ R @ H + np.diag(rates))


def predict(belief: Belief, step: Motion) -> Belief:
    """``x = F x`` and ``P = F P F' + Q``."""
    return Belief(
        belief.position + belief.velocity * step.dt_s,
        belief.rotation,
        belief.error + belief.angular_velocity * step.dt_s,
        belief.velocity,
        belief.angular_velocity,
        step.F @ belief.covariance @ step.F.T + step.Q,
    )


def update(belief: Belief, T: Array, R: Array, gate: float = GATE) -> tuple[Belief, Innovation]:
    """Take in one measured pose per object, unless it lies outside the gate.

    Args:
        belief: The prediction.
        T: Measured poses ``(n, 4, 4)``; of all that look the same, the nearest to the prediction.
        R: Their covariances ``R_t`` ``(n, 6, 6)`` over position and orientation error; what was not measured
            has a large variance.
        gate: Measurements with a larger normalised innovation squared change nothing.
    """
    P = belief.covariance
    residual = np.empty((len(T), 6))
    residual[:, :3] = T[:, :3, 3] - belief.position
    residual[:, 3:] = _error(T[:, :3, :3] @ belief.rotation.mT) - belief.error
    PHt = P @ H.T
    S_inverse = np.linalg.inv(H @ PHt + R)
    K = PHt @ S_inverse
    squared = (residual[:, None] @ S_inverse @ residual[:, :, None])[:, 0, 0]
    accepted = squared <= gate
    K *= accepted[:, None, None]
    change = (K @ residual[:, :, None])[:, :, 0]
    turn = belief.error + change[:, 6:9]
    # What is left of the orientation error is seen from the moved reference.
    reset = EYE_12 + (turn @ HALF_SKEW).reshape(-1, STATE, STATE)
    # Joseph's form stays positive for any gain. In floating point it is symmetric only to the rounding of its
    # largest terms; where a large variance shrinks to a small one, that is visible, hence the mean with its
    # transpose.
    kept, gained = reset @ (EYE_12 - K @ H), reset @ K
    P = kept @ P @ kept.mT + gained @ R @ gained.mT
    P = 0.5 * (P + P.mT)
    updated = Belief(
        belief.position + change[:, :3],
        _turned(turn) @ belief.rotation,
        np.zeros_like(turn),
        belief.velocity + change[:, 3:6],
        belief.angular_velocity + change[:, 9:],
        P,
    )
    return updated, Innovation(squared, accepted)


def _turned(error: Array) -> Array:
    """Rotation matrices ``(n, 3, 3)`` of orientation errors ``(n, 3)``."""
    skew = (error @ SKEW).reshape(-1, 3, 3)
    turned: Array = EYE_3 + (skew + 0.5 * (skew @ skew)) / (1 + 0.25 * (error[:, None] @ error[:, :, None]))
    return turned


def _error(R: Array) -> Array:
    """Orientation errors ``(n, 3)`` of rotation matrices ``(n, 3, 3)``: the inverse of :func:`_turned`."""
    flat = R.reshape(-1, 9)
    return (flat @ AXIS + ALMOST_NONE) / (flat @ TRACE + ALMOST_ONE)
