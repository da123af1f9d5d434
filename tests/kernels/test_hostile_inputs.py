"""Callers that mean harm or know no better: numbers that make no sense, counts that lie, crowds in a cell, far places.

`test_robustness.py` has odd but honest clouds and layouts; here arguments are refused by their names, no count makes a
plan read or write where it must not, and a crowd takes no longer than its points.
"""

import dataclasses
import inspect

import numpy as np
import pytest
import warp as wp
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

import warploom as wl
from warploom.kernels.ground import elevation_grid
from warploom.kernels.nms import RotatedNms, rotated_nms
from warploom.kernels.pillar import PillarGrid, pillarize

RANGE = (-20.0, -20.0, -4.0, 20.0, 20.0, 4.0)
CAMERA = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]], np.float64)
FROM_CAMERA = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]], np.float64)
INTRINSICS = np.array([[60, 0, 40], [0, 60, 30], [0, 0, 1.0]])
IMAGE = np.random.default_rng(0).random((60, 80, 3), np.float32)
TRIANGLE = [np.array([[-5.0, -5.0], [9.0, -6.0], [8.0, 8.0]])]
N = 300


def scene(n=N, seed=1):
    return np.random.default_rng(seed).uniform((-18, -18, -2, 0), (18, 18, 2, 1), (n, 4)).astype(np.float32)


def boxes(n=20):
    rng = np.random.default_rng(2)
    return np.column_stack(
        [rng.uniform(-9, 9, (n, 2)), rng.uniform(-1, 1, n), rng.uniform(1, 5, (n, 3)), rng.uniform(-3, 3, n)]
    ).astype(np.float32)


POINTS, BOXES, LABELS = scene(), boxes(), (np.arange(N) % 7 - 1).astype(np.int32)
STATE, COVARIANCE = np.ones((20, 10)), np.tile(np.eye(10), (20, 1, 1))
POSES = np.stack([np.eye(4), np.eye(4)])

# Numbers that an argument of each kind must refuse with a ValueError that has its name.
NAN, INF, HUGE = float("nan"), float("inf"), 2**40
FINITE = (NAN, INF, -INF)
POSITIVE = (*FINITE, 0, -1, -1e-3)
FROM_ZERO = (*FINITE, -1, -1e-3)
COUNT = (*FINITE, 0, -1, 1.5, HUGE, 1e300)
COUNT_OR_NONE = (*FINITE, -1, 1.5, HUGE, 1e300)

