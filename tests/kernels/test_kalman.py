"""Batched Kalman filters against the textbook's, track by track with full matrices in NumPy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.kalman import STATE_SIZES, KalmanFilter, kalman_predict, kalman_update

MODELS = tuple(STATE_SIZES)


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def some_tracks(model, n, seed, dtype=np.float64):
    """States, covariances, spectral densities, measurements and their variances."""
    rng = np.random.default_rng(seed)
    size = STATE_SIZES[model]
    state = rng.normal(0, 1, (n, size)) * np.r_[30, 30, 1, 1, 0.5, 0.5, 2, [8, 8, 1][: size - 7]]
    state[:, 6] = wrapped(state[:, 6])
    root = rng.normal(0, 0.4, (n, size, size))
    covariance = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(size)
    noise = rng.uniform(0.01, 1.0, (n, size))
    measured = state[:, :7] + rng.normal(0, 0.5, (n, 7))
    return [array.astype(dtype) for array in (state, covariance, noise, measured, rng.uniform(0.05, 1.0, (n, 7)))]


def ctrv_motion(x, dt):
    """The textbook's formula, with its division by the yaw rate."""
    moved = x.copy()
    yaw, speed, rate = x[6], x[7], x[8]
    if abs(rate) > 1e-9:
        moved[0] += speed / rate * (np.sin(yaw + rate * dt) - np.sin(yaw))
        moved[1] += speed / rate * (np.cos(yaw) - np.cos(yaw + rate * dt))
    else:
        moved[0] += speed * dt * np.cos(yaw)
        moved[1] += speed * dt * np.sin(yaw)
    moved[6] += rate * dt
    return moved


def predicted(model, x, P, dt, q):
    """F P Fᵀ + Q of one track; the Jacobian of the turn by central differences."""
    size = len(x)
    Q = np.diag(np.r_[q[:7], np.zeros(size - 7)] * dt)
    block = np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    if model == "constant_velocity":
        F = np.eye(size)
        F[[0, 1, 2], [7, 8, 9]] = dt
        moved = F @ x
        for axis in range(3):
            Q[np.ix_([axis, 7 + axis], [axis, 7 + axis])] += q[7 + axis] * block
    else:
        moved = ctrv_motion(x, dt)
        steps = 1e-5 * np.eye(size)
        F = np.stack([(ctrv_motion(x + h, dt) - ctrv_motion(x - h, dt)) / 2e-5 for h in steps], axis=1)
        c, s = np.cos(x[6] + x[8] * dt / 2), np.sin(x[6] + x[8] * dt / 2)
        G = np.zeros((size, 2))
        G[0, 0], G[1, 0], G[7, 1] = c, s, 1.0
        Q += q[7] * G @ block @ G.T
        Q[np.ix_([6, 8], [6, 8])] += q[8] * block
    moved[6] = wrapped(moved[6])
    return moved, F @ P @ F.T + Q


def corrected(x, P, z, r):
    """K = P Hᵀ (H P Hᵀ + R)⁻¹ of one track, all numbers at once."""
    seen = np.flatnonzero(np.isfinite(z))
    H = np.eye(7, len(x))[seen]
    innovation = z[seen] - x[seen]
    innovation[seen == 6] = wrapped(innovation[seen == 6])
    S = H @ P @ H.T + np.diag(r[seen])
    K = P @ H.T @ np.linalg.inv(S)
    updated = x + K @ innovation
    updated[6] = wrapped(updated[6])
    distance = innovation @ np.linalg.solve(S, innovation)
    likelihood = -0.5 * (distance + np.linalg.slogdet(2 * np.pi * S)[1])
    return updated, (np.eye(len(x)) - K @ H) @ P, distance, likelihood


def close(got, expected, tolerance):
    """Equal but for a share of the largest number; yaws may differ by a turn."""
    difference = got - expected
    if got.ndim == 2 and got.shape[1] > 7:
        difference[:, 6] = wrapped(difference[:, 6])
    np.testing.assert_array_less(np.abs(difference), tolerance * np.abs(expected).max() + 1e-300)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-9), (np.float32, 1e-5)])
def test_prediction_is_the_textbooks(model, dtype, tolerance, device):
    """Within 1e-9 of the largest number in double precision (of differences in the reference), 1e-5 in single."""
    state, covariance, noise, _, _ = some_tracks(model, 200, 1, dtype)
    dt = np.random.default_rng(2).uniform(0.02, 0.5, 200).astype(dtype)
    given_arrays = [on(device, array) for array in (state, covariance, dt, noise)]
    got = [back(array) for array in kalman_predict(*given_arrays, model=model)]
    assert got[0].dtype == dtype
    pairs = [
        predicted(model, *(a.astype(np.float64) for a in (x, P)), float(t), q.astype(np.float64))
        for x, P, t, q in zip(state, covariance, dt, noise, strict=True)
    ]
    close(got[0].astype(np.float64), np.array([x for x, _ in pairs]), tolerance)
    close(got[1].astype(np.float64), np.array([P for _, P in pairs]), tolerance)


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(np.float64, 1e-11), (np.float32, 1e-4)])
def test_correction_is_the_textbooks(model, dtype, tolerance, device):
    """Within 1e-11 of the largest number in double precision, 1e-4 in single; some numbers are not measured."""
    state, covariance, _, measured, variance = some_tracks(model, 200, 3, dtype)
    measured[np.random.default_rng(4).random(measured.shape) < 0.2] = np.nan
    got = kalman_update(*(on(device, a) for a in (state, covariance, measured, variance)), model=model)
    expected = [
        corrected(*(a.astype(np.float64) for a in arrays))
        for arrays in zip(state, covariance, measured, variance, strict=True)
    ]
    for name, part in zip(
        ("state", "covariance", "distance", "log_likelihood"), zip(*expected, strict=True), strict=True
    ):
        close(back(getattr(got, name)).astype(np.float64), np.array(part), tolerance)


