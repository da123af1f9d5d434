"""DBSCAN against scikit-learn, and against all pairs in float64 where distances equal eps."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from warploom.kernels import cell_columns
from warploom.kernels.cluster import cluster
from warploom.kernels.dbscan import Dbscan, dbscan
from warploom.kernels.interop import count_on


def sklearn(points, eps, min_points):
    """Labels and cores; points that are not finite are noise."""
    labels, core = np.full(len(points), -1), np.zeros(len(points), bool)
    finite = np.flatnonzero(np.isfinite(points[:, :3]).all(axis=1))
    if len(finite):
        wide = points[finite, :3].astype(np.float64)
        fitted = DBSCAN(eps=eps, min_samples=min_points, algorithm="kd_tree").fit(wide)
        labels[finite] = fitted.labels_
        core[finite[fitted.core_sample_indices_]] = True
    return labels, core


def brute_force(points, eps, min_points):
    """The definition, over all pairs; clusters are grown from the lowest core that has none."""
    wide = points.astype(np.float64)
    d = wide[:, None] - wide[None]
    near = d[..., 0] * d[..., 0] + d[..., 1] * d[..., 1] + d[..., 2] * d[..., 2] <= eps * eps
    core = near.sum(axis=1) >= min_points
    labels = np.full(len(points), -1)
    clusters = 0
    for seed in np.flatnonzero(core):
        if labels[seed] < 0:
            members = np.zeros(len(points), bool)
            members[seed] = True
            while True:
                grown = members | (core & near[members].any(axis=0))
                if (grown == members).all():
                    break
                members = grown
            border = near[members].any(axis=0) & ~core & (labels < 0)
            labels[members | border] = clusters
            clusters += 1
    return labels, core


def launched(points, device="cpu", **fields):
    """Labels and cores of a plan, launched twice so that what the first left is met."""
    n = len(points)
    plan = Dbscan(capacity=max(n, 1), device=device, **fields)
    for order in (points[::-1], points):
        plan.launch(wp.array(np.ascontiguousarray(order[:, :3]), dtype=wp.vec3, device=device), count_on(n, device))
    labels = plan.labels.numpy()[:n]
    assert plan.cluster_count.numpy()[0] == labels.max(initial=-1) + 1
    return labels, plan.core.numpy()[:n].astype(bool)


def assert_same(actual, expected):
    np.testing.assert_array_equal(actual[1], expected[1], err_msg="cores")
    np.testing.assert_array_equal(actual[0], expected[0], err_msg="labels")


@pytest.mark.parametrize("min_points", [1, 2, 5, 12, 60])
@pytest.mark.parametrize("eps", [0.15, 0.5, 2.0])
def test_scikit_learns_labels_and_cores_of_a_random_cloud(device, eps, min_points):
    points = np.random.default_rng(3).normal(0, [4, 4, 1], (3_000, 3)).astype(np.float32)
    assert_same(launched(points, device, eps=eps, min_points=min_points), sklearn(points, eps, min_points))


def test_scikit_learns_labels_of_real_scans(shared_data):
    path = min((shared_data / "semantic_kitti" / "full").glob("08_*.bin"))
    kitti = np.fromfile(path, np.float32).reshape(-1, 4)
    path = min((shared_data / "nuscenes_sample").glob("*.pcd.bin"))
    nuscenes = np.fromfile(path, np.float32).reshape(-1, 5)
    for points in (kitti[kitti[:, 2] > -1.4][:15_000], nuscenes[::2]):
        for min_points in (4, 10):
            np.testing.assert_array_equal(dbscan(points, 0.4, min_points), sklearn(points, 0.4, min_points)[0])


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 150),
    st.integers(1, 9),
    st.sampled_from([0.1, 0.3, 0.5]),
    st.sampled_from([0.1, 0.25, 0.3]),
    st.sampled_from([0.0, -1e5]),
)
def test_grids_of_points_with_duplicates_and_ties(seed, n, min_points, eps, step, offset):
    points = (np.random.default_rng(seed).integers(-4, 5, (n, 3)) * step + offset).astype(np.float32)
    assert_same(launched(points, eps=eps, min_points=min_points), brute_force(points, eps, min_points))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 300))
def test_order_of_points_does_not_change_cores_and_their_partition(seed, n):
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 4, (n, 3)).astype(np.float32)
    order = rng.permutation(n)
    labels, core = launched(points, eps=0.6, min_points=4)
    shuffled, shuffled_core = launched(points[order], eps=0.6, min_points=4)
    np.testing.assert_array_equal(core[order], shuffled_core)
    pairs = set(zip(labels[order][shuffled_core], shuffled[shuffled_core], strict=True))
    assert len(pairs) == labels.max() + 1 == shuffled.max() + 1
    np.testing.assert_array_equal(labels[order] < 0, shuffled < 0)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.floats(width=32)] * 3), max_size=40), st.integers(1, 4))
def test_any_floats_at_all(rows, min_points):
    points = np.array(rows, np.float32).reshape(-1, 3)
    labels, core = launched(points, eps=0.5, min_points=min_points)
    finite = np.isfinite(points).all(axis=1)
    assert_same((labels[finite], core[finite]), brute_force(points[finite], 0.5, min_points))
    assert (labels[~finite] == -1).all()
    assert not core[~finite].any()


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_the_number_of_parts_does_not_change_labels_and_cores(monkeypatch, parts):
    """Of a street, a tower taller than a mask, and a cloud too wide for the map; as many threads at once have it."""
    monkeypatch.setattr(cell_columns, "parts_for", lambda capacity: parts)
    rng = np.random.default_rng(11)
    street = rng.normal(0, [9, 9, 1], (4_000, 3))
    street[::90] = np.nan
    tower = rng.uniform(0, 1, (3_000, 3)) * (2, 2, 80)
    wide = np.concatenate([street[:1_500], street[:1_500] + np.array((9e4, -4e4, 2e4))])
    for points in (street, tower, wide):
        points = points.astype(np.float32)
        expected = launched(points, eps=0.6, min_points=5, method="shared")
        assert_same(launched(points, eps=0.6, min_points=5), expected)
        finite = np.isfinite(points).all(axis=1)
        assert_same((expected[0][finite], expected[1][finite]), sklearn(points[finite], 0.6, 5))


@pytest.mark.parametrize("min_points", [1, 3, 8])
def test_many_threads_at_once_give_scikit_learns_labels(device, min_points):
    points = np.random.default_rng(9).normal(0, [4, 4, 1], (1_500, 3)).astype(np.float32)
    actual = launched(points, device, eps=0.4, min_points=min_points, method="shared")
    assert_same(actual, sklearn(points, 0.4, min_points))


def test_with_single_points_as_cores_it_is_euclidean_clustering():
    points = np.random.default_rng(4).uniform(0, 9, (4_000, 3)).astype(np.float32)
    np.testing.assert_array_equal(dbscan(points, 0.4, 1), cluster(points, 0.4))


def test_a_border_point_goes_to_the_lowest_label():
    """Two rows, and a point between them that is near the end of both, each a core by it."""
    row = np.stack([np.arange(5) * 0.5, np.zeros(5), np.zeros(5)], 1)
    points = np.concatenate([[[3.0, 0, 0]], row + np.array((4.0, 0, 0)), row]).astype(np.float32)
    assert dbscan(points, 1.0, 4).tolist() == [0] + [0] * 5 + [1] * 5


def test_a_million_points_in_one_cell_and_crowds_a_hair_apart():
    crowd = np.random.default_rng(0).uniform(0, 0.2, (1_000_000, 3)).astype(np.float32)
    labels = dbscan(crowd, 0.5, 2_000_000)
    assert (labels == -1).all()
    assert (dbscan(crowd, 0.5, 10) == 0).all()
    sheet = crowd[:100_000] * np.float32((0, 1, 1))
    for gap, clusters in ((0.501, 2), (0.499, 1)):
        points = np.concatenate((sheet, sheet[::-1] + np.float32((gap, 0, 0))))
        assert dbscan(points, 0.5, 20).max() + 1 == clusters


@pytest.mark.parametrize("n", [0, 1])
def test_no_point_and_one_point(n):
    points = np.zeros((n, 3), np.float32)
    assert dbscan(points, 0.5, 1).tolist() == [0] * n
    assert dbscan(points, 0.5, 2).tolist() == [-1] * n
    assert dbscan(points, 0.5, 2).dtype == np.int32


def test_strided_read_only_and_float64_input_gives_the_same():
    points = np.random.default_rng(5).uniform(0, 5, (900, 6)).astype(np.float32)
    expected = dbscan(points[:, :3].copy(), 0.5, 4)
    strided = points[:, :5]
    strided.flags.writeable = False
    np.testing.assert_array_equal(dbscan(strided, 0.5, 4), expected)
    np.testing.assert_array_equal(dbscan(points.astype(np.float64), 0.5, 4), expected)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, 3), "eps must be a positive number"),
        ((float("nan"), 3), "eps must be a positive number"),
        ((float("inf"), 3), "eps must be a positive number"),
        ((0.5, 0), "min_points must be at least 1 and below 2³¹, not 0"),
    ],
)
def test_a_wrong_argument_is_refused_by_name(arguments, message):
    with pytest.raises(ValueError, match=message):
        dbscan(np.zeros((1, 3), np.float32), *arguments)


def test_a_plan_refuses_more_points_than_it_has_room_for():
    with pytest.raises(ValueError, match="capacity of 10"):
        Dbscan(eps=1.0, min_points=2, capacity=10).launch(wp.zeros(11, wp.vec3, device="cpu"), count_on(11, "cpu"))
    with pytest.raises(ValueError, match="method must be"):
        Dbscan(eps=1.0, min_points=2, capacity=10, method="fast")


def test_a_captured_launch_replays_on_other_points(device):
    rng = np.random.default_rng(20)
    first, second = rng.normal(0, [20, 20, 2], (2, 500, 3)).astype(np.float32)
    plan = Dbscan(eps=3.0, min_points=4, capacity=500, device=device)
    xyz = wp.array(first, dtype=wp.vec3, device=device)
    count = count_on(500, device)
    plan.launch(xyz, count)
    with wp.ScopedCapture(device=device) as capture:
        plan.launch(xyz, count)
    xyz.assign(second)
    wp.capture_launch(capture.graph)
    np.testing.assert_array_equal(plan.labels.numpy(), sklearn(second, 3.0, 4)[0])