# By function: how it is called, and of what kind its numbers are.
CALLS = {
    wl.bev: ({"points": POINTS, "point_range": RANGE, "shape": (40, 50)}, {}),
    wl.cluster: (
        {"points": POINTS, "radius": 0.5},
        {"radius": POSITIVE, "min_size": COUNT, "radius_per_metre": (*FROM_ZERO, 2)},
    ),
    wl.compensate_motion: (
        {"points": POINTS, "t": np.linspace(0, 0.1, N), "poses": POSES, "times": [0, 0.1], "reference_time": 0.1},
        {"reference_time": FINITE},
    ),
    wl.dbscan: ({"points": POINTS, "eps": 0.5, "min_points": 3}, {"eps": POSITIVE, "min_points": COUNT}),
    wl.dynamic_voxelize: (
        {"points": POINTS, "voxel_size": 0.5, "point_range": RANGE}, {"voxel_size": POSITIVE}
    ),
    elevation_grid: (
        {"points": POINTS, "sensor_height": 1.8}, {"cell_size": POSITIVE, "sensor_height": FINITE}
    ),
    wl.filter_points: ({"points": POINTS, "point_range": RANGE}, {}),
    wl.fit_boxes: ({"points": POINTS, "labels": LABELS}, {"min_size": (NAN, -1)}),
    wl.giou_3d: ({"a": BOXES, "b": BOXES}, {}),
    wl.grid_cluster: (
        {"points": POINTS, "cell": 0.5}, {"cell": POSITIVE, "min_size": COUNT, "connectivity": (*COUNT, 7)}
    ),
    wl.in_polygons: (
        {"points": POINTS, "polygons": TRIANGLE, "point_range": RANGE[:2] + RANGE[3:5]}, {"cell": POSITIVE}
    ),
    wl.inverse_perspective: (
        {"image": IMAGE, "intrinsics": INTRINSICS, "vehicle_from_camera": FROM_CAMERA, "bev_range": (2, -10, 22, 10),
         "shape": (20, 30)}, {},
    ),
    wl.iou_3d: ({"a": BOXES, "b": BOXES}, {}),
    wl.kalman_predict: (
        {"state": STATE, "covariance": COVARIANCE, "dt": 0.1, "noise": np.ones(10)}, {"dt": FINITE}
    ),
    wl.kalman_update: (
        {"state": STATE, "covariance": COVARIANCE, "measurements": BOXES.astype(np.float64), "noise": np.ones(7)}, {}
    ),
    wl.paint_points: (
        {"points": POINTS, "image": IMAGE, "camera_from_lidar": CAMERA, "intrinsics": INTRINSICS},
        {"occlusion_cell": COUNT_OR_NONE, "occlusion_margin": FROM_ZERO},
    ),
    pillarize: (
        {"points": POINTS, "sensor_height": 1.8, "point_range": RANGE, "cell": 0.5},
        {"sensor_height": FINITE, "cell": POSITIVE},
    ),
    wl.project_points: (
        {"points": POINTS, "camera_from_lidar": CAMERA, "intrinsics": INTRINSICS, "image_size": (80, 60)},
        {"occlusion_cell": COUNT_OR_NONE, "occlusion_margin": FROM_ZERO},
    ),
    wl.radius_outliers: (
        {"points": POINTS, "radius": 0.8}, {"radius": POSITIVE, "min_neighbors": COUNT}
    ),
    wl.range_image: ({"points": POINTS, "shape": (16, 64)}, {}),
    wl.register: (
        {"source": POINTS, "target": POINTS},
        {"voxel_size": POSITIVE, "max_distance": POSITIVE, "robust_scale": POSITIVE, "max_iterations": COUNT,
         "tolerance": (NAN, -1)},
    ),
    wl.rotated_iou_bev: ({"a": BOXES, "b": BOXES}, {}),
    rotated_nms: (
        {"boxes": BOXES, "scores": POINTS[:20, 3], "threshold": 0.3},
        {"threshold": (*FROM_ZERO, 1.5), "max_output": COUNT_OR_NONE},
    ),
    wl.segment_ground: ({"points": POINTS}, {"sensor_height": FINITE}),
    wl.statistical_outliers: ({"points": POINTS}, {"neighbors": (*COUNT, 1025), "std_ratio": FINITE}),
    wl.voxel_downsample: (
        {"points": POINTS, "voxel_size": 0.5, "mode": "random"},
        {"voxel_size": POSITIVE, "seed": (*FINITE, 1.5, 1e300)},
    ),
    wl.voxelize: (
        {"points": POINTS, "voxel_size": 0.5, "point_range": RANGE},
        {"voxel_size": POSITIVE, "max_points": COUNT, "max_voxels": COUNT},
    ),
}  # fmt: skip

# By function: the arguments that are several numbers, and how many of these they are.
ROWS = {
    wl.bev: {"point_range": 6, "shape": 2},
    wl.dynamic_voxelize: {"point_range": 6},
    elevation_grid: {"grid_range": 4},
    wl.filter_points: {"point_range": 6, "ego_box": 6},
    wl.in_polygons: {"point_range": 4},
    wl.inverse_perspective: {"bev_range": 4, "shape": 2, "plane": 4},
    pillarize: {"point_range": 6},
    wl.project_points: {"image_size": 2},
    wl.range_image: {"shape": 2, "vertical_fov": 2},
    wl.voxelize: {"point_range": 6},
}
CAMERAS = [wl.inverse_perspective, wl.paint_points, wl.project_points]


def names(value):
    return getattr(value, "__name__", str(value))


def assert_refused(function, arguments, name, errors=(TypeError, ValueError)):
    with pytest.raises(errors) as refusal:
        function(**arguments)
    assert name in str(refusal.value), f"{name} = {arguments.get(name)!r} is not named"


def test_every_function_of_the_api_is_here():
    functions = {name for home, found in wl._HOMES.items() if home.startswith("kernels.") for name in found}
    assert {name for name in functions if name[0].islower()} <= {function.__name__ for function in CALLS}


