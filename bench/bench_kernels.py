"""Kernels on whole clouds beside their peers: voxelization, downsampling, ground, clustering, maps."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from warploom.bench.contest import SelfTimed, contenders, on_device, peer, processors
from warploom.bench.scans import CITY, REAL, SIZES
from warploom.kernels.bev import BevMaps, bev
from warploom.kernels.cluster import EuclideanCluster, cluster
from warploom.kernels.downsample import VoxelDownsample, voxel_downsample
from warploom.kernels.ground import GroundSegment, segment_ground
from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.voxel import Voxelize, voxelize

PILLARS = {
    "voxel_size": (0.16, 0.16, 4.0),
    "point_range": (0.0, -39.68, -3.0, 69.12, 39.68, 1.0),
    "max_points": 32,
    "max_voxels": 40_000,
}
VOXEL_SIZE = 0.2
RADIUS = 0.5
# The goals are for whole scans: small ones are bound by launches, large ones by memory.
GOAL_SCANS = ("street 120k", REAL, CITY)
BEV_RANGE, BEV_SHAPE = (0.0, -25.0, -2.73, 50.0, 25.0, 1.27), (608, 608)


def goals_on(scan, **goals):
    """By peer the share of its time that ours is to take."""
    return goals if scan in GOAL_SCANS else {}


def borrowed(points, device):
    """The cloud and its count as a plan takes them."""
    cloud = borrow_points(on_device(points, device))
    return cloud, count_on(len(cloud), device)


# ---- voxelization


def spconv_voxelizer(points):
    generator = peer("spconv.utils").Point2VoxelCPU3d(
        vsize_xyz=list(PILLARS["voxel_size"]),
        coors_range_xyz=list(PILLARS["point_range"]),
        num_point_features=points.shape[1],
        max_num_voxels=PILLARS["max_voxels"],
        max_num_points_per_voxel=PILLARS["max_points"],
    )
    tensorview = peer("cumm.tensorview", "spconv")
    own = points.copy()  # spconv wants to be able to write to it, also where another benchmark has frozen the cloud
    return lambda: [part.numpy() for part in generator.point_to_voxel(tensorview.from_numpy(own))]


def same_voxels(ours, theirs):
    pairs = zip((ours.features, ours.coords, ours.counts), theirs, strict=True)
    equal = all(a.shape == b.shape and np.array_equal(a, b) for a, b in pairs)
    return f"{len(ours)} voxels, {'equal to the bit' if equal else f'not equal, theirs {len(theirs[2])}'}"


@pytest.mark.parametrize("contender", contenders("spconv", one_thread=True))
@pytest.mark.parametrize("scan", SIZES)
def bench_voxelize(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = Voxelize(**PILLARS, columns=points.shape[1], capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count, cloud.extra)

    def function(device):
        given = on_device(points, device)
        return lambda: voxelize(given, **PILLARS)

    calls = {"warploom": function, "warploom plan": plan, "spconv": lambda _: spconv_voxelizer(points)}
    contest.run(
        contender,
        calls,
        kernel="voxelize",
        on=scan,
        size=len(points),
        agree=same_voxels,
        goals=goals_on(scan, spconv=1 / 2),
        how="pillars of 0.16 × 0.16 × 4 m, x 0 … 69.12, y −39.68 … 39.68, z −3 … 1 m; up to 32 points, 40,000 pillars",
    )


# ---- downsampling


def small_gicp_downsample(points, threads):
    module, wide = peer("small_gicp"), points[:, :3].astype(np.float64)
    return lambda: module.voxelgrid_sampling(wide, VOXEL_SIZE, num_threads=threads).points()


def open3d_downsample(points):
    open3d = peer("open3d")
    wide = points[:, :3].astype(np.float64)

    def call():
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(wide))
        return np.asarray(cloud.voxel_down_sample(VOXEL_SIZE).points)

    return call


def near_centroids(ours, theirs):
    distance, _ = cKDTree(theirs[:, :3]).query(ours)
    return f"{len(ours)} centroids, theirs {len(theirs)}; {100 * (distance < 1e-3).mean():.1f} % of ours within 1 mm"


@pytest.mark.parametrize("contender", contenders("small_gicp", "small_gicp, all threads", "open3d", one_thread=True))
@pytest.mark.parametrize("scan", SIZES)
def bench_voxel_downsample(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = VoxelDownsample(voxel_size=VOXEL_SIZE, capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: voxel_downsample(given, VOXEL_SIZE)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "small_gicp": lambda _: small_gicp_downsample(points, 1),
        "small_gicp, all threads": lambda _: small_gicp_downsample(points, processors()),
        "open3d": lambda _: open3d_downsample(points),
    }
    contest.run(
        contender, calls, kernel="voxel_downsample", on=scan, size=len(points), agree=near_centroids,
        goals=goals_on(scan, **{"small_gicp": 1 / 4, "small_gicp, all threads": 1 / 4}),
        threads={"small_gicp, all threads": processors()}, how="centroids of voxels of 0.2 m",
    )  # fmt: skip


# ---- ground


def patchworkpp(points):
    """Patchwork++ with its default parameters, a new instance, whose height and thresholds then adapt."""
    module = peer("pypatchworkpp")
    parameters = module.Parameters()
    parameters.verbose = False
    segmenter = module.patchworkpp(parameters)

    def call():
        segmenter.estimateGround(points)
        mask = np.zeros(len(points), bool)
        mask[segmenter.getGroundIndices()] = True
        return mask

    return SelfTimed(call, lambda: segmenter.getTimeTaken() * 1e-6)


@pytest.mark.parametrize("contender", contenders("pypatchworkpp", one_thread=True))
@pytest.mark.parametrize("scan", SIZES)
def bench_segment_ground(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = GroundSegment(capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: segment_ground(given)

    calls = {"warploom": function, "warploom plan": plan, "pypatchworkpp": lambda _: patchworkpp(points)}
    contest.run(
        contender, calls, kernel="segment_ground", on=scan, size=len(points),
        agree=lambda ours, theirs: f"{100 * (ours.mask == theirs).mean():.1f} % of the points alike",
        goals=goals_on(scan, pypatchworkpp=1 / 5), how="mask and heights; default parameters, sensor height unknown",
    )  # fmt: skip


# ---- clustering


def scipy_components(xyz):
    def call():
        pairs = cKDTree(xyz).query_pairs(RADIUS, output_type="ndarray")
        ones = np.ones(len(pairs), np.int8)
        return connected_components(coo_array((ones, pairs.T), shape=(len(xyz), len(xyz))), directed=False)[1]

    return call


def sklearn_dbscan(xyz):
    cluster_module = peer("sklearn.cluster", "scikit-learn")
    return lambda: cluster_module.DBSCAN(eps=RADIUS, min_samples=1).fit_predict(xyz)


def open3d_dbscan(xyz):
    open3d = peer("open3d")
    wide = xyz.astype(np.float64)

    def call():
        cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(wide))
        return np.asarray(cloud.cluster_dbscan(eps=RADIUS, min_points=1))

    return call


def in_order_of_first(labels):
    """The labels renumbered by where each comes first."""
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    return np.argsort(np.argsort(first))[inverse]


def same_partition(ours, theirs):
    equal = np.array_equal(in_order_of_first(ours), in_order_of_first(theirs))
    return f"{ours.max() + 1} clusters, {'same partition' if equal else f'not the same, theirs {theirs.max() + 1}'}"


# The peers' time and memory grow with the number of pairs: half a million points are ours alone.
PEER_LIMIT = 200_000


@pytest.mark.parametrize("contender", contenders("scipy", "scikit-learn", "open3d", one_thread=True))
@pytest.mark.parametrize("scan", SIZES)
def bench_cluster(contest, contender, scan):
    whole = contest.cloud(scan)
    points = np.ascontiguousarray(whole[~segment_ground(whole).mask])
    if len(whole) > PEER_LIMIT and not contender.who.startswith("warploom"):
        pytest.skip(f"{scan} has too many pairs of points for the peers")
    xyz = points[:, :3].copy()

    def plan(device):
        cloud, count = borrowed(points, device)
        made = EuclideanCluster(radius=RADIUS, capacity=len(points), device=device)
        return lambda: made.launch(cloud.xyz, count)

    def function(device):
        given = on_device(points, device)
        return lambda: cluster(given, RADIUS)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "scipy": lambda _: scipy_components(xyz),
        "scikit-learn": lambda _: sklearn_dbscan(xyz),
        "open3d": lambda _: open3d_dbscan(xyz),
    }
    contest.run(
        contender, calls, kernel="cluster", on=f"{scan}, no ground", size=len(points), agree=same_partition,
        goals=goals_on(scan, scipy=1 / 80), threads={"open3d": processors()},
        how="Euclidean, exact, steps up to 0.5 m, of the points that are not ground",
    )  # fmt: skip


# ---- maps from above


def numpy_bev(points):
    """The maps by a sort of the points and `maximum.at`."""
    low, high = np.float32(BEV_RANGE[:3]), np.float32(BEV_RANGE[3:])
    rows, columns = BEV_SHAPE
    scale = np.float32([rows / (high[0] - low[0]), columns / (high[1] - low[1])])

    def call():
        inside = np.all((points[:, :3] >= low) & (points[:, :3] < high), axis=1)
        kept = points[inside]
        at = ((kept[:, :2] - low[:2]) * scale).astype(np.int32)
        cell = np.minimum(at[:, 0], rows - 1) * columns + np.minimum(at[:, 1], columns - 1)
        maps = np.zeros((3, rows * columns), np.float32)
        highest = np.full(rows * columns, -np.inf, np.float32)
        np.maximum.at(highest, cell, kept[:, 2])
        order = np.lexsort((-kept[:, 2], cell))
        first = np.concatenate([[True], np.diff(cell[order]) != 0])[: len(order)]
        seen = cell[order[first]]
        maps[0, seen] = highest[seen]
        maps[1, seen] = kept[order[first], 3]
        maps[2] = np.minimum(1.0, np.log1p(np.bincount(cell, minlength=rows * columns)) / np.log(64.0))
        return maps.reshape(3, rows, columns)

    return call


def same_maps(ours, theirs):
    alike = (np.abs(ours - theirs) <= 1e-6).all(axis=0)
    return f"{100 * alike.mean():.3f} % of the cells within 1e-6 in all three maps"


@pytest.mark.parametrize("contender", contenders("numpy", one_thread=True))
@pytest.mark.parametrize("scan", SIZES)
def bench_bev(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = BevMaps(capacity=len(points), point_range=BEV_RANGE, shape=BEV_SHAPE, device=device)
        return lambda: made.launch(cloud.xyz, cloud.intensity, count)

    def function(device):
        given = on_device(points, device)
        return lambda: bev(given, BEV_RANGE, BEV_SHAPE)

    calls = {"warploom": function, "warploom plan": plan, "numpy": lambda _: numpy_bev(points)}
    contest.run(
        contender, calls, kernel="bev", on=scan, size=len(points), agree=same_maps,
        goals=goals_on(scan, numpy=1 / 10), how="height, intensity, density; x 0 … 50, y −25 … 25 m, 608 × 608",
    )  # fmt: skip
