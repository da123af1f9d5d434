"""Euclidean clustering against SciPy: the pairs of a KD-tree in float64, and the components of their graph."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from warploom.kernels import cell_columns
from warploom.kernels import cluster as clustering
from warploom.kernels.cluster import EuclideanCluster, cluster
from warploom.kernels.interop import count_on


def reference(points, radius, min_size=1):
    """Labels by the lowest index, -1 for small components and points that are not finite."""
    labels = np.full(len(points), -1, np.int32)
    finite = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    if len(finite) == 0:
        return labels
    pairs = cKDTree(points[finite, :3].astype(np.float64)).query_pairs(radius, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), (len(finite),) * 2)
    component = connected_components(graph, directed=False)[1]
    large = np.bincount(component)[component] >= min_size
    _, first, inverse = np.unique(component[large], return_index=True, return_inverse=True)
    order = np.empty(len(first), np.int32)
    order[np.argsort(first)] = np.arange(len(first))
    labels[finite[large]] = order[inverse]
    return labels


def adaptive_reference(points, radius, per_metre, min_size=1):
    """All pairs in float64, each with the radius at the point nearer to the origin; the labels by the lowest index."""
    wide = points[:, :3].astype(np.float64)
    x, y, z = wide.T
    reach = radius + per_metre * np.sqrt(x * x + y * y + z * z)
    rows, columns = [], []
    for begin in range(0, len(wide), 256):
        d = wide[begin : begin + 256, None] - wide[None]
        squared = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2]
        row, column = np.nonzero(squared <= np.minimum(reach[begin : begin + 256, None], reach[None]) ** 2)
        rows.append(row + begin)
        columns.append(column)
    row, column = np.concatenate(rows or [[]]), np.concatenate(columns or [[]])
    graph = coo_matrix((np.ones(len(row), bool), (row.astype(int), column.astype(int))), (len(wide),) * 2)
    component = connected_components(graph, directed=False)[1] if len(wide) else np.zeros(0, int)
    large = np.bincount(component)[component] >= min_size
    labels = np.full(len(points), -1, np.int32)
    _, first, inverse = np.unique(component[large], return_index=True, return_inverse=True)
    labels[large] = np.argsort(np.argsort(first))[inverse]
    return labels


def launched(points, device="cpu", include=None, **fields):
    """The labels of a plan, launched twice so that what the first left is met."""
    if device != "cpu" and fields.get("method") == "in_order":
        pytest.skip("in order is for a CPU")
    plan = EuclideanCluster(capacity=max(len(points), 1), device=device, **fields)
    for order in (points[::-1], points):
        xyz = wp.array(np.ascontiguousarray(order[:, :3]), dtype=wp.vec3, device=device)
        plan.launch(xyz, count_on(len(points), device), include)
    labels = plan.labels.numpy()[: len(points)]
    assert plan.cluster_count.numpy()[0] == labels.max(initial=-1) + 1
    return labels


def cloud(seed, n=500):
    return np.random.default_rng(seed).normal(0, [20, 20, 2], (n, 3)).astype(np.float32)


def decoded(path):
    """The positions of a packed KITTI scan (its README)."""
    planes = np.load(path)["planes"].astype(np.int64)
    u = planes[0] | planes[1] << 8 | planes[2] << 16
    return (np.cumsum((u >> 1) ^ -(u & 1), axis=1).T / 1000).astype(np.float32)


def scans(folder):
    """One or two scans of each kind, whole."""
    for path in sorted((folder / "kitti_object" / "velodyne").glob("*.bin"))[:2]:
        yield path.name, np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
    yield "tracking", decoded(min((folder / "kitti_tracking" / "velodyne_packed").rglob("*.npz")))
    yield "traffic", decoded(min((folder / "kitti_raw_traffic" / "velodyne_packed").rglob("*.npz")))
    path = min((folder / "semantic_kitti" / "full").glob("08_*.bin"))
    yield path.name, np.fromfile(path, np.float32).reshape(-1, 4)[:, :3]
    path = min((folder / "nuscenes_sample").glob("*.pcd.bin"))
    yield path.name, np.fromfile(path, np.float32).reshape(-1, 5)[:, :3]
    for kind in ("semantic_kitti/range_64x1024", "nuscenes_range_32x1024", "ika_vlp32_range_32x240"):
        yield kind, np.load(min((folder / kind).glob("*.npz")))["xyz"].reshape(-1, 3)
    yield "gndnet", np.load(min((folder / "gndnet" / "reduced_velo").glob("*.npy")))[:, :3]


def test_scipys_partition_of_real_scans_without_the_ground(shared_data):
    for name, points in scans(shared_data):
        above = points[points[:, 2] > -1.4].astype(np.float32)[:12_000]
        # A range image holds its missing returns as one crowd at the origin, which SciPy takes the square of.
        above = above[np.any(above != 0, axis=1)]
        np.testing.assert_array_equal(cluster(above, 0.5, 5), reference(above, 0.5, 5), err_msg=name)


@pytest.mark.real
def test_scipys_partition_of_thinned_whole_scans(shared_data):
    for name, points in scans(shared_data):
        points = points[np.any(points != 0, axis=1)].astype(np.float32)[::6]
        np.testing.assert_array_equal(cluster(points, 0.5), reference(points, 0.5), err_msg=name)


@pytest.mark.parametrize("method", ["in_order", "shared"])
@pytest.mark.parametrize("radius", [0.05, 0.4, 1.5, 200.0])
def test_scipys_partition_of_a_random_cloud(device, method, radius):
    points = np.random.default_rng(3).normal(0, [8, 8, 1.5], (1_500, 3)).astype(np.float32)
    for min_size in (1, 4):
        actual = launched(points, device, method=method, radius=radius, min_size=min_size)
        np.testing.assert_array_equal(actual, reference(points, radius, min_size))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 200),
    st.sampled_from([0.1, 0.25, 0.3, 0.5, 1.0]),
    st.sampled_from([0.1, 0.25, 0.3, 0.5]),
    st.sampled_from([0.0, 1000.0, -1e5]),
)
def test_pairs_at_just_the_radius_are_decided_as_in_float64(seed, n, radius, step, offset):
    """Points of a grid are full of distances equal to the radius, but for the rounding of the coordinates."""
    rng = np.random.default_rng(seed)
    points = (rng.integers(-6, 7, (n, 3)) * step + offset).astype(np.float32)
    expected = reference(points, radius, 2)
    for method in ("in_order", "shared"):
        np.testing.assert_array_equal(launched(points, method=method, radius=radius, min_size=2), expected)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
def test_order_of_points_does_not_change_the_partition(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (n, 3)).astype(np.float32)
    order = rng.permutation(n)
    labels, shuffled = cluster(points, 0.5), cluster(points[order], 0.5)
    assert len(set(zip(labels[order], shuffled, strict=True))) == labels.max() + 1 == shuffled.max() + 1


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40), st.sampled_from([1e-6, 0.5, 1e6]))
def test_any_floats_at_all(rows, radius):
    """NaN, infinities, denormals, and numbers whose squares overflow float32."""
    points = np.array(rows, np.float32).reshape(-1, 3)
    near = np.clip(points, -1e18, 1e18)  # SciPy's own squares stay finite
    for method in ("in_order", "shared"):
        np.testing.assert_array_equal(launched(near, method=method, radius=radius), reference(near, radius))
        launched(points, method=method, radius=radius)


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_points_that_are_not_finite_or_not_included_get_no_label(device, method):
    points = np.random.default_rng(5).uniform(0, 4, (500, 3)).astype(np.float32)
    points[::50, 1] = np.nan
    points[7] = np.inf, -np.inf, np.nan
    mask = np.random.default_rng(6).uniform(size=500) < 0.6
    left = points.copy()
    left[~mask] = np.nan
    for dtype in (wp.bool, wp.uint8):
        # The first launch of two sees the points in reverse, the second as they are.
        include = wp.array(mask.astype(wp.dtype_to_numpy(dtype)), dtype=dtype, device=device)
        actual = launched(points, device, include, method=method, radius=0.4, min_size=2)
        np.testing.assert_array_equal(actual, reference(left, 0.4, 2))


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_crowded_cells_do_not_take_the_square_of_their_points(method):
    """A million points in one cell, and two crowds a hair farther apart than the radius, or a hair nearer."""
    rng = np.random.default_rng(0)
    crowd = rng.uniform(0, 0.2, (500_000, 3)).astype(np.float32)
    assert launched(np.concatenate([crowd, crowd]), method=method, radius=0.5).max() == 0
    for gap, clusters in ((0.501, 2), (0.499, 1)):
        sheet = crowd[:200_000] * np.float32([0, 1, 1])
        points = np.concatenate((sheet, sheet[::-1] + np.float32((gap, 0, 0))))
        assert launched(points, method=method, radius=0.5).max() + 1 == clusters
    ball = rng.normal(size=(10_000, 3))
    ball *= 0.1 / np.linalg.norm(ball, axis=1, keepdims=True)
    points = np.concatenate((ball, ball + np.array((0.51, 0.4, 0.3)))).astype(np.float32)
    assert launched(points, method=method, radius=0.5).max() + 1 == 2


@pytest.mark.parametrize("method", ["in_order", "shared"])
@pytest.mark.parametrize(("radius", "per_metre"), [(0.3, 0.01), (0.1, 0.05), (0.02, 0.3), (0.01, 1.0), (1.0, 1e-5)])
def test_a_radius_that_grows_with_the_range_joins_what_brute_force_does(device, method, radius, per_metre):
    """Densities fall off with the range, so that the graph is between one cluster and none at all ranges."""
    rng = np.random.default_rng(8)
    direction = rng.normal(size=(2_500, 3)) * (1, 1, 0.2)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = (direction * 10.0 ** rng.uniform(-1, 2, (2_500, 1))).astype(np.float32)
    fields = {"method": method, "radius": radius, "radius_per_metre": per_metre, "min_size": 2}
    actual = launched(points, device, **fields)
    np.testing.assert_array_equal(actual, adaptive_reference(points, radius, per_metre, 2))
    assert actual.max() > 0 or per_metre == 1.0


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 150),
    st.sampled_from([0.1, 0.3, 1.0]),
    st.sampled_from([0.01, 0.1, 1.0]),
    st.sampled_from([0.1, 0.5, 3.0]),
    st.sampled_from([0.0, 30.0, -1e5]),
)
def test_a_growing_radius_on_grids_of_points(seed, n, radius, per_metre, step, offset):
    """Duplicates, lines and planes of points, near and far, of equal distances and ranges."""
    points = (np.random.default_rng(seed).integers(-9, 10, (n, 3)) * step + offset).astype(np.float32)
    expected = adaptive_reference(points, radius, per_metre)
    for method in ("in_order", "shared"):
        actual = launched(points, method=method, radius=radius, radius_per_metre=per_metre)
        np.testing.assert_array_equal(actual, expected)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40), st.sampled_from([1e-6, 0.5, 1e6]))
def test_a_growing_radius_on_any_floats_at_all(rows, radius):
    points = np.array(rows, np.float32).reshape(-1, 3)
    finite = points[np.isfinite(points).all(axis=1)]
    for per_metre in (1e-5, 0.02, 1.0):
        expected = adaptive_reference(finite, radius, per_metre)
        for method in ("in_order", "shared"):
            actual = launched(finite, method=method, radius=radius, radius_per_metre=per_metre)
            np.testing.assert_array_equal(actual, expected)
            launched(points, method=method, radius=radius, radius_per_metre=per_metre)


def test_a_growing_radius_on_a_crowd_and_on_a_real_scan(shared_data):
    path = min((shared_data / "semantic_kitti" / "full").glob("08_*.bin"))
    scan = np.fromfile(path, np.float32).reshape(-1, 4)[::30, :3]
    crowd = np.random.default_rng(0).uniform(0, 0.5, (4_000, 3)).astype(np.float32)
    for points in (scan, crowd + np.float32((40, 0, 0))):
        expected = adaptive_reference(points, 0.3, 0.02)
        np.testing.assert_array_equal(cluster(points, 0.3, radius_per_metre=0.02), expected)


def test_a_pole_of_many_cells():
    """One column of cells, in no order: the sort by height does not take their square."""
    points = np.zeros((200_000, 3), np.float32)
    points[:, 2] = np.random.default_rng(0).permutation(200_000) * 0.5
    assert cluster(points, 0.4).max() + 1 == 200_000
    assert cluster(points, 0.6).max() + 1 == 1


def clouds_of_all_kinds():
    """Whatever the columns of cells treat apart: dense, tall, wide, with a point far off, collinear, coplanar."""
    rng = np.random.default_rng(11)
    street = rng.normal(0, [20, 20, 1.5], (4_000, 3))
    tower = rng.uniform(0, 1, (3_000, 3)) * (3, 3, 120)
    wide = np.concatenate([street[:1_500] + shift for shift in ((0, 0, 0), (9e4, -4e4, 0), (-9e4, 100, 3e3))])
    line = np.outer(rng.uniform(-60, 60, 900), (1, 0.5, 0.1))
    plane = rng.uniform(-9, 9, (2_000, 3)) * (1, 1, 0)
    twice = np.repeat(street[:700], 2, axis=0)
    long_row = rng.uniform(0, 1, (3_000, 3)) * (0.7, 900, 1)
    for name, points in {
        "street": street,
        "tower": tower,
        "wide": wide,
        "one far off": np.concatenate([street, [[8e4, 8e4, 8e4]]]),
        "line": line,
        "plane": plane,
        "twice": twice,
        "long row": long_row,
        "denormal": street[:500] * 1e-42,
    }.items():
        yield name, points.astype(np.float32)


def cut_into(parts, monkeypatch):
    """Cuts the work of plans that are made from here on into so many parts."""
    monkeypatch.setattr(clustering, "parts_for", lambda capacity, least: parts)
    monkeypatch.setattr(cell_columns, "parts_for", lambda capacity: parts)


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_the_number_of_parts_does_not_change_the_labels(monkeypatch, parts):
    cut_into(parts, monkeypatch)
    for name, points in clouds_of_all_kinds():
        expected = reference(points, 0.5, 2)
        np.testing.assert_array_equal(launched(points, radius=0.5, min_size=2), expected, err_msg=name)
        if parts == 2:
            np.testing.assert_array_equal(launched(points, radius=0.5, min_size=2, method="shared"), expected)
    for n in (0, 1, 2):
        assert launched(cloud(1)[:n], radius=1e-3).tolist() == list(range(n))
    points = cloud(4, 1_500)
    actual = launched(points, radius=0.2, radius_per_metre=0.03)
    np.testing.assert_array_equal(actual, adaptive_reference(points, 0.2, 0.03))


@pytest.mark.real
def test_real_scans_are_clustered_alike_by_all_ways(shared_data, monkeypatch):
    for name, points in scans(shared_data):
        points = np.ascontiguousarray(points, np.float32)
        expected = launched(points, radius=0.5, method="shared")
        for parts in (1, 3):
            cut_into(parts, monkeypatch)
            np.testing.assert_array_equal(launched(points, radius=0.5), expected, err_msg=name)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3.0, 3.0), st.integers(2, 400))
def test_a_rigid_motion_keeps_the_partition(seed, angle, n):
    """Of points whose distances are all clear of the radius, by more than rounding moves them."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 6, (n, 3)).astype(np.float32).astype(np.float64)
    cos, sin = np.cos(angle), np.sin(angle)
    moved = points @ np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) + (12.0, -7.0, 3.0)
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    radius = 0.5
    while (np.abs(distances - radius) < 1e-5).any():
        radius += 3e-5
    np.testing.assert_array_equal(cluster(moved.astype(np.float32), radius), cluster(points, radius))


