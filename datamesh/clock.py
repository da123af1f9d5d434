"""The clock of a mesh: the time, and calls at a later time. Tests and replays inject one that they move by hand."""

from __future__ import annotations

import heapq
import itertools
import logging
import threading
import time
from collections.abc import Callable
from typing import Protocol

__all__ = ["Clock", "ManualClock", "SystemClock", "Timer"]

_log = logging.getLogger(__name__)


class Timer:
    """A call that is due later."""

    __slots__ = ("_callback", "due_ns")

    def __init__(self, due_ns: int, callback: Callable[[], None]) -> None:
        self.due_ns = due_ns
        self._callback: Callable[[], None] | None = callback

    @property
    def is_due(self) -> bool:
        """Whether the call is still to be made."""
        return self._callback is not None

    def cancel(self) -> None:
        """The call is not made, unless it is being made already."""
        self._callback = None

    def fire(self) -> None:
        """Makes the call; the clock does that."""
        callback, self._callback = self._callback, None
        if callback is None:
            return
        try:
            callback()
        except Exception:  # the calls behind it are due all the same
            _log.exception("a call that was due failed")


class Clock(Protocol):
    """Two times: `now_ns` can step, as clocks that are set do; `monotonic_ns` cannot, and timers go by it."""

    def now_ns(self) -> int:
        """The time that versions are in [ns]."""
        ...

    def monotonic_ns(self) -> int:
        """Time that only goes forward [ns]; deadlines and latencies are in it."""
        ...

    def call_at(self, due_ns: int, callback: Callable[[], None]) -> Timer:
        """Calls back once `monotonic_ns` has reached `due_ns`, in a thread of the clock: the call must be short."""
        ...

    def tidy(self) -> None:
        """Lets go of calls that were cancelled, and of the thread if no other is due."""
        ...


class SystemClock:
    """The machine's clock. Its one thread lives while a call is due."""

    def __init__(self) -> None:
        self._due: list[tuple[int, int, Timer]] = []
        self._numbers = itertools.count()
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    now_ns = staticmethod(time.time_ns)
    monotonic_ns = staticmethod(time.perf_counter_ns)

    def call_at(self, due_ns: int, callback: Callable[[], None]) -> Timer:
        """Calls back in the clock's thread."""
        timer = Timer(due_ns, callback)
        with self._changed:
            heapq.heappush(self._due, (due_ns, next(self._numbers), timer))
            if self._thread is None:
                self._thread = threading.Thread(target=self._serve, name="clock", daemon=True)
                self._thread.start()
            elif self._due[0][2] is timer:
                self._changed.notify()
        return timer

    def _serve(self) -> None:
        while True:
            with self._changed:
                while self._due and not self._due[0][2].is_due:
                    heapq.heappop(self._due)
                if not self._due:
                    self._thread = None
                    return
                left = self._due[0][0] - time.perf_counter_ns()
                if left > 0:
                    self._changed.wait(left / 1e9)
                    continue
                timer = heapq.heappop(self._due)[2]
            timer.fire()
            del timer  # what was called must not live until the next call is due

    def tidy(self) -> None:
        """Lets go of calls that were cancelled, and of the thread if no other is due."""
        with self._changed:
            self._due = [one for one in self._due if one[2].is_due]
            heapq.heapify(self._due)
            thread = self._thread
            self._changed.notify()
        if thread is None or thread is threading.current_thread():
            return
        while thread.is_alive() and not self._due:  # a call that comes meanwhile keeps it
            thread.join(0.01)

    def stop(self) -> None:
        """Makes none of the calls that are due, and ends the thread."""
        with self._changed:
            for _, _, timer in self._due:
                timer.cancel()
        self.tidy()


class ManualClock:
    """A clock that stands until it is moved; the calls that come due are made by who moves it, in their order."""

    def __init__(self, now_ns: int = 0) -> None:
        self._elapsed = 0
        self._start = now_ns
        self._due: list[tuple[int, int, Timer]] = []
        self._numbers = itertools.count()
        self._lock = threading.Lock()

    def now_ns(self) -> int:
        """The time that was set, and what it was advanced by since [ns]."""
        return self._start + self._elapsed

    def monotonic_ns(self) -> int:
        """All that it was advanced by [ns]."""
        return self._elapsed

    def call_at(self, due_ns: int, callback: Callable[[], None]) -> Timer:
        """Calls back within the `advance` that reaches `due_ns`."""
        timer = Timer(due_ns, callback)
        with self._lock:
            heapq.heappush(self._due, (due_ns, next(self._numbers), timer))
        return timer

    def advance(self, by_ns: int) -> None:
        """Moves on, call by call.

        Raises:
            ValueError: `by_ns` is negative; a clock that is set back `step`s.
        """
        if by_ns < 0:
            raise ValueError(f"by_ns must be >= 0, not {by_ns}: `step` sets the clock back")
        end = self._elapsed + by_ns
        while True:
            with self._lock:
                if not self._due or self._due[0][0] > end:
                    self._elapsed = end
                    return
                timer = heapq.heappop(self._due)[2]
                self._elapsed = max(self._elapsed, timer.due_ns)
            timer.fire()

    def tidy(self) -> None:
        """Lets go of calls that were cancelled."""
        with self._lock:
            self._due = [one for one in self._due if one[2].is_due]
            heapq.heapify(self._due)

    def step(self, by_ns: int) -> None:
        """Sets the time of versions forward, or back, as when a clock is set: no time has passed."""
        self._start += by_ns
