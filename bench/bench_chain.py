"""A frame's whole kernel chain: as one plan, launched directly or replayed from a recording, and step by step."""

import numpy as np
import pytest
import warp as wp

import warploom as wl
from warploom.bench.contest import on_device, record_figure
from warploom.bench.long_run import cycled
from warploom.bench.scans import REAL
from warploom.components.pipeline import Pipeline
from warploom.errors import ModelError
from warploom.kernels.threads import thread_count

SCANS = ("street 10k", "street 120k", REAL)
CONFIG = wl.ChainConfig()
WHAT = "filter, ground, clusters, boxes, pillars, BEV maps"
FRAMES = 30
GPU_PROFILES = [pytest.param(name, marks=pytest.mark.cuda) for name in ("gpu", "gpu-chain")]
GOALS = {"cpu": 12.0, "cuda:0": 0.3}  # [ms] of a whole scan
WHOLE = ("street 120k", REAL)


def step_by_step(points):
    """The chain through the public functions, each on what the one before gave back."""
    cloud = wl.filter_points(points, point_range=CONFIG.point_range, ego_box=CONFIG.ego_box).points
    ground = wl.segment_ground(cloud)
    stands = ~ground.mask & (ground.height >= CONFIG.min_height) & (ground.height <= CONFIG.max_height)
    labels = np.full(len(cloud), -1, np.int32)
    labels[stands] = wl.cluster(cloud[stands], CONFIG.radius, CONFIG.min_size)
    boxes = wl.fit_boxes(cloud, labels)
    voxels = wl.voxelize(cloud, CONFIG.pillar_size, CONFIG.pillar_range, CONFIG.max_points, CONFIG.max_pillars)
    return ground, labels, boxes, voxels, wl.bev(cloud, CONFIG.bev_range, CONFIG.bev_shape)


def record(benchmark, name, points, device, goal=None):
    """The median [ms] as a figure of its own."""
    if benchmark.stats is not None:
        milliseconds = benchmark.stats.stats.median * 1e3
        note = f"median; {WHAT}; {len(points):,} points"
        if device == "cpu":
            note += f"; {thread_count()} threads"
        record_figure(benchmark, name, milliseconds, "ms", goal=goal, note=note)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("captured", [False, True], ids=["direct", "captured"])
@pytest.mark.parametrize("scan", SCANS)
def bench_chain(benchmark, contest, scan, captured, device):
    """The launch alone, the frame being on the device."""
    if device != "cpu" and not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    points = contest.cloud(scan)
    chain = wl.KernelChain(config=CONFIG, capacity=len(points), device=device, captured=captured)
    expected = step_by_step(points)
    labels = chain(points).labels
    assert np.array_equal(labels, expected[1])
    chain.upload(points)

    def launch():
        chain.launch()
        if device != "cpu":
            wp.synchronize_device(device)

    how = "captured" if captured else "direct"
    benchmark.extra_info.update(kernel="kernel chain", on=f"{scan}, {how}", size=len(points), device=device)
    benchmark(launch)
    goal = GOALS[device] if captured and scan in WHOLE else None
    record(benchmark, f"kernel chain, {how}, {scan}, {device}", points, device, goal)


@pytest.mark.parametrize("how", ["call", "call, views", "steps"])
@pytest.mark.parametrize("scan", SCANS)
def bench_chain_call(benchmark, contest, scan, how):
    """NumPy in and NumPy out on the CPU: one call of the chain, copied or shown; or one function after the other."""
    points = contest.cloud(scan)
    chain = wl.KernelChain(config=CONFIG, capacity=len(points))
    calls = {
        "call": lambda: chain(points),
        "call, views": lambda: chain(points, copy=False),
        "steps": lambda: step_by_step(points),
    }
    benchmark.extra_info.update(kernel="kernel chain", on=f"{scan}, {how}", size=len(points), device="cpu")
    benchmark(calls[how])
    record(benchmark, f"kernel chain, {how}, {scan}, cpu", points, "cpu")


@pytest.mark.cuda
@pytest.mark.parametrize("scan", SCANS)
def bench_chain_upload(benchmark, contest, scan):
    """Host memory to the GPU's, through pinned memory, and the launch after it."""
    if not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    points = contest.cloud(scan)
    chain = wl.KernelChain(config=CONFIG, capacity=len(points), device="cuda:0")

    def frame():
        chain.upload(points)
        chain.launch()
        wp.synchronize_device("cuda:0")

    benchmark.extra_info.update(
        kernel="kernel chain", on=f"{scan}, upload and launch", size=len(points), device="cuda:0"
    )
    benchmark(frame)
    record(benchmark, f"kernel chain, upload and launch, {scan}, cuda:0", points, "cuda:0")
    given = on_device(points, "cuda:0")
    assert len(chain(given).labels) == len(chain(points).labels)


@pytest.mark.parametrize("profile", ["cpu", "cpu-chain", *GPU_PROFILES])
def bench_frame_with_chain(benchmark, contest, profile):
    """The main job with single stages and with the chain as one: from the frame to the labels of its points."""
    if profile.startswith("gpu") and not wp.is_cuda_available():
        pytest.skip("no CUDA device here")
    try:
        made = Pipeline.from_profile(profile)
    except ModelError as error:
        pytest.skip(f"the profile {profile} cannot run: {error}")
    taken = []
    with made:
        frames = made.run(cycled([frame.points for frame in contest.scans.street], FRAMES + 5))
        benchmark.extra_info.update(kernel="frame with chain", on=profile)
        benchmark.pedantic(lambda: taken.append(next(frames)), rounds=FRAMES, warmup_rounds=5)
        frames.close()
    taken = taken[-FRAMES:]
    assert not any(frame.failed for frame in taken)
    stages = ("perception.chain", "perception.filter", "perception.ground", "perception.cluster")
    front = [
        sum(frame.latency.stages[name].run_ms for name in stages if name in frame.latency.stages) for frame in taken
    ]
    note = f"filter, ground and clusters; median of {FRAMES} frames"
    record_figure(benchmark, f"front stages, {profile}", np.median(front), "ms", note=note)
    total = np.median([frame.latency.total_ms for frame in taken])
    record_figure(benchmark, f"whole frame, {profile}, median", total, "ms", note=f"of {FRAMES} frames")
