"""What a data process reads in its runs: written to the log, and in a replay given to it again.

A data process takes snapshots and waits as it likes, and what it finds depends on what others have committed by then.
So the log says of each snapshot what it showed, and of each wait how it ended, in their order.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Container, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from ..datamesh import Entry, Input, Outcome, Snapshot, Waiting
from ..datamesh.snapshot import State
from .component import DataProcessComponent
from .recorded_reads import Awaited
from .trigger import Trigger

__all__ = ["Access", "LoggedAccesses", "ReplayedAccesses", "decode_access"]


class Showed(NamedTuple):
    """What a snapshot showed."""

    input: str
    epoch: int
    versions: tuple[int, ...]
    evicted: int
    settled: tuple[int, ...]


class Waited(NamedTuple):
    """How a wait ended."""

    input: str
    found: tuple[int, int] | None
    """Epoch and version; None where it ended without."""
    outcome: Outcome


Access = Showed | Waited
_Datum = tuple[str, int, int]


class LoggedAccesses:
    """Notes what a component reads in each of its runs."""

    def __init__(self, component: DataProcessComponent, log: Callable[[Trigger, Sequence[tuple]], None]) -> None:
        """Watches the inputs of a component.

        Args:
            component: A data process, not started.
            log: Is told after each run what was read in it, as `decode_access` takes it.
        """
        self._component = component
        self._log = log
        self._accesses: list[tuple] = []
        for handle in component.inputs.values():
            handle.reads = self
        component.after_run = self._end

    def snapshot(self, handle: Input, epoch: int, stream: Any) -> Snapshot:
        """Takes a snapshot and notes what it shows."""
        snapshot = handle.window.snapshot(epoch, stream)
        if self._component.running is not None:
            state = snapshot.state
            self._accesses.append((handle.name, state.epoch, state.versions, state.evicted, tuple(state.settled)))
        return snapshot

    def wait(self, handle: Input, version: int, epoch: int, wait: Callable[[], Waiting]) -> Waiting:
        """Waits, and notes how that ended."""
        waiting = wait()
        if self._component.running is not None and waiting.outcome is not None:
            entry = waiting.entry
            found = None if entry is None else (entry.epoch, entry.version)
            self._accesses.append((handle.name, found, waiting.outcome.value))
        return waiting

    def _end(self, trigger: Trigger) -> None:
        accesses, self._accesses = self._accesses, []
        if accesses:
            self._log(trigger, accesses)


def decode_access(noted: tuple, first: int) -> Access:
    """What `LoggedAccesses` noted.

    Args:
        noted: Of the log.
        first: The first epoch of the recording, which is the epoch 0 of the replay.
    """
    if len(noted) == 3:
        name, found, outcome = noted
        return Waited(name, None if found is None else (found[0] - first, found[1]), Outcome(outcome))
    name, epoch, versions, evicted, settled = noted
    return Showed(name, epoch - first, tuple(versions), evicted, tuple(settled))


class ReplayedAccesses:
    """Gives the runs of a component what they read when they were recorded, and waits for what is not there yet.

    What is still to be read is kept, as a replay may be so far ahead that it has left the window. A run that reads more
    than it did then is given what is there.
    """

    def __init__(
        self,
        component: DataProcessComponent,
        accesses: Mapping[tuple[int, int], Sequence[Access]],
        awaited: Awaited,
        topics: Container[str],
    ) -> None:
        """Watches the inputs, which must be bound.

        Args:
            component: A data process, not started, that follows the replay.
            accesses: Epoch and version of a trigger → what was read in its run.
            awaited: Counts the waits of all of the replay.
            topics: Those that the replay has; inputs of others are read as they are.
        """
        self._component = component
        self._awaited = awaited
        inputs = {name: handle for name, handle in component.inputs.items() if handle.topic in topics}
        self._left = {order: deque(one for one in run if one.input in inputs) for order, run in accesses.items()}
        self._needed = Counter(datum for run in self._left.values() for one in run for datum in _data(one))
        self._kept: dict[_Datum, Entry] = {}
        for name, handle in inputs.items():
            handle.reads = self
            handle.window.subscribe(partial(self._on_commit, name), lambda version, epoch: None)
        component.after_run = self._end

    def _on_commit(self, name: str, entry: Entry) -> None:
        datum = (name, entry.epoch, entry.version)
        if datum in self._needed:
            self._kept[datum] = entry

    def snapshot(self, handle: Input, epoch: int, stream: Any) -> Snapshot:
        """What the snapshot showed in the recorded run."""
        showed = self._next(handle.name, Showed)
        if showed is None:
            return handle.window.snapshot(epoch, stream)
        found = [self._entry(handle, showed.epoch, version) for version in showed.versions]
        entries = tuple(entry for entry in found if entry is not None)
        versions = tuple(entry.version for entry in entries)
        settled = dict.fromkeys(showed.settled)
        return Snapshot(State(showed.epoch, versions, entries, showed.evicted, settled, deque(), None), stream)

    def wait(self, handle: Input, version: int, epoch: int, wait: Callable[[], Waiting]) -> Waiting:
        """Ends as the wait of the recorded run did."""
        waited = self._next(handle.name, Waited)
        if waited is None:
            return wait()
        waiting: Waiting = Waiting(version, epoch, 0, lambda _: None)
        entry = None if waited.found is None else self._entry(handle, *waited.found)
        waiting.end(waited.outcome if waited.found is None or entry is not None else Outcome.EVICTED, entry)
        return waiting

    def _next(self, name: str, kind: type) -> Any:
        """What the recorded run read next; None where that was something else."""
        running = self._component.running
        left = None if running is None else self._left.get((running.epoch, running.version))
        if left and isinstance(left[0], kind) and left[0].input == name:
            return left.popleft()
        return None

    def _entry(self, handle: Input, epoch: int, version: int) -> Entry | None:
        """A datum, waited for; None, counted, where it cannot come any more."""
        datum = (handle.name, epoch, version)
        if datum not in self._kept:
            ended = threading.Event()
            with self._awaited.one():
                waiting = handle.when(version, lambda _: ended.set(), epoch=epoch)
                ended.wait()
            if datum not in self._kept and waiting.entry is not None:
                self._kept[datum] = waiting.entry
        entry = self._kept.get(datum)
        if entry is None:
            self._component.losses.count(self._component.name, "not replayed", version)
        self._release(datum)
        return entry

    def _release(self, datum: _Datum) -> None:
        self._needed[datum] -= 1
        if self._needed[datum] <= 0:
            del self._needed[datum]
            self._kept.pop(datum, None)

    def _end(self, trigger: Trigger) -> None:
        for access in self._left.pop((trigger.epoch, trigger.version), ()):
            for datum in _data(access):
                self._release(datum)


def _data(access: Access) -> list[_Datum]:
    """What was read, each datum."""
    if isinstance(access, Showed):
        return [(access.input, access.epoch, version) for version in access.versions]
    return [] if access.found is None else [(access.input, *access.found)]
