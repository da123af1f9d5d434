"""Every plan under a CPU's graph capture: a replay on new input gives what a direct launch gives.

Recorded is what is recorded on a GPU too: a plan whose `launch` allocated its outputs anew, went through the host or
kept a number of the frame before would show it here. Plans with a way of work for GPUs are recorded in that way too.
"""

import importlib
import pkgutil

import numpy as np
import pytest
import warp as wp

import warploom as wl
import warploom.kernels
from warploom.kernels.anchor_decode import AnchorDecode
from warploom.kernels.bev import BevMaps
from warploom.kernels.box_points import BoxPoints
from warploom.kernels.box_refine import BoxRefine
from warploom.kernels.box_rescore import RESIDUALS, BoxRescore
from warploom.kernels.boxes import FitBoxes
from warploom.kernels.camera import camera_model
from warploom.kernels.cluster import EuclideanCluster
from warploom.kernels.dbscan import Dbscan
from warploom.kernels.decode import REGRESSION_MAPS, CenterDecode
from warploom.kernels.downsample import VoxelDownsample
from warploom.kernels.dynamic_voxel import DynamicVoxelize
from warploom.kernels.filters import PointFilter
from warploom.kernels.gather import gather_rows
from warploom.kernels.grid_cluster import GridCluster
from warploom.kernels.ground import GroundSegment
from warploom.kernels.inverse_perspective import InversePerspective
from warploom.kernels.iou import GeneralizedIou, RotatedIou
from warploom.kernels.kalman import KalmanFilter
from warploom.kernels.motion import MotionCompensation
from warploom.kernels.neighbor_distances import NeighborDistances
from warploom.kernels.nms import RotatedNms
from warploom.kernels.outliers import RadiusOutliers, StatisticalOutliers
from warploom.kernels.pillar import PillarGrid
from warploom.kernels.point_tree import PointTree
from warploom.kernels.projection import PointPainting, PointProjection
from warploom.kernels.range_image import RangeProjection
from warploom.kernels.registration import ScanRegistration
from warploom.kernels.roi import PolygonMask
from warploom.kernels.selection import select_heights
from warploom.kernels.voxel import Voxelize
from warploom.kernels.voxel_map import VoxelMap

N = 1500
BOXES = 40
EGO = (-2.0, -1.0, -3.0, 2.0, 1.0, 1.0)
RANGE = (-20.0, -20.0, -4.0, 20.0, 20.0, 4.0)
CAMERA = camera_model(
    np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.0], [0, 0, 0, 1]]),
    np.array([[60, 0, 40], [0, 60, 30], [0, 0, 1.0]]),
)


