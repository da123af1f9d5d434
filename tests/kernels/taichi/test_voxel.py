"""Taichi's voxels against Warp's: all to the bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.voxel import voxelize

RANGE = (0.0, -39.68, -3.0, 69.12, 39.68, 1.0)
AROUND = (-40.0, -40.0, -4.0, 40.0, 40.0, 4.0)
PILLAR = (0.16, 0.16, 4.0)
# Size, points and voxels kept: pillars, few of each, a hash table, a hash table that overflows.
SETTINGS = [(PILLAR, 32, 40_000), (1.0, 2, 200), ((0.04, 0.04, 0.02), 3, 40_000), (0.05, 1, 1000)]


def check(points, voxel_size=PILLAR, max_points=32, max_voxels=40_000, point_range=AROUND):
    arguments = (points, voxel_size, point_range, max_points, max_voxels)
    ours, expected = voxelize(*arguments, backend="taichi"), voxelize(*arguments)
    for name in ("features", "coords", "counts"):
        mine, theirs = getattr(ours, name), getattr(expected, name)
        assert mine.dtype == theirs.dtype
        assert mine.shape == theirs.shape
        np.testing.assert_array_equal(mine.view(np.int32), theirs.view(np.int32))
    for name in ("dropped_points", "dropped_voxels", "outside"):
        assert getattr(ours, name) == getattr(expected, name), name


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5000), st.sampled_from(SETTINGS))
def test_random_clouds(normal, seed, n, setting):
    check(normal(seed, n), *setting)


@pytest.mark.parametrize("setting", SETTINGS)
def test_awkward_clouds(awkward, setting):
    check(awkward, *setting)


@pytest.mark.parametrize("columns", [3, 4, 7])
def test_any_number_of_columns(normal, columns):
    check(np.tile(normal(0, 2000), 2)[:, :columns].copy())


@pytest.mark.parametrize("setting", SETTINGS)
def test_a_simulated_sweep(street, setting):
    check(street, *setting)


@pytest.mark.real
def test_real_sweeps(scans):
    for scan in scans:
        check(scan, point_range=RANGE)
        check(scan, 0.05, 5, 150_000, (-100.0, -100.0, -5.0, 100.0, 100.0, 5.0))


def test_many_points_of_a_voxel_in_falling_order():
    """The points a voxel keeps are the first, though the list it picks them from is in any order."""
    random = np.random.default_rng(0)
    points = np.concatenate([random.uniform(0, 0.4, (100_000, 3)), np.arange(100_000)[:, None]], axis=1)
    check(points.astype(np.float32), 0.5, 100_000, 3)
    check(points.astype(np.float32), 0.5, 7, 3)


def test_a_plan_leaves_nothing_behind(normal):
    from warploom.kernels.taichi.device import workspace
    from warploom.kernels.taichi.voxel import Voxelize

    import taichi as ti  # isort: skip

    for size in (1.0, 0.02):
        plan = Voxelize(voxel_size=(size,) * 3, point_range=AROUND, max_points=4, max_voxels=500, capacity=4000)
        features, coords = workspace((500, 4, 4), ti.f32), workspace((500, 3), ti.i32)
        counts = workspace(500, ti.i32)
        for seed in range(3):
            points = normal(seed, 3000)
            plan.launch(points, 2000, features, coords, counts)
            expected = voxelize(points[:2000], size, AROUND, 4, 500)
            found, *dropped = plan.totals.to_numpy()
            assert found == len(expected)
            assert dropped == [expected.dropped_points, expected.dropped_voxels, expected.outside]
            np.testing.assert_array_equal(features.to_numpy()[:found], expected.features)
            np.testing.assert_array_equal(coords.to_numpy()[:found], expected.coords)
            np.testing.assert_array_equal(counts.to_numpy()[:found], expected.counts)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"voxel_size": (0.0, 1.0, 1.0)}, "voxel_size must be > 0"),
        ({"point_range": (0.0, 0.0, 0.0, -1.0, 1.0, 1.0)}, "point_range must be"),
        ({"max_points": 0}, "max_points must be at least 1"),
        ({"max_voxels": 0}, "max_voxels must be at least 1"),
        ({"max_voxels": 1 << 30}, "lower max_voxels"),
        ({"columns": 2}, "columns must be at least 3"),
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"device": "opengl"}, "device must be 'taichi'"),
    ],
)
def test_wrong_numbers(changed, message):
    from warploom.kernels.taichi.voxel import Voxelize

    with pytest.raises(ValueError, match=message):
        Voxelize(**{"voxel_size": (1.0, 1.0, 1.0), "point_range": AROUND, "capacity": 10} | changed)