def on(device, array):
    return array if device == "cpu" else wp.array(array, dtype=wp.dtype_from_numpy(array.dtype), device=device)


def back(array):
    return array if isinstance(array, np.ndarray) else array.numpy()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(MODELS), st.floats(0.01, 1.0))
def test_covariances_stay_symmetric_and_positive_and_corrections_only_lower_them(seed, model, dt):
    state, covariance, noise, measured, variance = some_tracks(model, 5, seed)
    state, covariance = kalman_predict(state, covariance, dt, noise, model=model)
    update = kalman_update(state, covariance, measured, variance, model=model)
    for matrix in (covariance, update.covariance):
        assert np.array_equal(matrix, matrix.transpose(0, 2, 1)) or np.allclose(
            matrix, matrix.transpose(0, 2, 1), rtol=1e-12
        )
        assert np.linalg.eigvalsh(matrix).min() > 0
    assert np.linalg.eigvalsh(covariance - update.covariance).min() > -1e-9
    assert (update.distance >= 0).all()


@pytest.mark.parametrize("rate", [0.0, 1e-12, -1e-6, 0.3, 0.41, 5.0])
def test_turns_of_any_rate_are_exact(rate):
    """Also the ones that the textbook's formula divides by next to nothing; against steps of a microsecond's share."""
    state = np.array([[1.0, 2.0, 0, 4, 2, 1.5, 0.7, 10.0, rate]])
    moved, _ = kalman_predict(state, np.eye(9)[None], 0.1, np.zeros(9), model="ctrv")
    yaw = 0.7 + rate * (np.arange(100_000) + 0.5) * 1e-6
    assert moved[0, :2] == pytest.approx([1 + 1e-5 * np.cos(yaw).sum(), 2 + 1e-5 * np.sin(yaw).sum()], abs=1e-9)


@pytest.mark.parametrize("model", MODELS)
def test_tracks_that_are_not_active_stay_as_they_are(model):
    state, covariance, noise, measured, variance = some_tracks(model, 6, 5)
    active = np.array([True, False, True, False, False, True])
    moved = kalman_predict(state, covariance, 0.1, noise, model=model, active=active)
    update = kalman_update(state, covariance, measured, variance, model=model, active=active.astype(np.int64))
    for new, old in ((moved[0], state), (moved[1], covariance), (update.state, state), (update.covariance, covariance)):
        assert np.array_equal(new[~active], old[~active])
        assert (new[active] != old[active]).any()
    assert (update.distance[~active] == 0).all()
    assert (update.log_likelihood[~active] == 0).all()


def test_the_short_way_round():
    state, covariance, _, measured, variance = some_tracks("constant_velocity", 1, 6)
    covariance[:] = np.eye(10)
    state[0, 6], measured[0, 6] = np.pi - 0.1, -np.pi + 0.1
    variance[:] = 1.0
    assert kalman_update(state, covariance, measured, variance).state[0, 6] == pytest.approx(-np.pi)


def test_nothing_measured_changes_nothing():
    state, covariance, _, measured, variance = some_tracks("ctrv", 3, 7)
    measured[:] = np.nan
    measured[1] = np.inf
    update = kalman_update(state, covariance, measured, variance, model="ctrv")
    assert np.array_equal(update.state, state)
    assert np.array_equal(update.covariance, covariance)
    assert (update.distance == 0).all()


def test_a_filter_finds_the_speed_of_what_it_follows():
    rng = np.random.default_rng(8)
    state, covariance = np.zeros((1, 9)), 10.0 * np.eye(9)[None]
    true = np.array([0, 0, 0, 4.5, 1.9, 1.6, 0.5, 9.0, 0.4])
    noise, variance = np.r_[np.full(7, 1e-3), 1.0, 0.1], np.full(7, 0.01)
    for _ in range(60):
        true = ctrv_motion(true, 0.1)
        state, covariance = kalman_predict(state, covariance, 0.1, noise, model="ctrv")
        update = kalman_update(state, covariance, (true[:7] + rng.normal(0, 0.1, 7))[None], variance, model="ctrv")
        state, covariance = update.state, update.covariance
    assert state[0, 7] == pytest.approx(9.0, abs=0.5)
    assert state[0, 8] == pytest.approx(0.4, abs=0.15)


