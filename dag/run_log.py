"""The log of a run: what the clock decided in it, so that a replay need not ask a clock.

Which triggers each component took, with the versions that triggered (what a backlog dropped is not among them); what
weak and strong sync read, and so which waits ended without data; what data processes read; and which vertices a
deadline left out. All of it is in a recording beside the data.
"""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from ..datamesh import Entry, Miss, Outcome, Status
from ..datamesh.recording import READS, RUNS, RecordedEvent
from .component import DataProcessComponent
from .dag_component import DagComponent
from .engine import VertexTiming
from .process import Process
from .recorded_accesses import Access, LoggedAccesses, ReplayedAccesses, decode_access
from .recorded_reads import Awaited, Read, RecordedReads
from .trigger import Trigger

__all__ = ["RecordedRuns", "RunLog"]

_Order = tuple[int, int]
_Datum = tuple[str, int, int]
"""Input, epoch and version."""
Log = Callable[[str, int, int, object], None]


class RunLog:
    """Writes the log of a run: `log(topic, epoch, version, value)` is called for each entry, from any thread."""

    def __init__(self, log: Log) -> None:
        self._log = log

    def watch(self, process: Process) -> None:
        """Logs what the components of a process take, which has not started."""
        for component in process.components.values():
            if isinstance(component, DataProcessComponent) and component.backlog is not None:
                component.backlog.on_taken = partial(self._on_taken, component.name)
                if not isinstance(component, DagComponent):
                    LoggedAccesses(component, partial(self._on_accesses, component.name))

    def _on_taken(self, component: str, trigger: Trigger) -> None:
        self._log(RUNS, trigger.epoch, trigger.version, (component, dict(trigger.inputs)))

    def _on_accesses(self, component: str, trigger: Trigger, accesses: Sequence[tuple]) -> None:
        self._log(READS, trigger.epoch, trigger.version, (component, list(accesses)))

    def on_timing(self, timing: VertexTiming) -> None:
        """Logs what a vertex read, and that it was left out."""
        if timing.reads or timing.status is Status.CUT:
            reads = {name: r.value if isinstance(r, Outcome) else tuple(r) for name, r in timing.reads.items()}
            what = None if timing.status is Status.CUT else reads
            self._log(READS, timing.epoch, timing.version, (f"{timing.component}.{timing.vertex}", what))


@dataclass
class _Taken:
    """The triggers that a component took, in their order."""

    runs: list[tuple[int, int, dict[str, int]]] = field(default_factory=list)
    """Epoch, version, and the versions that triggered, by input."""
    given: int = 0
    released: int = 0
    """Those without inputs, which time triggered, are given when the replay gets to where they were taken."""
    kept: dict[_Datum, Entry] = field(default_factory=dict)
    """What triggers those that are still to be given, as far as it is there."""
    needed: Counter[_Datum] = field(default_factory=Counter)
    """How many of them each datum triggers."""
    lock: threading.RLock = field(default_factory=threading.RLock)


