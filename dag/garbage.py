"""Python's garbage collector while components run.

A full pass of it looks at every object of the process and holds all threads up meanwhile: for 0.1 s where the usual
libraries are loaded, a whole frame's time. What is there when the components start lives as long as they do, so it is
taken out of the passes until they stop; what the frames leave behind is collected as ever, in a millisecond.
"""

from __future__ import annotations

import gc
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import ClassVar, NamedTuple

__all__ = ["FrozenHeap", "GarbagePause", "frozen_heap", "on_pause"]


class FrozenHeap:
    """Keeps the collector from what is there now, from the first one that holds it until the last has let go."""

    _lock: ClassVar[threading.Lock] = threading.Lock()
    _holders: ClassVar[int] = 0

    def __init__(self) -> None:
        self._holds = False

    def hold(self) -> None:
        """Takes all objects that are there out of the collector's passes. Twice is no harm."""
        with self._lock:
            FrozenHeap._holders += not self._holds
            self._holds = True
            gc.freeze()
            # It finds nothing, in microseconds; but full passes come as often as befits what the last one looked at.
            gc.collect()

    def release(self) -> None:
        """Lets the collector see them again, unless another one holds them."""
        with self._lock:
            if self._holds:
                self._holds = False
                FrozenHeap._holders -= 1
                if FrozenHeap._holders == 0:
                    gc.unfreeze()


@contextmanager
def frozen_heap() -> Iterator[None]:
    """Keeps the garbage collector from what is there now, while the block runs; a running `Process` does so by itself.

    To be entered when all is built: libraries, models, components. Garbage among it, in cycles, is freed afterwards.
    """
    heap = FrozenHeap()
    heap.hold()
    try:
        yield
    finally:
        heap.release()


class GarbagePause(NamedTuple):
    """One pass of the collector, which holds all threads up; times from `time.perf_counter_ns`."""

    generation: int
    """2: it looked at all objects; 0 and 1: at young ones."""
    start_ns: int
    end_ns: int
    collected: int
    """Objects that it freed."""

    @property
    def ms(self) -> float:
        """How long it took [ms]."""
        return (self.end_ns - self.start_ns) / 1e6


def on_pause(callback: Callable[[GarbagePause], object]) -> Callable[[], None]:
    """Calls back after every pass of the collector.

    Args:
        callback: Is called in the thread in which a pass happened, between any two of its instructions: it must take no
            lock, as that thread may hold it.

    Returns:
        A function that ends it.
    """
    start = 0

    def passes(phase: str, info: dict[str, int]) -> None:
        nonlocal start
        now = time.perf_counter_ns()
        if phase == "start":
            start = now
        elif start:  # it may have begun to watch in the midst of one
            callback(GarbagePause(info["generation"], start, now, info["collected"]))
            start = 0

    def end() -> None:
        if passes in gc.callbacks:
            gc.callbacks.remove(passes)

    gc.callbacks.append(passes)
    return end
