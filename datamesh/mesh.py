"""The mesh: the windows of a process by their topics."""

from __future__ import annotations

import threading
from typing import Any

from .counters import LossCounters
from .window import Window

__all__ = ["DataMesh"]


class DataMesh:
    """All topics of a process. A topic's window is made when it is first asked for."""

    def __init__(self, window_capacity: int = 32) -> None:
        """Makes an empty mesh.

        Args:
            window_capacity: How many versions each window keeps, unless it is made with another number.
        """
        self.losses = LossCounters()
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
                window = Window(topic, self._window_capacity if capacity is None else capacity, self.losses)
                self._windows[topic] = window
            return window

    def topics(self) -> list[str]:
        """The names of all topics, sorted."""
        with self._lock:
            return sorted(self._windows)
