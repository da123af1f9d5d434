"""The whole frame: latency by stage, memory and its growth."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from warploom.bench.contest import record_figure
from warploom.bench.long_run import cycled
from warploom.bench.scans import REAL
from warploom.components.pipeline import Pipeline
from warploom.components.sources import open_source
from warploom.errors import ConfigError, ModelError

FRAMES = 60
TURNING = "street, turning"
LONG_RUN = 1000


def pipeline_of(profile):
    try:
        return Pipeline.from_profile(profile)
    except (ModelError, ConfigError) as error:
        pytest.skip(f"the profile {profile} cannot run: {error}")


@pytest.fixture
def pipeline():
    with pipeline_of("cpu") as made:
        yield made


@pytest.mark.parametrize("scan", ["street", TURNING, REAL])
def bench_frame(benchmark, contest, pipeline, scan):
    """Frame after frame through the profile `cpu`, head included, one at a time; of sweeps that turn, motion undone."""
    taken = some_frames(benchmark, contest, pipeline, scan)
    total = [frame.latency.total_ms for frame in taken]
    points = np.median([len(frame.points) for frame in taken])
    record_figure(
        benchmark, f"whole frame, {scan}, median", np.median(total), "ms", goal=100.0, note=f"{points:,.0f} points"
    )
    record_figure(benchmark, f"whole frame, {scan}, p99", np.percentile(total, 99), "ms", note=f"of {FRAMES} frames")
    names = dict.fromkeys(name for frame in taken for name in frame.latency.stages)
    benchmark.extra_info["stages"] = {
        name: {
            "run_ms": float(np.median([f.latency.stages[name].run_ms for f in taken if name in f.latency.stages])),
            "wait_ms": float(np.median([f.latency.stages[name].wait_ms for f in taken if name in f.latency.stages])),
        }
        for name in names
    }


def bench_frame_in_taichi(benchmark, contest):
    """The same through the profile `taichi-cpu`."""
    with pipeline_of("taichi-cpu") as pipeline:
        taken = some_frames(benchmark, contest, pipeline, "street")
    total = np.median([frame.latency.total_ms for frame in taken])
    record_figure(benchmark, "whole frame, street, profile taichi-cpu, median", total, "ms", note=f"of {FRAMES} frames")


def some_frames(benchmark, contest, pipeline, scan):
    """Times frames one at a time, after a few that are not counted."""
    if scan == TURNING:
        street = open_source("sim:street?seed=7&duration=2&turning=1&sensors=lidar")
        drive = [replace(frame, truth=None) for frame in street]
        scans = [frame.points for frame in drive]
        source = (
            replace(drive[k % len(drive)], version=frame.version, index=frame.index, continues=k % len(drive) > 0)
            for k, frame in enumerate(cycled(scans, FRAMES + 10))
        )
    else:
        scans = [frame.points for frame in contest.scans.street] if scan == "street" else [contest.cloud(scan)]
        source = cycled(scans, FRAMES + 10)
    frames = pipeline.run(source)
    taken = []
    benchmark.extra_info.update(kernel="frame", on=scan)
    benchmark.pedantic(lambda: taken.append(next(frames)), rounds=FRAMES, warmup_rounds=10)
    taken = taken[-FRAMES:]
    frames.close()
    assert not any(frame.failed for frame in taken)
    return taken


@pytest.mark.slow
def bench_memory(benchmark, scans, pipeline, tmp_path):
    """A process of its own perceives a thousand whole frames and writes their objects."""
    if not sys.platform.startswith("linux"):
        pytest.skip("memory is read from /proc, which only Linux has")
    pipeline.close()
    for frame in scans.street:
        np.save(tmp_path / f"{frame.index:03d}.npy", frame.points)
    command = [sys.executable, "-m", "warploom.bench.long_run", str(tmp_path), "--frames", str(LONG_RUN)]
    benchmark.extra_info.update(kernel="long run", on="street")
    done = benchmark.pedantic(
        subprocess.run, args=(command,), kwargs={"capture_output": True, "text": True, "check": True}, rounds=1
    )
    said = json.loads(done.stdout)
    assert said["frames"] == LONG_RUN
    assert said["frames_failed"] == 0
    resident = {int(frames): mib for frames, mib in said["resident_mib"].items()}
    record_figure(
        benchmark, "peak resident memory", said["peak_mib"], "MiB", goal=2048.0,
        note=f"{LONG_RUN} frames of {said['points_per_frame']:,.0f} points",
    )  # fmt: skip
    record_figure(
        benchmark, f"growth from frame 100 to {LONG_RUN}", resident[LONG_RUN] - resident[100], "MiB", goal=20.0,
        note=f"{resident[100]:.0f} MiB resident after 100, {resident[LONG_RUN]:.0f} MiB after {LONG_RUN}",
    )  # fmt: skip
    total = said["latency_ms"]["total"]
    record_figure(benchmark, f"whole frame over {LONG_RUN} frames, median", total["median"], "ms", goal=100.0,
                  note=f"p99 {total['p99']:.1f} ms")  # fmt: skip
