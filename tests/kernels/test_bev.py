"""Bird's-eye-view maps against NumPy."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.bev import BevMaps, bev

RANGE = (-40.0, -40.0, -2.5, 40.0, 40.0, 1.5)


def reference(points, point_range, shape):
    """Sorted by cell, then falling height, then index: the first of each cell is the one drawn."""
    low, high = np.float32(point_range[:3]), np.float32(point_range[3:])
    xyz = points[:, :3]
    index = np.flatnonzero(((xyz >= low) & (xyz < high)).all(axis=1))
    cells_per_metre = np.float32(np.array(shape) / (np.float64(point_range[3:5]) - np.float64(point_range[:2])))
    cells = ((xyz[index, :2] - low[:2]) * cells_per_metre).astype(np.int64)
    cells = np.minimum(cells, np.array(shape) - 1) @ [shape[1], 1]
    order = np.lexsort([index, -xyz[index, 2], cells])
    cell, first, count = np.unique(cells[order], return_index=True, return_counts=True)
    drawn = index[order][first]
    maps = np.zeros((3, shape[0] * shape[1]), np.float32)
    maps[0, cell] = xyz[drawn, 2]
    maps[1, cell] = points[drawn, 3]
    maps[2, cell] = np.minimum(1, np.log1p(count) / np.log(64))
    return maps.reshape(3, *shape)


def cloud(n, seed, step=None):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, [20, 20, 1.5, 1], (n, 4)).astype(np.float32)
    if step:  # many equal heights
        points[:, 2] = np.round(points[:, 2] / step) * step
    points[rng.random(n) < 0.02, 0] = np.nan
    return points


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5000), st.sampled_from([(40, 64), (1, 1), (200, 7)]))
def test_equals_numpy(seed, n, shape):
    """Heights and intensities to the bit, densities within 1e-6."""
    points = cloud(n, seed, step=0.5)
    maps, expected = bev(points, RANGE, shape), reference(points, RANGE, shape)
    assert maps.shape == (3, *shape)
    assert maps.dtype == np.float32
    assert np.array_equal(maps[:2], expected[:2])
    np.testing.assert_allclose(maps[2], expected[2], atol=1e-6)


@pytest.mark.real
def test_equals_numpy_on_a_scan(shared_data):
    points = np.fromfile(shared_data / "semantic_kitti" / "full" / "00_000000.bin", np.float32).reshape(-1, 4)
    maps, expected = bev(points, RANGE, (608, 608)), reference(points, RANGE, (608, 608))
    assert np.array_equal(maps[:2], expected[:2])
    np.testing.assert_allclose(maps[2], expected[2], atol=1e-6)


def test_rows_rise_with_x_and_columns_with_y():
    maps = bev(np.float32([[9.5, 0.5, 1, 0.25]]), (0, 0, 0, 10, 5, 2), (10, 5))
    assert maps[0].argmax() == 9 * 5
    assert maps[0, 9, 0] == 1
    assert maps[1, 9, 0] == np.float32(0.25)
    assert maps[2, 9, 0] == pytest.approx(np.log(2) / np.log(64))


def test_of_equal_heights_the_first_point_is_drawn():
    points = np.float32([[0.5, 0.5, -0.0, 3], [0.2, 0.2, 0.0, 7], [0.1, 0.1, -1, 9]])
    assert bev(points, (0, 0, -2, 1, 1, 2), (1, 1))[1, 0, 0] == 3
    assert bev(points[::-1], (0, 0, -2, 1, 1, 2), (1, 1))[1, 0, 0] == 7


def test_density_is_full_at_63_points():
    points = np.zeros((63, 3), np.float32)
    limits = (-1, -1, -1, 1, 1, 1)
    assert bev(points, limits, (1, 1))[2, 0, 0] == pytest.approx(1)
    assert bev(points[:62], limits, (1, 1))[2, 0, 0] < 1
    assert bev(np.repeat(points, 100, axis=0), limits, (1, 1))[2, 0, 0] == 1


def test_arrays_of_other_families():
    import torch

    points = cloud(2000, 1)
    expected = bev(points, RANGE, (50, 50))
    maps = bev(torch.from_numpy(points), RANGE, (50, 50))
    assert isinstance(maps, torch.Tensor)
    assert np.array_equal(maps.numpy(), expected)
    assert np.array_equal(bev(wp.array(points, dtype=wp.float32, device="cpu"), RANGE, (50, 50)).numpy(), expected)


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_the_plan_reads_its_count_and_leaves_nothing_behind(device, method):
    first, second = cloud(4000, 1, step=0.5), cloud(3000, 2)
    plan = BevMaps(capacity=4096, point_range=RANGE, shape=(64, 48), device=device, method=method)
    for points, n in ((first, 4000), (second, 1000), (first, 2500)):
        plan.launch(
            wp.array(points[:, :3].copy(), dtype=wp.vec3, device=device),
            wp.array(points[:, 3].copy(), dtype=wp.float32, device=device),
            wp.array([n], dtype=wp.int32, device=device),
        )
        expected = reference(points[:n], RANGE, (64, 48))
        assert np.array_equal(plan.maps.numpy()[:2], expected[:2])
        np.testing.assert_allclose(plan.maps.numpy()[2], expected[2], atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 4), max_size=40))
def test_both_methods_draw_any_floats_alike(rows):
    """NaN, infinities and denormals; maps are compared as bytes."""
    points = np.array(rows, np.float32).reshape(-1, 4)
    drawn = []
    for method in ("in_order", "shared"):
        plan = BevMaps(capacity=64, point_range=RANGE, shape=(8, 8), method=method)
        count = wp.array([len(points)], dtype=wp.int32, device="cpu")
        xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu")
        plan.launch(xyz, wp.array(points[:, 3].copy(), dtype=wp.float32, device="cpu"), count)
        drawn.append(plan.maps.numpy().tobytes())
    assert drawn[0] == drawn[1] == bev(points, RANGE, (8, 8)).tobytes()


@pytest.mark.parametrize("columns", [1, 31, 32, 33, 100])
def test_methods_and_parts_draw_the_same_bytes_scan_after_scan(columns):
    ways = [{"method": "in_order", "parts": parts} for parts in (1, 2, 3, 7)] + [{"method": "shared"}]
    plans = [BevMaps(capacity=4000, point_range=RANGE, shape=(70, columns), **way) for way in ways]
    for seed, n in enumerate((4000, 3, 0, 3000)):
        points = cloud(4000, seed, step=0.5)
        xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu")
        intensity = wp.array(points[:, 3].copy(), dtype=wp.float32, device="cpu")
        count = wp.array([n], dtype=wp.int32, device="cpu")
        for plan in plans:
            plan.launch(xyz, intensity, count)
        drawn = bev(points[:n], RANGE, (70, columns)).tobytes()
        assert all(plan.maps.numpy().tobytes() == drawn for plan in plans)


@pytest.mark.parametrize("kind", ["one cell", "on a line", "equal", "far", "backwards", "columns first"])
def test_awkward_clouds(kind):
    rng = np.random.default_rng(6)
    points = cloud(3000, 6)
    if kind == "one cell":
        points[:, :2] = rng.uniform(0.1, 0.2, (3000, 2))
    elif kind == "on a line":
        points[:, 1] = points[:, 0] / 2
    elif kind == "equal":
        points[:] = points[1]
    elif kind == "far":
        points[::2, :3] += rng.choice([-1e5, 1e5], (1500, 3)).astype(np.float32)
    made = {
        "backwards": lambda: points[::-1].copy()[::-1],
        "columns first": lambda: np.asfortranarray(points),
    }.get(kind, lambda: points)()
    maps, expected = bev(made, RANGE, (60, 50)), reference(points, RANGE, (60, 50))
    assert np.array_equal(maps[:2], expected[:2])
    np.testing.assert_allclose(maps[2], expected[2], atol=1e-6)


def test_strided_read_only_and_float64_input_gives_the_same():
    points = np.random.default_rng(5).normal(0, [20, 20, 1.5, 1, 1, 1], (900, 6)).astype(np.float32)
    expected = bev(points[:, :4].copy(), RANGE, (30, 20))
    strided = points[:, :5]
    strided.flags.writeable = False
    assert np.array_equal(bev(strided, RANGE, (30, 20)), expected)
    assert np.array_equal(bev(points.astype(np.float64), RANGE, (30, 20)), expected)


@pytest.mark.parametrize("method", ["in_order", "shared"])
def test_a_captured_launch_replays_on_other_points(device, method):
    plan = BevMaps(capacity=500, point_range=RANGE, shape=(20, 30), device=device, method=method)
    xyz = wp.array(cloud(500, 1)[:, :3].copy(), dtype=wp.vec3, device=device)
    intensity = wp.array(cloud(500, 1)[:, 3].copy(), dtype=wp.float32, device=device)
    count = wp.array([500], dtype=wp.int32, device=device)
    plan.launch(xyz, intensity, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, intensity, count)
    points = cloud(500, 2)
    xyz.assign(points[:, :3].copy())
    intensity.assign(points[:, 3].copy())
    wp.capture_launch(capture.graph)
    assert np.array_equal(plan.maps.numpy()[:2], reference(points, RANGE, (20, 30))[:2])


def test_an_unknown_method_is_refused():
    with pytest.raises(ValueError, match="method must be 'auto', 'in_order' or 'shared', not 'fast'"):
        BevMaps(capacity=1, point_range=RANGE, shape=(1, 1), method="fast")
    with pytest.raises(ValueError, match="parts must be at least 1, not 0"):
        BevMaps(capacity=1, point_range=RANGE, shape=(1, 1), parts=0)


@pytest.mark.parametrize(
    ("point_range", "shape", "message"),
    [
        ((0, 0, 0, 1, 1), (2, 2), "point_range must be"),
        ((0, 0, 0, 1, 0, 1), (2, 2), "point_range must be"),
        ((0, 0, 0, np.inf, 1, 1), (2, 2), "point_range must be"),
        ((0, 0, 0, 1, 1, 1), (0, 2), "shape must be"),
        ((0, 0, 0, 1, 1, 1), (2,), "shape must be"),
        ((0, 0, 0, 1, 1, 1), (1 << 16, 1 << 16), "more cells"),
    ],
)
def test_wrong_arguments_are_refused(point_range, shape, message):
    with pytest.raises(ValueError, match=message):
        bev(np.zeros((4, 4), np.float32), point_range, shape)