class RecordedRuns:
    """What the log of a recorded run says; makes a process repeat it."""

    def __init__(self) -> None:
        self._taken: dict[str, _Taken] = defaultdict(_Taken)
        self._reads: dict[str, dict[_Order, Mapping[str, Read] | None]] = defaultdict(dict)
        """Vertex → epoch and version of the frame → what it read, by input; None where it was left out."""
        self._accesses: dict[str, dict[_Order, list[Access]]] = defaultdict(dict)
        """Data process → epoch and version of the trigger → what it read, in its order."""

    def add(self, event: RecordedEvent, first: int) -> None:
        """Takes up an entry.

        Args:
            event: Of the topics `RUNS` and `READS`; others are left.
            first: The first epoch of the recording, which is the epoch 0 of the replay.

        Raises:
            ValueError: It is damaged.
        """
        if event.topic not in (RUNS, READS):
            return
        order = (event.epoch - first, event.version)
        place, what = event.value
        if event.topic == RUNS:
            self._taken[place].runs.append((*order, what))
        elif what is None:
            self._reads[place][order] = None
        elif isinstance(what, list):
            self._accesses[place][order] = [decode_access(noted, first) for noted in what]
        else:
            self._reads[place][order] = {name: _read(read, first) for name, read in what.items()}

    def __bool__(self) -> bool:
        return bool(self._taken)

    def apply(self, process: Process, topics: Container[str]) -> None:
        """Makes a process that has not started take the triggers of the log, and read what it says.

        Args:
            process: The components.
            topics: Those that the replay has: played, or committed by the components.
        """
        awaited = Awaited()
        for component in process.components.values():
            taken = self._taken.get(component.name)
            if not isinstance(component, DataProcessComponent) or taken is None or component.backlog is None:
                continue
            component.follow({(epoch, version) for epoch, version, _ in taken.runs}, awaited)
            for epoch, _, inputs in taken.runs:
                taken.needed.update((name, epoch, version) for name, version in inputs.items())
            for name in component.trigger_inputs:
                on_commit, on_settle = partial(self._on_commit, component, name), partial(self._on_settle, component)
                component.inputs[name].window.subscribe(on_commit, on_settle)
            if not isinstance(component, DagComponent):
                ReplayedAccesses(component, self._accesses[component.name], awaited, topics)
        for component in process.components.values():
            for vertex in component.vertices if isinstance(component, DagComponent) else ():
                place = f"{component.name}.{vertex.name}"
                recorded = RecordedReads(self._reads[place], component.inputs, awaited)
                vertex.processor.recorded, vertex.left_out = recorded, recorded.left_out

    def on_played(self, event: RecordedEvent, process: Process) -> None:
        """Gives the triggers of time that were taken here."""
        if event.topic != RUNS:
            return
        name, inputs = event.value
        component = process.components.get(name)
        if not inputs and isinstance(component, DataProcessComponent):
            self._taken[name].released += 1
            self._give(component)

    def _on_commit(self, component: DataProcessComponent, name: str, entry: Entry) -> None:
        taken, datum = self._taken[component.name], (name, entry.epoch, entry.version)
        if datum in taken.needed:
            taken.kept[datum] = entry
        self._give(component)

    def _on_settle(self, component: DataProcessComponent, version: int, epoch: int) -> None:
        self._give(component)

    def _give(self, component: DataProcessComponent) -> None:
        """Gives a component the next triggers of the log, as far as what triggered is there."""
        taken = self._taken[component.name]
        with taken.lock:
            while taken.given < len(taken.runs):
                epoch, version, inputs = taken.runs[taken.given]
                if not inputs and taken.given >= taken.released:
                    return
                data = {name: taken.kept.get((name, epoch, at)) for name, at in inputs.items()}
                missing = [name for name, entry in data.items() if entry is None]
                gone = any(_is_gone(component, name, epoch, inputs[name]) for name in missing)
                if missing and not gone:
                    return
                taken.given += 1
                for datum in ((name, epoch, at) for name, at in inputs.items()):
                    taken.needed[datum] -= 1
                    if not taken.needed[datum]:
                        del taken.needed[datum]
                        taken.kept.pop(datum, None)
                if gone:
                    component.losses.count(component.name, "not replayed", version)
                    component.settle(version, epoch)
                    continue
                now = component.clock.monotonic_ns()
                entries = {name: entry for name, entry in data.items() if entry is not None}
                received = next((entry.received_ns for entry in entries.values()), 0) or now
                component.give(Trigger(version, received, False, epoch, now, inputs), entries)


def _is_gone(component: DataProcessComponent, name: str, epoch: int, version: int) -> bool:
    """Whether what triggered the recorded run cannot come in the replay."""
    snapshot = component.inputs[name].window.snapshot(epoch)
    return snapshot.epoch == epoch and snapshot.miss(version) in (Miss.EVICTED, Miss.SETTLED_EMPTY)


def _read(recorded: Any, first: int) -> Read:
    """What an entry of the log says of one input."""
    if isinstance(recorded, str):
        return Outcome(recorded)
    epoch, version = recorded
    return epoch - first, version
