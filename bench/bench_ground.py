"""How right the ground is, ours and Patchwork++'s on the same scans in the same run: F1 by sensor, and heights."""

import numpy as np
import pytest

from warploom.bench.bench_kernels import patchworkpp
from warploom.bench.contest import peer, record_score
from warploom.kernels.ground import elevation_grid, segment_ground
from warploom.models.evaluation.ground import ground_scores

# In points of F1 [%]: how far the mean is to be above the peer's, and how far below one scan may be.
GAIN = {"KITTI, 64 beams, full scans": 0.3, "KITTI, 64 beams, range images": 0.3}
SLACK = 0.5
NEAR_GROUND = 0.3  # [m]
SETS = ("KITTI, 64 beams, full scans", "KITTI, 64 beams, range images", "nuScenes, 32 beams, range images",
        "VLP-32, range images")  # fmt: skip


def percent(points, scan, segment):
    return 100 * ground_scores(segment(points), scan.ground, scan.scored).f1


@pytest.mark.parametrize("name", SETS)
def bench_ground_f1(benchmark, scans, name):
    """Each scan by itself: a new instance of the peer with its default parameters, no height told to either."""
    peer("pypatchworkpp")
    try:
        labelled = scans.labelled[name]
    except FileNotFoundError as error:
        pytest.skip(str(error))

    def score():
        ours = [percent(scan.points, scan, lambda points: segment_ground(points).mask) for scan in labelled]
        theirs = [percent(scan.points, scan, lambda points: patchworkpp(points)()) for scan in labelled]
        return np.array(ours), np.array(theirs)

    benchmark.extra_info.update(kernel="ground, F1", on=name)
    ours, theirs = benchmark.pedantic(score, rounds=1)
    record_score(
        benchmark, "F1 of the ground, mean", on=name, ours=ours.mean(), theirs=theirs.mean(), peer="pypatchworkpp",
        unit="%", gain=GAIN.get(name, 0.0), note=f"{len(labelled)} scans; vegetation and the unlabelled not scored",
    )  # fmt: skip
    worst = int(np.argmin(ours - theirs))
    record_score(
        benchmark, "F1 of the ground, worst scan beside the peer's", on=name, ours=ours[worst],
        theirs=theirs[worst], peer="pypatchworkpp", unit="%", gain=-SLACK, note=labelled[worst].name,
    )  # fmt: skip


def heights_of(points, mask, shape):
    """Mean z of the ground points in each square, NaN where there is none."""
    ground = points[mask & (np.abs(points[:, :2]) < 50).all(axis=1)]
    square = np.ravel_multi_index(np.floor(ground[:, :2] + 50).astype(int).T, shape)
    count = np.bincount(square, minlength=np.prod(shape))
    with np.errstate(invalid="ignore"):
        return (np.bincount(square, ground[:, 2], np.prod(shape)) / count).reshape(shape)


def bench_ground_height(benchmark, scans):
    """Squares of 1 m that have a point within 0.3 m of the true ground; scans tilted by up to 10°.

    Ours is the elevation grid. Patchwork++ has none: its height is the mean of its ground points in a square, where it
    has any.
    """
    peer("pypatchworkpp")
    try:
        tilted = scans.elevations()
    except FileNotFoundError as error:
        pytest.skip(str(error))

    def errors():
        ours, theirs = [], []
        for points, truth in tilted:
            near = np.abs(points[:, :2]).max(axis=1) < 50
            index = tuple(np.floor(points[near, :2] + 50).astype(int).T)
            seen = np.zeros(truth.shape, bool)
            np.logical_or.at(seen, index, np.abs(points[near, 2] - truth[index]) < NEAR_GROUND)
            ours.append((elevation_grid(points) - truth)[seen])
            theirs.append((heights_of(points, patchworkpp(points)(), truth.shape) - truth)[seen])
        return np.concatenate(ours), np.concatenate(theirs)

    benchmark.extra_info.update(kernel="ground, height", on="GndNet")
    ours, theirs = benchmark.pedantic(errors, rounds=1)
    known = ~np.isnan(theirs)
    on = "GndNet, tilted by up to 10°"
    squares = f"{len(ours):,} squares of 1 m with a point within {NEAR_GROUND} m of the true ground"
    for name, rows, note in (
        ("height of the ground, root mean square error", known, f"where the peer has ground: {known.mean():.0%} of"),
        ("height of the ground, root mean square error", ~np.isnan(ours), "all"),
    ):
        error = None if rows.sum() > known.sum() else np.sqrt(np.mean(theirs[rows] ** 2))
        record_score(
            benchmark, name, on=on, ours=np.sqrt(np.mean(ours[rows] ** 2)), theirs=error, peer="pypatchworkpp",
            unit="m", note=f"{note} {squares}", lower_is_better=True,
        )  # fmt: skip
