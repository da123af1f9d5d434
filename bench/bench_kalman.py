"""Batched Kalman filters beside NumPy: its matrix products over all tracks at once, and track by track."""

import numpy as np
import pytest
import warp as wp

from warploom.bench.contest import contenders, on_device
from warploom.kernels.kalman import STATE_SIZES, KalmanFilter, kalman_predict, kalman_update

MODEL = "constant_velocity"
SIZE = STATE_SIZES[MODEL]
DT = 0.1


def some_tracks(count):
    random = np.random.default_rng(7)
    state = random.normal(0, 10, (count, SIZE))
    root = random.normal(0, 0.4, (count, SIZE, SIZE))
    covariance = root @ root.transpose(0, 2, 1) + 0.05 * np.eye(SIZE)
    measured = state[:, :7] + random.normal(0, 0.3, (count, 7))
    return [a.astype(np.float32) for a in (state, covariance, measured)]


def matrices(dtype):
    """F, Q, H and R of the textbook."""
    rates, q = np.arange(7, 10), 0.5
    F, Q = np.eye(SIZE), np.zeros((SIZE, SIZE))
    F[[0, 1, 2], rates] = DT
    Q[[0, 1, 2], [0, 1, 2]] = q * DT**3 / 3
    Q[[0, 1, 2], rates] = Q[rates, [0, 1, 2]] = q * DT**2 / 2
    Q[rates, rates] = q * DT
    return [a.astype(dtype) for a in (F, Q, np.eye(7, SIZE), 0.04 * np.eye(7))]


def wrapped(angle):
    return (angle + np.pi) % (2 * np.pi) - np.pi


def batched_numpy(state, covariance, measured):
    """One matrix product for all tracks."""
    F, Q, H, R = matrices(np.float32)

    def call():
        x, P = state @ F.T, F @ covariance @ F.T + Q
        S = P[:, :7, :7] + R
        K = np.linalg.solve(S, P[:, :7, :]).transpose(0, 2, 1)
        innovation = measured - x[:, :7]
        innovation[:, 6] = wrapped(innovation[:, 6])
        x = x + np.einsum("nij,nj->ni", K, innovation)
        x[:, 6] = wrapped(x[:, 6])
        return x, P - K @ (H @ P)

    return call


def numpy_in_a_loop(state, covariance, measured):
    """The textbook, as trackers with a filter object for each track have it."""
    F, Q, H, R = matrices(np.float64)

    def call():
        states, covariances = [], []
        for x, P, z in zip(state, covariance, measured, strict=True):
            x, P = F @ x, F @ P @ F.T + Q
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            innovation = z - H @ x
            innovation[6] = wrapped(innovation[6])
            x = x + K @ innovation
            x[6] = wrapped(x[6])
            states.append(x)
            covariances.append(P - K @ H @ P)
        return np.array(states), np.array(covariances)

    return call


def alike(ours, theirs):
    difference = ours[0] - theirs[0]
    difference[:, 6] = wrapped(difference[:, 6])
    return f"states within {np.abs(difference).max():.0e}, covariances within {np.abs(ours[1] - theirs[1]).max():.0e}"


@pytest.mark.parametrize("contender", contenders("numpy, batched", "numpy, track by track"))
@pytest.mark.parametrize("count", [30, 300, 3000])
def bench_kalman(contest, contender, count):
    """A prediction and a correction of all tracks."""
    tracks = some_tracks(count)
    noise, variance = np.float32([0.0] * 7 + [0.5] * 3), np.full(7, 0.04, np.float32)

    def plan(device):
        made = KalmanFilter(capacity=count, model=MODEL, device=device)
        state, covariance, measured, wander, spread = (
            wp.array(a, dtype=wp.float32, device=device) for a in (*tracks, noise[None], variance[None])
        )
        dt = wp.array([DT], dtype=wp.float32, device=device)
        made.active.fill_(1)

        def call():
            wp.copy(made.state, state)
            wp.copy(made.covariance, covariance)
            made.predict(dt, wander)
            made.update(measured, spread)

        return call

    def function(device):
        state, covariance, measured, wander, spread = (on_device(a, device) for a in (*tracks, noise, variance))

        def call():
            update = kalman_update(*kalman_predict(state, covariance, DT, wander), measured, spread)
            return update.state, update.covariance

        return call

    contest.run(
        contender,
        {
            "warploom": function,
            "warploom plan": plan,
            "numpy, batched": lambda _: batched_numpy(*tracks),
            "numpy, track by track": lambda _: numpy_in_a_loop(*tracks),
        },
        kernel="kalman",
        on=f"{count} tracks",
        size=count,
        agree=alike,
    )