@pytest.mark.parametrize("function", CALLS, ids=names)
def test_numbers_that_make_no_sense_are_refused_by_name(function):
    call, numbers = CALLS[function]
    function(**call)
    for name, refused in numbers.items():
        for value in refused:
            assert_refused(function, call | {name: value}, name, ValueError)
        for value in ("0.5", [0.5, 0.5], {}):
            if name != "voxel_size" or value != [0.5, 0.5]:
                assert_refused(function, call | {name: value}, name, (TypeError, ValueError))


@pytest.mark.parametrize("function", ROWS, ids=names)
def test_rows_of_numbers_that_make_no_sense_are_refused_by_name(function):
    call, _ = CALLS[function]
    for name, length in ROWS[function].items():
        sound = call.get(name, inspect.signature(function).parameters[name].default)
        sound = RANGE if sound is None else tuple(sound)
        assert len(sound) == length
        wrong = [1.0, "a" * length, sound[:-1], (*sound, 1), [*sound[:-1], "x"], [*sound[:-1], None]]
        wrong += [tuple(NAN if at == k else v for k, v in enumerate(sound)) for at in range(length)]
        if length != 2 and name != "plane":
            wrong += [sound[::-1], sound[:1] * length]  # least above most, and nothing between
        for value in wrong:
            assert_refused(function, call | {name: value}, name, (TypeError, ValueError))


@pytest.mark.parametrize("function", [wl.bev, wl.cluster, wl.segment_ground, wl.voxelize], ids=names)
def test_taichi_refuses_the_same(function):
    pytest.importorskip("taichi")
    call, numbers = CALLS[function]
    for name, refused in numbers.items():
        for value in (*refused, "0.5", {}):
            assert_refused(function, call | {name: value, "backend": "taichi"}, name)
    for name, length in ROWS.get(function, {}).items():
        for value in (1.0, (1.0,) * (length + 1), (NAN,) * length, ("x",) * length):
            assert_refused(function, call | {name: value, "backend": "taichi"}, name)


@pytest.mark.parametrize("function", CAMERAS, ids=names)
def test_cameras_that_make_no_sense_are_refused_by_name(function):
    call, _ = CALLS[function]
    pose = "vehicle_from_camera" if function is wl.inverse_perspective else "camera_from_"
    pose_name = pose if function is wl.inverse_perspective else "camera_from_lidar"
    for name, said, value in [
        ("intrinsics", "intrinsics", np.eye(2)),
        ("intrinsics", "intrinsics", INTRINSICS * NAN),
        ("intrinsics", "intrinsics", "x"),
        (pose_name, pose, np.eye(3)),
        (pose_name, pose, np.full((4, 4), INF)),
        (pose_name, pose, [[1, 2], [3]]),
        ("distortion", "distortion", [0.1, 0.2]),
        ("distortion", "distortion", [0.1, 0.2, 0.0, NAN]),
        ("distortion", "distortion", "x"),
        ("distortion", "distortion", 0.5),
    ]:
        assert_refused(function, call | {name: value}, said, (TypeError, ValueError))


@pytest.mark.parametrize("polygons", [3, None, "x", [3], [None], [np.zeros((3, 3))], [np.eye(2)], [[[0, 0], [1], [2]]]])
def test_polygons_that_are_none_are_refused(polygons):
    with pytest.raises((TypeError, ValueError), match="polygons"):
        wl.in_polygons(POINTS, polygons, (-20, -20, 20, 20))


TABLES = {
    "one row": (np.zeros(4, np.float32), ValueError),
    "two columns": (np.zeros((9, 2), np.float32), ValueError),
    "a cube": (np.zeros((9, 4, 4), np.float32), ValueError),
    "integers": (np.zeros((9, 4), np.int32), TypeError),
    "complex": (np.zeros((9, 4), np.complex64), TypeError),
    "objects": (np.full((9, 4), None), TypeError),
    "a list": ([[0.0, 0.0, 0.0, 0.0]], TypeError),
    "nothing": (None, TypeError),
    "text": ("points", TypeError),
}


