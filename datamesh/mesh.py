"""The mesh: the windows of a process by their topics."""

from __future__ import annotations

import threading
from typing import Any

from .clock import Clock, SystemClock
from .counters import LossCounters
from .window import Window

__all__ = ["DataMesh"]


class DataMesh:
    """All topics of a process. A topic's window is made when it is first asked for."""

    def __init__(self, window_capacity: int = 32, *, clock: Clock | None = None, check: bool = False) -> None:
        """Makes an empty mesh.

        Args:
            window_capacity: How many versions each window keeps, unless it is made with another number.
            clock: By which data are stamped, waits end and time triggers come; by default the machine's.
            check: Payloads are compared with what they were at their commit, when they are released and when they are
                evicted; what was written to since is counted as `modified`. For tests: it reads every byte.

        Raises:
            ValueError: `window_capacity` is below 1.
        """
        if window_capacity < 1:
            raise ValueError(f"window_capacity must be >= 1, not {window_capacity}")
        self.losses = LossCounters()
        self.clock = clock if clock is not None else SystemClock()
        self.check = check
        self._window_capacity = window_capacity
        self._windows: dict[str, Window[Any]] = {}
        self._lock = threading.Lock()

    def window(self, topic: str, capacity: int | None = None) -> Window[Any]:
        """The window of a topic.

        Args:
            topic: Its name, such as `perception/obstacles`.
            capacity: How many versions it keeps, if this call makes it.
        """
        with self._lock:
            window = self._windows.get(topic)
            if window is None:
                capacity = self._window_capacity if capacity is None else capacity
                window = Window(topic, capacity, self.losses, clock=self.clock, check=self.check)
                self._windows[topic] = window
            return window

    def topics(self) -> list[str]:
        """The names of all topics, sorted."""
        with self._lock:
            return sorted(self._windows)
