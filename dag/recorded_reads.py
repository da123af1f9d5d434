"""What a vertex read of inputs that did not trigger it, in a run that was recorded: a replay gives it the same."""

from __future__ import annotations

import threading
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial

from ..datamesh import Entry, Input, Outcome
from .trigger import Trigger

__all__ = ["Awaited", "Read", "RecordedReads"]

Read = tuple[int, int] | Outcome
"""Epoch and version of a datum that was read, or how the wait for it ended without."""
_Order = tuple[int, int]


class Awaited:
    """How many reads of a replay wait for what is still to be played.

    While there are any, nothing may hold up the player: a recorded run may have read what was committed after many of
    the triggers that waited for their turn then.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count = 0
        self.on_first: list[Callable[[], None]] = []
        """Are called when one waits, and none did."""

    def __bool__(self) -> bool:
        return self._count > 0

    def add(self, number: int) -> None:
        """So many more wait; fewer where it is negative."""
        with self._lock:
            first = self._count == 0 and number > 0
            self._count += number
        for tell in self.on_first if first else ():
            tell()

    @contextmanager
    def one(self) -> Iterator[None]:
        """One waits within."""
        self.add(1)
        try:
            yield
        finally:
            self.add(-1)


class RecordedReads:
    """Of one vertex. It waits for what it read, without a deadline, and takes nothing else.

    What it is still to read is kept for it: a replay may be so far ahead that it has left the window.
    """

    def __init__(
        self,
        reads: Mapping[_Order, Mapping[str, Read] | None],
        inputs: Mapping[str, Input],
        awaited: Awaited | None = None,
    ) -> None:
        """Watches the inputs, which must be bound.

        Args:
            reads: Epoch and version of a frame → what the vertex read in it, by input; None where it was left out.
            inputs: Of the component, by name.
            awaited: Counts the waits of all vertices of the replay.
        """
        self._reads = reads
        self._awaited = Awaited() if awaited is None else awaited
        self.left_out = {order for order, read in reads.items() if read is None}
        """Epochs and versions of the frames in which the vertex was left out."""
        self._readers: dict[tuple[str, int, int], list[_Order]] = defaultdict(list)
        self._kept: dict[_Order, dict[str, Entry]] = {}
        for order, of_frame in reads.items():
            for name, read in (of_frame or {}).items():
                if not isinstance(read, Outcome):
                    self._readers[name, *read].append(order)
                    self._kept[order] = {}
        for name in {name for name, _, _ in self._readers}:
            inputs[name].window.subscribe(partial(self._on_commit, name), lambda version, epoch: None)

    def _on_commit(self, name: str, entry: Entry) -> None:
        for order in self._readers.get((name, entry.epoch, entry.version), ()):
            kept = self._kept.get(order)
            if kept is not None:
                kept[name] = entry

    def of(self, trigger: Trigger) -> Mapping[str, Read]:
        """What was read in a frame, by input."""
        return self._reads.get((trigger.epoch, trigger.version)) or {}

    def take(self, trigger: Trigger) -> Mapping[str, Entry]:
        """What is kept for a frame, by input; no longer after that."""
        return self._kept.pop((trigger.epoch, trigger.version), {})

    def wait(self, begin: Callable[[Callable[[], None]], bool], resume: Callable[[], None]) -> bool:
        """Begins a wait for what was read, which counts as one while it lasts.

        Args:
            begin: Begins it: takes what is to be called at its end, and tells whether it waits at all.
            resume: Is called at the end of the wait, if there is one.
        """

        def end() -> None:
            self._awaited.add(-1)
            resume()

        self._awaited.add(1)
        waits = begin(end)
        if not waits:
            self._awaited.add(-1)
        return waits
