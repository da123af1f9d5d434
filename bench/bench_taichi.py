"""The four core families on Taichi beside Warp's: the whole call, on the CPU with all its threads."""

import numpy as np
import pytest

from warploom.bench.bench_clustering import RADIUS as GROWING
from warploom.bench.bench_clustering import RADIUS_PER_METRE
from warploom.bench.bench_clustering import SCANS as GROWING_SCANS
from warploom.bench.bench_kernels import BEV_RANGE, BEV_SHAPE, PILLARS, RADIUS
from warploom.bench.contest import Contender, peer, processors
from warploom.bench.scans import SIZES
from warploom.kernels.bev import bev
from warploom.kernels.cluster import cluster
from warploom.kernels.ground import segment_ground
from warploom.kernels.interop import borrow_points
from warploom.kernels.voxel import voxelize

TAICHI = "warploom on Taichi"


def run(contest, kernel, on, points, call, agree):
    """Times a function with Taichi as its backend, and compares what it gives with Warp."""
    peer("taichi")
    calls = {"warploom": lambda _: lambda: call(backend="warp"), TAICHI: lambda _: lambda: call(backend="taichi")}
    contest.run(
        Contender(TAICHI),
        calls,
        kernel=kernel,
        on=on,
        size=len(points),
        agree=agree,
        threads={TAICHI: processors()},
    )


def same_voxels(ours, theirs):
    equal = all(np.array_equal(getattr(ours, name), getattr(theirs, name)) for name in ("features", "coords", "counts"))
    return f"{len(ours)} voxels, {'equal to the bit' if equal else 'not equal'}"


@pytest.mark.parametrize("scan", SIZES)
def bench_voxelize(contest, scan):
    points = contest.cloud(scan)
    run(contest, "voxelize", scan, points, lambda **options: voxelize(points, **PILLARS, **options), same_voxels)


def same_ground(ours, theirs):
    alike = (ours.mask == theirs.mask).mean()
    furthest = np.nanmax(np.abs(ours.height - theirs.height))
    return f"{100 * alike:.2f} % of the points alike, heights within {1e3 * furthest:.3f} mm"


@pytest.mark.parametrize("scan", SIZES)
def bench_segment_ground(contest, scan):
    points = contest.cloud(scan)
    run(contest, "segment_ground", scan, points, lambda **options: segment_ground(points, **options), same_ground)


def same_labels(ours, theirs):
    return f"{ours.max() + 1} clusters, {'the same labels' if np.array_equal(ours, theirs) else 'not the same'}"


@pytest.mark.parametrize("scan", SIZES)
def bench_cluster(contest, scan):
    whole = contest.cloud(scan)
    points = np.ascontiguousarray(whole[~segment_ground(whole).mask])
    run(
        contest,
        "cluster",
        f"{scan}, no ground",
        points,
        lambda **options: cluster(points, RADIUS, **options),
        same_labels,
    )


@pytest.mark.parametrize("scan", GROWING_SCANS)
def bench_cluster_adaptive(contest, scan):
    whole = contest.cloud(scan)
    points = np.ascontiguousarray(whole[~segment_ground(whole).mask])

    def call(backend):
        if backend == "warp":
            return cluster(points, GROWING, radius_per_metre=RADIUS_PER_METRE)
        return peer("warploom.kernels.taichi.cluster").cluster(borrow_points(points), GROWING, 1, RADIUS_PER_METRE)

    run(contest, "cluster, growing radius", f"{scan}, no ground", points, call, same_labels)


def same_maps(ours, theirs):
    return "equal to the bit" if np.array_equal(ours, theirs) else "not equal"


@pytest.mark.parametrize("scan", SIZES)
def bench_bev(contest, scan):
    points = contest.cloud(scan)
    run(contest, "bev", scan, points, lambda **options: bev(points, BEV_RANGE, BEV_SHAPE, **options), same_maps)
