"""Registration and odometry beside their peers: the time of a pair, the time of a scan of a drive, and the drift."""

import itertools

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from warploom.bench.contest import contenders, on_device, peer, processors
from warploom.kernels.downsample import VoxelDownsample
from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.registration import ScanRegistration, register
from warploom.kernels.voxel_map import VoxelMap
from warploom.models.evaluation.odometry import absolute_trajectory_error, path_length, relative_pose_error
from warploom.models.odometry import Odometry, OdometryConfig

FRAME = 100_000_000  # [ns]


# ---- a pair of scans


def small_gicp_align(source, target, threads, kind):
    module = peer("small_gicp")
    wide = [points[:, :3].astype(np.float64) for points in (target, source)]
    return lambda: (
        module.align(*wide, registration_type=kind, downsampling_resolution=0.25, num_threads=threads).T_target_source
    )


def open3d_icp(source, target):
    open3d = peer("open3d")
    wide = [points[:, :3].astype(np.float64) for points in (source, target)]

    def call():
        clouds = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(xyz)) for xyz in wide]
        clouds = [cloud.voxel_down_sample(0.25) for cloud in clouds]
        return open3d.pipelines.registration.registration_icp(*clouds, 1.0).transformation

    return call


@pytest.mark.parametrize("contender", contenders("small_gicp ICP", "small_gicp GICP, all threads", "open3d ICP"))
@pytest.mark.parametrize("pair", ["street, 0.8 m apart", "real pair, 0.5 m apart"])
def bench_register(contest, contender, pair):
    if pair.startswith("street"):
        scans, poses = contest.scans.drive("street")
        source, target, truth = scans[1], scans[0], poses[1]
    else:
        try:
            source, target, truth = contest.scans.pair()
        except FileNotFoundError as error:
            pytest.skip(str(error))

    def off(transform):
        error = np.linalg.inv(truth) @ transform
        angle = np.degrees(Rotation.from_matrix(error[:3, :3]).magnitude())
        return f"{1e3 * np.linalg.norm(error[:3, 3]):.0f} mm, {angle:.2f}° off"

    def plan(device):
        """The thinned source against a map that is kept, as in odometry."""
        voxel_map = VoxelMap(voxel_size=1.0, capacity=len(target), device=device)
        fixed, moving = (borrow_points(on_device(points, device)) for points in (target, source))
        identity = wp.array(np.eye(4)[None], dtype=wp.mat44d, device=device)
        voxel_map.launch(fixed.xyz, count_on(len(target), device), identity)
        thin = VoxelDownsample(voxel_size=0.5, capacity=len(source), device=device)
        made = ScanRegistration(capacity=len(source), device=device)
        limits = wp.array([1.0, 0.5, 0.3], dtype=wp.float32, device=device)

        def call():
            thin.launch(moving.xyz, count_on(len(source), device))
            made.launch(thin.centroids, thin.centroid_count, voxel_map, identity, limits)
            return made

        return call

    def function(device):
        given = [on_device(points, device) for points in (source, target)]
        return lambda: register(*given)

    def score(result):
        if isinstance(result, ScanRegistration):
            return off(result.pose.numpy()[0])
        return off(getattr(result, "transform", result))

    contest.run(
        contender,
        {
            "warploom": function,
            "warploom plan": plan,
            "small_gicp ICP": lambda _: small_gicp_align(source, target, 1, "ICP"),
            "small_gicp GICP, all threads": lambda _: small_gicp_align(source, target, processors(), "GICP"),
            "open3d ICP": lambda _: open3d_icp(source, target),
        },
        kernel="register",
        on=pair,
        size=len(source),
        score=score,
        threads={"small_gicp GICP, all threads": processors(), "open3d ICP": processors()},
    )


# ---- a drive


class KissIcp:
    """KISS-ICP with its defaults, and without its own motion compensation: the scans have no times."""

    def __init__(self, threads):
        module = peer("kiss_icp.kiss_icp", "kiss-icp")
        from kiss_icp.config import load_config

        config = load_config(None)
        config.mapping.voxel_size, config.data.deskew, config.registration.max_num_threads = 1.0, False, threads
        self._made = module.KissICP(config)

    def __call__(self, number, points):
        """The pose of the next scan."""
        self._made.register_frame(points[:, :3].astype(np.float64), np.empty(0))
        return self._made.last_pose


class SmallGicp:
    """small_gicp's own example of odometry against a map of Gaussian voxels, with a constant-velocity guess."""

    def __init__(self, threads):
        self._module = peer("small_gicp")
        self._threads = threads
        self._map = self._module.GaussianVoxelMap(1.0)
        self._poses = [np.eye(4), np.eye(4)]

    def __call__(self, number, points):
        """The pose of the next scan."""
        wide = points[:, :3].astype(np.float64)
        cloud, _ = self._module.preprocess_points(wide, 0.25, num_threads=self._threads)
        last, latest = self._poses[-2:]
        pose = latest
        if number:
            guess = latest @ np.linalg.inv(last) @ latest
            pose = self._module.align(self._map, cloud, guess, num_threads=self._threads).T_target_source
        self._map.insert(cloud, pose)
        self._poses.append(pose)
        return pose


def ours(device):
    odometry = Odometry(OdometryConfig(device=device))
    return lambda number, points: odometry.update(number * FRAME, points)


def next_scans(make, scans):
    """A call a scan; when the drive is over it begins anew."""

    def calls():
        while True:
            follow = make()
            for number, points in enumerate(scans):
                yield follow(number, points)

    results = calls()
    return lambda: next(results)


# KISS-ICP keeps the number of threads that it was first given in a process, so that only one can be tried.
ODOMETERS = contenders("kiss-icp, all threads", "small_gicp, all threads")


@pytest.mark.parametrize("contender", [c for c in ODOMETERS if c.values[0].who != "warploom plan"])
@pytest.mark.parametrize("drive", ["street", "KITTI"])
def bench_odometry(contest, contender, drive):
    try:
        scans, truth = contest.scans.drive(drive)
    except FileNotFoundError as error:
        pytest.skip(str(error))
    makers = {
        "warploom": lambda: ours(contender.device),
        "kiss-icp, all threads": lambda: KissIcp(processors()),
        "small_gicp, all threads": lambda: SmallGicp(processors()),
    }

    def drift(_):
        follow = makers[contender.who]()
        poses = np.array([follow(number, points).copy() for number, points in enumerate(scans)])
        turn = np.degrees(relative_pose_error(poses, truth, delta=len(poses) - 1).rotation_mean)
        error = absolute_trajectory_error(poses, truth).rmse
        return f"{path_length(poses):.1f} m for {path_length(truth):.1f} m, ATE {error:.3f} m, end turned {turn:.2f}°"

    def calls(make):
        def prepared(device):
            given = [on_device(points, device) for points in scans]
            call = next_scans(make, given)
            for _ in itertools.repeat(None, 3):  # the first scans of a drive are unlike the others
                call()
            return call

        return prepared

    contest.run(
        contender,
        {who: calls(make) for who, make in makers.items()},
        kernel="odometry, a scan",
        on=f"{drive} drive",
        size=int(np.median([len(points) for points in scans])),
        score=drift,
        goals={"kiss-icp, all threads": 1 / 2},
        threads={"kiss-icp, all threads": processors(), "small_gicp, all threads": processors()},
    )
