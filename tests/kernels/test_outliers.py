"""Outliers against SciPy's KD-tree in float64."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from warploom.kernels import outliers
from warploom.kernels.outliers import RadiusOutliers, StatisticalOutliers, radius_outliers, statistical_outliers
from warploom.kernels.threads import set_thread_count, thread_count

# A point whose mean distance is this near to the threshold, as a share of it, may fall on either side.
TOLERANCE = 1e-6


def by_radius(points, radius, min_neighbors):
    finite = np.isfinite(points[:, :3]).all(axis=1)
    outlier = np.ones(len(points), bool)
    xyz = points[finite, :3].astype(np.float64)
    if len(xyz):
        outlier[finite] = cKDTree(xyz).query_ball_point(xyz, radius, return_length=True) - 1 < min_neighbors
    return outlier


def by_statistics(points, neighbors, std_ratio):
    """Who is an outlier, and who is too near to the threshold to say."""
    finite = np.isfinite(points[:, :3]).all(axis=1)
    outlier, close = np.ones(len(points), bool), np.zeros(len(points), bool)
    xyz = points[finite, :3].astype(np.float64)
    k = min(neighbors, len(xyz) - 1)
    mean = np.zeros(len(xyz))
    if k > 0:
        # Of duplicates the tree may return any as the first: the greatest k of k + 1 distances are those to others.
        mean = cKDTree(xyz).query(xyz, k + 1)[0][:, 1:].mean(axis=1)
    if len(xyz):
        limit = mean.mean() + std_ratio * (mean.std(ddof=1) if len(xyz) > 1 else 0)
        outlier[finite] = mean > limit
        close[finite] = np.abs(mean - limit) <= TOLERANCE * np.abs(limit)
    return outlier, close


def assert_statistics(points, neighbors=20, std_ratio=2.0):
    expected, close = by_statistics(points, neighbors, std_ratio)
    outlier = statistical_outliers(points, neighbors, std_ratio)
    assert outlier.dtype == bool
    assert np.array_equal(outlier[~close], expected[~close])
    return outlier


def cloud(n, seed):
    """Clumps, a sheet, and noise; some points twice, some not finite."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(0, 20, (5, 3))
    points = centres[rng.integers(0, 5, n)] + rng.normal(0, 0.5, (n, 3))
    sheet = rng.random(n) < 0.4
    points[sheet] = np.column_stack([rng.uniform(-30, 30, (sheet.sum(), 2)), np.full(sheet.sum(), -1.7)])
    noise = rng.random(n) < 0.02
    points[noise] = rng.uniform(-60, 60, (noise.sum(), 3))
    points[rng.random(n) < 0.05] = points[: max(n, 1)][0] if n else 0
    points = points.astype(np.float32)
    points[rng.random(n) < 0.01, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    return points


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000), st.sampled_from([0.05, 0.5, 5.0]), st.integers(1, 40))
def test_radius_outliers_equal_scipys(seed, n, radius, min_neighbors):
    """Exactly: whether a neighbour is within the radius is decided in float64."""
    points = cloud(n, seed)
    assert np.array_equal(radius_outliers(points, radius, min_neighbors), by_radius(points, radius, min_neighbors))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 3000), st.integers(1, 40), st.sampled_from([-0.5, 0.0, 1.0, 2.0]))
def test_statistical_outliers_equal_scipys(seed, n, neighbors, std_ratio):
    """Exactly, but within 1e-6 of the threshold."""
    assert_statistics(cloud(n, seed), neighbors, std_ratio)


@pytest.mark.real
def test_on_a_scan(shared_data):
    points = np.fromfile(shared_data / "semantic_kitti" / "full" / "08_000000.bin", np.float32).reshape(-1, 4)[::4]
    assert_statistics(np.ascontiguousarray(points))
    points = np.ascontiguousarray(points[::2])
    assert np.array_equal(radius_outliers(points, 0.5, 4), by_radius(points, 0.5, 4))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 1000))
def test_the_order_of_the_points_does_not_matter(seed, n):
    points = cloud(n, seed)
    order = np.random.default_rng(seed).permutation(n)
    assert np.array_equal(radius_outliers(points[order], 0.5, 4), radius_outliers(points, 0.5, 4)[order])
    _, close = by_statistics(points, 20, 1.0)
    same = statistical_outliers(points[order], 20, 1.0) == statistical_outliers(points, 20, 1.0)[order]
    assert same[~close[order]].all()


