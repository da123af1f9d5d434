"""Voxel downsampling against NumPy in double precision."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.downsample import VoxelDownsample, voxel_downsample
from warploom.kernels.interop import borrow_points, count_on


def reference(points, voxel_size):
    """Centroids in order of first appearance, summed in float64."""
    cells = np.floor(points[:, :3].astype(np.float32) * np.float32(1.0 / voxel_size)).astype(np.int64)
    _, first, voxel = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    sums = np.zeros((len(first), 3))
    np.add.at(sums, voxel.ravel(), points[:, :3].astype(np.float64))
    return (sums / np.bincount(voxel.ravel())[:, None])[np.argsort(first)]


def launched(points, device="cpu", **fields):
    """The centroids and the dropped count of a plan, launched twice so that what the first left is met."""
    plan = VoxelDownsample(capacity=max(len(points), 1), device=device, **fields)
    for order in (points[::-1], points):
        xyz = wp.array(np.ascontiguousarray(order[:, :3]), dtype=wp.vec3, device=device)
        plan.launch(xyz, count_on(len(points), device))
    return plan.centroids.numpy()[: int(plan.centroid_count.numpy()[0])], int(plan.dropped.numpy()[0])


def drawn(n, seed):
    """The numbers that the mode `random` draws: MurmurHash3's finalizer of index × golden ratio + seed."""
    h = (np.arange(n, dtype=np.uint64) * 0x9E3779B9 + (seed & 0xFFFFFFFF)) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return (h ^ (h >> 16)) >> 1


def chosen_reference(points, voxel_size, mode, seed):
    """The indices chosen, in order of each voxel's first point."""
    cells = np.floor(points[:, :3].astype(np.float32) * np.float32(1.0 / voxel_size)).astype(np.int64)
    order = np.lexsort(
        (np.arange(len(points)), drawn(len(points), seed) if mode == "random" else np.zeros(len(points)))
    )
    _, first, voxel = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    best = np.full(len(first), -1)
    best[voxel.ravel()[order[::-1]]] = order[::-1]
    return best[np.argsort(first)]


def street(seed, n=60_000):
    return np.random.default_rng(seed).normal(0, [30, 30, 2, 1], (n, 4)).astype(np.float32)


@pytest.mark.parametrize("method", ["in_order", "shared"])
@pytest.mark.parametrize("voxel_size", [0.05, 0.2, 2.0])
def test_matches_the_reference_on_a_street(device, method, voxel_size):
    """Same voxels, same order; centroids within 2 float32 steps at 128 m and the 0.24 µm of the fixed point."""
    points = street(7)
    expected = reference(points, voxel_size)
    actual, dropped = launched(points, device, method=method, voxel_size=voxel_size)
    assert actual.shape == expected.shape
    assert dropped == 0
    np.testing.assert_allclose(actual, expected, rtol=0, atol=1.6e-5)
    np.testing.assert_array_equal(actual, voxel_downsample(points, voxel_size))


def test_matches_the_reference_on_real_scans(shared_data):
    for path in sorted((shared_data / "kitti_object" / "velodyne").glob("*.bin"))[:3]:
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        expected = reference(points, 0.2)
        actual = voxel_downsample(points, 0.2)
        assert actual.shape == expected.shape
        np.testing.assert_allclose(actual, expected, rtol=0, atol=1.6e-5)


WAYS = [{"method": "in_order", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "shared"}]


@pytest.mark.parametrize("voxel_size", [0.05, 0.8, 50.0])
def test_methods_and_parts_give_the_same_bytes_scan_after_scan(voxel_size):
    plans = [VoxelDownsample(capacity=5000, voxel_size=voxel_size, **way) for way in WAYS]
    for seed, n in enumerate((5000, 3, 0, 4000)):
        points = street(seed, 5000)
        points[::50, seed % 3] = np.nan
        xyz = borrow_points(points).xyz
        outputs = []
        for plan in plans:
            plan.launch(xyz, count_on(n, "cpu"))
            voxels = int(plan.centroid_count.numpy()[0])
            outputs.append((plan.centroids.numpy()[:voxels].tobytes(), plan.dropped.numpy().tobytes()))
        assert all(output == outputs[0] for output in outputs)


