"""Which profile suits this machine, and does it keep its budget: looked at, proposed, measured on the demo drive."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .machine import describe_machine, taichi_devices
from .messages import SensorFrame
from .pipeline import PerceptionFrame, Pipeline

__all__ = ["Measurement", "Proposal", "StageTimes", "Times", "look", "measure_profile", "propose", "verdict_lines"]

WARM_UP = 5
"""Frames at the start of a drive whose times are left out: memory is touched for the first time there."""

_BUSY = 1.0
"""A load beyond which what is measured is not the profile's alone."""

_LARGE_GPU_GIB = 60.0
_SMALL_HOST_GIB = 3.0


@dataclass(frozen=True, kw_only=True)
class Proposal:
    """The profile that suits a machine."""

    profile: str
    """Name of a shipped profile."""
    reasons: tuple[str, ...]
    """What on the machine speaks for it."""
    others: Mapping[str, str] = field(default_factory=dict)
    """Profiles that are possible too, and when they are better."""


@dataclass(frozen=True, kw_only=True)
class Times:
    """The distribution of a time over the frames [ms]."""

    median: float
    p95: float
    max: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Times:
        """Of some values, at least one."""
        return cls(
            median=round(float(np.median(values)), 3),
            p95=round(float(np.percentile(values, 95)), 3),
            max=round(float(np.max(values)), 3),
        )


@dataclass(frozen=True, kw_only=True)
class StageTimes:
    """One vertex."""

    wait: Times
    """From when its inputs were there to its start."""
    run: Times
    """Its own work."""


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """How a profile did on the demo drive, fed in real time."""

    profile: str
    device: str
    rate_hz: float
    """Frames a second that were fed."""
    frames: int
    """Frames that were fed."""
    measured: int
    """Those that came out, less the first ones."""
    lost: int
    """Frames that did not come out."""
    losses: Mapping[str, Mapping[str, int]]
    """By place and reason."""
    points: int
    """Of a frame, in the middle."""
    budget_ms: float
    total: Times | None
    """From the reception of a frame to the commit of its obstacles, every wait included; None: no frame came out."""
    stages: Mapping[str, StageTimes]
    """By vertex, as `component.vertex`; branches run side by side, so they do not add up to the total."""
    prepare_s: float
    """To build everything, kernels compiled [s]."""
    load: float | None = None
    """How many processes wanted a core in the minute before, on average; None: unknown here."""

    @property
    def holds(self) -> bool:
        """Whether 95 % of the frames are within the budget and none was lost."""
        return self.total is not None and self.total.p95 <= self.budget_ms and self.lost == 0

    def as_dict(self) -> dict[str, Any]:
        """As plain values, with the verdict."""
        return {**asdict(self), "holds": self.holds}


def look() -> dict[str, Any]:
    """The machine: processor, cores, memory, GPUs, devices of Warp, providers of ONNX Runtime, devices of Taichi."""
    from ..kernels.device import device_names

    machine = describe_machine()
    machine["taichi"] = taichi_devices()
    machine["cuda"] = [_cuda(name) for name in device_names() if name.startswith("cuda")]
    return machine


def _cuda(name: str) -> dict[str, Any]:
    import warp as wp

    device = wp.get_device(name)
    return {
        "device": name,
        "name": device.name,
        "memory_gib": round(device.total_memory / 2**30, 1),
        # A Jetson's GPU is called as its chip, and its system has this file.
        "integrated": "orin" in device.name.lower() or Path("/etc/nv_tegra_release").exists(),
    }


def propose(machine: Mapping[str, Any]) -> Proposal:
    """The profile that suits a machine, by what `look` says of it."""
    reasons: list[str] = []
    others: dict[str, str] = {}
    memory, cores = machine.get("memory_gib"), machine["cores"]
    if machine.get("cuda"):
        gpu = machine["cuda"][0]
        told = f"{gpu['name']} with {gpu['memory_gib']:g} GiB"
        if gpu["integrated"]:
            name = "orin"
            reasons.append(f"{told} is on a board that shares its memory with the CPU")
        elif gpu["memory_gib"] >= _LARGE_GPU_GIB:
            name = "h200"
            reasons.append(f"{told} has room for dense clouds")
        else:
            name = "gpu"
            reasons.append(f"{told} runs the kernels")
        if "CUDA" not in machine.get("inference_providers", ()):
            reasons.append("ONNX Runtime has no CUDA provider, so networks run on the CPU: pip install onnxruntime-gpu")
        others["cpu"] = "to leave the GPU to others"
        return Proposal(profile=name, reasons=tuple(reasons), others=others)
    reasons.append("Warp finds no CUDA device, so the kernels run on the CPU")
    small = memory is not None and memory < _SMALL_HOST_GIB
    reasons.append(f"{cores} core{'s' if cores != 1 else ''}" + (f", {memory:g} GiB" if memory is not None else ""))
    if small:
        reasons.append(f"less than {_SMALL_HOST_GIB:g} GiB: the small capacities of cpu-min")
    else:
        others["cpu-min"] = "to leave memory to others: the demo stays below 1 GiB"
    graphics = [name for name in machine.get("taichi", ()) if name in ("vulkan", "metal")]
    if graphics:
        others["taichi-vulkan"] = f"Taichi knows {', '.join(graphics)}: better where that is a GPU, measure both"
    if cores > 2 and "cpu" in machine.get("taichi", ()):
        others["taichi-cpu"] = "Taichi computes ground and clusters on all cores: measure both"
    return Proposal(profile="cpu-min" if small else "cpu", reasons=tuple(reasons), others=others)


