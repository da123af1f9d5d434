"""Voxelization against the sequential reference in NumPy, and against spconv's where it is installed: to the bit."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.voxel import Voxelize, voxelize

RANGE = (0.0, -39.68, -3.0, 69.12, 39.68, 1.0)
PILLAR = (0.16, 0.16, 4.0)


def reference(points, voxel_size, point_range, max_points, max_voxels):
    """Point after point, in float32."""
    size, low = np.float32(voxel_size), np.float32(point_range[:3])
    shape = np.round((np.float64(point_range[3:]) - point_range[:3]) / voxel_size).astype(int)
    cells = np.floor((points[:, :3] - low) / size)
    voxels, features, coords, counts = {}, [], [], []
    for cell, point in zip(cells, points, strict=True):
        if not (np.all(cell >= 0) and np.all(cell < shape) and np.all(point[:3] < np.float32(point_range[3:]))):
            continue
        voxel = voxels.setdefault(tuple(cell), len(voxels))
        if voxel >= max_voxels:
            continue
        if voxel == len(features):
            features.append(np.zeros((max_points, points.shape[1]), np.float32))
            coords.append(cell[::-1])
            counts.append(0)
        if counts[voxel] < max_points:
            features[voxel][counts[voxel]] = point
            counts[voxel] += 1
    return (
        np.array(features, np.float32).reshape(-1, max_points, points.shape[1]),
        np.array(coords, np.int32).reshape(-1, 3),
        np.array(counts, np.int32),
    )


def street(seed, n=6_000, columns=4):
    return np.random.default_rng(seed).normal(0, [25, 25, 1.5] + [1] * (columns - 3), (n, columns)).astype(np.float32)


def launched(points, device="cpu", **fields):
    """The outputs of a plan, launched a second time so that what the first left is met."""
    plan = Voxelize(columns=points.shape[1], capacity=max(len(points), 1), device=device, **fields)
    given = borrow_points(wp.array(points, dtype=wp.float32, device=device))
    others = borrow_points(wp.array(points[::-1].copy(), dtype=wp.float32, device=device))
    plan.launch(others.xyz, count_on(len(points), device), others.extra)
    plan.launch(given.xyz, count_on(len(points), device), given.extra)
    count = int(plan.voxel_count.numpy()[0])
    assert not plan.features.numpy()[count:].any()
    outputs = [array.numpy()[:count] for array in (plan.features, plan.coords, plan.counts)]
    return *outputs, plan.dropped.numpy().tolist()


@pytest.mark.parametrize("method", ["in_order", "sort"])
@pytest.mark.parametrize(
    ("voxel_size", "max_points", "max_voxels"),
    [(PILLAR, 32, 40_000), (PILLAR, 2, 500), ((1.28, 1.28, 4.0), 5, 40_000), ((0.04, 0.04, 0.02), 3, 40_000)],
    ids=["pillars", "overflow", "crowded", "hashed"],
)
def test_every_method_equals_the_sequential_reference(device, method, voxel_size, max_points, max_voxels):
    points = street(1)
    expected = reference(points, voxel_size, RANGE, max_points, max_voxels)
    features, coords, counts, dropped = launched(
        points,
        device,
        method=method,
        voxel_size=voxel_size,
        point_range=RANGE,
        max_points=max_points,
        max_voxels=max_voxels,
    )
    for actual, wanted in zip((features, coords, counts), expected, strict=True):
        assert actual.dtype == wanted.dtype
        np.testing.assert_array_equal(actual, wanted)
    unlimited = reference(points, voxel_size, RANGE, len(points), len(points))[2] if max_voxels < 40_000 else None
    if unlimited is not None:
        kept = unlimited[:max_voxels]
        outside = len(points) - unlimited.sum()
        assert dropped == [(kept - np.minimum(kept, max_points)).sum(), len(unlimited) - max_voxels, outside]


@pytest.mark.parametrize("columns", [3, 4, 6])
def test_the_function_equals_the_reference_and_counts_what_it_drops(columns):
    points = street(2, columns=columns)
    points[7, 0], points[11, 2], points[13, 1] = np.nan, np.inf, -np.inf
    voxels = voxelize(points, PILLAR, RANGE, max_points=4, max_voxels=500)
    features, coords, counts = reference(points, PILLAR, RANGE, 4, 500)
    np.testing.assert_array_equal(voxels.features, features)
    np.testing.assert_array_equal(voxels.coords, coords)
    np.testing.assert_array_equal(voxels.counts, counts)
    everything = reference(points, PILLAR, RANGE, len(points), len(points))[2]
    assert voxels.outside == len(points) - everything.sum()
    assert voxels.dropped_voxels == len(everything) - 500
    assert voxels.dropped_points == np.maximum(everything[:500] - 4, 0).sum()


def test_equals_spconv_on_real_scans(shared_data):
    utils = pytest.importorskip("spconv.utils", reason="spconv is not installed")
    tensorview = pytest.importorskip("cumm.tensorview")
    peer = utils.Point2VoxelCPU3d(list(PILLAR), list(RANGE), 4, 40_000, 32)
    for path in sorted((shared_data / "kitti_object" / "velodyne").glob("*.bin"))[:4]:
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        features, coords, counts = (array.numpy() for array in peer.point_to_voxel(tensorview.from_numpy(points)))
        voxels = voxelize(points, PILLAR, RANGE)
        np.testing.assert_array_equal(voxels.features, features)
        np.testing.assert_array_equal(voxels.coords, coords)
        np.testing.assert_array_equal(voxels.counts, counts)
        by_sort = launched(points, method="sort", voxel_size=PILLAR, point_range=RANGE)
        np.testing.assert_array_equal(by_sort[0], features)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 300), st.integers(1, 6), st.integers(1, 80))
def test_methods_agree_on_any_cloud(seed, n, max_points, max_voxels):
    points = np.random.default_rng(seed).uniform(-1.2, 1.2, (n, 3)).astype(np.float32)
    points = np.round(points * 8) / 8  # many on the faces of voxels
    arguments = {
        "voxel_size": (0.25, 0.25, 0.5),
        "point_range": (-1, -1, -1, 1, 1, 1),
        "max_points": max_points,
        "max_voxels": max_voxels,
    }
    expected = reference(points, *arguments.values())
    for method in ("in_order", "sort"):
        for actual, wanted in zip(launched(points, method=method, **arguments)[:3], expected, strict=True):
            np.testing.assert_array_equal(actual, wanted)


WAYS = [{"method": "in_order", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "sort"}]


@pytest.mark.parametrize("voxel_size", [(0.4, 0.4, 4.0), (0.04, 0.04, 0.02)], ids=["dense", "hashed"])
@pytest.mark.parametrize("columns", [3, 4, 5])
def test_methods_and_parts_give_the_same_bytes_scan_after_scan(voxel_size, columns):
    fields = {"voxel_size": voxel_size, "point_range": RANGE, "max_points": 3, "max_voxels": 1500, "columns": columns}
    plans = [Voxelize(capacity=5000, **fields, **way) for way in WAYS]
    for seed, n in enumerate((5000, 3, 0, 4000)):
        points = borrow_points(street(seed, 5000, columns))
        for plan in plans:
            plan.launch(points.xyz, count_on(n, "cpu"), points.extra)
        voxels = int(plans[0].voxel_count.numpy()[0])
        outputs = [
            [plan.features.numpy().tobytes(), plan.voxel_count.numpy().tobytes(), plan.dropped.numpy().tobytes()]
            + [part.numpy()[:voxels].tobytes() for part in (plan.coords, plan.counts)]
            for plan in plans
        ]
        assert all(output == outputs[0] for output in outputs)


@pytest.mark.parametrize(
    "kind", ["one voxel", "on a line", "equal", "denormal", "far", "backwards", "columns first", "float64", "read-only"]
)
def test_awkward_clouds(kind):
    rng = np.random.default_rng(8)
    points = street(8, 3000)
    if kind == "one voxel":
        points[:, :3] = rng.uniform(0.01, 0.15, (3000, 3))
    elif kind == "on a line":
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
        "float64": lambda: points.astype(np.float64),
    }.get(kind, lambda: points)()
    made.setflags(write=kind != "read-only")
    voxels = voxelize(made, PILLAR, RANGE, max_points=5)
    expected = reference(points, PILLAR, RANGE, 5, 40_000)
    for actual, wanted in zip((voxels.features, voxels.coords, voxels.counts), expected, strict=True):
        np.testing.assert_array_equal(actual, wanted)


@pytest.mark.parametrize("way", [WAYS[1], WAYS[-1]], ids=str)
def test_a_million_points_in_one_voxel(way):
    points = np.random.default_rng(9).uniform(0.01, 0.15, (1_000_000, 4)).astype(np.float32)
    features, coords, counts, dropped = launched(points, voxel_size=PILLAR, point_range=RANGE, max_voxels=3, **way)
    np.testing.assert_array_equal(features, points[None, :32])
    assert coords.tolist() == [[0, 248, 0]]
    assert counts.tolist() == [32]
    assert dropped == [1_000_000 - 32, 0, 0]


def test_the_upper_bound_is_open_and_the_lower_is_not():
    points = np.array([[0, 0, 0], [1, 0.5, 0.5], [0.5, 1, 0.5], [0.5, 0.5, 1], [-1e-7, 0, 0]], np.float32)
    voxels = voxelize(points, 0.5, (0, 0, 0, 1, 1, 1))
    assert voxels.coords.tolist() == [[0, 0, 0]]
    assert voxels.outside == 4


def test_a_range_that_is_no_whole_number_of_voxels_loses_no_point():
    points = np.array([[0.95, 0.05, 0.05], [0.05, 0.99, 0.05]], np.float32)
    voxels = voxelize(points, 0.3, (0, 0, 0, 1, 1, 1))
    assert voxels.coords.tolist() == [[0, 0, 3], [0, 3, 0]]


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    voxels = voxelize(np.zeros((n, 4), np.float32), 1.0, (-1, -1, -1, 1, 1, 1), max_points=3)
    assert voxels.features.shape == (n, 3, 4)
    assert len(voxels) == n


def test_results_are_the_callers_own():
    points = street(3)
    first = voxelize(points, PILLAR, RANGE)
    kept = first.features.copy(), first.coords.copy(), first.counts.copy()
    voxelize(points[::-1], PILLAR, RANGE)
    for actual, wanted in zip((first.features, first.coords, first.counts), kept, strict=True):
        np.testing.assert_array_equal(actual, wanted)


@pytest.mark.parametrize("held", ["array", "view", "torch", "warp"])
def test_results_are_the_callers_own_as_long_as_a_part_of_them_is_held(held):
    """Memory that nobody holds any more serves again, whatever was written into it."""
    points = street(5)
    given = points
    if held == "torch":
        given = pytest.importorskip("torch").from_numpy(points)
    elif held == "warp":
        given = wp.array(points, device="cpu")
    expected = np.array(voxelize(points, PILLAR, RANGE).features)
    kept = voxelize(given, PILLAR, RANGE).features
    if held == "view":
        kept = kept[1:, :, :2]
        expected = expected[1:, :, :2]
    for seed in (6, 7):
        other = voxelize(street(seed), PILLAR, RANGE).features
        other[:] = np.nan
        del other
    np.testing.assert_array_equal(kept.numpy() if held in ("torch", "warp") else kept, expected)
    del kept
    voxels = voxelize(points, PILLAR, RANGE)
    np.testing.assert_array_equal(voxels.features, reference(points, PILLAR, RANGE, 32, 40_000)[0])


def test_a_plan_takes_positions_and_intensities_apart():
    points = street(4)
    expected = voxelize(points, PILLAR, RANGE)
    plan = Voxelize(voxel_size=PILLAR, point_range=RANGE, capacity=30_000)
    xyz = wp.array(points[:, :3], dtype=wp.vec3, device="cpu")
    intensity = wp.array(points[:, 3], dtype=wp.float32, device="cpu")
    plan.launch(xyz, count_on(len(points), "cpu"), intensity)
    np.testing.assert_array_equal(plan.features.numpy()[: len(expected)], expected.features)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"voxel_size": 0.0}, "voxel_size must be > 0"),
        ({"voxel_size": (0.1, float("nan"), 0.1)}, "voxel_size must be > 0 m and finite, not nan along y"),
        ({"point_range": (0, 0, 0, 1, 0, 1)}, "min < max, not 0.0 … 0.0 along y"),
        ({"point_range": (0, 0, 0, 1)}, "six numbers"),
        ({"max_points": 0}, "max_points must be at least 1"),
        ({"max_voxels": -1}, "max_voxels must be at least 1"),
        ({"voxel_size": 1e-9}, "choose a larger voxel_size"),
        ({"voxel_size": (1.0, 1.0)}, "voxel_size must be one number or three"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(change, message):
    arguments = {"voxel_size": 0.5, "point_range": (0, 0, 0, 1, 1, 1)} | change
    with pytest.raises(ValueError, match=message):
        voxelize(np.zeros((1, 3), np.float32), **arguments)


def test_a_plan_refuses_what_does_not_fit():
    plan = Voxelize(voxel_size=PILLAR, point_range=RANGE, capacity=10)
    xyz = wp.zeros(11, dtype=wp.vec3, device="cpu")
    with pytest.raises(ValueError, match="capacity of 10"):
        plan.launch(xyz, count_on(11, "cpu"))
    with pytest.raises(ValueError, match="extra must have shape"):
        plan.launch(xyz[:5], count_on(5, "cpu"))
    with pytest.raises(ValueError, match="method must be"):
        Voxelize(voxel_size=PILLAR, point_range=RANGE, capacity=10, method="fast")
    with pytest.raises(ValueError, match="parts must be at least 1, not 0"):
        Voxelize(voxel_size=PILLAR, point_range=RANGE, capacity=10, parts=0)


@pytest.mark.parametrize("method", ["in_order", "sort"])
def test_a_captured_launch_replays_on_other_points(device, method):
    plan = Voxelize(voxel_size=PILLAR, point_range=RANGE, columns=3, capacity=500, device=device, method=method)
    xyz = wp.array(street(20, 500)[:, :3], dtype=wp.vec3, device=device)
    count = count_on(500, device)
    plan.launch(xyz, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, count)
    xyz.assign(street(21, 500)[:, :3])
    wp.capture_launch(capture.graph)
    replayed = plan.features.numpy().copy()
    plan.launch(xyz, count)
    np.testing.assert_array_equal(plan.features.numpy(), replayed)