def test_a_neighbour_at_just_the_radius_counts():
    points = np.float32([[0, 0, 0], [3, 4, 0], [20, 0, 0]])
    assert radius_outliers(points, 5.0, 1).tolist() == [False, False, True]
    assert radius_outliers(points, np.nextafter(5.0, 0), 1).tolist() == [True, True, True]
    assert radius_outliers(points, 5.0, 2).all()


def test_a_lone_point_far_away_is_an_outlier():
    points = np.concatenate([np.random.default_rng(1).normal(0, 1, (500, 3)), [[50, 0, 0]]]).astype(np.float32)
    assert np.flatnonzero(statistical_outliers(points, 10, 3.0)).tolist()[-1] == 500
    assert radius_outliers(points, 2.0, 3)[500]


@pytest.mark.parametrize("scale", [1e-45, 1e-20, 1e5])
def test_far_and_tiny_coordinates(scale):
    """Distances below the roots of float32's smallest numbers count as zero; nothing is lost for it."""
    points = (cloud(500, 2) * np.float32(scale)).astype(np.float32)
    if scale == 1e5:
        assert_statistics(points)
        assert np.array_equal(radius_outliers(points, 1e5, 4), by_radius(points, 1e5, 4))
    else:
        finite = np.isfinite(points).all(axis=1)
        assert np.array_equal(radius_outliers(points, 0.1, 4), ~finite)
        assert np.array_equal(statistical_outliers(points)[~finite], np.ones((~finite).sum(), bool))


def test_coordinates_of_any_size_beside_each_other():
    points = cloud(1000, 3)
    points[[5, 10, 15]] = [[1e5, 0, 0], [-1e5, 1e5, 0], [3e38, -3e38, 0]]
    outlier = radius_outliers(points, 0.5, 4)
    assert outlier[[5, 10, 15]].all()
    others = np.delete(np.arange(1000), [5, 10, 15])
    assert np.array_equal(outlier[others], by_radius(points[others], 0.5, 4))
    assert_statistics(points[[*range(15), *range(20, 200)]], std_ratio=1.0)
    assert not statistical_outliers(np.float32([[3e38, 0, 0], [-3e38, 0, 0], [0, 0, 0]]), std_ratio=2.0).any()


def test_many_points_in_one_place():
    points = np.zeros((20_000, 3), np.float32)
    points[-1] = 1, 0, 0
    assert np.flatnonzero(radius_outliers(points, 0.1, 1000)).tolist() == [19_999]
    assert np.flatnonzero(statistical_outliers(points)).tolist() == [19_999]
    line = np.zeros((3000, 3), np.float32)
    line[:, 1] = np.arange(3000) * 0.125
    assert not radius_outliers(line, 0.25, 2).any()
    assert_statistics(line, 4, 1.0)


def test_many_neighbours():
    for neighbors in (100, 333, 599, 600, 1024):
        assert_statistics(cloud(600, 9), neighbors, 1.0)


def test_few_points():
    assert radius_outliers(np.zeros((0, 3), np.float32), 1.0).shape == (0,)
    assert statistical_outliers(np.zeros((0, 3), np.float32)).shape == (0,)
    one = np.ones((1, 3), np.float32)
    assert radius_outliers(one, 1.0, 1).tolist() == [True]
    assert statistical_outliers(one).tolist() == [False]
    assert statistical_outliers(np.full((3, 3), np.nan, np.float32)).all()
    assert_statistics(cloud(5, 4))


def test_any_layout_of_the_input():
    points = cloud(500, 5)
    frozen = points.copy()
    frozen.setflags(write=False)
    expected = radius_outliers(points, 0.5, 4), statistical_outliers(points)
    for given_points in (frozen, np.asfortranarray(points), points.astype(np.float64), np.repeat(points, 2, 0)[::2]):
        assert np.array_equal(radius_outliers(given_points, 0.5, 4), expected[0])
        assert np.array_equal(statistical_outliers(given_points), expected[1])


def test_arrays_of_other_families():
    import torch

    points = cloud(500, 6)
    outlier = radius_outliers(torch.from_numpy(points), 0.5, 4)
    assert outlier.dtype == torch.bool
    assert np.array_equal(outlier.numpy(), radius_outliers(points, 0.5, 4))
    outlier = statistical_outliers(wp.array(points, dtype=wp.float32, device="cpu"))
    assert np.array_equal(outlier.numpy(), statistical_outliers(points))


