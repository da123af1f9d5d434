"""Tracking beside an object for each track, as AB3DMOT and many others have it, and beside norfair; and fusion."""

import itertools
import pathlib

import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from warploom.bench.contest import Contender, peer, record_figure
from warploom.models.classes import CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from warploom.models.fusion import Fusion
from warploom.models.geometry import invert, transform_boxes
from warploom.models.tracker import Tracker, TrackerConfig

PERIOD = 100_000_000
OURS, LOOP, NORFAIR = "warploom", "an object each (filterpy)", "norfair"
FRAMES = 50  # of real sequences in one call: a tenth of a second for the slowest


def contenders(*peers):
    return [pytest.param(Contender(who), id=who) for who in (OURS, *peers)]


def crowd(count, frames=10):
    """Cars on a grid that wanders, in shuffled order: as many tracks as detections."""
    random = np.random.default_rng(3)
    side = int(np.ceil(np.sqrt(count)))
    grid = np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2)[:count] * 9.0
    for _ in range(frames):
        boxes = np.tile([0.0, 0.0, 0.8, 4.2, 1.8, 1.6, 0.0], (count, 1))
        boxes[:, :2] = grid + random.normal(0, 0.12, grid.shape)
        yield boxes[random.permutation(count)]


def of_warploom(frames):
    """All frames, with their tracks kept from call to call, as in a long run."""
    tracker, clock = Tracker(TrackerConfig()), itertools.count(1)

    def call():
        for boxes in frames:
            n = len(boxes)
            tracks = tracker.update(next(clock) * PERIOD, boxes, np.full(n, 0.9), np.full(n, VEHICLE), pose=np.eye(4))
        return len(tracks)

    return call


class LoopTracker:
    """AB3DMOT's structure: a filterpy filter of ten numbers a track, costs by loops, SciPy's assignment."""

    def __init__(self):
        self._filterpy = peer("filterpy.kalman", "filterpy")
        self.tracks = []

    def _born(self, box):
        f = self._filterpy.KalmanFilter(dim_x=10, dim_z=7)
        f.F[:3, 7:] = 0.1 * np.eye(3)
        f.H = np.eye(7, 10)
        f.P[7:, 7:] *= 1000.0
        f.P *= 10.0
        f.Q[7:, 7:] *= 0.01
        f.x[:7, 0] = box
        f.missed = 0
        return f

    def update(self, boxes):
        """Takes up one frame."""
        for f in self.tracks:
            f.predict()
        cost = np.full((len(self.tracks), len(boxes)), 1e3)
        for i, f in enumerate(self.tracks):
            for j, box in enumerate(boxes):
                away = np.linalg.norm(box[:3] - f.x[:3, 0])
                if away < 3.0:
                    cost[i, j] = away
        rows, columns = linear_sum_assignment(cost)
        made = [(i, j) for i, j in zip(rows, columns, strict=True) if cost[i, j] < 3.0]
        for i, j in made:
            self.tracks[i].update(boxes[j])
            self.tracks[i].missed = -1
        taken = {j for _, j in made}
        for f in self.tracks:
            f.missed += 1
        self.tracks = [f for f in self.tracks if f.missed <= 2]
        self.tracks += [self._born(box) for j, box in enumerate(boxes) if j not in taken]


def of_a_loop(frames):
    tracker = LoopTracker()

    def call():
        for boxes in frames:
            tracker.update(boxes)
        return len(tracker.tracks)

    return call


def of_norfair(frames):
    """Centres on the ground: norfair keeps points, no boxes."""
    norfair = peer("norfair")
    tracker = norfair.Tracker(distance_function="euclidean", distance_threshold=3.0, initialization_delay=1)

    def call():
        for boxes in frames:
            tracked = tracker.update([norfair.Detection(points=box[None, :2]) for box in boxes])
        return len(tracked)

    return call


def frame_figures(benchmark, contender, what, frames):
    """What the shortest call says of one frame."""
    if benchmark.stats is not None:  # None where benchmarks only run once, untimed
        shortest = benchmark.stats.stats.min
        note = f"of the shortest of {benchmark.stats.stats.rounds} calls of {frames} frames"
        record_figure(benchmark, f"{what}, {contender.who}: speed", frames / shortest, "frames/s", note=note)
        record_figure(benchmark, f"{what}, {contender.who}: a frame", 1e3 * shortest / frames, "ms", note=note)


@pytest.mark.parametrize("contender", contenders(LOOP, NORFAIR))
def bench_tracking_real_cars(contest, benchmark, contender):
    """PointRCNN's cars in fifty frames of each of six sequences of KITTI."""
    from warploom.components.evaluation.kitti_tracking import TYPES, TrackingSequence

    data = pathlib.Path(__file__).resolve().parent.parent.parent / "shared" / "data" / "kitti_tracking"
    if not (data / "pointrcnn_Car").is_dir():
        pytest.skip("KITTI's tracking set is not here")
    car = next(kind for kind in TYPES if kind.name == "Car")
    frames = []
    for name in ("0001", "0012", "0013", "0014", "0016", "0019"):
        sequence = TrackingSequence.read(data, data / "pointrcnn_Car", name, car, logits=True)
        frames += [b[s >= 0.525] for b, s in zip(sequence.boxes[:FRAMES], sequence.scores[:FRAMES], strict=True)]
    contest.run(
        contender,
        {OURS: lambda _: of_warploom(frames), LOOP: lambda _: of_a_loop(frames), NORFAIR: lambda _: of_norfair(frames)},
        kernel="tracking",
        on=f"real cars, {len(frames)} frames",
        size=len(frames),
    )
    frame_figures(benchmark, contender, "PointRCNN's cars of six sequences of KITTI", len(frames))


