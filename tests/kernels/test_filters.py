"""Filters against NumPy's boolean masks."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.filters import PointFilter, filter_points
from warploom.kernels.interop import borrow_points, count_on

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


WAYS = [{"method": "parts", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "scan"}]


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3000), st.sampled_from(WAYS))
def test_the_result_does_not_hang_on_the_parts(seed, n, way):
    points = cloud(n, seed)
    index, counts = reference(points)
    plan = PointFilter(capacity=n, point_range=RANGE, ego_box=EGO, **way)
    given_points = borrow_points(points)
    plan.launch(given_points.xyz, given_points.intensity, count_on(n, "cpu"))
    kept = int(plan.count.numpy()[0])
    assert np.array_equal(plan.index.numpy()[:kept], index)
    assert np.array_equal(plan.xyz.numpy()[:kept], points[index, :3])
    assert np.array_equal(plan.intensity.numpy()[:kept], points[index, 3])
    assert tuple(plan.dropped.numpy()) == counts


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_a_captured_launch_replays_on_other_points(way):
    plan = PointFilter(capacity=900, point_range=RANGE, ego_box=EGO, **way)
    points = cloud(900, 1)
    xyz, count = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"), count_on(900, "cpu")
    plan.launch(xyz, None, count)
    with wp.ScopedCapture(device="cpu") as capture:
        plan.launch(xyz, None, count)
    others = cloud(900, 2)
    xyz.assign(others[:, :3])
    wp.capture_launch(capture.graph)
    index, counts = reference(others)
    assert np.array_equal(plan.index.numpy()[: len(index)], index)
    assert tuple(plan.dropped.numpy()) == counts


@pytest.mark.parametrize("layout", ["strided", "columns first", "backwards", "read-only", "float64", "three columns"])
def test_any_layout_gives_the_same(layout):
    points = cloud(700, 5)
    index, _ = reference(points)
    made = {
        "strided": lambda: np.repeat(points, 2, axis=0)[::2],
        "columns first": lambda: np.asfortranarray(points),
        "backwards": lambda: points[::-1].copy()[::-1],
        "read-only": lambda: points.copy(),
        "float64": lambda: points.astype(np.float64),
        "three columns": lambda: points[:, :3],
    }[layout]()
    made.setflags(write=layout != "read-only")
    kept = filter_points(made, point_range=RANGE, ego_box=EGO)
    assert np.array_equal(kept.index, index)
    assert np.array_equal(kept.points, points[index, : made.shape[1]])


def test_denormal_and_huge_coordinates_are_compared_as_they_are():
    tiny, huge = np.float32(1e-45), np.finfo(np.float32).max
    points = np.float32([[tiny, 0, 0], [-tiny, 0, 0], [0, 0, 0], [huge, huge, huge], [-huge, 0, 0], [1e5, -1e5, 1e5]])
    assert filter_points(points, point_range=(0, -1e6, -1, 1e6, 1e6, 1e6)).index.tolist() == [0, 2, 5]
    assert len(filter_points(points).index) == 6


def test_few_that_stay_do_not_hold_the_memory_of_all():
    points = np.zeros((1000, 4), np.float32)
    points[10:, 0] = np.nan
    kept = filter_points(points).points
    assert len(kept) == 10
    assert kept.base is None


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: filter_points(np.zeros((4, 2), np.float32)), "points must have shape"),
        (lambda: filter_points(np.zeros((4, 3), np.float32), point_range=(0, 0, 0, 1, 1)), "point_range must be"),
        (lambda: filter_points(np.zeros((4, 3), np.float32), ego_box=(0, 0, 0, 1, 1, 0)), "ego_box must be"),
        (lambda: PointFilter(capacity=0), "capacity must be"),
        (lambda: PointFilter(capacity=5, parts=0), "parts must be at least 1, not 0"),
        (lambda: PointFilter(capacity=5, method="fast"), "method must be 'auto', 'parts' or 'scan', not 'fast'"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
