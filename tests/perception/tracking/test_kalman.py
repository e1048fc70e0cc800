import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from scipy.stats import chi2
from tests.geometry.strategies import transforms

from lerobot_openspm.geometry import se3
from lerobot_openspm.perception.tracking import kalman

STEP = kalman.motion(0.05, linear=0.05, angular=0.2)
R = np.diag([1e-6, 1e-6, 4e-6, 1e-4, 1e-4, 4e-4])


def tracks(n: int, steps: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, kalman.Belief]:
    """True poses and measurements `(steps, n, 4, 4)` of objects moved by the model, and the first belief."""
    T = se3.transform(se3.exp_so3(rng.uniform(-1.5, 1.5, (n, 3))), rng.uniform(-0.5, 0.5, (n, 3)))
    rates = np.concatenate([0.1 * rng.standard_normal((n, 3)), 0.3 * rng.standard_normal((n, 3))], axis=1)
    half = np.linalg.cholesky(R)
    noise = np.linalg.cholesky(STEP.Q + 1e-18 * np.eye(12))
    true, seen = [], []
    for _ in range(steps):
        true.append(T)
        error = rng.standard_normal((n, 6)) @ half.T
        seen.append(se3.apply_increment(T, error))
        pushed = rng.standard_normal((n, 12)) @ noise.T
        move = STEP.dt_s * rates + pushed[:, [0, 1, 2, 6, 7, 8]]
        T = se3.apply_increment(T, move)
        rates = rates + pushed[:, [3, 4, 5, 9, 10, 11]]
    belief = kalman.begin(seen[0], np.tile(R, (n, 1, 1)), velocity_std=0.1, angular_velocity_std=0.3)
    return np.array(true), np.array(seen), belief


def errors(belief: kalman.Belief, true: np.ndarray) -> np.ndarray:
    return se3.increment(belief.T, true)


def test_innovations_are_as_large_as_the_filter_expects_over_a_thousand_tracks():
    n, steps = 1000, 30
    # One seed in twenty falls outside such bounds by chance.
    true, seen, belief = tracks(n, steps, np.random.default_rng(1))
    squared, apart = [], []
    for t in range(1, steps):
        belief, innovation = kalman.update(
            kalman.predict(belief, STEP), seen[t], np.tile(R, (n, 1, 1)), np.inf
        )
        squared.append(innovation.squared)
        off = errors(belief, true[t])
        P = kalman.H @ belief.covariance @ kalman.H.T
        apart.append((off[:, None] @ np.linalg.inv(P) @ off[:, :, None])[:, 0, 0])
    count = n * (steps - 1)
    # 95 % bounds of the mean of so many chi-squared numbers of six degrees of freedom.
    low, high = chi2.ppf([0.025, 0.975], 6 * count) / count
    assert low < np.mean(squared) < high
    # And 95 % of the tracks keep their own sum within its own bounds, give or take what 1,000 tracks tell.
    low, high = chi2.ppf([0.025, 0.975], 6 * (steps - 1))
    inside = np.mean([low < total < high for total in np.sum(squared, axis=0)])
    assert inside == pytest.approx(0.95, abs=0.02)
    # The error against the truth is as the covariance says, too; errors of one track are not independent.
    assert np.mean(apart) == pytest.approx(6, abs=0.15)


def test_filtering_is_better_than_the_measurements():
    n, steps = 200, 40
    true, seen, belief = tracks(n, steps, np.random.default_rng(1))
    for t in range(1, steps):
        belief, _ = kalman.update(kalman.predict(belief, STEP), seen[t], np.tile(R, (n, 1, 1)))
    raw = np.linalg.norm(se3.increment(seen[-1], true[-1]), axis=0)
    assert (np.linalg.norm(errors(belief, true[-1]), axis=0) < 0.9 * raw).all()


def test_position_alone_is_the_textbook_filter():
    """Against the equations of the paper written out with full matrices."""
    rng = np.random.default_rng(2)
    belief = kalman.begin(np.eye(4)[None], R[None], 0.1, 0.3)
    x, P = np.zeros(12), belief.covariance[0]
    for _ in range(20):
        z = 0.01 * rng.standard_normal(3)
        x, P = STEP.F @ x, STEP.F @ P @ STEP.F.T + STEP.Q
        K = P @ kalman.H.T @ np.linalg.inv(kalman.H @ P @ kalman.H.T + R)
        x = x + K @ (np.concatenate([z, np.zeros(3)]) - kalman.H @ x)
        P = (np.eye(12) - K @ kalman.H) @ P
        measured = se3.transform(np.eye(3), z)[None]
        belief, _ = kalman.update(kalman.predict(belief, STEP), measured, R[None], np.inf)
    np.testing.assert_allclose(belief.position[0], x[:3], atol=1e-12)
    np.testing.assert_allclose(belief.velocity[0], x[3:6], atol=1e-11)
    np.testing.assert_allclose(belief.covariance[0], P, atol=1e-12)


