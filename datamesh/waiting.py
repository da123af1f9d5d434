"""A wait for a version of a window, which ends once: by a commit or settle there, at a deadline, or at a shutdown."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Generic, TypeVar

from .snapshot import Entry, Snapshot, State
from .status import Outcome

__all__ = ["Waiting"]

T = TypeVar("T")


class Waiting(Generic[T]):
    """One wait, for exactly a version or one near it. `outcome` and `entry` stand once it has ended."""

    __slots__ = ("_claim", "_on_end", "entry", "epoch", "outcome", "tolerance_ns", "version")

    def __init__(self, version: int, epoch: int, tolerance_ns: int, on_end: Callable[[Waiting[T]], None]) -> None:
        """Begins to wait.

        Args:
            version: What is waited for [ns].
            epoch: The epoch of that version.
            tolerance_ns: How far from it the datum's version may be; the nearest is taken.
            on_end: Is called once, in the thread that ended the wait.
        """
        self.version = version
        self.epoch = epoch
        self.tolerance_ns = tolerance_ns
        self.outcome: Outcome | None = None
        self.entry: Entry[T] | None = None
        self._on_end = on_end
        self._claim = threading.Lock()

    def end(self, outcome: Outcome, entry: Entry[T] | None = None) -> bool:
        """Ends the wait; tells whether this call did, which only the first does."""
        if not self._claim.acquire(blocking=False):
            return False
        self.entry = entry
        self.outcome = outcome
        self._on_end(self)
        return True

    def decide(self, state: State[T]) -> tuple[Outcome, Entry[T] | None] | None:
        """How the wait ends by what the window holds; None where it goes on."""
        of_epoch = state.of_epoch(self.epoch)
        snapshot = Snapshot(of_epoch)
        index = snapshot.nearest(self.version, self.tolerance_ns)
        if index >= 0:
            return Outcome.FOUND, snapshot.entry(index)
        if self.version in of_epoch.settled:
            return Outcome.SETTLED_EMPTY, None
        reach, newest = self.version + self.tolerance_ns, of_epoch.versions[-1] if of_epoch.versions else -1
        if reach <= min(of_epoch.evicted, newest) or of_epoch.epoch < state.epoch:
            return Outcome.EVICTED, None
        return None