class Inputs:
    """Device arrays of fixed places, filled with other numbers for each frame."""

    def __init__(self):
        def zeros(shape, dtype=wp.float32):
            return wp.zeros(shape, dtype=dtype, device="cpu")

        self.xyz, self.intensity, self.t = zeros(N, wp.vec3), zeros(N), zeros(N)
        self.count, self.ring = zeros(1, wp.int32), zeros(N, wp.uint16)
        self.extra = self.intensity.reshape((N, 1))
        self.include, self.height, self.labels = zeros(N, wp.bool), zeros(N), zeros(N, wp.int32)
        self.image = zeros((60, 80, 3), wp.uint8)
        self.boxes, self.scores, self.box_count = zeros((BOXES, 7)), zeros(BOXES), zeros(1, wp.int32)
        self.others, self.box_counts = zeros((BOXES, 7)), zeros(2, wp.int32)
        self.sensor_height, self.dt, self.noise, self.variance = zeros(1), zeros(1), zeros((1, 10)), zeros((1, 7))
        self.maps = zeros((1, 2 + REGRESSION_MAPS, 16, 16))
        self.logits, self.residuals, self.directions = (zeros((1, 2 * k, 16, 16)) for k in (2, 7, 2))
        self.pose, self.limits = zeros(1, wp.mat44d), zeros(3)

    def fill(self, seed, count):
        rng = np.random.default_rng(seed)
        points = rng.uniform((-22, -22, -2.5), (22, 22, 2.5), (N, 3))
        points[:600] = rng.uniform(-15, 15, (12, 3))[rng.integers(0, 12, 600)] * (1, 1, 0.1)
        points[:600] += rng.normal(0, 0.3, (600, 3))
        points[600:1200, 2] = -1.8 + rng.normal(0, 0.02, 600)
        points[::97, rng.integers(0, 3)] = np.nan
        self.xyz.assign(points.astype(np.float32))
        self.intensity.assign(rng.uniform(0, 1, N).astype(np.float32))
        self.t.assign(np.sort(rng.uniform(0, 0.1, N)).astype(np.float32))
        self.ring.assign(rng.integers(0, 16, N).astype(np.uint16))
        self.count.assign([count])
        self.include.assign(rng.random(N) < 0.8)
        self.height.assign(points[:, 2].astype(np.float32) + 1.8)
        self.labels.assign(rng.integers(-1, 30, N).astype(np.int32))
        self.image.assign(rng.integers(0, 255, (60, 80, 3)).astype(np.uint8))
        for boxes in (self.boxes, self.others):
            boxes.assign(rng.uniform((-9, -9, 0, 1, 1, 1, -3), (9, 9, 1, 5, 3, 2, 3), (BOXES, 7)).astype(np.float32))
        self.scores.assign(rng.uniform(0, 1, BOXES).astype(np.float32))
        self.box_count.assign([min(count, BOXES)])
        self.box_counts.assign([min(count, BOXES), BOXES - 7])
        self.sensor_height.assign(rng.uniform(1.5, 2, 1).astype(np.float32))
        self.dt.assign(rng.uniform(0.05, 0.2, 1).astype(np.float32))
        self.noise.assign(rng.uniform(0.1, 1, (1, 10)).astype(np.float32))
        self.variance.assign(rng.uniform(0.1, 1, (1, 7)).astype(np.float32))
        self.maps.assign(rng.normal(0, 1, self.maps.shape).astype(np.float32))
        for maps in (self.logits, self.residuals, self.directions):
            maps.assign(rng.normal(0, 0.5, maps.shape).astype(np.float32))
        pose = np.eye(4)
        pose[:3, 3] = rng.uniform(-0.2, 0.2, 3)
        self.pose.assign(pose[None])
        self.limits.assign(np.float32([2.0, 1.0, 0.3]))


def simple(plan_class, *names, **configuration):
    """A plan whose `launch` takes these inputs."""

    def make(given):
        plan = plan_class(**configuration)
        return plan, lambda: plan.launch(*(getattr(given, name) for name in names))

    return make


def painting(given):
    projection = PointProjection(capacity=N, image_size=(80, 60), occlusion_cell=4)
    plan = PointPainting(channels=3, projection=projection)
    return plan, lambda: plan.launch(given.xyz, given.count, CAMERA, given.image)


def projection(given):
    plan = PointProjection(capacity=N, image_size=(80, 60), occlusion_cell=4)
    return plan, lambda: plan.launch(given.xyz, given.count, CAMERA)


def perspective(given):
    ground_camera = camera_model(
        np.array([[0, -1, 0, 0], [0, 0, -1, 1.5], [1, 0, 0, 0.0], [0, 0, 0, 1]]),
        np.array([[60, 0, 40], [0, 60, 30], [0, 0, 1.0]]),
    )
    plan = InversePerspective(image_size=(80, 60), bev_range=(2.0, -10.0, 22.0, 10.0), shape=(40, 30))
    plan.set_camera(ground_camera)
    return plan, lambda: plan.launch(given.image)


def elevation(given):
    plan = GroundSegment(capacity=N, method="shared")

    def launch():
        plan.launch(given.xyz, given.count)
        plan.launch_elevation()

    return plan, launch


def polygons(given):
    plan = PolygonMask(capacity=N, point_range=(-20.0, -20.0, 20.0, 20.0), exact=True)
    plan.set_polygons([np.array([[-5, -5], [8, -6], [9, 9], [-6, 7]])])
    return plan, lambda: plan.launch(given.xyz, given.count)


def kalman(given):
    plan = KalmanFilter(capacity=BOXES)
    plan.active.fill_(1)
    plan.covariance.assign(np.tile(np.eye(10, dtype=np.float32), (BOXES, 1, 1)))

    def launch():
        plan.predict(given.dt, given.noise)
        plan.update(given.boxes, given.variance)

    return plan, launch


def mapping(method):
    def make(given):
        plan = VoxelMap(voxel_size=1.0, capacity=N, max_voxels=4096, max_distance=15.0, method=method)
        return plan, lambda: plan.launch(given.xyz, given.count, given.pose)

    return make


