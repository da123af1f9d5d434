"""One benchmark of one contender: its time, and beside it what it was measured on and how right it is."""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import warp as wp

from ..kernels.device import DEFAULT_DEVICE, resolve_device
from ..kernels.threads import set_thread_count, thread_count
from .scans import Scans

__all__ = [
    "ONE_THREAD",
    "OURS",
    "PLAN",
    "Contender",
    "Contest",
    "SelfTimed",
    "contenders",
    "on_device",
    "peer",
    "processors",
    "record_figure",
    "record_score",
]

OURS, PLAN, ONE_THREAD = "warploom", "warploom plan", "warploom, 1 thread"
_SLOW = 0.1  # [s] a call, from which three rounds must do
_WATCHED, _LEAST_WATCH = 0.05, 0.002  # [s] that a call is watched before it is timed, in all and in one go


@dataclass(frozen=True)
class Contender:
    """Who is timed, and where it computes."""

    who: str
    """`warploom` (the function), `warploom plan` (its preallocated face), `warploom, 1 thread`, or a peer's name."""
    device: str = DEFAULT_DEVICE
    """A Warp device; peers compute on the CPU."""

    @property
    def is_ours(self) -> bool:
        """Whether it is no peer."""
        return self.who in (OURS, PLAN, ONE_THREAD)


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


def contenders(*peers: str, one_thread: bool = False) -> list[Any]:
    """Parameters of a benchmark: function and plan on each device, then the peers.

    Args:
        *peers: Their names.
        one_thread: Whether the function is to be timed with one CPU thread too.
    """
    faces = (OURS, PLAN, ONE_THREAD) if one_thread else (OURS, PLAN)
    ours = [pytest.param(Contender(who, DEFAULT_DEVICE), id=f"{who} cpu") for who in faces]
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
        how: str = "",
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
            how: What the kernel was asked for, its sizes and ranges, for people; the same for all contenders.
        """
        who, device = contender.who, contender.device
        self._benchmark.extra_info["how"] = how
        if device != DEFAULT_DEVICE:
            if not wp.is_cuda_available():
                pytest.skip("no CUDA device here")
            resolve_device(device)
        if who == ONE_THREAD:
            if thread_count() == 1:
                pytest.skip("one CPU thread is all that there is")
            with _one_thread():
                self._run(contender, calls[OURS], kernel, on, size, [], 1)
            return
        call = calls[who](device)
        result = call()
        accuracy = [score(result)] if score is not None else []
        if agree is not None and not contender.is_ours:
            accuracy.append(agree(calls[OURS](DEFAULT_DEVICE)(), result))
        if not contender.is_ours:
            self._benchmark.extra_info["goal"] = (goals or {}).get(who)
        used = thread_count() if contender.is_ours else (threads or {}).get(who, 1)
        self._run(contender, lambda _: call, kernel, on, size, accuracy, used)

    def _run(
        self,
        contender: Contender,
        prepare: Callable[[str], Callable[[], Any]],
        kernel: str,
        on: str,
        size: int,
        accuracy: list[str],
        threads: int,
    ) -> None:
        device = contender.device
        call = prepare(device)
        timed = call if device == DEFAULT_DEVICE else _finished(call, device)
        if contender.is_ours:
            timed()
        once, busy_cores = _watch(timed)
        info = self._benchmark.extra_info
        info.update(
            kernel=kernel,
            on=on,
            size=size,
            who=contender.who,
            device=device,
            threads=threads,
            accuracy="; ".join(text for text in accuracy if text),
        )
        self._benchmark.group = f"{kernel}, {on}"
        if isinstance(call, SelfTimed):
            call.taken.clear()
        if once < _SLOW:
            self._benchmark(timed)
        else:
            self._benchmark.pedantic(timed, rounds=3)
        if isinstance(call, SelfTimed):
            info["own_timer_s"] = float(np.median(call.taken))
        if device == DEFAULT_DEVICE:
            info["busy_cores"] = busy_cores


@contextmanager
def _one_thread() -> Iterator[None]:
    before = thread_count()
    set_thread_count(1)
    try:
        yield
    finally:
        set_thread_count(before)


def _watch(call: Callable[[], Any]) -> tuple[float, float]:
    """Seconds of a call, and how many cores it keeps busy: the processor's time over that of the clock.

    Where others disturb the calls, the least disturbed ones tell.
    """
    repeats, shortest, busiest, left = 1, float("inf"), 0.0, _WATCHED
    while left > 0:
        clock, processor = time.perf_counter(), time.process_time()
        for _ in range(repeats):
            call()
        processor, clock = time.process_time() - processor, time.perf_counter() - clock
        shortest = min(shortest, clock / repeats)
        if repeats * shortest > _LEAST_WATCH:
            busiest = max(busiest, processor / clock)
        left -= clock
        repeats = max(1, round(2 * _LEAST_WATCH / shortest))
    return shortest, busiest


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


def record_score(
    benchmark: Any,
    name: str,
    *,
    on: str,
    ours: float,
    theirs: float | None,
    peer: str,
    unit: str,
    gain: float | None = None,
    note: str = "",
    lower_is_better: bool = False,
) -> None:
    """Adds how right ours is beside a peer on the same input.

    Args:
        benchmark: The fixture of pytest-benchmark.
        name: What it is.
        on: What both were given.
        ours: How right ours is.
        theirs: How right the peer is; None where it gives nothing.
        peer: The peer's name.
        unit: Of both.
        gain: How much higher than the peer's ours is to be, which may be below zero; None where there is no goal.
        note: How it was taken.
        lower_is_better: Whether these are errors; the gain is then how much lower.
    """
    benchmark.extra_info.setdefault("scores", []).append({
        "name": name, "on": on, "ours": float(ours), "theirs": None if theirs is None else float(theirs),
        "peer": peer, "unit": unit, "gain": gain, "note": note, "lower_is_better": lower_is_better,
    })  # fmt: skip
