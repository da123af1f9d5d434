"""Filters against NumPy's boolean masks."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.filters import PointFilter, filter_points

RANGE = (-20.0, -10.0, -2.0, 20.0, 10.0, 1.0)
EGO = (-2.0, -1.0, -2.0, 3.0, 1.0, 0.5)


def cloud(n, seed=0):
    rng = np.random.default_rng(seed)
    points = rng.uniform([-30, -15, -3, 0], [30, 15, 2, 1], (n, 4)).astype(np.float32)
    points[rng.random(n) < 0.1, :3] = rng.uniform([-2, -1, -2], [3, 1, 0.5], 3)
    points[rng.random(n) < 0.05, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    return points


def reference(points):
    """What stays, and the counts of what goes."""
    xyz = points[:, :3]
    finite = np.isfinite(xyz).all(axis=1)
    bounds, ego = np.float32(RANGE), np.float32(EGO)
    inside = finite & (xyz >= bounds[:3]).all(axis=1) & (xyz < bounds[3:]).all(axis=1)
    own = inside & (xyz >= ego[:3]).all(axis=1) & (xyz < ego[3:]).all(axis=1)
    counts = (int((~finite).sum()), int((finite & ~inside).sum()), int(own.sum()))
    return np.flatnonzero(inside & ~own), counts


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000))
def test_equals_numpys_masks(seed, n):
    points = cloud(n, seed)
    index, counts = reference(points)
    kept = filter_points(points, point_range=RANGE, ego_box=EGO)
    assert np.array_equal(kept.index, index)
    assert kept.index.dtype == np.int32
    assert np.array_equal(kept.points, points[index])
    assert (kept.non_finite, kept.out_of_range, kept.ego) == counts
    assert len(kept.points) + sum(counts) == n


def test_by_default_only_what_is_not_finite_goes():
    points = cloud(500)
    kept = filter_points(points)
    assert np.array_equal(kept.index, np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1)))
    assert kept.out_of_range == kept.ego == 0


def test_upper_bounds_are_open():
    points = np.float32([[0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, 0.5, np.nextafter(np.float32(1), np.float32(0))]])
    assert filter_points(points, point_range=(0, 0, 0, 1, 1, 1)).index.tolist() == [0, 3]


def test_all_columns_come_along_and_the_input_stays_as_it_is():
    points = np.random.default_rng(1).normal(size=(100, 6)).astype(np.float32)
    points[3, 0] = np.nan
    before = points.copy()
    kept = filter_points(points)
    assert np.array_equal(kept.points, np.delete(points, 3, axis=0))
    assert np.array_equal(points, before, equal_nan=True)


def test_arrays_of_other_families():
    import torch

    points = cloud(300)
    index, _ = reference(points)
    kept = filter_points(torch.from_numpy(points), point_range=RANGE, ego_box=EGO)
    assert isinstance(kept.points, torch.Tensor)
    assert np.array_equal(kept.points.numpy(), points[index])
    kept = filter_points(wp.array(points, dtype=wp.float32, device="cpu"), point_range=RANGE, ego_box=EGO)
    assert np.array_equal(kept.index.numpy(), index)


def test_the_plan_reads_its_count(device):
    points = cloud(2000)
    index, counts = reference(points[:1500])
    plan = PointFilter(capacity=2048, point_range=RANGE, ego_box=EGO, device=device)
    xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device=device)
    intensity = wp.array(points[:, 3].copy(), dtype=wp.float32, device=device)
    count = wp.array([1500], dtype=wp.int32, device=device)
    for _ in range(2):
        plan.launch(xyz, intensity, count)
        n = int(plan.count.numpy()[0])
        assert np.array_equal(plan.index.numpy()[:n], index)
        assert np.array_equal(plan.xyz.numpy()[:n], points[index, :3])
        assert np.array_equal(plan.intensity.numpy()[:n], points[index, 3])
        assert tuple(plan.dropped.numpy()) == counts
    plan.launch(xyz, None, count)
    assert not plan.intensity.numpy()[:n].any()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: filter_points(np.zeros((4, 2), np.float32)), "points must have shape"),
        (lambda: filter_points(np.zeros((4, 3), np.float32), point_range=(0, 0, 0, 1, 1)), "point_range must be"),
        (lambda: filter_points(np.zeros((4, 3), np.float32), ego_box=(0, 0, 0, 1, 1, 0)), "ego_box must be"),
        (lambda: PointFilter(capacity=0), "capacity must be"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