@pytest.mark.parametrize("contender", contenders(LOOP, NORFAIR))
@pytest.mark.parametrize("count", [10, 100, 500])
def bench_tracking_crowds(contest, benchmark, contender, count):
    """Frames of as many tracks as detections."""
    if count == 500 and contender.who == LOOP:
        pytest.skip("a loop over 500 objects and 500 detections takes seconds a frame")
    frames = list(crowd(count, 2 if count == 500 else 10))  # of which objects and loops take a second each
    contest.run(
        contender,
        {OURS: lambda _: of_warploom(frames), LOOP: lambda _: of_a_loop(frames), NORFAIR: lambda _: of_norfair(frames)},
        kernel="tracking",
        on=f"{count} tracks, {len(frames)} frames",
        size=count,
        score=lambda tracked: f"{tracked} of {count} tracked",
    )
    frame_figures(benchmark, contender, f"{count} tracks, {count} detections", len(frames))


@pytest.mark.parametrize("contender", contenders())
@pytest.mark.parametrize("count", [1000, 2000, 5000])
def bench_tracking_thousands(contest, benchmark, contender, count):
    """Ten frames of as many tracks as detections, for which objects and loops are too slow."""
    frames = list(crowd(count))
    contest.run(
        contender,
        {OURS: lambda _: of_warploom(frames)},
        kernel="tracking",
        on=f"{count} tracks, {len(frames)} frames",
        size=count,
        score=lambda tracked: f"{tracked} of {count} tracked",
    )
    frame_figures(benchmark, contender, f"{count} tracks, {count} detections", len(frames))


def surrounded_drive():
    """Two seconds of a street with the 13 cameras and 5 radars that the reference node's profile mounts.

    The LiDAR has found the true objects, and 150 clusters that stand about them.
    """
    from warploom.components.node.transforms import mounting_matrix
    from warploom.components.profile import load_profile
    from warploom.components.sources import open_source
    from warploom.components.sources.simulated_sensors import mounted_suite

    sensors = load_profile("hw50_pandar90_13_600").content.sensors
    mounted = {
        kind: {one.name: mounting_matrix(one.mounting.xyz, one.mounting.rpy_deg) for one in sensors[kind]}
        for kind in ("lidar", "camera", "radar")
    }
    source = open_source("sim:street?seed=7&duration=2&lidar=vlp16")
    source.suite = mounted_suite(next(iter(mounted["lidar"].values())), mounted["camera"], mounted["radar"])
    random = np.random.default_rng(7)
    clusters = np.zeros((150, 7))
    clusters[:, :2], clusters[:, 2] = random.uniform(-60, 60, (150, 2)), -0.9
    clusters[:, 3:6], clusters[:, 6] = random.uniform(0.3, 3.0, (150, 3)), random.uniform(-3, 3, 150)
    for frame in source:
        known = np.isin(frame.truth.classes, (VEHICLE, PEDESTRIAN, CYCLIST)) & (frame.truth.points > 0)
        boxes = np.concatenate([frame.truth.boxes[known], transform_boxes(clusters, invert(frame.pose))])
        background = np.arange(len(boxes)) >= known.sum()
        classes = np.concatenate([frame.truth.classes[known], np.full(len(clusters), UNKNOWN)])
        yield frame, boxes, background, classes


def bench_fusion_of_13_cameras_and_5_radars(benchmark):
    """What joins the reference node's sensors and tracks, frame by frame."""
    drive, fusion = list(surrounded_drive()), Fusion()

    def fuse():
        fusion.clear()
        for frame, boxes, background, classes in drive:
            objects = fusion.update(
                frame.version, boxes, np.full(len(boxes), 0.6), classes, background=background, pose=frame.pose,
                cameras=frame.cameras.cameras, radars=frame.radars.radars,
            )  # fmt: skip
        return objects

    benchmark.extra_info.update(kernel="fusion", on=f"13 cameras, 5 radars, {len(drive)} frames")
    objects = benchmark.pedantic(fuse, rounds=10, warmup_rounds=2)
    seen = np.mean([len(camera.boxes) for frame, *_ in drive for camera in frame.cameras.cameras])
    if benchmark.stats is not None:
        note = (
            f"{np.mean([len(each[1]) for each in drive]):.0f} detections, {len(objects)} objects, {seen:.0f} a camera"
        )
        shortest = 1e3 * benchmark.stats.stats.min / len(drive)
        record_figure(benchmark, "fusion of 13 cameras and 5 radars, a frame", shortest, "ms", goal=6.0, note=note)