def test_strided_read_only_and_float64_input_gives_the_same():
    points = np.random.default_rng(5).uniform(0, 5, (900, 6)).astype(np.float32)
    expected = reference(points[:, :3].copy(), 0.4)
    strided = points[:, :5]
    strided.flags.writeable = False
    np.testing.assert_array_equal(cluster(strided, 0.4), expected)
    np.testing.assert_array_equal(cluster(points[::-1], 0.4), reference(points[::-1], 0.4))
    np.testing.assert_array_equal(cluster(points.astype(np.float64), 0.4), expected)


def test_far_from_the_origin():
    points = np.random.default_rng(1).uniform(0, 30, (3_000, 3)) + np.array((1e5, -1e5, 50))
    points = points.astype(np.float32)
    for radius in (0.05, 0.5, 2.0):
        np.testing.assert_array_equal(cluster(points, radius), reference(points, radius))


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    labels = cluster(np.zeros((n, 3), np.float32), 0.5)
    assert labels.dtype == np.int32
    assert labels.tolist() == [0] * n


def test_labels_are_the_callers_own():
    """A later call of the same size, which the same plan serves, leaves them alone."""
    points, others = cloud(31), cloud(32)
    labels = cluster(points, 0.8)
    expected = reference(points, 0.8)
    assert labels.dtype == np.int32
    assert labels.flags.writeable
    assert labels.flags.owndata
    np.testing.assert_array_equal(cluster(others, 0.8), reference(others, 0.8))
    np.testing.assert_array_equal(labels, expected)
    in_warp = cluster(wp.array(points, dtype=wp.vec3, device="cpu"), 0.8)
    np.testing.assert_array_equal(cluster(others, 0.8), reference(others, 0.8))
    np.testing.assert_array_equal(in_warp.numpy(), expected)


