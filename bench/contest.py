"""One benchmark of one contender: its time, and beside it what it was measured on and how right it is."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import warp as wp

from ..kernels.device import DEFAULT_DEVICE, resolve_device
from .scans import Scans

__all__ = ["Contender", "Contest", "SelfTimed", "contenders", "on_device", "peer", "processors", "record_figure"]

OURS, PLAN = "warploom", "warploom plan"


@dataclass(frozen=True)
class Contender:
    """Who is timed, and where it computes."""

    who: str
    """`warploom` (the function), `warploom plan` (its preallocated face), or a peer's name."""
    device: str = DEFAULT_DEVICE
    """A Warp device; peers compute on the CPU."""


@dataclass
class SelfTimed:
    """A peer that has a timer of its own, which leaves its bindings out."""

    call: Callable[[], Any]
    """What is timed."""
    own_seconds: Callable[[], float]
    """Its own time of the latest call [s]."""
    taken: list[float] = field(default_factory=list)
    """What its timer said of each call [s]."""

    def __call__(self) -> Any:
        """Calls it and notes its time."""
        result = self.call()
        self.taken.append(self.own_seconds())
        return result


def contenders(*peers: str) -> list[Any]:
    """Parameters of a benchmark: function and plan on each device, then the peers."""
    ours = [pytest.param(Contender(who, DEFAULT_DEVICE), id=f"{who} cpu") for who in (OURS, PLAN)]
    ours += [pytest.param(Contender(who, "cuda:0"), id=f"{who} cuda:0", marks=pytest.mark.cuda) for who in (OURS, PLAN)]
    return ours + [pytest.param(Contender(who), id=who) for who in peers]


def peer(module: str, package: str | None = None) -> Any:
    """A peer's module; the benchmark is skipped, by the peer's name, where it cannot be imported."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        pytest.skip(f"{package or module.split('.')[0]} cannot be imported here: {error}")


class Contest:
    """Times contenders through pytest-benchmark; `extra_info` carries what the report says beside the time."""

    def __init__(self, benchmark: Any, scans: Scans):
        self._benchmark = benchmark
        self._scans = scans

    def cloud(self, name: str) -> np.ndarray:
        """The cloud of this name; the benchmark is skipped where it is a real one and not here."""
        try:
            return self._scans.cloud(name)
        except FileNotFoundError as error:
            pytest.skip(str(error))

    @property
    def scans(self) -> Scans:
        """Where the clouds come from."""
        return self._scans

    def run(
        self,
        contender: Contender,
        calls: Mapping[str, Callable[[str], Callable[[], Any]]],
        *,
        kernel: str,
        on: str,
        size: int,
        agree: Callable[[Any, Any], str] | None = None,
        score: Callable[[Any], str] | None = None,
        goals: Mapping[str, float] | None = None,
        threads: Mapping[str, int] | None = None,
    ) -> None:
        """Times one contender.

        Args:
            contender: Who.
            calls: By name a function that prepares, given a device, the call that is timed.
            kernel: The kernel's name, as the report says it.
            on: What it was given, for people.
            size: How many points, boxes or rays those are.
            agree: Says how a peer's result compares with ours.
            score: Says how right a result is.
            goals: By peer the share of its time that ours is to take.
            threads: By peer how many threads it uses, where that is more than one.
        """
        who, device = contender.who, contender.device
        if device != DEFAULT_DEVICE:
            if not wp.is_cuda_available():
                pytest.skip("no CUDA device here")
            resolve_device(device)
        call = calls[who](device)
        result = call()
        accuracy = []
        if score is not None:
            accuracy.append(score(result))
        is_peer = who not in (OURS, PLAN)
        if agree is not None and is_peer:
            accuracy.append(agree(calls[OURS](DEFAULT_DEVICE)(), result))
        info = self._benchmark.extra_info
        info.update(
            kernel=kernel,
            on=on,
            size=size,
            who=who,
            device=device,
            threads=(threads or {}).get(who, 1),
            accuracy="; ".join(text for text in accuracy if text),
        )
        if is_peer:
            info["goal"] = (goals or {}).get(who)
        self._benchmark.group = f"{kernel}, {on}"
        if device == DEFAULT_DEVICE:
            self._benchmark(call)
        else:
            self._benchmark(_finished(call, device))
        if isinstance(call, SelfTimed):
            info["own_timer_s"] = float(np.median(call.taken))


def _finished(call: Callable[[], Any], device: str) -> Callable[[], None]:
    """The call, and then the wait until the device is done with it."""

    def run() -> None:
        call()
        wp.synchronize_device(device)

    return run


def processors() -> int:
    """Threads that a peer takes when it takes all."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_device(points: np.ndarray, device: str) -> Any:
    """The array as a caller on that device would have it: NumPy on the CPU, else a Warp array."""
    return (
        points if device == DEFAULT_DEVICE else wp.array(points, dtype=wp.dtype_from_numpy(points.dtype), device=device)
    )


def record_figure(
    benchmark: Any, name: str, value: float, unit: str, *, goal: float | None = None, note: str = ""
) -> None:
    """Adds a figure that is no time of a call: memory, growth, the time of another process.

    Args:
        benchmark: The fixture of pytest-benchmark.
        name: What it is.
        value: How much.
        unit: Of what.
        goal: What it should not exceed.
        note: How it was taken.
    """
    figures = benchmark.extra_info.setdefault("figures", [])
    figures.append({"name": name, "value": float(value), "unit": unit, "goal": goal, "note": note})