@pytest.mark.parametrize("kind", TABLES)
@pytest.mark.parametrize("function", [f for f, (call, _) in CALLS.items() if {"points", "source"} & {*call}], ids=names)
def test_what_is_no_cloud_is_refused_by_name(function, kind):
    table, error = TABLES[kind]
    for name in ("points",) if function is not wl.register else ("source", "target"):
        with pytest.raises(error, match=name):
            function(**CALLS[function][0] | {name: table})


# By plan: how it is made, and what it is launched with.
PLANS = {
    wl.BevMaps: ({"point_range": RANGE, "shape": (40, 50)}, ("xyz", "intensity", "count")),
    wl.Dbscan: ({"eps": 0.5, "min_points": 3}, ("xyz", "count")),
    wl.DynamicVoxelize: ({"voxel_size": (0.5, 0.5, 0.5), "point_range": RANGE}, ("xyz", "count", "extra")),
    wl.EuclideanCluster: ({"radius": 0.5}, ("xyz", "count")),
    wl.FitBoxes: ({"max_clusters": 40}, ("xyz", "labels", "count")),
    wl.GridCluster: ({"cell": 0.5}, ("xyz", "count")),
    wl.GroundSegment: ({}, ("xyz", "count")),
    wl.MotionCompensation: ({}, ("xyz", "t", "count")),
    PillarGrid: ({"cell": 0.5}, ("xyz", "count", "height")),
    wl.PointFilter: ({"point_range": RANGE}, ("xyz", "intensity", "count")),
    wl.PolygonMask: ({"point_range": RANGE[:2] + RANGE[3:5]}, ("xyz", "count")),
    wl.RadiusOutliers: ({"radius": 0.8}, ("xyz", "count")),
    wl.RangeProjection: ({"shape": (16, 64)}, ("xyz", "intensity", "count")),
    wl.StatisticalOutliers: ({"neighbors": 5}, ("xyz", "count")),
    wl.VoxelDownsample: ({"voxel_size": 0.5}, ("xyz", "count")),
    wl.Voxelize: (
        {"voxel_size": (0.5, 0.5, 0.5), "point_range": RANGE, "max_points": 4, "max_voxels": 300},
        ("xyz", "count", "extra"),
    ),
}


def launched(plan_class, points, count, capacity=N):
    """The outputs of a plan, launched on `points` with a count that may be another."""
    fields, given = PLANS[plan_class]
    plan = plan_class(capacity=capacity, **fields)
    if plan_class is wl.PolygonMask:
        plan.set_polygons(TRIANGLE)
    if plan_class is wl.MotionCompensation:
        plan.set_poses(POSES, np.array([0.0, 0.1]), 0.1)
    n = len(points)
    arrays = {
        "xyz": wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu"),
        "intensity": wp.array(points[:, 3].copy(), dtype=wp.float32, device="cpu"),
        "extra": wp.array(points[:, 3:].copy(), dtype=wp.float32, device="cpu"),
        "t": wp.array(np.linspace(0, 0.1, n), dtype=wp.float32, device="cpu"),
        "labels": wp.array(np.arange(n) % 7 - 1, dtype=wp.int32, device="cpu"),
        "count": wp.array([count], dtype=wp.int32, device="cpu"),
        "height": 1.8,
    }
    plan.launch(*(arrays[name] for name in given))
    return {name: value.numpy() for name, value in vars(plan).items() if isinstance(value, wp.array) and name[0] != "_"}


@pytest.mark.parametrize("plan_class", PLANS, ids=names)
def test_counts_that_lie_are_held_to_the_rows(plan_class, monkeypatch):
    monkeypatch.setattr(wp, "empty", wp.zeros)  # what a plan leaves unset is compared too
    for count, honest in ((N + 1, N), (2**31 - 1, N), (-1, 0), (-(2**31), 0)):
        actual, expected = launched(plan_class, POINTS, count), launched(plan_class, POINTS, honest)
        for name, array in expected.items():
            np.testing.assert_array_equal(actual[name], array, err_msg=f"{name}, count {count}")


@pytest.mark.parametrize("plan_class", PLANS, ids=names)
def test_more_rows_than_a_plan_has_room_for_are_refused(plan_class):
    with pytest.raises(ValueError, match="capacity"):
        launched(plan_class, POINTS, N, capacity=N - 1)