@pytest.mark.parametrize("way", WAYS, ids=str)
def test_cells_that_all_want_the_same_slots_of_their_blocks(way):
    """One cell of each block of 8 × 8: the table must find room for them beside it."""
    corners = np.stack(np.meshgrid(*[8 * np.arange(40)] * 2), -1).reshape(-1, 2)
    points = np.float32(np.c_[corners + 0.5, np.full(1600, 0.5)])
    actual, dropped = launched(points, voxel_size=1.0, **way)
    np.testing.assert_array_equal(actual, points)
    assert dropped == 0


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_clouds_of_any_length_and_layout_of_rows(columns):
    """Points are looked at by the block: lengths about those, and rows that end where their memory ends."""
    table = np.repeat(street(11, 200), 3, axis=0)[:, [0, 1, 2, 3, 3]]  # runs of three
    table[::41] = np.nan
    for length in (1, 7, 8, 9, 127, 128, 129, 257, 600):
        memory = np.ascontiguousarray(table[:length, :columns])
        finite = memory[np.isfinite(memory[:, 0])]
        np.testing.assert_allclose(voxel_downsample(memory, 2.0), reference(finite, 2.0), rtol=0, atol=1.6e-5)
        last = memory[:, columns - 3 :]
        finite = last[np.isfinite(last[:, 0])]
        np.testing.assert_allclose(voxel_downsample(last, 2.0), reference(finite, 2.0), rtol=0, atol=1.6e-5)


@pytest.mark.parametrize("kind", ["on a line", "equal", "denormal", "far", "backwards", "columns first"])
def test_awkward_clouds(kind):
    rng = np.random.default_rng(8)
    points = street(8, 3000)
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
    expected = reference(points, 0.5)
    # Two float32 steps at 1e5 m, and at 128 m.
    np.testing.assert_allclose(voxel_downsample(made, 0.5), expected, rtol=0, atol=1.6e-2 if kind == "far" else 1.6e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 500))