@pytest.mark.parametrize("model", MODELS)
def test_the_plan_does_what_the_functions_do(model, device):
    state, covariance, noise, measured, variance = some_tracks(model, 8, 9, np.float32)
    active = np.array([1, 1, 0, 1, 1, 1, 1, 0], np.int32)
    plan = KalmanFilter(capacity=8, model=model, device=device)

    def put(array):
        return wp.array(array, dtype=wp.dtype_from_numpy(array.dtype), device=device)

    for array, target in ((state, plan.state), (covariance, plan.covariance), (active, plan.active)):
        wp.copy(target, put(array))
    plan.predict(put(np.float32([0.1])), put(noise))
    plan.update(put(measured), put(variance[:1]))
    moved = kalman_predict(state, covariance, 0.1, noise, model=model, active=active)
    update = kalman_update(*moved, measured, variance[0], model=model, active=active)
    for name in ("state", "covariance", "distance", "log_likelihood"):
        got, expected = getattr(plan, name).numpy(), getattr(update, name)
        assert np.array_equal(got, expected) if device == "cpu" else np.allclose(got, expected, rtol=1e-4, atol=1e-5)


def test_a_launch_can_be_captured():
    plan = KalmanFilter(capacity=4, dtype="float64")
    plan.active.fill_(1)
    plan.covariance.assign(np.tile(np.eye(10), (4, 1, 1)))
    plan.state.assign(np.ones((4, 10)))
    dt, noise = wp.array([0.1], dtype=wp.float64, device="cpu"), wp.zeros((1, 10), dtype=wp.float64, device="cpu")
    plan.predict(dt, noise)
    with wp.ScopedCapture(device="cpu") as capture:
        plan.predict(dt, noise)
    before = plan.state.numpy().copy()
    for _ in range(3):
        wp.capture_launch(capture.graph)
    assert plan.state.numpy()[:, :3] == pytest.approx(before[:, :3] + 0.3, abs=1e-12)
    assert np.array_equal(plan.state.numpy()[:, 3:], before[:, 3:])


def test_any_array_will_do_and_none_is_changed():
    state, covariance, noise, _, _ = some_tracks("ctrv", 5, 10)
    before = state.copy(), covariance.copy()
    expected = kalman_predict(state, covariance, 0.1, noise, model="ctrv")
    assert np.array_equal(state, before[0])
    assert np.array_equal(covariance, before[1])
    wide = np.zeros((5, 18))
    wide[:, ::2] = state
    wide.flags.writeable = False
    assert np.array_equal(kalman_predict(wide[:, ::2], covariance, 0.1, noise, model="ctrv")[0], expected[0])
    torch = pytest.importorskip("torch")
    got = kalman_predict(torch.from_numpy(state), torch.from_numpy(covariance), 0.1, noise, model="ctrv")
    assert isinstance(got[0], torch.Tensor)
    assert np.array_equal(got[1].numpy(), expected[1])


def test_no_tracks_at_all():
    state, covariance = np.empty((0, 10), np.float32), np.empty((0, 10, 10), np.float32)
    moved = kalman_predict(state, covariance, 0.1, np.zeros(10))
    assert moved[0].shape == (0, 10)
    assert kalman_update(*moved, np.empty((0, 7)), np.ones(7)).distance.shape == (0,)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda s, p: kalman_predict(s, p, 0.1, np.zeros(10), model="walk"), ValueError, "model must be one of"),
        (lambda s, p: kalman_predict(s, p, 0.1, np.zeros(9)), ValueError, r"noise must have shape \(10\)"),
        (lambda s, p: kalman_predict(s, p[:1], 0.1, np.zeros(10)), ValueError, "covariance must have shape"),
        (lambda s, p: kalman_predict(s, p, np.zeros(3), np.zeros(10)), ValueError, "dt must have shape"),
        (lambda s, p: kalman_predict(s, p, 0.1, [0.0] * 10), TypeError, "noise must be a NumPy, torch, Warp"),
        (
            lambda s, p: kalman_predict(s, p, 0.1, np.zeros(10), active=np.ones(2)),
            TypeError,
            "active must be of an int",
        ),
        (lambda s, p: kalman_update(s, p, np.zeros((2, 6)), np.ones(7)), ValueError, "measurements must have shape"),
        (lambda s, p: kalman_update(s[:, :9], p, np.zeros((2, 7)), np.ones(7)), ValueError, "state must have shape"),
        (lambda s, p: KalmanFilter(capacity=0), ValueError, "capacity must be at least 1"),
        (lambda s, p: KalmanFilter(capacity=1, dtype="half"), ValueError, "dtype must be one of float32, float64"),
        (lambda s, p: KalmanFilter(capacity=1, model="x"), ValueError, "model must be one of constant_velocity, ctrv"),
    ],
)
def test_refuses_what_does_not_fit(call, error, message):
    with pytest.raises(error, match=message):
        call(np.zeros((2, 10)), np.zeros((2, 10, 10)))
