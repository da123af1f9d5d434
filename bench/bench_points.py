"""Kernels on single points beside their peers: motion compensation, points in polygons, outliers."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from warploom.bench.contest import contenders, on_device, peer, processors
from warploom.bench.scans import SCANS
from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.motion import MotionCompensation, compensate_motion
from warploom.kernels.outliers import RadiusOutliers, StatisticalOutliers, radius_outliers, statistical_outliers
from warploom.kernels.roi import PolygonMask, in_polygons

RADIUS, MIN_NEIGHBORS = 0.5, 16
NEIGHBORS, STD_RATIO = 20, 2.0
AREA = (-50.0, -50.0, 50.0, 50.0)
# Neighbours of half a million points are ours alone.
PEER_LIMIT = 200_000


def borrowed(points, device):
    cloud = borrow_points(on_device(points, device))
    return cloud, count_on(len(cloud), device)


def skip_large(contender, points, scan):
    if len(points) > PEER_LIMIT and not contender.who.startswith("warploom"):
        pytest.skip(f"{contender.who} is not tried on {scan}: it takes too long")


# ---- motion compensation


@pytest.fixture(scope="module")
def drive():
    """Eleven poses in a tenth of a second, of a car at 15 m/s in a bend."""
    times = np.linspace(0.0, 0.1, 11)
    poses = np.tile(np.eye(4), (11, 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("z", 0.5 * times[:, None]).as_matrix()
    poses[:, 0, 3] = 15.0 * times
    return poses, times


def scipy_motion(points, t, poses, times):
    t = t.astype(np.float64).clip(times[0], times[-1])

    def call():
        turn = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))
        place = np.stack([np.interp(t, times, poses[:, axis, 3]) for axis in range(3)], -1)
        return turn(t).apply(points[:, :3]) + place

    return call


@pytest.mark.parametrize("contender", contenders("scipy"))
@pytest.mark.parametrize("scan", SCANS)
def bench_compensate_motion(contest, contender, scan, drive):
    points, (poses, times) = contest.cloud(scan), drive
    t = np.linspace(0.0, 0.1, len(points), dtype=np.float32)

    def plan(device):
        cloud, count = borrowed(points, device)
        stamps = wp.array(t, device=device)
        made = MotionCompensation(capacity=len(points), max_poses=len(poses), device=device)
        made.set_poses(poses, times, 0.0)
        return lambda: made.launch(cloud.xyz, stamps, count)

    def function(device):
        given, stamps = on_device(points, device), on_device(t, device)
        return lambda: compensate_motion(given, stamps, poses, times, 0.0)

    def error(ours, theirs):
        return f"within {np.abs(ours[:, :3] - theirs).max():.0e} m"

    calls = {"warploom": function, "warploom plan": plan, "scipy": lambda _: scipy_motion(points, t, poses, times)}
    contest.run(contender, calls, kernel="compensate_motion", on=scan, size=len(points), agree=error)


# ---- points in polygons


@pytest.fixture(scope="module")
def polygons():
    """Thirty polygons of 12 vertices, as the drivable areas of a map."""
    random = np.random.default_rng(7)
    made = []
    for _ in range(30):
        angle = np.sort(random.uniform(0, 2 * np.pi, 12))
        ring = np.column_stack([np.cos(angle), np.sin(angle)]) * random.uniform(5, 15, (12, 1))
        made.append(random.uniform(-40, 40, 2) + ring)
    return made


def shapely_points(points, polygons):
    """The union, prepared before the clock starts."""
    shapely = peer("shapely")
    union = shapely.union_all([shapely.Polygon(ring).buffer(0) for ring in polygons])
    shapely.prepare(union)
    return lambda: shapely.contains_xy(union, points[:, 0], points[:, 1])


@pytest.mark.parametrize("contender", contenders("shapely"))
@pytest.mark.parametrize("exact", [False, True], ids=["bitmap", "exact"])
@pytest.mark.parametrize("scan", SCANS)
def bench_in_polygons(contest, contender, exact, scan, polygons):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = PolygonMask(capacity=len(points), point_range=AREA, exact=exact, device=device)
        made.set_polygons(polygons)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: in_polygons(given, polygons, AREA, exact=exact)

    def alike(ours, theirs):
        within = (np.abs(points[:, :2]) < AREA[2]).all(axis=1)
        return f"{100 * (ours == (theirs & within)).mean():.3f} % of the points alike"

    calls = {"warploom": function, "warploom plan": plan, "shapely": lambda _: shapely_points(points, polygons)}
    on = f"{scan}, {'exact' if exact else 'bitmap'}"
    contest.run(contender, calls, kernel="in_polygons", on=on, size=len(points), agree=alike)


# ---- outliers


def open3d_outliers(points, remove):
    """Open3D uses all threads."""
    open3d = peer("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points[:, :3].astype(np.float64)))

    def call():
        outlier = np.ones(len(points), bool)
        outlier[np.asarray(remove(cloud)[1], np.int64)] = False
        return outlier

    return call


def scipy_radius(points):
    wide = points[:, :3].astype(np.float64)
    return lambda: cKDTree(wide).query_ball_point(wide, RADIUS, return_length=True) <= MIN_NEIGHBORS


def scipy_statistics(points):
    wide = points[:, :3].astype(np.float64)

    def call():
        mean = cKDTree(wide).query(wide, NEIGHBORS + 1)[0][:, 1:].mean(axis=1)
        return mean > mean.mean() + STD_RATIO * mean.std(ddof=1)

    return call


def same_outliers(ours, theirs):
    return f"{ours.sum()} outliers; {100 * (ours == theirs).mean():.3f} % of the points alike"


@pytest.mark.parametrize("contender", contenders("scipy", "open3d"))
@pytest.mark.parametrize("scan", SCANS)
def bench_radius_outliers(contest, contender, scan):
    points = contest.cloud(scan)
    skip_large(contender, points, scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = RadiusOutliers(radius=RADIUS, min_neighbors=MIN_NEIGHBORS, capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: radius_outliers(given, RADIUS, MIN_NEIGHBORS)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "scipy": lambda _: scipy_radius(points),
        "open3d": lambda _: open3d_outliers(points, lambda c: c.remove_radius_outlier(MIN_NEIGHBORS, RADIUS)),
    }
    contest.run(
        contender, calls, kernel="radius_outliers", on=scan, size=len(points), agree=same_outliers,
        goals={"open3d": 1 / 2}, threads={"open3d": processors()},
    )  # fmt: skip


@pytest.mark.parametrize("contender", contenders("scipy", "open3d"))
@pytest.mark.parametrize("scan", SCANS)
def bench_statistical_outliers(contest, contender, scan):
    """Open3D counts a point as its own neighbour, so its distances are those of one neighbour less."""
    points = contest.cloud(scan)
    skip_large(contender, points, scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = StatisticalOutliers(neighbors=NEIGHBORS, std_ratio=STD_RATIO, capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: statistical_outliers(given, NEIGHBORS, STD_RATIO)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "scipy": lambda _: scipy_statistics(points),
        "open3d": lambda _: open3d_outliers(points, lambda c: c.remove_statistical_outlier(NEIGHBORS + 1, STD_RATIO)),
    }
    contest.run(
        contender, calls, kernel="statistical_outliers", on=scan, size=len(points), agree=same_outliers,
        goals={"open3d": 1 / 2}, threads={"open3d": processors()},
    )  # fmt: skip