def test_order_of_points_does_not_change_the_set(seed, n):
    """Shuffling the input gives the same centroids, to the bit, and either method does."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-5, 5, (n, 3)).astype(np.float32)
    shuffled = points[rng.permutation(n)]
    a, b = voxel_downsample(points, 0.5), voxel_downsample(shuffled, 0.5)
    np.testing.assert_array_equal(a[np.lexsort(a.T)], b[np.lexsort(b.T)])
    np.testing.assert_array_equal(launched(shuffled, method="shared", voxel_size=0.5)[0], b)


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_points_that_are_not_finite_or_too_far_are_skipped_and_counted(method):
    points = np.zeros((8, 3), np.float32)
    points[1, 0], points[2, 1], points[3, 2] = np.nan, np.inf, -np.inf
    points[4, 0] = 2.0**20
    points[5] = -(2.0**20) + 1, 5, 5
    points[6] = np.nan, np.inf, -np.inf
    actual, dropped = launched(points, method=method, voxel_size=0.5)
    np.testing.assert_array_equal(actual, [[0, 0, 0], [-(2.0**20) + 1, 5, 5]])
    assert dropped == 5


def test_a_million_points_in_one_voxel_far_away():
    points = np.full((1_000_000, 3), 1e5, np.float32) + np.random.default_rng(0).uniform(0, 1, (1_000_000, 1)) * 0.4
    points = points.astype(np.float32)
    expected = reference(points, 10.0)
    np.testing.assert_allclose(voxel_downsample(points, 10.0), expected, rtol=0, atol=0.008)


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    points = np.full((n, 3), 0.3, np.float32)
    np.testing.assert_allclose(voxel_downsample(points, 1.0), points, atol=1e-6)


def test_cells_below_zero_are_not_folded_onto_those_above():
    points = np.array([[-0.1, 0, 0], [0.1, 0, 0], [-0.9, 0, 0]], np.float32)
    np.testing.assert_allclose(voxel_downsample(points, 1.0), [[-0.5, 0, 0], [0.1, 0, 0]], atol=1e-6)


@pytest.mark.parametrize("method", ["in_order", "shared"])
@pytest.mark.parametrize(("mode", "seed"), [("first", 0), ("random", 0), ("random", 1), ("random", -7)])
def test_chosen_points_are_those_of_the_reference(device, method, mode, seed):
    points = street(9)
    points[::1000, 1] = np.nan
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    plan = VoxelDownsample(capacity=len(points), device=device, method=method, mode=mode, seed=seed, voxel_size=0.8)
    for order in (points[::-1], points):
        xyz = wp.array(np.ascontiguousarray(order[:, :3]), dtype=wp.vec3, device=device)
        plan.launch(xyz, count_on(len(points), device))
    m = int(plan.centroid_count.numpy()[0])
    chosen = plan.chosen.numpy()[:m]
    if mode == "first":
        np.testing.assert_array_equal(chosen, finite[chosen_reference(points[finite], 0.8, mode, seed)])
    else:
        # Draws are by the index among all points: those that are left out take no part.
        marked = points.copy()
        marked[~np.isfinite(points).all(axis=1), :3] = 1e6
        expected = chosen_reference(marked, 0.8, mode, seed)
        np.testing.assert_array_equal(chosen, expected[np.abs(marked[expected, 0]) < 1e5])
    np.testing.assert_array_equal(plan.centroids.numpy()[:m], points[chosen, :3])
    np.testing.assert_array_equal(voxel_downsample(points, 0.8, mode, seed=seed), points[chosen, :3])


def test_random_choice_is_even_and_hangs_on_the_seed():
    """Each of 8 points of a voxel is chosen about one time in 8: 4 standard deviations of the binomial."""
    points = np.zeros((2_000, 8, 3), np.float32)
    points[..., 0] = np.arange(8) / 16
    points[..., 1] = np.arange(2_000)[:, None]
    picks = [voxel_downsample(points.reshape(-1, 3), 1.0, "random", seed=seed)[:, 0] * 16 for seed in range(3)]
    for pick in picks:
        assert np.abs(np.bincount(pick.astype(int), minlength=8) - 250).max() < 4 * np.sqrt(2_000 / 8 * 7 / 8)
    assert 0.08 < np.mean(picks[0] == picks[1]) < 0.17


def test_an_unknown_mode_is_refused():
    with pytest.raises(ValueError, match="mode must be 'centroid', 'first' or 'random', not 'median'"):
        voxel_downsample(np.zeros((1, 3), np.float32), 1.0, "median")


@pytest.mark.parametrize("size", [0.0, -1.0, float("nan"), float("inf")])
def test_a_size_that_is_not_positive_is_refused(size):
    with pytest.raises(ValueError, match="voxel_size must be > 0"):
        voxel_downsample(np.zeros((1, 3), np.float32), size)


def test_a_plan_refuses_what_does_not_fit():
    with pytest.raises(ValueError, match="capacity must be at least 1"):
        VoxelDownsample(voxel_size=1.0, capacity=0)
    with pytest.raises(ValueError, match="method must be"):
        VoxelDownsample(voxel_size=1.0, capacity=1, method="fast")
    with pytest.raises(ValueError, match="parts must be 1 to 64, not 0"):
        VoxelDownsample(voxel_size=1.0, capacity=1, parts=0)
    with pytest.raises(ValueError, match="capacity of 10"):
        VoxelDownsample(voxel_size=1.0, capacity=10).launch(wp.zeros(11, wp.vec3, device="cpu"), count_on(11, "cpu"))


@pytest.mark.parametrize("mode", ["centroid", "first", "random"])
@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_a_captured_launch_replays_on_other_points(device, method, mode):
    plan = VoxelDownsample(voxel_size=2.0, capacity=500, device=device, method=method, mode=mode)
    xyz = wp.array(street(20, 500)[:, :3], dtype=wp.vec3, device=device)
    count = count_on(500, device)
    plan.launch(xyz, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, count)
    xyz.assign(street(21, 500)[:, :3])
    wp.capture_launch(capture.graph)
    replayed = plan.centroids.numpy().copy()
    plan.launch(xyz, count)
    np.testing.assert_array_equal(plan.centroids.numpy(), replayed)