def registration(method):
    def make(given):
        target = VoxelMap(voxel_size=1.0, capacity=N, max_voxels=4096)
        target.launch(given.xyz, given.count, given.pose)
        plan = ScanRegistration(capacity=N, max_iterations=6, method=method)
        return plan, lambda: plan.launch(given.xyz, given.count, target, given.pose, given.limits)

    return make


def tree(given):
    plan = PointTree(capacity=N)
    return plan, lambda: plan.build(given.xyz, given.count)


class Selected:
    def __init__(self):
        self.selected = wp.zeros(N, dtype=wp.bool, device="cpu")


class Gathered:
    def __init__(self):
        self.values = wp.zeros(N, dtype=wp.float32, device="cpu")


def gathering(given):
    plan = Gathered()
    return plan, lambda: gather_rows(given.height, given.labels, given.count, plan.values)


class Refined:
    """Boxes that `BoxRefine` changes in place, copied from those of the frame."""

    def __init__(self):
        self.boxes = wp.zeros((BOXES, 7), dtype=wp.float32, device="cpu")


def refinement(given):
    refine, refined = BoxRefine(capacity=N, boxes=BOXES, refined=(True,)), Refined()
    kinds = wp.zeros(BOXES, dtype=wp.int32, device="cpu")
    keep = wp.array(np.arange(BOXES, dtype=np.int32), device="cpu")

    def launch():
        wp.copy(refined.boxes, given.boxes)
        refine.launch(given.xyz, given.count, refined.boxes, kinds, keep, given.box_count)

    return refined, launch


def gathering_in_boxes(given):
    plan = BoxPoints(capacity=N, boxes=24, points_of_box=32, classes=2, origin=(-25.0, -25.0), size=(50.0, 50.0))
    kinds = wp.zeros(BOXES, dtype=wp.int32, device="cpu")
    keep = wp.array(np.arange(BOXES, dtype=np.int32)[::-1].copy(), device="cpu")
    cloud, boxes = (given.xyz, given.count), (given.boxes, given.scores, kinds)
    return plan, lambda: plan.launch(*cloud, *boxes, keep, given.box_count, given.sensor_height)


def rescoring(given):
    plan = BoxRescore(
        boxes=16, candidates=BOXES, moved=(True, False), size_shares=(1.0, 0.5), powers=(1.0, 1.2),
        weights=(0.4, 0.4, 0.2),
    )  # fmt: skip
    kinds = wp.array(np.arange(BOXES, dtype=np.int32) % 2, device="cpu")
    keep = wp.array(np.arange(BOXES, dtype=np.int32), device="cpu")
    columns = 4 + len(RESIDUALS)
    said = given.maps.flatten()[: 16 * columns].reshape((16, columns))

    def launch():
        plan.choose(given.scores, kinds, keep, given.box_count, 0.3)
        plan.launch(given.boxes, given.scores, plan.chosen, plan.chosen_count, said, 0.3)

    return plan, launch


def selection(given):
    plan = Selected()
    return plan, lambda: select_heights(given.include, given.height, given.count, (0.2, 3.0), plan.selected)


