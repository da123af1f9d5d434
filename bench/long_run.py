"""A process that perceives the same scans over and over: `python -m warploom.bench.long_run` for memory and growth."""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ..components.messages import SensorFrame
from ..components.pipeline import Pipeline
from ..components.report import RunReport
from ..components.sinks import JsonLinesSink

__all__ = ["cycled", "long_run", "memory_mib"]


def memory_mib(what: str = "VmRSS") -> float:
    """Memory of this process [MiB]: `VmRSS` is resident now, `VmHWM` the most so far. Linux only."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(what + ":"):
            return int(line.split()[1]) / 1024
    raise OSError(f"/proc/self/status says no {what}")


def cycled(scans: list[np.ndarray], count: int) -> Iterator[SensorFrame]:
    """So many frames, 0.1 s apart, that go through the scans forth and back, so that things move as they do."""
    there_and_back = [*range(len(scans)), *range(len(scans) - 2, 0, -1)]
    for index, scan in enumerate(itertools.islice(itertools.cycle(there_and_back), count)):
        yield SensorFrame(version=(index + 1) * 100_000_000, index=index, points=scans[scan])


def long_run(scans: list[np.ndarray], frames: int, profile: str = "cpu", device: str | None = None) -> dict:
    """Perceives so many frames and writes their objects.

    Returns:
        Under `latency_ms` what the run's report says, under `resident_mib` the memory by number of frames done, and
        under `peak_mib` the most it was.
    """
    report, resident = RunReport(), {}
    with (
        tempfile.TemporaryDirectory() as folder,
        JsonLinesSink(Path(folder) / "objects.jsonl") as sink,
        Pipeline.from_profile(profile, device=device) as pipeline,
    ):
        for frame in pipeline.run(cycled(scans, frames)):
            sink.write(frame.objects, latency_ms=frame.latency.total_ms, points=frame.points, pose=None)
            report.add(frame)
            if report.frames % 100 == 0 or report.frames == frames:
                resident[report.frames] = memory_mib()
    said = report.as_dict()
    return {
        "frames": said["frames"],
        "frames_failed": said["frames_failed"],
        "points_per_frame": said["points_per_frame"],
        "latency_ms": said["latency_ms"],
        "resident_mib": resident,
        "peak_mib": memory_mib("VmHWM"),
    }


def main() -> None:
    """Reads the scans of a folder (`.npy`) and prints what was measured as JSON."""
    parser = argparse.ArgumentParser(prog="python -m warploom.bench.long_run")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--profile", default="cpu")
    parser.add_argument("--device", default=None)
    given = parser.parse_args()
    scans = [np.load(path) for path in sorted(given.folder.glob("*.npy"))]
    json.dump(long_run(scans, given.frames, given.profile, given.device), sys.stdout)


if __name__ == "__main__":
    main()