def measure_profile(
    name: str,
    *,
    seconds: float = 5.0,
    seed: int = 7,
    rate_hz: float = 10.0,
    device: str | None = None,
    settings: Iterable[str] = (),
    frames: Sequence[SensorFrame] | None = None,
) -> Measurement:
    """Feeds the demo drive to a profile in real time, and takes the times.

    The frames are made first: what the simulator computes is no part of what is timed.

    Args:
        name: The profile, by name or path.
        seconds: Length of the drive.
        seed: Of the simulated street.
        rate_hz: Frames a second.
        device: In place of the profile's.
        settings: Changes by dotted key, as texts `key=value`.
        frames: These instead of the demo drive.

    Raises:
        ConfigError: The profile is bad.
        DeviceError: Its device is not here.
        ModelError: Its model does not fit its card.
        ValueError: There are no more frames than those for warming up.
    """
    load = round(os.getloadavg()[0], 1) if hasattr(os, "getloadavg") else None
    started = time.perf_counter()
    pipeline = Pipeline.from_profile(name, device=device, settings=list(settings))
    prepared = time.perf_counter() - started
    with pipeline:
        if frames is None:
            from .sources import open_source

            frames = list(open_source(f"sim:street?seed={seed}&duration={seconds:g}&rate={rate_hz:g}", device=device))
        if len(frames) <= WARM_UP:
            raise ValueError(f"{len(frames)} frames are too few: the first {WARM_UP} warm up; drive longer")
        came = [_Timed.of(frame) for frame in pipeline.run(frames, realtime=True)]
        timed = [one for one in came if one.index >= frames[WARM_UP].index]
        stages: dict[str, StageTimes] = {}
        for stage in dict.fromkeys(itertools.chain.from_iterable(one.stages for one in timed)):
            waits, runs = zip(*(one.stages[stage] for one in timed if stage in one.stages), strict=True)
            stages[stage] = StageTimes(wait=Times.of(waits), run=Times.of(runs))
        return Measurement(
            profile=pipeline.profile.profile,
            device=pipeline.device,
            rate_hz=rate_hz,
            frames=len(frames),
            measured=len(timed),
            lost=len(frames) - len(came),
            losses=pipeline.losses,
            points=int(np.median([len(frame.points) for frame in frames])),
            budget_ms=pipeline.profile.latency_budget_ms,
            total=Times.of([one.total for one in timed]) if timed else None,
            stages=stages,
            prepare_s=round(prepared, 2),
            load=load,
        )


@dataclass(frozen=True)
class _Timed:
    """What is kept of a frame."""

    index: int
    total: float
    stages: dict[str, tuple[float, float]]

    @classmethod
    def of(cls, frame: PerceptionFrame) -> _Timed:
        stages = {name: (stage.wait_ms, stage.run_ms) for name, stage in frame.latency.stages.items()}
        return cls(frame.index, frame.latency.total_ms, stages)


def verdict_lines(measured: Measurement) -> list[str]:
    """Whether the budget holds, and if not, where the time goes and what can be done."""
    budget = f"{measured.budget_ms:g} ms at {measured.rate_hz:g} Hz"
    if measured.total is None:
        return [f"the budget of {budget} does not hold: none of {measured.frames} frames came out"]
    took = f"95 % of {measured.measured} frames took at most {measured.total.p95:.1f} ms"
    if measured.holds:
        return [f"the budget of {budget} holds: {took}, and none was lost"]
    lines = [f"the budget of {budget} does not hold: {took}, and {measured.lost} of {measured.frames} frames were lost"]
    if measured.stages:
        slowest = max(measured.stages, key=lambda stage: measured.stages[stage].run.p95)
        times = measured.stages[slowest]
        lines.append(f"most of it is {slowest}: {times.run.p95:.1f} ms, and {times.wait.p95:.1f} ms of waiting for it")
        lines.append(_way_out(slowest, measured))
    if measured.load is not None and measured.load > _BUSY:
        lines.append(f"the machine was busy before it began (load {measured.load:g}): measure again on a quiet one")
    return lines


def _way_out(stage: str, measured: Measurement) -> str:
    vertex = stage.partition(".")[2]
    if vertex == "detect":
        where = "ONNX Runtime's CUDA provider" if measured.device != "cpu" else "a GPU"
        return (
            f"what helps: {where}, a smaller head (models.detector), or free cores (--set profile.threads.inference=N)"
        )
    if measured.device == "cpu":
        return "what helps: a GPU, free cores, or fewer points: a smaller point_range of the filter"
    return "what helps: the chain (profile gpu-chain), which launches a frame's kernels at once, or fewer points"