def test_a_measurement_outside_the_gate_changes_nothing_but_its_own_object():
    T = np.tile(np.eye(4), (2, 1, 1))
    belief = kalman.predict(kalman.begin(T, np.tile(R, (2, 1, 1)), 0.01, 0.01), STEP)
    T[0, 0, 3], T[1, 0, 3] = 0.5, 0.001
    after, innovation = kalman.update(belief, T, np.tile(R, (2, 1, 1)))
    assert innovation.accepted.tolist() == [False, True]
    np.testing.assert_allclose(after.position[0], belief.position[0])
    np.testing.assert_allclose(after.covariance[0], belief.covariance[0], atol=1e-15)
    assert 0 < after.position[1, 0] <= 0.001


def test_half_a_turn_is_outside_the_gate():
    belief = kalman.begin(np.eye(4)[None], R[None])
    over = se3.transform(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))[None]
    after, innovation = kalman.update(belief, over, R[None])
    assert not innovation.accepted[0]
    assert np.isfinite(after.T).all()


def test_an_unmeasured_yaw_stays_unknown():
    """As perception says of a body of revolution: its yaw has the variance of any angle."""
    blind = R.copy()
    blind[5, 5] = np.pi**2 / 3
    belief = kalman.begin(np.eye(4)[None], blind[None])
    for _ in range(20):
        belief, _ = kalman.update(belief, np.eye(4)[None], blind[None])
    assert belief.covariance[0, 8, 8] > 0.1
    assert belief.covariance[0, 6, 6] < 1e-5


@given(T=transforms(), seed=st.integers(0, 2**32 - 1))
def test_moving_the_world_moves_the_estimate(T: np.ndarray, seed: int):
    rng = np.random.default_rng(seed)
    noise = 1e-4 * np.eye(6)  # the same along every axis, so that a turn of the world leaves it alone
    start = se3.transform(se3.exp_so3(rng.uniform(-0.1, 0.1, (1, 3))), rng.uniform(-0.1, 0.1, (1, 3)))
    plain, moved = (kalman.begin(pose, noise[None], 0.1, 0.1) for pose in (start, T @ start))
    for _ in range(4):
        seen = se3.apply_increment(start, 0.02 * rng.standard_normal((1, 6)))
        plain, one = kalman.update(kalman.predict(plain, STEP), seen, noise[None])
        moved, other = kalman.update(kalman.predict(moved, STEP), T @ seen, noise[None])
        np.testing.assert_allclose(one.squared, other.squared, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(moved.T, T @ plain.T, atol=1e-8)


@given(st.integers(1, 5), st.integers(0, 2**32 - 1))
def test_many_objects_are_filtered_as_each_alone(n: int, seed: int):
    rng = np.random.default_rng(seed)
    _, seen, belief = tracks(n, 4, rng)
    alone = [kalman.Belief(*(part[i : i + 1] for part in belief)) for i in range(n)]
    for measured in seen[1:]:
        belief, _ = kalman.update(kalman.predict(belief, STEP), measured, np.tile(R, (n, 1, 1)))
        alone = [
            kalman.update(kalman.predict(one, STEP), measured[i : i + 1], R[None])[0]
            for i, one in enumerate(alone)
        ]
    for i, one in enumerate(alone):
        np.testing.assert_allclose(belief.T[i], one.T[0], atol=1e-12)
        np.testing.assert_allclose(belief.covariance[i], one.covariance[0], atol=1e-14)


@given(st.integers(0, 2**32 - 1))
@example(229)  # a variance of 1e6 shrinks to 1e-2 in one step
@example(287)
def test_the_covariance_stays_symmetric_and_positive(seed: int):
    rng = np.random.default_rng(seed)
    belief = kalman.begin(np.eye(4)[None], R[None], 1.0, 1.0)
    for _ in range(100):
        spread = np.diag(10.0 ** rng.uniform(-12, 2, 6))
        measured = se3.transform(se3.exp_so3(0.3 * rng.standard_normal(3)), 0.1 * rng.standard_normal(3))[
            None
        ]
        belief, _ = kalman.update(kalman.predict(belief, STEP), measured, spread[None], np.inf)
        P = belief.covariance[0]
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P).min() > -1e-9 * np.abs(P).max()