@pytest.mark.parametrize("plan_class", [*PLANS, wl.KalmanFilter, wl.KernelChain, RotatedNms], ids=names)
@pytest.mark.parametrize("capacity", [0, -1, NAN, INF, 2**40])
def test_capacities_that_make_no_sense_are_refused(plan_class, capacity):
    fields = {"threshold": 0.5, "max_output": 5} if plan_class is RotatedNms else PLANS.get(plan_class, ({},))[0]
    with pytest.raises(ValueError, match="capacity"):
        plan_class(capacity=capacity, **fields)


@pytest.mark.parametrize("plan_class", PLANS, ids=names)
def test_numbers_of_plans_that_make_no_sense_are_refused_by_name(plan_class):
    """All whole numbers of a plan that must be at least one."""
    fields, _ = PLANS[plan_class]
    counted = {"min_size", "min_points", "min_neighbors", "neighbors", "max_clusters", "max_poses", "max_voxels",
               "max_vertices"}  # fmt: skip
    for field in dataclasses.fields(plan_class):
        if field.init and field.name in counted and not (plan_class is wl.FitBoxes and field.name == "min_size"):
            for value in (NAN, INF, -1, 2**40):
                assert_refused(plan_class, {"capacity": N} | fields | {field.name: value}, field.name, ValueError)


# ---- crowds


