"""The rest of clustering and voxelization beside peers: DBSCAN, a grid of voxels, a growing radius, no capacities."""

import numpy as np
import pytest
from scipy import ndimage

from warploom.bench.contest import contenders, on_device, peer, processors
from warploom.bench.scans import REAL
from warploom.kernels.cluster import EuclideanCluster, cluster
from warploom.kernels.dbscan import Dbscan, dbscan
from warploom.kernels.downsample import VoxelDownsample, voxel_downsample
from warploom.kernels.dynamic_voxel import DynamicVoxelize, dynamic_voxelize
from warploom.kernels.grid_cluster import GridCluster, grid_cluster
from warploom.kernels.ground import segment_ground
from warploom.kernels.interop import borrow_points, count_on

SCANS = ("street 10k", "street 120k", REAL)
EPS, MIN_POINTS = 0.5, 10
CELL = 0.3
RADIUS, RADIUS_PER_METRE = 0.3, 0.02
VOXEL_SIZE, POINT_RANGE = (0.2, 0.2, 0.2), (-70.0, -70.0, -4.0, 70.0, 70.0, 4.0)


def without_ground(contest, scan):
    whole = contest.cloud(scan)
    return np.ascontiguousarray(whole[~segment_ground(whole).mask])


def plan_of(make):
    """What prepares the launch of a plan that `make` makes for a cloud and a device."""

    def prepare(points, device):
        cloud = borrow_points(on_device(points, device))
        made, count = make(points, device), count_on(len(cloud), device)
        return lambda: made.launch(cloud.xyz, count)

    return prepare


# ---- DBSCAN


def sklearn_dbscan(points):
    wide, module = points[:, :3].astype(np.float64), peer("sklearn.cluster", "scikit-learn")
    return lambda: module.DBSCAN(eps=EPS, min_samples=MIN_POINTS, algorithm="kd_tree").fit_predict(wide)


def open3d_dbscan(points):
    open3d, wide = peer("open3d"), points[:, :3].astype(np.float64)

    def call():
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(wide))
        return np.asarray(cloud.cluster_dbscan(eps=EPS, min_points=MIN_POINTS))

    return call


def same_labels(ours, theirs):
    equal = f"{100 * (ours == theirs).mean():.2f} % of the labels equal"
    return f"{ours.max() + 1} clusters, theirs {theirs.max() + 1}; {equal}"


@pytest.mark.parametrize("contender", contenders("scikit-learn", "open3d"))
@pytest.mark.parametrize("scan", SCANS)
def bench_dbscan(contest, contender, scan):
    points = without_ground(contest, scan)
    plan = plan_of(lambda p, device: Dbscan(eps=EPS, min_points=MIN_POINTS, capacity=len(p), device=device))

    def function(device):
        given = on_device(points, device)
        return lambda: dbscan(given, EPS, MIN_POINTS)

    calls = {
        "warploom": function,
        "warploom plan": lambda device: plan(points, device),
        "scikit-learn": lambda _: sklearn_dbscan(points),
        "open3d": lambda _: open3d_dbscan(points),
    }
    contest.run(
        contender, calls, kernel="dbscan", on=f"{scan}, no ground", size=len(points), agree=same_labels,
        threads={"open3d": processors()},
    )  # fmt: skip


# ---- a grid of voxels


def scipy_label(points):
    """The dense grid of all voxels, labelled."""

    def call():
        voxels = np.floor(points[:, :3].astype(np.float64) * (1.0 / CELL)).astype(np.int64)
        voxels -= voxels.min(axis=0)
        grid = np.zeros(voxels.max(axis=0) + 1, bool)
        at = tuple(voxels.T)
        grid[at] = True
        return ndimage.label(grid, np.ones((3, 3, 3)))[0][at]

    return call


def same_partition(ours, theirs):
    pairs = len(np.unique(np.stack([ours, theirs]), axis=1).T)
    same = pairs == len(np.unique(ours)) == len(np.unique(theirs))
    return f"{ours.max() + 1} clusters, {'same partition' if same else 'not the same'}"


