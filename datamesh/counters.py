"""Loss counters: nothing is dropped without being counted, with a reason, and told to whoever asks."""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable

__all__ = ["LossCounters"]

_log = logging.getLogger(__name__)

OnLoss = Callable[[str, str, int], None]


class LossCounters:
    """Counts what was lost, by place and reason. Safe to use from any thread."""

    def __init__(self) -> None:
        self._counts: Counter[tuple[str, str]] = Counter()
        self._lock = threading.Lock()
        self._callbacks: list[OnLoss] = []

    def count(self, place: str, reason: str, version: int = 0, amount: int = 1) -> None:
        """Counts a loss and calls back.

        Args:
            place: The topic or component that lost it.
            reason: Why, such as `backlog`, `out_of_order`, `evicted`, `failed`.
            version: Of the frame that was lost [ns].
            amount: How many were lost.
        """
        with self._lock:
            self._counts[place, reason] += amount
            callbacks = tuple(self._callbacks)
        for callback in callbacks:
            try:
                callback(place, reason, version)
            except Exception:  # who watches losses must not cause more of them
                _log.exception("a callback on losses failed")

    def on_loss(self, callback: OnLoss) -> None:
        """Calls `callback(place, reason, version)` at every loss from now on, in the thread that lost it."""
        with self._lock:
            self._callbacks.append(callback)

    def __getitem__(self, key: tuple[str, str]) -> int:
        with self._lock:
            return self._counts[key]

    def as_dict(self) -> dict[str, dict[str, int]]:
        """All counts: place → reason → how many."""
        with self._lock:
            counts: dict[str, dict[str, int]] = {}
            for (place, reason), amount in sorted(self._counts.items()):
                counts.setdefault(place, {})[reason] = amount
            return counts