CLOUD, PILLARS = ("xyz", "count"), {"voxel_size": (0.5, 0.5, 8.0), "point_range": RANGE}
ANCHORS = ((4.0, 1.8, 1.5, -1.0, 0.0), (4.0, 1.8, 1.5, -1.0, 1.57))
CASES = {
    "anchor decode": simple(
        AnchorDecode, "logits", "residuals", "directions", "threshold", "sensor_height",
        anchors=ANCHORS, classes=2, shape=(16, 16), first=(-8.0, -8.0), step=(1.0, 1.0), capacity=64,
    ),
    "anchor decode, each class": simple(
        AnchorDecode, "logits", "residuals", "directions", "threshold", "sensor_height",
        anchors=ANCHORS, classes=2, shape=(16, 16), first=(-8.0, -8.0), step=(1.0, 1.0), capacity=64, each_class=True,
    ),
    "bev in order": simple(BevMaps, "xyz", "intensity", "count", capacity=N, point_range=RANGE, shape=(60, 50)),
    "bev shared": simple(
        BevMaps, "xyz", "intensity", "count", capacity=N, point_range=RANGE, shape=(60, 50), method="shared"
    ),
    "boxes refined": refinement,
    "boxes rescored": rescoring,
    "points of boxes": gathering_in_boxes,
    "boxes by shape": simple(FitBoxes, "xyz", "labels", "count", capacity=N, max_clusters=24),
    "boxes by area": simple(FitBoxes, "xyz", "labels", "count", capacity=N, max_clusters=64, method="min_area"),
    "cluster": simple(EuclideanCluster, "xyz", "count", "include", radius=0.5, min_size=2, capacity=N),
    "cluster shared": simple(
        EuclideanCluster, "xyz", "count", "include", radius=0.5, min_size=2, capacity=N, method="shared"
    ),
    "cluster by range": simple(EuclideanCluster, *CLOUD, radius=0.3, radius_per_metre=0.02, capacity=N),
    "cluster by range, shared": simple(
        EuclideanCluster, *CLOUD, radius=0.3, radius_per_metre=0.02, capacity=N, method="shared"
    ),
    "dbscan": simple(Dbscan, *CLOUD, eps=0.5, min_points=4, capacity=N),
    "decode": simple(
        CenterDecode, "maps", "threshold", "sensor_height",
        shape=(2 + REGRESSION_MAPS, 16, 16), classes=2, origin=(-8.0, -8.0), cell=1.0, capacity=64,
    ),
    "downsample": simple(VoxelDownsample, *CLOUD, voxel_size=0.5, capacity=N),
    "downsample shared": simple(VoxelDownsample, *CLOUD, voxel_size=0.5, capacity=N, method="shared"),
    "downsample first": simple(VoxelDownsample, *CLOUD, voxel_size=0.5, capacity=N, mode="first"),
    "downsample random, shared": simple(
        VoxelDownsample, *CLOUD, voxel_size=0.5, capacity=N, mode="random", method="shared"
    ),
    "dynamic voxels": simple(DynamicVoxelize, "xyz", "count", "extra", capacity=N, **PILLARS),
    "dynamic voxels, sort": simple(DynamicVoxelize, "xyz", "count", "extra", capacity=N, method="sort", **PILLARS),
    "elevation": elevation,
    "filter": simple(PointFilter, "xyz", "intensity", "count", capacity=N, point_range=RANGE, ego_box=EGO),
    "filter by scan": simple(
        PointFilter, "xyz", "intensity", "count", capacity=N, point_range=RANGE, ego_box=EGO, method="scan"
    ),
    "gather": gathering,
    "giou": simple(GeneralizedIou, "boxes", "others", "box_counts", rows=BOXES, columns=BOXES),
    "grid cluster": simple(GridCluster, *CLOUD, cell=0.6, capacity=N),
    "grid cluster shared": simple(GridCluster, *CLOUD, cell=0.6, capacity=N, method="shared"),
    "ground in parts": simple(GroundSegment, *CLOUD, capacity=N),
    "iou": simple(RotatedIou, "boxes", "others", "box_counts", rows=BOXES, columns=BOXES),
    "kalman": kalman,
    "motion": simple(MotionCompensation, "xyz", "t", "count", capacity=N),
    "neighbour distances": simple(NeighborDistances, *CLOUD, neighbors=8, capacity=N),
    "nms": simple(RotatedNms, "boxes", "scores", "box_count", capacity=BOXES, threshold=0.2, max_output=20),
    "outliers by radius": simple(RadiusOutliers, *CLOUD, radius=0.8, min_neighbors=3, capacity=N),
    "outliers by statistics": simple(StatisticalOutliers, *CLOUD, neighbors=8, std_ratio=1.0, capacity=N),
    "painting": painting,
    "perspective": perspective,
    "pillar channels": simple(PillarGrid, "xyz", "count", "sensor_height", capacity=N, cell=0.5),
    "pillar channels shared": simple(
        PillarGrid, "xyz", "count", "sensor_height", capacity=N, cell=0.5, method="shared"
    ),
    "polygons": polygons,
    "projection": projection,
    "range image": simple(RangeProjection, "xyz", "intensity", "count", capacity=N, shape=(16, 128)),
    "range image by ring": simple(RangeProjection, "xyz", "intensity", "count", "ring", capacity=N, shape=(16, 128)),
    "registration": registration("in_order"),
    "registration shared": registration("shared"),
    "selection": selection,
    "tree": tree,
    "voxel map": mapping("in_order"),
    "voxel map shared": mapping("shared"),
    "voxels": simple(Voxelize, "xyz", "count", "extra", capacity=N, max_points=4, max_voxels=300, **PILLARS),
    "voxels, sort": simple(
        Voxelize, "xyz", "count", "extra", capacity=N, max_points=4, max_voxels=300, method="sort", **PILLARS
    ),
}  # fmt: skip


