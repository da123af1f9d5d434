"""What a vertex read of inputs that did not trigger it, in a run that was recorded: a replay gives it the same."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from functools import partial

from ..datamesh import Entry, Input, Outcome
from .trigger import Trigger

__all__ = ["Read", "RecordedReads"]

Read = tuple[int, int] | Outcome
"""Epoch and version of a datum that was read, or how the wait for it ended without."""
_Order = tuple[int, int]


class RecordedReads:
    """Of one vertex. It waits for what it read, without a deadline, and takes nothing else.

    What it is still to read is kept for it: a replay may be so far ahead that it has left the window.
    """

    def __init__(self, reads: Mapping[_Order, Mapping[str, Read] | None], inputs: Mapping[str, Input]) -> None:
        """Watches the inputs, which must be bound.

        Args:
            reads: Epoch and version of a frame → what the vertex read in it, by input; None where it was left out.
            inputs: Of the component, by name.
        """
        self._reads = reads
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
