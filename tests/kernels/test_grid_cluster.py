"""Voxel-grid clustering against scipy.ndimage.label on the dense grid of the same voxels."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from warploom.kernels import cell_columns
from warploom.kernels.grid_cluster import GridCluster, grid_cluster
from warploom.kernels.interop import count_on


def reference(points, cell, min_size=1, connectivity=26):
    labels = np.full(len(points), -1, np.int32)
    finite = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    if len(finite) == 0:
        return labels
    voxels = np.floor(points[finite, :3].astype(np.float64) * (1.0 / cell)).astype(np.int64)
    voxels -= voxels.min(axis=0)
    # Columns of the grid without a point: two are as good as many, and the dense grid stays small.
    for axis in range(3):
        occupied = np.unique(voxels[:, axis])
        places = np.cumsum(np.minimum(np.diff(occupied, prepend=occupied[0]), 2))
        voxels[:, axis] = places[np.searchsorted(occupied, voxels[:, axis])]
    grid = np.zeros(voxels.max(axis=0) + 1, bool)
    grid[tuple(voxels.T)] = True
    component, _ = ndimage.label(grid, ndimage.generate_binary_structure(3, {6: 1, 18: 2, 26: 3}[connectivity]))
    component = component[tuple(voxels.T)]
    large = np.bincount(component)[component] >= min_size
    _, first, inverse = np.unique(component[large], return_index=True, return_inverse=True)
    labels[finite[large]] = np.argsort(np.argsort(first))[inverse]
    return labels


def launched(points, device="cpu", **fields):
    """The labels of a plan, launched twice so that what the first left is met."""
    if device != "cpu" and fields.get("method") == "in_order":
        pytest.skip("in order is for a CPU")
    plan = GridCluster(capacity=max(len(points), 1), device=device, **fields)
    for order in (points[::-1], points):
        xyz = wp.array(np.ascontiguousarray(order[:, :3]), dtype=wp.vec3, device=device)
        plan.launch(xyz, count_on(len(points), device))
    labels = plan.labels.numpy()[: len(points)]
    assert plan.cluster_count.numpy()[0] == labels.max(initial=-1) + 1
    return labels


@pytest.mark.parametrize("method", ["in_order", "shared"])
@pytest.mark.parametrize("connectivity", [6, 18, 26])
@pytest.mark.parametrize("cell", [0.1, 0.5, 100.0])
def test_scipys_labels_of_a_random_cloud(device, method, connectivity, cell):
    points = np.random.default_rng(3).normal(0, [4, 4, 1], (3_000, 3)).astype(np.float32)
    points[::50, 1], points[7] = np.nan, (np.inf, -np.inf, np.nan)
    for min_size in (1, 4):
        fields = {"cell": cell, "min_size": min_size, "connectivity": connectivity}
        actual = launched(points, device, method=method, **fields)
        np.testing.assert_array_equal(actual, reference(points, **fields))


def test_scipys_labels_of_real_scans(shared_data):
    path = min((shared_data / "semantic_kitti" / "full").glob("08_*.bin"))
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    points = points[points[:, 2] > -1.4]
    for cell, connectivity in ((0.5, 26), (0.3, 18), (0.3, 6)):
        expected = reference(points, cell, 5, connectivity)
        np.testing.assert_array_equal(grid_cluster(points, cell, 5, connectivity), expected)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 200),
    st.sampled_from([0.1, 0.25, 0.3]),
    st.sampled_from([0.1, 0.25, 0.5]),
    st.sampled_from([6, 18, 26]),
    st.sampled_from([0.0, 1e5, -1e5]),
)
def test_grids_of_points_with_duplicates_near_and_far(seed, n, cell, step, connectivity, offset):
    points = (np.random.default_rng(seed).integers(-5, 6, (n, 3)) * step + offset).astype(np.float32)
    expected = reference(points, cell, 2, connectivity)
    for method in ("in_order", "shared"):
        actual = launched(points, method=method, cell=cell, min_size=2, connectivity=connectivity)
        np.testing.assert_array_equal(actual, expected)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
def test_order_of_points_does_not_change_the_partition(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (n, 3)).astype(np.float32)
    order = rng.permutation(n)
    labels, shuffled = grid_cluster(points, 0.5), grid_cluster(points[order], 0.5)
    assert len(set(zip(labels[order], shuffled, strict=True))) == labels.max() + 1 == shuffled.max() + 1


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40), st.sampled_from([1e-6, 0.5, 1e6]))
def test_any_floats_at_all(rows, cell):
    """NaN, infinities, denormals; voxels beyond 2³⁰ are far apart, and neighbours only of the same coordinate."""
    points = np.array(rows, np.float32).reshape(-1, 3)
    near = np.clip(points, -1e9 * cell, 1e9 * cell)
    for method in ("in_order", "shared"):
        np.testing.assert_array_equal(launched(near, method=method, cell=cell), reference(near, cell))
        launched(points, method=method, cell=cell)


def test_voxels_far_away_are_joined_along_the_axes_that_still_have_neighbours():
    far = np.nextafter(np.float32(1e12), np.float32(np.inf))
    points = np.array([[1e12, 0.1, 0], [1e12, 0.2, 0], [far, 0.1, 0], [far, 0.3, 0]], np.float32)
    for method in ("in_order", "shared"):
        assert launched(points, method=method, cell=0.15).tolist() == [0, 0, 1, 2]
        assert launched(points, method=method, cell=0.3).tolist() == [0, 0, 1, 1]


def test_a_million_points_in_one_voxel():
    points = np.random.default_rng(0).uniform(0, 0.4, (1_000_000, 3)).astype(np.float32)
    assert grid_cluster(points, 0.5, 1_000_000).max() == 0
    assert grid_cluster(points, 0.5, 1_000_001).max() == -1


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    labels = grid_cluster(np.zeros((n, 3), np.float32), 0.5)
    assert labels.dtype == np.int32
    assert labels.tolist() == [0] * n


@pytest.mark.parametrize("connectivity", [6, 18, 26])
@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_the_number_of_parts_does_not_change_the_labels(monkeypatch, parts, connectivity):
    """Of a street, a tower taller than a mask, and a cloud too wide for the map."""
    monkeypatch.setattr(cell_columns, "parts_for", lambda capacity: parts)
    rng = np.random.default_rng(11)
    street = rng.normal(0, [20, 20, 1.5], (4_000, 3))
    tower = rng.uniform(0, 1, (400, 3)) * (2, 2, 80)
    wide = np.concatenate([street, street + np.array((9e4, -4e4, 2e4))])
    for points in (street, tower, wide):
        points = points.astype(np.float32)
        fields = {"cell": 0.5, "min_size": 2, "connectivity": connectivity}
        expected = launched(points, method="shared", **fields)
        np.testing.assert_array_equal(launched(points, **fields), expected)
        assert len(np.unique(expected)) > 3


def test_strided_read_only_and_float64_input_gives_the_same():
    points = np.random.default_rng(5).uniform(0, 5, (900, 6)).astype(np.float32)
    expected = grid_cluster(points[:, :3].copy(), 0.2)
    strided = points[:, :5]
    strided.flags.writeable = False
    np.testing.assert_array_equal(grid_cluster(strided, 0.2), expected)
    np.testing.assert_array_equal(grid_cluster(points.astype(np.float64), 0.2), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "cell must be a positive number"),
        ((float("nan"),), "cell must be a positive number"),
        ((float("inf"),), "cell must be a positive number"),
        ((0.5, 0), "min_size must be at least 1"),
        ((0.5, 1, 8), "connectivity must be 6, 18 or 26, not 8"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        grid_cluster(np.zeros((1, 3), np.float32), *arguments)


def test_a_plan_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="capacity of 10"):
        GridCluster(cell=1.0, capacity=10).launch(wp.zeros(11, wp.vec3, device="cpu"), count_on(11, "cpu"))
    with pytest.raises(ValueError, match="method must be"):
        GridCluster(cell=1.0, capacity=10, method="fast")


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_a_captured_launch_replays_on_other_points(device, method):
    if device != "cpu" and method == "in_order":
        pytest.skip("in order is for a CPU")
    first, second = np.random.default_rng(20).normal(0, [20, 20, 2], (2, 500, 3)).astype(np.float32)
    plan = GridCluster(cell=2.0, capacity=500, device=device, method=method)
    xyz = wp.array(first, dtype=wp.vec3, device=device)
    count = count_on(500, device)
    plan.launch(xyz, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, count)
    xyz.assign(second)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(plan.labels.numpy(), reference(second, 2.0))