def outputs(plan):
    """The bytes of all that a plan shows."""
    arrays = {name: value for name, value in vars(plan).items() if isinstance(value, wp.array) and name[0] != "_"}
    assert arrays
    return {name: array.numpy().tobytes() for name, array in arrays.items()}


@pytest.mark.parametrize("name", CASES)
def test_a_replay_on_new_input_equals_a_direct_launch(name, monkeypatch):
    monkeypatch.setattr(wp, "empty", wp.zeros)  # what lies beyond the counts is compared too
    given = Inputs()
    given.threshold = 0.6
    given.fill(0, N)
    captured, launch_captured = CASES[name](given)
    direct, launch_directly = CASES[name](given)
    launch_captured()
    launch_directly()
    before = outputs(direct)
    with wp.ScopedCapture("cpu") as capture:
        launch_captured()
    assert outputs(captured) == before
    frames = [(1, N), (2, 700), (3, 0), (4, 1), (5, N)]
    changed = False
    for seed, count in frames:
        given.fill(seed, count)
        wp.capture_launch(capture.graph)
        launch_directly()
        after = outputs(direct)
        assert outputs(captured) == after, f"frame {seed} of {count} points"
        changed |= after != before
    assert changed, "the frames tell nothing"


# Plans without a line above, and why.
ELSEWHERE = {
    "KernelChain": "test_chain.py captures it",
    "LidarCast": "needs a scene: a simulator's, which is not part of a frame's graph",
    "TrackStep": "swaps its two tables from launch to launch, so a graph of one launch is none of it",
    "CpuGraph": "is a recording itself",
    "PackedLaunch": "is what plans launch",
    **dict.fromkeys(
        ("CellColumns", "CellTable", "GroundPlane", "JoinedColumns", "VoxelOrder", "VoxelSort", "VoxelSums"),
        "is a part of plans above",
    ),
}


def test_every_plan_is_here():
    """A class that a module of kernels shows, and that has a `launch`, has a line in the table above."""
    plans = {name for name in wl.__all__ if callable(getattr(getattr(wl, name), "launch", None))}
    for found in pkgutil.iter_modules(warploom.kernels.__path__):
        if found.ispkg:
            continue
        module = importlib.import_module(f"warploom.kernels.{found.name}")
        shown = ((name, getattr(module, name)) for name in module.__all__)
        plans |= {name for name, value in shown if isinstance(value, type) and hasattr(value, "launch")}
    assert {"FitBoxes", "AnchorDecode"} <= plans
    assert plans - set(ELSEWHERE) <= set(globals())
    assert set(ELSEWHERE) <= plans


def test_what_is_launched_while_recording_waits_for_the_replay():
    """Warp only records: whoever reads the outputs before the first replay sees the frame before."""
    given = Inputs()
    given.fill(0, N)
    plan, launch = CASES["filter"](given)
    with wp.ScopedCapture("cpu") as capture:
        launch()
    assert plan.count.numpy()[0] == 0
    wp.capture_launch(capture.graph)
    assert plan.count.numpy()[0] > 1000


def test_what_numpy_does_to_an_array_is_not_recorded():
    """A view of the host's writes while it is recorded, and not in a replay."""
    values, copy = (wp.zeros(3, dtype=wp.int32, device="cpu") for _ in range(2))
    with wp.ScopedCapture("cpu") as capture:
        values.numpy()[:] = 7
        wp.copy(copy, values)
    assert values.numpy().tolist() == [7, 7, 7]
    values.zero_()
    wp.capture_launch(capture.graph)
    assert values.numpy().tolist() == copy.numpy().tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    "call",
    [
        lambda table: table[:, 1].fill_(1),
        lambda table: wp.copy(table[:, :2], table[:, 1:]),
        lambda table: wp.utils.array_sum(table[0]),
    ],
    ids=["fill of a strided array", "copy of a strided array", "sum to the host"],
)
def test_what_warp_cannot_record_is_refused(call):
    table = wp.zeros((4, 3), dtype=wp.float32, device="cpu")
    with pytest.raises(NotImplementedError, match="APIC capture"), wp.ScopedCapture("cpu"):
        call(table)
    with wp.ScopedCapture("cpu"):  # and the next recording is none the worse for it
        table.zero_()
