"""When a datum comes that was announced, and for how long its reader stays awake for it."""

from __future__ import annotations

import ctypes
import os
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress

__all__ = ["Aside", "Durations", "Expectation", "current_core"]

_REMEMBERED = 8
_SAVED_NS = 5_000_000
"""How much of its share a reader can save up [ns]."""
_LONGEST_PAUSE = 256
_LATE_NS = 200_000
"""How much longer than all before it a payload may take, to be waited for all the same [ns]."""

current_core: Callable[[], int] = ctypes.PyDLL(None).sched_getcpu  # which keeps the interpreter's lock: it is short
"""On which core the calling thread runs."""


class Aside:
    """Where the thread that receives waits: on another core than the one of its writer.

    Linux likes to wake a thread on the core of who wakes it by a socket, as if that were about to sleep; kernels that
    would rather not wake a core do nothing else. There it runs once the writer sleeps, which is after the commit, or
    takes the core from it. What runs once a datum is there may run everywhere again.
    """

    def __init__(self) -> None:
        """It waits anywhere."""
        self._core = -1
        self._everywhere: set[int] = set()
        self._here: set[int] = set()

    def avoid(self, core: int) -> None:
        """Notes on which core its writer runs, and leaves that."""
        if core != self._core:
            self.end()
            self._core = core
        if not self._here:
            self.begin()

    def begin(self) -> None:
        """From here on the calling thread is not on its writer's core, if it may run on another."""
        if self._core < 0:
            return
        cores = os.sched_getaffinity(0)
        here = cores - {self._core}
        if here and here != cores:
            with suppress(OSError):  # the last of these cores was taken from this process just now
                os.sched_setaffinity(0, here)
                self._everywhere, self._here = cores, here

    def end(self) -> None:
        """It may run where it could before, unless somebody has moved it meanwhile."""
        if self._here:
            if os.sched_getaffinity(0) == self._here:
                with suppress(OSError):
                    os.sched_setaffinity(0, self._everywhere)
            self._here = set()


class Durations:
    """How long payloads take to build, at a writer."""

    def __init__(self) -> None:
        """None was built yet."""
        self._last: deque[int] = deque(maxlen=_REMEMBERED)

    def add(self, took_ns: int) -> tuple[int, int]:
        """Notes one more, and says between which times the next is to be expected [ns]."""
        self._last.append(took_ns)
        last = sorted(self._last)
        return last[len(last) // 8], last[-1] + _LATE_NS


class Expectation:
    """Of one connection: for how long to stay awake for the next datum.

    Staying awake takes a core. It is done for a bounded time around the moment at which a datum is due, for a bounded
    share of all time, never where this process has but one core, and more and more rarely where data do not come when
    they are due, as on a machine on which too much runs.
    """

    def __init__(self, most_ns: int, share: float) -> None:
        """Begins with nothing saved.

        Args:
            most_ns: For how long to stay awake for one datum [ns].
            share: Of all time, for how much.
        """
        self.allowed = 0
        """For how long to stay awake for the next [ns]."""
        self._most = most_ns if len(os.sched_getaffinity(0)) > 1 else 0
        self._share = share
        self._saved = self._pause = self._skip = 0
        self._counted = time.perf_counter_ns()

    @property
    def is_worth_it(self) -> bool:
        """Whether it may stay awake at all, and data come when they are due."""
        return self._most > 0 and not self._skip

    def came(self, awake_ns: int, in_vain: bool) -> None:
        """Notes for how long the reader stayed awake for a datum [ns], and whether that came later all the same."""
        now = time.perf_counter_ns()
        self._saved = min(_SAVED_NS, self._saved + round(self._share * (now - self._counted))) - awake_ns
        self._counted = now
        if awake_ns:
            self._pause = min(_LONGEST_PAUSE, 2 * self._pause + 1) if in_vain else self._pause // 2
            self._skip = self._pause
        elif self._skip:
            self._skip -= 1
        self.allowed = 0 if self._skip else min(self._most, self._saved)
