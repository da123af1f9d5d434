"""Dynamic voxelization against NumPy's unique and float64 sums in the order of the input: equal to the bit."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.dynamic_voxel import DynamicVoxelize, dynamic_voxelize
from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.voxel import voxelize

RANGE = (-20.0, -16.0, -3.0, 20.0, 16.0, 1.0)


def reference(points, voxel_size, point_range):
    """Voxel of each point, coordinates z y x, counts and means."""
    low, high = np.float32(point_range[:3]), np.float32(point_range[3:])
    size = np.broadcast_to(np.float32(voxel_size), 3)
    with np.errstate(invalid="ignore"):
        inside = np.flatnonzero(((points[:, :3] >= low) & (points[:, :3] < high)).all(axis=1))
    cells = ((points[inside, :3] - low) / size).astype(np.int64)
    limit = np.array(
        [round((stop - start) / edge) for start, stop, edge in zip(point_range[:3], point_range[3:], size, strict=True)]
    )
    fits = (cells < limit).all(axis=1)
    inside, cells = inside[fits], cells[fits]
    found, first, inverse = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rows = np.argsort(order)[inverse.ravel()]
    voxel_of_point = np.full(len(points), -1, np.int32)
    voxel_of_point[inside] = rows
    sums = np.zeros((len(found), points.shape[1]))
    np.add.at(sums, rows, points[inside].astype(np.float64))
    counts = np.bincount(rows, minlength=len(found)).astype(np.int32)
    return voxel_of_point, found[order][:, ::-1].astype(np.int32), counts, (sums / counts[:, None]).astype(np.float32)


def launched(points, device="cpu", **fields):
    """The outputs of a plan, launched twice so that what the first left is met."""
    n, columns = points.shape
    plan = DynamicVoxelize(capacity=max(n, 1), columns=columns, device=device, **fields)
    for order in (points[::-1], points):
        cloud = borrow_points(wp.array(np.ascontiguousarray(order), dtype=wp.float32, device=device))
        plan.launch(cloud.xyz, count_on(n, device), cloud.extra)
    v = int(plan.voxel_count.numpy()[0])
    assert plan.outside.numpy()[0] == (plan.voxel_of_point.numpy()[:n] < 0).sum()
    return plan.voxel_of_point.numpy()[:n], plan.coords.numpy()[:v], plan.counts.numpy()[:v], plan.means.numpy()[:v]


def assert_equal(actual, expected):
    for name, ours, theirs in zip(("voxel_of_point", "coords", "counts", "means"), actual, expected, strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg=name)


def cloud(seed, n=20_000, columns=4):
    rng = np.random.default_rng(seed)
    return np.concatenate([rng.normal(0, [12, 12, 1], (n, 3)), rng.uniform(0, 1, (n, columns - 3))], 1).astype("f4")


@pytest.mark.parametrize("method", ["in_order", "sort"])
@pytest.mark.parametrize("voxel_size", [(0.16, 0.16, 4.0), (0.1, 0.1, 0.2), (2.0, 4.0, 1.0)])
def test_numpys_voxels_and_means(device, method, voxel_size):
    points = cloud(1)
    points[::100, 1], points[5] = np.nan, np.inf
    fields = {"voxel_size": voxel_size, "point_range": RANGE}
    expected = reference(points, **fields)
    assert_equal(launched(points, device, method=method, **fields), expected)
    found = dynamic_voxelize(points, **fields)
    assert_equal((found.voxel_of_point, found.coords, found.counts, found.means), expected)
    assert len(found) == len(expected[2])
    assert found.outside == (expected[0] < 0).sum()


def test_voxels_of_a_real_scan_are_those_of_voxelize(shared_data):
    path = min((shared_data / "kitti_object" / "velodyne").glob("*.bin"))
    points = np.fromfile(path, np.float32).reshape(-1, 4)
    arguments = ((0.16, 0.16, 4.0), (0.0, -39.68, -3.0, 69.12, 39.68, 1.0))
    found, hard = dynamic_voxelize(points, *arguments), voxelize(points, *arguments)
    np.testing.assert_array_equal(found.coords, hard.coords)
    np.testing.assert_array_equal(np.minimum(found.counts, 32), hard.counts)
    assert found.outside == hard.outside
    assert_equal((found.voxel_of_point, found.coords, found.counts, found.means), reference(points, *arguments))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(3, 7))
def test_both_methods_and_any_number_of_columns(seed, n, columns):
    points = cloud(seed, n, columns)
    points[: n // 3] = points[n - n // 3 :]  # duplicates
    fields = {"voxel_size": (1.0, 1.0, 0.5), "point_range": RANGE}
    expected = reference(points, **fields)
    for method in ("in_order", "sort"):
        assert_equal(launched(points, method=method, **fields), expected)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40))
def test_any_floats_at_all(rows):
    """NaN, infinities, denormals; the means lie within the range, to rounding."""
    points = np.array(rows, np.float32).reshape(-1, 3)
    fields = {"voxel_size": (1.0, 1.0, 0.5), "point_range": RANGE}
    for method in ("in_order", "sort"):
        assert_equal(launched(points, method=method, **fields), reference(points, **fields))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_order_of_points_changes_neither_counts_nor_means_beyond_rounding(seed):
    points = cloud(seed, 400)
    order = np.random.default_rng(seed).permutation(400)
    a, b = (dynamic_voxelize(p, 2.0, RANGE) for p in (points, points[order]))
    sort_a, sort_b = np.lexsort(a.coords.T), np.lexsort(b.coords.T)
    np.testing.assert_array_equal(a.coords[sort_a], b.coords[sort_b])
    np.testing.assert_array_equal(a.counts[sort_a], b.counts[sort_b])
    np.testing.assert_allclose(a.means[sort_a], b.means[sort_b], rtol=1e-6, atol=1e-12)


def test_a_million_points_in_one_voxel():
    points = np.random.default_rng(0).uniform(0, 0.9, (1_000_000, 3)).astype(np.float32)
    found = dynamic_voxelize(points, 1.0, RANGE)
    assert found.counts.tolist() == [1_000_000]
    assert_equal((found.voxel_of_point, found.coords, found.counts, found.means), reference(points, 1.0, RANGE))


@pytest.mark.parametrize("voxel_size", [(0.4, 0.4, 4.0), (0.04, 0.04, 0.02)], ids=["dense", "hashed"])
@pytest.mark.parametrize("columns", [3, 4, 5])
def test_methods_and_parts_give_the_same_bytes_scan_after_scan(voxel_size, columns):
    fields = {"voxel_size": voxel_size, "point_range": RANGE, "columns": columns, "capacity": 5000}
    ways = [{"method": "in_order", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "sort"}]
    plans = [DynamicVoxelize(**fields, **way) for way in ways]
    for seed, n in enumerate((5000, 3, 0, 4000)):
        points = borrow_points(cloud(seed, 5000, columns))
        outputs = []
        for plan in plans:
            plan.launch(points.xyz, count_on(n, "cpu"), points.extra)
            voxels = int(plan.voxel_count.numpy()[0])
            parts = (plan.coords, plan.counts, plan.means)
            outputs.append([part.numpy()[:voxels].tobytes() for part in parts])
            outputs[-1].append(plan.voxel_of_point.numpy()[:n].tobytes())
        assert all(output == outputs[0] for output in outputs)


@pytest.mark.parametrize("kind", ["on a line", "equal", "denormal", "far", "backwards", "columns first"])
def test_awkward_clouds(kind):
    rng = np.random.default_rng(8)
    points = cloud(8, 3000)
    if kind == "on a line":
        points[:, 1:3] = 0
    elif kind == "equal":
        points[:] = points[0]
    elif kind == "denormal":
        points[:, :3] = rng.choice([-1e-45, 0.0, 1e-45], (3000, 3))
    elif kind == "far":
        points[::2, :3] += rng.choice([-1e5, 1e5], (1500, 3)).astype(np.float32)
    made = {
        "backwards": lambda: points[::-1].copy()[::-1],
        "columns first": lambda: np.asfortranarray(points),
    }.get(kind, lambda: points)()
    found = dynamic_voxelize(made, 0.16, RANGE)
    assert_equal((found.voxel_of_point, found.coords, found.counts, found.means), reference(points, 0.16, RANGE))


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    found = dynamic_voxelize(np.zeros((n, 4), np.float32), 0.5, RANGE)
    assert found.voxel_of_point.tolist() == [0] * n
    assert found.means.shape == (n, 4)
    assert found.coords.dtype == found.counts.dtype == np.int32


def test_strided_read_only_and_float64_input_gives_the_same():
    points = cloud(6, 900, 6)
    expected = dynamic_voxelize(points[:, :4].copy(), 0.5, RANGE).means
    strided = points[:, :4]
    strided.flags.writeable = False
    np.testing.assert_array_equal(dynamic_voxelize(strided, 0.5, RANGE).means, expected)
    np.testing.assert_array_equal(dynamic_voxelize(strided.astype(np.float64), 0.5, RANGE).means, expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, RANGE), "voxel_size must be > 0 m and finite, not 0.0 along x"),
        (((1.0, 1.0), RANGE), "voxel_size must be one number or three, not 2"),
        ((1.0, RANGE[:5]), "point_range must have six numbers"),
        ((1.0, (0, 0, 0, 1, 0, 1)), "point_range must be xmin ymin zmin xmax ymax zmax with min < max"),
        ((1e-6, RANGE), "more than 2²⁰; choose a larger voxel_size"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        dynamic_voxelize(np.zeros((1, 3), np.float32), *arguments)


def test_a_plan_refuses_what_does_not_fit():
    fields = {"voxel_size": (1.0, 1.0, 1.0), "point_range": RANGE}
    plan = DynamicVoxelize(capacity=10, **fields)
    with pytest.raises(ValueError, match="capacity of 10"):
        plan.launch(wp.zeros(11, wp.vec3, device="cpu"), count_on(11, "cpu"), wp.zeros((11, 1), device="cpu"))
    with pytest.raises(ValueError, match=r"extra must have shape \(5, 1\)"):
        plan.launch(wp.zeros(5, wp.vec3, device="cpu"), count_on(5, "cpu"), wp.zeros((5, 2), device="cpu"))
    with pytest.raises(ValueError, match="method must be"):
        DynamicVoxelize(capacity=10, method="fast", **fields)
    with pytest.raises(ValueError, match="parts must be at least 1, not 0"):
        DynamicVoxelize(capacity=10, parts=0, **fields)


@pytest.mark.parametrize("method", ["in_order", "sort"])
def test_a_captured_launch_replays_on_other_points(device, method):
    fields = {"voxel_size": (1.0, 1.0, 1.0), "point_range": RANGE}
    plan = DynamicVoxelize(capacity=500, device=device, method=method, **fields)
    table = wp.array(cloud(20, 500), dtype=wp.float32, device=device)
    borrowed = borrow_points(table)
    count = count_on(500, device)
    plan.launch(borrowed.xyz, count, borrowed.extra)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(borrowed.xyz, count, borrowed.extra)
    table.assign(cloud(21, 500))
    wp.capture_launch(capture.graph)
    expected = reference(cloud(21, 500), **fields)
    np.testing.assert_array_equal(plan.voxel_of_point.numpy(), expected[0])
    np.testing.assert_array_equal(plan.means.numpy()[: len(expected[3])], expected[3])