def test_the_plans_read_their_count(device):
    points = cloud(2000, 7)
    near = RadiusOutliers(radius=0.5, min_neighbors=4, capacity=2048, device=device)
    far = StatisticalOutliers(neighbors=10, std_ratio=1.0, capacity=2048, device=device)
    xyz = wp.array(points, dtype=wp.vec3, device=device)
    for n in (2000, 300, 0, 1500):
        count = wp.array([n], dtype=wp.int32, device=device)
        near.launch(xyz, count)
        far.launch(xyz, count)
        assert np.array_equal(near.outlier.numpy()[:n], by_radius(points[:n], 0.5, 4))
        expected, close = by_statistics(points[:n], 10, 1.0)
        assert np.array_equal(far.outlier.numpy()[:n][~close], expected[~close])
        assert near.outlier.numpy()[n:].all()
        assert far.outlier.numpy()[n:].all()


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_parts_do_not_change_a_byte(parts):
    points, before = cloud(6000, 9), thread_count()
    expected = (radius_outliers(points, 0.5, 4).tobytes(), statistical_outliers(points, 10, 1.0).tobytes())
    xyz, count = wp.array(points, dtype=wp.vec3, device="cpu"), wp.array([6000], dtype=wp.int32, device="cpu")
    try:
        set_thread_count(parts)
        near = RadiusOutliers(radius=0.5, min_neighbors=4, capacity=6000, device="cpu")
        far = StatisticalOutliers(neighbors=10, std_ratio=1.0, capacity=6000, device="cpu")
    finally:
        set_thread_count(before)
    near.launch(xyz, count)
    far.launch(xyz, count)
    assert (near.outlier.numpy().tobytes(), far.outlier.numpy().tobytes()) == expected


def test_one_thread_a_point_says_the_same():
    """As on a GPU."""
    points = cloud(3000, 10)
    plan = RadiusOutliers(radius=0.5, min_neighbors=4, capacity=3000, device="cpu")
    plan.launch(wp.array(points, dtype=wp.vec3, device="cpu"), wp.array([3000], dtype=wp.int32, device="cpu"))
    tree, outlier = plan._tree, wp.full(3000, True, dtype=wp.bool, device="cpu")
    inputs = [tree.points, tree.index, tree.size, tree.low, tree.high, tree.leaves, plan._reach, plan.min_neighbors]
    wp.launch(outliers._find_lonely, 3000, inputs=inputs, outputs=[outlier], device="cpu")
    assert np.array_equal(outlier.numpy(), plan.outlier.numpy())


@pytest.mark.parametrize("dtype", [np.float16, np.float64])
def test_other_floats_strides_and_read_only_arrays(dtype):
    points = cloud(500, 11)
    points = points[np.isfinite(points).all(axis=1)].clip(-60000, 60000)
    other = np.zeros((2 * len(points), 5), dtype)
    other[::2, 1:4] = points
    other.setflags(write=False)
    given_so, plain = other[::2, 1:4], np.ascontiguousarray(other[::2, 1:4], np.float32)
    assert np.array_equal(radius_outliers(given_so, 0.5, 4), radius_outliers(plain, 0.5, 4))
    assert np.array_equal(statistical_outliers(given_so, 10), statistical_outliers(plain, 10))


def test_the_same_cloud_gives_the_same_bytes(device):
    points = wp.array(cloud(2000, 8), dtype=wp.vec3, device=device)
    plan = StatisticalOutliers(capacity=2048, device=device)
    seen = set()
    for _ in range(3):
        plan.launch(points, wp.array([2000], dtype=wp.int32, device=device))
        seen.add(plan.threshold.numpy().tobytes() + plan.outlier.numpy().tobytes())
    assert len(seen) == 1


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: radius_outliers(p, 0), "radius must be"),
        (lambda p: radius_outliers(p, np.nan), "radius must be"),
        (lambda p: radius_outliers(p, 1.0, 0), "min_neighbors must be"),
        (lambda p: statistical_outliers(p, 0), "neighbors must be"),
        (lambda p: statistical_outliers(p, 5000), "neighbors must be"),
        (lambda p: statistical_outliers(p, 5, np.inf), "std_ratio must be"),
        (lambda p: statistical_outliers(p[:, :2]), "points must have shape"),
    ],
)
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.zeros((5, 3), np.float32))