def crowd(n, far=False):
    """A crowd of a centimetre in no order, within one cell of any size that is used here; and a point far away."""
    points = np.random.default_rng(3).uniform((1.01, 1.01, 1.01, 0), (1.02, 1.02, 1.02, 1), (n, 4)).astype(np.float32)
    if far:
        points[n // 2, :3] = 1e5
    return points


def check_crowd(points):
    n = len(points)
    wide = points.astype(np.float64)
    for labels in (wl.cluster(points, 0.5), wl.dbscan(points, 0.5, 5), wl.grid_cluster(points, 0.3)):
        assert (labels == 0).all()
    assert (wl.cluster(points, 0.3, radius_per_metre=0.02) == 0).all()
    assert not wl.radius_outliers(points, 0.5, 16).any()
    # The mean distance of a point to its neighbours, of a sample, held against all.
    sample = np.random.default_rng(4).choice(n, 500, replace=False)
    tree = cKDTree(wide[:, :3])
    outlier = wl.statistical_outliers(points, 8, 2.0)
    mean = tree.query(wide[:, :3] if n <= 20_000 else wide[sample, :3], 9)[0][:, 1:].mean(axis=1)
    if n <= 20_000:
        assert np.array_equal(outlier, mean > mean.mean() + 2 * mean.std(ddof=1))
    else:
        assert mean[outlier[sample]].min(initial=np.inf) >= mean[~outlier[sample]].max()
    thin = wl.voxel_downsample(points, 0.5)
    np.testing.assert_allclose(thin, [wide[:, :3].mean(axis=0)], atol=2e-6)
    assert np.array_equal(wl.voxel_downsample(points, 0.5, "first"), points[:1, :3])
    voxels = wl.voxelize(points, 0.5, RANGE, max_points=32, max_voxels=10)
    assert np.array_equal(voxels.features[0], points[:32])
    assert voxels.counts.tolist() == [32]
    dynamic = wl.dynamic_voxelize(points, 0.5, RANGE)
    assert dynamic.counts.tolist() == [n]
    np.testing.assert_allclose(dynamic.means[0], wide.mean(axis=0), atol=1e-5)
    maps = wl.bev(points, RANGE, (40, 40))
    assert np.count_nonzero(maps[2]) == 1
    assert maps[0].max() - maps[0].min() <= 1.0 + RANGE[5] - RANGE[2]
    box = wl.fit_boxes(points, np.zeros(n, np.int32))
    assert box.shape == (1, 7)
    assert np.allclose(box[0, :3], 1.015, atol=1e-3)
    assert (box[0, 3:6] <= np.float32(0.1)).all()  # the least that a box has
    assert wl.range_image(points, (16, 64)).index.max() < n
    pixels = wl.project_points(points, CAMERA, INTRINSICS, (80, 60), occlusion_cell=4)
    assert np.isfinite(pixels.depth).all()
    assert wl.filter_points(points, point_range=RANGE).points.shape == (n, 4)
    assert wl.segment_ground(points, sensor_height=1.8).mask.shape == (n,)
    assert np.allclose(wl.register(points, points[: n // 2]).transform, np.eye(4), atol=0.05)


def test_a_crowd_in_one_cell():
    check_crowd(crowd(20_000))


def test_a_million_points_in_one_cell():
    """What takes the product of a crowd with itself would take days."""
    check_crowd(crowd(1_000_000))


@pytest.mark.parametrize("n", [20_000, 1_000_000])
def test_a_crowd_in_one_cell_and_a_point_far_away(n):
    """The point far away makes the cloud ten million times as wide as the crowd."""
    points = crowd(n, far=True)
    far = np.arange(n) == n // 2
    assert np.array_equal(wl.cluster(points, 0.5), far.astype(np.int32))
    assert np.array_equal(wl.dbscan(points, 0.5, 5), -far.astype(np.int32))
    assert np.array_equal(wl.grid_cluster(points, 0.3), far.astype(np.int32))
    assert np.array_equal(wl.radius_outliers(points, 0.5, 16), far)
    assert np.array_equal(wl.statistical_outliers(points, 8, 2.0), far)
    assert len(wl.voxel_downsample(points, 0.5)) == 2
    assert wl.dynamic_voxelize(points, 0.5, RANGE).counts.tolist() == [n - 1]
    assert wl.segment_ground(points, sensor_height=1.8).mask.shape == (n,)


@pytest.mark.parametrize("n", [4_000, 400_000])
def test_two_crowds_just_within_and_just_beyond_the_radius(n):
    """Every point of one crowd is near the radius from every point of the other."""
    one = np.random.default_rng(5).uniform(-1e-3, 0, (n // 2, 4)).astype(np.float32)
    for gap, clusters in ((0.5, 1), (0.5001, 2)):
        other = -one[:, :] + np.float32([gap, 0, 0, 0])
        other[0, :3] = gap, 0, 0
        one[0, :3] = 0
        labels = wl.cluster(np.concatenate([one, other]), 0.5)
        assert len(np.unique(labels)) == clusters


# ---- far places


@pytest.mark.parametrize("place", [(1e5, -1e5, 500.0), (-1e5, -1e5, -1e5), (5e5, 5e6, 0.0)])
def test_far_from_the_origin_results_are_those_of_the_rounded_points(place):
    """As on a map: a cloud of 30 m there, beside what float64 makes of the same float32 numbers."""
    points = (scene(2000, 6)[:, :3].astype(np.float64) + place).astype(np.float32)
    wide = points.astype(np.float64)
    tree = cKDTree(wide)
    counts = tree.query_ball_point(wide, 1.5, return_length=True) - 1
    assert np.array_equal(wl.radius_outliers(points, 1.5, 3), counts < 3)
    mean = tree.query(wide, 9)[0][:, 1:].mean(axis=1)
    outlier = wl.statistical_outliers(points, 8, 1.0)
    limit = mean.mean() + mean.std(ddof=1)
    sure = np.abs(mean - limit) > 1e-5 * limit
    assert np.array_equal(outlier[sure], (mean > limit)[sure])
    labels = wl.cluster(points, 1.5)
    pairs = tree.query_pairs(1.5, output_type="ndarray")
    assert (labels[pairs[:, 0]] == labels[pairs[:, 1]]).all()
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    assert len(np.unique(labels)) == connected_components(graph, directed=False)[0]


# ---- the wrong device


@pytest.mark.cuda
@pytest.mark.parametrize(
    "plan_class", [made for made, (_, given) in PLANS.items() if given == ("xyz", "count")], ids=names
)
def test_a_cloud_on_another_device_is_refused(plan_class):
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    plan = plan_class(capacity=N, device="cuda:0", **PLANS[plan_class][0])
    with pytest.raises(RuntimeError, match="device"):
        plan.launch(wp.zeros(N, dtype=wp.vec3, device="cpu"), wp.array([N], dtype=wp.int32, device="cpu"))
