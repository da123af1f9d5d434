"""The plane near the sensor against planes that are known, and a least-squares fit by NumPy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.ground_plane import GroundPlane


def fitted(points, device="cpu", sensor_height=None):
    plan = GroundPlane(capacity=max(1, len(points)), sensor_height=sensor_height, device=device)
    count = wp.array([len(points)], dtype=wp.int32, device=device)
    plan.launch(wp.array(points.astype(np.float32), dtype=wp.vec3, device=device), count)
    return plan.plane.numpy()[0], float(plan.found_height.numpy()[0])


def plane_points(a, b, c, n=4000, seed=0):
    rng = np.random.default_rng(seed)
    r, angle = rng.uniform(3, 30, n), rng.uniform(-np.pi, np.pi, n)
    x, y = r * np.cos(angle), r * np.sin(angle)
    return np.stack([x, y, a * x + b * y + c], axis=1)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-4, 0.5), st.integers(0, 99))
def test_finds_the_plane_under_things(a, b, c, seed):
    """Within 0.002 of slope and 2 cm, a third of the points being higher; and the height is the distance to it."""
    points = plane_points(a, b, c, seed=seed)
    points[::3, 2] += np.random.default_rng(seed).uniform(0.5, 3, len(points[::3]))
    plane, height = fitted(points)
    assert (np.abs(plane - [a, b, c]) < [0.002, 0.002, 0.02]).all()
    assert height == pytest.approx(-c / np.sqrt(1 + a * a + b * b), abs=0.02)


def test_equals_least_squares_where_all_candidates_fit(device):
    """With one point in each patch, all of them candidates: NumPy's fit to 1 mm and 1e-4."""
    sector, band = (grid.ravel() for grid in np.meshgrid(np.arange(32), np.arange(8), indexing="ij"))
    angle, r = (sector + 0.5) * np.pi / 16, 2 * np.sqrt(2.0) ** (band + 0.5)
    x, y = r * np.cos(angle), r * np.sin(angle)
    z = 0.05 * x - 0.02 * y - 1.7 + np.random.default_rng(1).uniform(-0.02, 0.02, 256)
    expected = np.linalg.lstsq(np.stack([x, y, np.ones(256)], axis=1), z, rcond=None)[0]
    plane, _ = fitted(np.stack([x, y, z], axis=1), device)
    assert (np.abs(plane - expected) < [1e-4, 1e-4, 1e-3]).all()


def test_of_two_levels_the_one_at_the_given_height_is_taken():
    low, high = plane_points(0, 0, -1.8, seed=1), plane_points(0, 0, -0.9, seed=2)
    high = high[np.abs(high[:, 1]) > 12]
    low = low[np.abs(low[:, 1]) < 12]
    both = np.concatenate([low, high])
    assert fitted(both, sensor_height=1.8)[1] == pytest.approx(1.8, abs=0.02)
    assert fitted(both, sensor_height=0.9)[1] == pytest.approx(0.9, abs=0.02)


@pytest.mark.parametrize("sensor_height", [None, 2.5])
def test_without_points_the_plane_is_level(sensor_height):
    plane, height = fitted(np.full((1, 3), np.nan), sensor_height=sensor_height)
    assert plane.tolist() == pytest.approx([0, 0, -(sensor_height or 1.8)])
    assert height == pytest.approx(sensor_height or 1.8)
