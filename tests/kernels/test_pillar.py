"""The pillar grid against NumPy in double precision."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.interop import count_on
from warploom.kernels.pillar import PillarGrid, pillar_channels, pillarize

RANGE = (-16.0, -12.0, -2.0, 16.0, 12.0, 6.0)
SLICES = 15


def reference(points, height, point_range=RANGE, cell=0.25):
    """Channels by the definition: a loop over the cells that hold points."""
    columns, rows = (round((point_range[a + 3] - point_range[a]) / cell) for a in (0, 1))
    grid = np.zeros((20, rows, columns))
    xyz = points[:, :3].astype(np.float32)
    z = xyz[:, 2] + np.float32(height)
    low, high = np.float32(point_range[:3]), np.float32(point_range[3:])
    full = np.c_[xyz[:, :2], z]
    with np.errstate(invalid="ignore"):
        inside = ((full >= low) & (full < high)).all(axis=1)
    full = full[inside]
    u = (full[:, 0] - low[0]) * np.float32(1 / cell)
    v = (full[:, 1] - low[1]) * np.float32(1 / cell)
    column, row = u.astype(int), v.astype(int)
    for key in set(zip(row.tolist(), column.tolist(), strict=True)):
        members = (row == key[0]) & (column == key[1])
        height_in = full[members, 2].astype(np.float64)
        level = np.where(height_in < 0, 0, np.minimum((height_in / 0.25).astype(int) + 1, SLICES - 1))
        grid[level, key[0], key[1]] = 1.0
        grid[15, key[0], key[1]] = (u[members].astype(np.float64) - key[1] - 0.5).mean()
        grid[16, key[0], key[1]] = (v[members].astype(np.float64) - key[0] - 0.5).mean()
        grid[17, key[0], key[1]] = height_in.mean()
        grid[18, key[0], key[1]] = height_in.max()
        grid[19, key[0], key[1]] = height_in.min()
    return grid


def cloud(rng, n):
    return np.c_[rng.uniform(-20, 20, (n, 2)), rng.normal(-1.2, 1.0, n), rng.random(n)].astype(np.float32)


def test_channels_agree_with_their_definition(device):
    """Slices exactly, means and heights within a millimetre and the 1/4096 of a cell they are summed in."""
    points = cloud(np.random.default_rng(1), 4000)
    given_points = points if device == "cpu" else wp.array(points, dtype=wp.float32, device=device)
    got = pillarize(given_points, sensor_height=1.7, point_range=RANGE)
    got = got if isinstance(got, np.ndarray) else got.numpy()
    expected = reference(points, 1.7)
    assert got.shape == expected.shape == (len(pillar_channels()), 96, 128)
    np.testing.assert_array_equal(got[:SLICES], expected[:SLICES])
    np.testing.assert_allclose(got[SLICES:], expected[SLICES:], atol=2e-3)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400))
def test_the_order_of_points_changes_no_byte(seed, n):
    rng = np.random.default_rng(seed)
    points = cloud(rng, n)
    a = pillarize(points, sensor_height=1.7, point_range=RANGE)
    b = pillarize(points[rng.permutation(n)], sensor_height=1.7, point_range=RANGE)
    assert a.tobytes() == b.tobytes()


def test_a_plan_forgets_the_scan_before():
    rng = np.random.default_rng(2)
    plan = PillarGrid(point_range=RANGE, capacity=4096)
    for n in (3000, 10, 2000, 0, 5):
        points = cloud(rng, max(n, 1))
        xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3)
        plan.launch(xyz, wp.array([n], dtype=wp.int32), 1.7)
        np.testing.assert_allclose(plan.grid.numpy()[0], reference(points[:n], 1.7), atol=2e-3)


def test_points_that_are_not_finite_or_outside_are_left_out():
    points = np.zeros((6, 3), np.float32)
    points[0, 0], points[1, 1], points[2, 2] = np.nan, np.inf, -np.inf
    points[3, 0], points[4, 2] = 16.0, 6.0
    grid = pillarize(points, sensor_height=0.0, point_range=RANGE)
    assert grid[:SLICES].sum() == 1


def test_the_height_may_lie_on_the_device():
    points = cloud(np.random.default_rng(3), 500)
    plan = PillarGrid(point_range=RANGE, capacity=512)
    xyz, count = wp.array(points[:, :3].copy(), dtype=wp.vec3), wp.array([500], dtype=wp.int32)
    plan.launch(xyz, count, wp.array([1.9], dtype=wp.float32))
    np.testing.assert_array_equal(plan.grid.numpy()[0], pillarize(points, sensor_height=1.9, point_range=RANGE))


WAYS = [{"method": "rows", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "shared"}]


@pytest.mark.parametrize("columns", [1, 31, 32, 33, 100])
def test_methods_and_parts_give_the_same_bytes_scan_after_scan(columns):
    """Also where a row of the grid is no whole number of words, and its last cell is cut long or short."""
    rng = np.random.default_rng(columns)
    point_range = (-5.0, -9.0, -2.0, -5.0 + 0.25 * columns + 0.1, 9.1, 6.0)
    plans = [PillarGrid(point_range=point_range, capacity=4096, **way) for way in WAYS]
    for n in (3000, 7, 0, 4096):
        points = cloud(rng, 4096)
        points[rng.random(4096) < 0.01, 1] = np.nan
        xyz, count = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"), count_on(n, "cpu")
        for plan in plans:
            plan.launch(xyz, count, 1.7)
        grids = [plan.grid.numpy() for plan in plans]
        assert all(grid.tobytes() == grids[0].tobytes() for grid in grids)
        fresh = pillarize(points[:n], sensor_height=1.7, point_range=point_range)
        assert fresh.tobytes() == grids[0].tobytes()


@pytest.mark.parametrize("way", WAYS, ids=str)
@pytest.mark.parametrize("chosen", [(0, 3, 14), (15, 18, 19), (2, 16), tuple(range(20))], ids=str)
def test_some_of_the_channels_are_those_of_all_scan_after_scan(way, chosen):
    rng = np.random.default_rng(7)
    names = tuple(pillar_channels()[k] for k in chosen)
    plan = PillarGrid(point_range=RANGE, capacity=4096, channels=names, **way)
    for n in (3000, 7, 0, 4096):
        points = cloud(rng, 4096)
        plan.launch(wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"), count_on(n, "cpu"), 1.7)
        assert plan.grid.shape == (1, len(chosen), 96, 128)
        expected = reference(points[:n], 1.7)[list(chosen)]
        np.testing.assert_allclose(plan.grid.numpy()[0], expected, atol=2e-3)
        whole = pillarize(points[:n], sensor_height=1.7, point_range=RANGE)
        assert plan.grid.numpy()[0].tobytes() == whole[list(chosen)].tobytes()


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_a_captured_launch_replays_on_the_cpu(way):
    points = cloud(np.random.default_rng(4), 500)
    plan = PillarGrid(point_range=RANGE, capacity=512, **way)
    xyz, count = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"), count_on(500, "cpu")
    height = wp.array([1.7], dtype=wp.float32, device="cpu")
    plan.launch(xyz, count, height)
    with wp.ScopedCapture("cpu") as capture:
        plan.launch(xyz, count, height)
    others = cloud(np.random.default_rng(5), 500)
    xyz.assign(others[:, :3])
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(plan.grid.numpy()[0], pillarize(others, sensor_height=1.7, point_range=RANGE))


@pytest.mark.parametrize(
    "kind", ["one cell", "on a line", "equal", "denormal", "far", "backwards", "columns first", "float64", "read-only"]
)
def test_awkward_clouds(kind):
    rng = np.random.default_rng(6)
    points = cloud(rng, 3000)
    if kind == "one cell":
        points[:, :2] = rng.uniform(0.26, 0.49, (3000, 2))
    elif kind == "on a line":
        points[:, 1] = points[:, 0] / 2
    elif kind == "equal":
        points[:] = points[0]
    elif kind == "denormal":
        points[:, :2] = rng.choice([-1e-45, 0.0, 1e-45], (3000, 2))
    elif kind == "far":
        points[::2, :3] += rng.choice([-1e5, 1e5], (1500, 3)).astype(np.float32)
    made = {
        "backwards": lambda: points[::-1].copy()[::-1],
        "columns first": lambda: np.asfortranarray(points),
        "float64": lambda: points.astype(np.float64),
    }.get(kind, lambda: points)()
    made.setflags(write=kind != "read-only")
    got = pillarize(made, sensor_height=1.7, point_range=RANGE)
    expected = reference(points, 1.7)
    np.testing.assert_array_equal(got[:SLICES], expected[:SLICES])
    np.testing.assert_allclose(got[SLICES:], expected[SLICES:], atol=2e-3)


@pytest.mark.parametrize("way", [{"method": "rows", "parts": 2}, {"method": "shared"}], ids=str)
def test_a_million_points_in_one_cell(way):
    points = np.full((1_000_000, 3), 0.3, np.float32)
    points[::2, 2] = 30.0
    plan = PillarGrid(capacity=len(points), point_range=(0, 0, -0.5, 1, 1, 60), **way)
    plan.launch(wp.array(points, dtype=wp.vec3, device="cpu"), count_on(len(points), "cpu"), 0.0)
    grid = plan.grid.numpy()[0]
    np.testing.assert_allclose(grid[SLICES:, 1, 1], [-0.3, -0.3, 15.15, 30.0, 0.3], atol=2e-3)
    assert np.count_nonzero(grid) == 7


@pytest.mark.cuda
def test_a_launch_is_captured_in_a_graph():
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    points = cloud(np.random.default_rng(3), 500)
    plan = PillarGrid(point_range=RANGE, capacity=512, device="cuda:0")
    xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cuda:0")
    count = wp.array([500], dtype=wp.int32, device="cuda:0")
    plan.launch(xyz, count, 1.7)
    with wp.ScopedCapture("cuda:0") as capture:
        plan.launch(xyz, count, 1.7)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(plan.grid.numpy()[0], pillarize(points, sensor_height=1.7, point_range=RANGE))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cell": 0.0}, "cell must be > 0"),
        ({"point_range": (0, 0, 0, -1, 1, 1)}, "point_range must be"),
        ({"cell": float("inf")}, "cell must be > 0 m and finite"),
        ({"cell": 1000.0}, "point_range must be 1 to 2³¹ cells"),
        ({"point_range": (0, 0, 0, 1, 1)}, "point_range must be xmin"),
        ({"point_range": (0, 0, 0, 1, float("inf"), 1)}, "finite"),
        ({"method": "fast"}, "method must be 'auto', 'rows' or 'shared'"),
        ({"parts": 0}, "parts must be at least 1"),
        ({"channels": ()}, "channels must be some of below, z0.00"),
        ({"channels": ("z0.25", "z0.00")}, "in that order"),
        ({"channels": ("z9.00",)}, "channels must be some of"),
        ({"capacity": 0}, "capacity must be"),
        ({"point_range": (-9, -9, -3e6, 9, 9, 3e6)}, "less than 2³¹ mm high"),
    ],
)
def test_wrong_arguments_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        PillarGrid(**{"capacity": 1024, **wrong})


def test_more_points_than_capacity_are_refused():
    plan = PillarGrid(point_range=RANGE, capacity=10)
    with pytest.raises(ValueError, match="capacity of 10"):
        plan.launch(wp.zeros(11, dtype=wp.vec3), wp.array([11], dtype=wp.int32), 1.7)
