"""Taichi's maps against Warp's: heights and intensities to the bit, densities within 1e-6."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.bev import bev

RANGE = (-40.0, -40.0, -2.5, 40.0, 40.0, 1.5)


def check(points, point_range=RANGE, shape=(160, 120)):
    ours, expected = bev(points, point_range, shape, backend="taichi"), bev(points, point_range, shape)
    assert ours.shape == expected.shape
    assert ours.dtype == expected.dtype
    np.testing.assert_array_equal(ours[:2].view(np.int32), expected[:2].view(np.int32))
    np.testing.assert_allclose(ours[2], expected[2], atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5000), st.sampled_from([(40, 64), (1, 1), (200, 7)]))
def test_random_clouds(normal, seed, n, shape):
    check(normal(seed, n), shape=shape)


def test_awkward_clouds(awkward):
    check(awkward)
    check(awkward, (-2e5, -2e5, -2e5, 2e5, 2e5, 2e5), (50, 60))


def test_without_intensity(street):
    check(np.ascontiguousarray(street[:, :3]))


def test_a_simulated_sweep(street):
    check(street, shape=(608, 608))


@pytest.mark.real
def test_real_sweeps(scans):
    for scan in scans:
        check(scan, shape=(608, 608))


def test_a_plan_leaves_nothing_behind(normal):
    from warploom.kernels.taichi.bev import BevMaps

    plan = BevMaps(capacity=4000, point_range=RANGE, shape=(80, 80))
    for seed in range(3):
        points = normal(seed, 3000)
        plan.launch(points, 2000)
        np.testing.assert_array_equal(plan.maps.to_numpy().reshape(3, 80, 80), bev(points[:2000], RANGE, (80, 80)))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"point_range": (0.0, 0.0, 0.0, -1.0, 1.0, 1.0)}, "point_range must be"),
        ({"point_range": (0.0,) * 5}, "point_range must be"),
        ({"shape": (0, 5)}, "shape must be rows and columns"),
        ({"shape": (40_000, 40_000)}, "more cells than"),
        ({"device": "cuda:0"}, "device must be 'taichi'"),
    ],
)
def test_wrong_numbers(changed, message):
    from warploom.kernels.taichi.bev import BevMaps

    with pytest.raises(ValueError, match=message):
        BevMaps(**{"capacity": 10, "point_range": RANGE, "shape": (5, 5)} | changed)


def test_more_points_than_the_plan_takes(normal):
    from warploom.kernels.taichi.bev import BevMaps

    plan = BevMaps(capacity=10, point_range=RANGE, shape=(5, 5))
    with pytest.raises(ValueError, match="count must be 0 … 10, with 20 rows and a capacity of 10, not 11"):
        plan.launch(normal(0, 20), 11)