@pytest.mark.parametrize("contender", contenders("scipy"))
@pytest.mark.parametrize("scan", SCANS)
def bench_grid_cluster(contest, contender, scan):
    points = without_ground(contest, scan)
    plan = plan_of(lambda p, device: GridCluster(cell=CELL, capacity=len(p), device=device))

    def function(device):
        given = on_device(points, device)
        return lambda: grid_cluster(given, CELL)

    calls = {
        "warploom": function,
        "warploom plan": lambda device: plan(points, device),
        "scipy": lambda _: scipy_label(points),
    }
    contest.run(
        contender, calls, kernel="grid_cluster", on=f"{scan}, no ground", size=len(points), agree=same_partition
    )


# ---- a radius that grows with the range; no peer has one


@pytest.mark.parametrize("contender", contenders())
@pytest.mark.parametrize("scan", SCANS)
def bench_cluster_adaptive(contest, contender, scan):
    points = without_ground(contest, scan)
    growth = {"radius": RADIUS, "radius_per_metre": RADIUS_PER_METRE}
    plan = plan_of(lambda p, device: EuclideanCluster(**growth, capacity=len(p), device=device))

    def function(device):
        given = on_device(points, device)
        return lambda: cluster(given, **growth)

    calls = {"warploom": function, "warploom plan": lambda device: plan(points, device)}
    contest.run(contender, calls, kernel="cluster, growing radius", on=f"{scan}, no ground", size=len(points))


# ---- voxels without capacities


def numpy_voxels(points):
    low, high, size = np.float32(POINT_RANGE[:3]), np.float32(POINT_RANGE[3:]), np.float32(VOXEL_SIZE)
    cells_along = np.round((high - low) / size).astype(np.int64)

    def call():
        kept = points[((points[:, :3] >= low) & (points[:, :3] < high)).all(axis=1)]
        cells = ((kept[:, :3] - low) / size).astype(np.int64)
        number = (cells[:, 2] * cells_along[1] + cells[:, 1]) * cells_along[0] + cells[:, 0]
        found, inverse, counts = np.unique(number, return_inverse=True, return_counts=True)
        sums = [np.bincount(inverse, kept[:, column], len(found)) for column in range(kept.shape[1])]
        return (np.stack(sums, axis=1) / counts[:, None]).astype(np.float32)

    return call


def same_means(ours, theirs):
    def in_order(means):
        return means[np.lexsort(np.round(means[:, :3], 3).T)]

    alike = len(ours) == len(theirs) and np.allclose(in_order(ours.means), in_order(theirs), atol=2e-3)
    return f"{len(ours)} voxels, theirs {len(theirs)}{', the same means' if alike else ''}"


@pytest.mark.parametrize("contender", contenders("numpy"))
@pytest.mark.parametrize("scan", SCANS)
def bench_dynamic_voxelize(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrow_points(on_device(points, device)), count_on(len(points), device)
        made = DynamicVoxelize(
            voxel_size=VOXEL_SIZE, point_range=POINT_RANGE, columns=points.shape[1], capacity=len(points), device=device
        )
        extra = cloud.extra
        return lambda: made.launch(cloud.xyz, count, extra)

    def function(device):
        given = on_device(points, device)
        return lambda: dynamic_voxelize(given, VOXEL_SIZE, POINT_RANGE)

    calls = {"warploom": function, "warploom plan": plan, "numpy": lambda _: numpy_voxels(points)}
    contest.run(contender, calls, kernel="dynamic_voxelize", on=scan, size=len(points), agree=same_means)


# ---- downsampling to points of the cloud


@pytest.mark.parametrize("contender", contenders())
@pytest.mark.parametrize("mode", ["first", "random"])
def bench_voxel_choice(contest, contender, mode):
    points = contest.cloud("street 120k")
    plan = plan_of(lambda p, device: VoxelDownsample(voxel_size=0.2, mode=mode, capacity=len(p), device=device))

    def function(device):
        given = on_device(points, device)
        return lambda: voxel_downsample(given, 0.2, mode)

    calls = {"warploom": function, "warploom plan": lambda device: plan(points, device)}
    contest.run(contender, calls, kernel=f"voxel_downsample {mode}", on="street 120k", size=len(points))