def test_a_cluster_of_min_size_stays_and_a_smaller_one_goes():
    points = np.array([[9, 0, 0], [0, 0, 0], [0.3, 0, 0], [5, 0, 0], [5.3, 0, 0], [5.6, 0, 0]], np.float32)
    assert cluster(points, 0.5, 1).tolist() == [0, 1, 1, 2, 2, 2]
    assert cluster(points, 0.5, 2).tolist() == [-1, 0, 0, 1, 1, 1]
    assert cluster(points, 0.5, min_size=3).tolist() == [-1, -1, -1, 0, 0, 0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0,), "radius must be a positive number"),
        ((float("nan"),), "radius must be a positive number"),
        ((float("inf"),), "radius must be a positive number"),
        ((0.5, 0), "min_size must be at least 1"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        cluster(np.zeros((1, 3), np.float32), *arguments)


@pytest.mark.parametrize("growth", [-0.01, 1e-6, 1.5, float("nan")])
def test_a_growth_of_the_radius_out_of_bounds_is_refused(growth):
    with pytest.raises(ValueError, match="radius_per_metre must be 0, or from 1e-05 to 1"):
        cluster(np.zeros((1, 3), np.float32), 0.5, radius_per_metre=growth)


def test_a_plan_refuses_what_does_not_fit():
    plan = EuclideanCluster(radius=0.5, capacity=10)
    with pytest.raises(ValueError, match="capacity of 10"):
        plan.launch(wp.zeros(11, dtype=wp.vec3, device="cpu"), count_on(11, "cpu"))
    with pytest.raises(ValueError, match="include must be bool or uint8 with at least 5 rows"):
        plan.launch(wp.zeros(5, dtype=wp.vec3, device="cpu"), count_on(5, "cpu"), wp.zeros(4, wp.bool, device="cpu"))
    with pytest.raises(ValueError, match="method must be"):
        EuclideanCluster(radius=0.5, capacity=10, method="fast")


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_a_captured_launch_replays_on_other_points(device, method):
    if device != "cpu" and method == "in_order":
        pytest.skip("in order is for a CPU")
    plan = EuclideanCluster(radius=2.0, capacity=500, device=device, method=method)
    xyz = wp.array(cloud(20), dtype=wp.vec3, device=device)
    count = count_on(500, device)
    plan.launch(xyz, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, count)
    xyz.assign(cloud(21))
    wp.capture_launch(capture.graph)
    replayed = plan.labels.numpy().copy()
    plan.launch(xyz, count)
    np.testing.assert_array_equal(plan.labels.numpy(), replayed)
