"""Processors that connect a graph to the DataMesh: weak sync, strong sync, and the commit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from pydantic import Field

from ..datamesh import CURRENT_EPOCH, CommitPolicy, Entry, EqualVersion, Input, Outcome, Reorder, Status, Waiting
from ..datamesh.payload import holds_device_array
from .configuration import nearest
from .processor import In, Out, Processor, ProcessorConfig
from .trigger import Trigger

__all__ = ["AlignDagProcessor", "Aligned", "CommitDagProcessor", "GetRecentDagProcessor"]


def _input_of(processor: Processor, name: str) -> Input:
    if name not in processor.component_inputs:
        raise ValueError(f"the component has no input {name!r}; {nearest(name, processor.component_inputs)}")
    return processor.component_inputs[name]


def _begin_waits(waits: Iterable[Callable[[Callable[[Waiting], None]], Waiting]], resume: Callable[[], None]) -> bool:
    """Begins several waits, of which the last to end resumes; False where all have ended at once."""
    lock = threading.Lock()
    begun, ended, waiting = 0, 0, False

    def on_end(_: Waiting) -> None:
        nonlocal ended
        with lock:
            ended += 1
            last = waiting and ended == begun
        if last:
            resume()

    for begin in waits:
        begin(on_end)
        begun += 1
    with lock:
        waiting = ended < begun
    return waiting


class _GetRecentConfig(ProcessorConfig):
    input: str
    """The component's input to look at."""
    max_age_ms: float | None = Field(None, ge=0.0, le=86_400_000.0)
    """How much older than the trigger the datum may be [ms]; null is any age."""


class GetRecentDagProcessor(Processor):
    """Weak sync: looks, and returns at once. The newest datum that is not newer than the trigger, if there is one.

    Of an epoch before the trigger's, the newest is taken where `max_age_ms` is null: ages do not reach across epochs.
    """

    Config = _GetRecentConfig
    waits = True

    value: Out[Any]
    version: Out[int]

    def check(self, config: _GetRecentConfig) -> None:
        """Looks whether the component has the input."""
        _input_of(self, config.input)

    def init(self, config: _GetRecentConfig) -> None:
        """Finds the input."""
        self._input = _input_of(self, config.input)
        self._max_age = None if config.max_age_ms is None else round(config.max_age_ms * 1e6)
        self._name = config.input
        self._recorded: Waiting | None = None

    def begin(self, trigger: Trigger, resume: Callable[[], None]) -> bool:
        """Waits in a replay alone, for what the recorded run read."""
        recorded = self.recorded
        read = None if recorded is None else recorded.of(trigger).get(self._name)
        if recorded is None or not isinstance(read, tuple):
            return False

        def begin(on_end: Callable[[Waiting], None]) -> Waiting:
            self._recorded = self._input.when(read[1], on_end, epoch=read[0])
            return self._recorded

        return recorded.wait(partial(_begin_waits, [begin]), resume)

    def process(self, trigger: Trigger) -> Status:
        """Gives value and version, or neither, which is a MISS."""
        stream = getattr(self.context, "stream", None)
        if self.recorded is None:
            found = self._look(trigger)
        else:
            waiting, self._recorded = self._recorded, None
            kept = self.recorded.take(trigger).get(self._name)
            found = kept or (waiting.entry if waiting is not None else None)
        if found is None:
            return Status.MISS
        self.value.value, self.version.value = found.read(stream), found.version
        self.reads[self._name] = (found.epoch, found.version)
        return Status.OK

    def _look(self, trigger: Trigger) -> Entry | None:
        current = self._input.window.epoch
        epoch = current if trigger.epoch == CURRENT_EPOCH else min(trigger.epoch, current)
        with self._input.access(epoch) as snapshot:
            if trigger.epoch in (epoch, CURRENT_EPOCH):
                index = snapshot.until(trigger.version)
                if index >= 0 and self._max_age is not None:
                    index = index if trigger.version - snapshot.versions[index] <= self._max_age else -1
            else:
                index = len(snapshot) - 1 if self._max_age is None else -1
            return snapshot.entry(index) if index >= 0 else None


@dataclass(frozen=True)
class Aligned:
    """Data of several inputs that belong to one version."""

    values: Mapping[str, Any]
    """What was found, by input."""
    versions: Mapping[str, int]
    """The versions of what was found, by input [ns]."""
    outcomes: Mapping[str, Outcome]
    """How each wait ended, by input."""

    @property
    def absent(self) -> tuple[str, ...]:
        """The inputs of which nothing was found."""
        return tuple(name for name, outcome in self.outcomes.items() if outcome is not Outcome.FOUND)


class _AlignConfig(ProcessorConfig):
    inputs: tuple[str, ...] = Field(min_length=1)
    """The component's inputs to wait for."""
    timeout_ms: float = Field(ge=0.0, le=86_400_000.0)
    """From the trigger to the end of the wait [ms]; at zero it only looks."""
    tolerance_ms: float = Field(0.0, ge=0.0, le=86_400_000.0)
    """How far from the trigger's version those of the inputs may be [ms]."""
    partial: bool = True
    """Whether what was found is given on when something is absent."""


class AlignDagProcessor(Processor):
    """Strong sync: waits until every input has the trigger's version, or cannot have it, or the time is over.

    The time counts from the trigger. The worker is given back meanwhile; later frames wait behind.
    """

    Config = _AlignConfig
    waits = True

    aligned: Out[Aligned]

    def check(self, config: _AlignConfig) -> None:
        """Looks whether the component has the inputs."""
        for name in config.inputs:
            _input_of(self, name)

    def init(self, config: _AlignConfig) -> None:
        """Finds the inputs."""
        self._inputs = {name: _input_of(self, name) for name in config.inputs}
        self._timeout, self._tolerance = round(config.timeout_ms * 1e6), round(config.tolerance_ms * 1e6)
        self._partial = config.partial
        self._waits: dict[str, Waiting] = {}
        self._ended: dict[str, Outcome] = {}

    def begin(self, trigger: Trigger, resume: Callable[[], None]) -> bool:
        """Waits for all inputs at once."""
        recorded = None
        if self.recorded is not None:
            reads = self.recorded.of(trigger)
            recorded = {name: read for name, read in reads.items() if isinstance(read, tuple)}
            self._ended = {name: read for name, read in reads.items() if isinstance(read, Outcome)}

        def begin(name: str, on_end: Callable[[Waiting], None]) -> Waiting:
            handle = self._inputs[name]
            if recorded is None:
                at = handle.window.clock.monotonic_ns() if trigger.at_ns is None else trigger.at_ns
                waiting = handle.when(
                    trigger.version,
                    on_end,
                    due_ns=at + self._timeout,
                    tolerance_ns=self._tolerance,
                    epoch=trigger.epoch,
                )
            else:
                epoch, version = recorded[name]
                waiting = handle.when(version, on_end, epoch=epoch)
            self._waits[name] = waiting
            return waiting

        names = [name for name in self._inputs if recorded is None or name in recorded]
        waits = partial(_begin_waits, [partial(begin, name) for name in names])
        return waits(resume) if self.recorded is None else self.recorded.wait(waits, resume)

    def process(self, trigger: Trigger) -> Status:
        """Gives what was found. OK if all was; else SHUTDOWN, TIMEOUT or MISS, and what is absent is counted."""
        waits, self._waits = self._waits, {}
        stream = getattr(self.context, "stream", None)
        found = {name: waiting.entry for name, waiting in waits.items() if waiting.entry is not None}
        if self.recorded is not None:
            found.update(self.recorded.take(trigger))
        found = {name: found[name] for name in self._inputs if name in found}
        outcomes, self._ended = self._ended, {}
        outcomes.update({name: waiting.outcome for name, waiting in waits.items() if waiting.outcome is not None})
        outcomes.update(dict.fromkeys(found, Outcome.FOUND))
        outcomes = {name: outcomes.get(name, Outcome.TIMEOUT) for name in self._inputs}
        for name, outcome in outcomes.items():
            self.reads[name] = (found[name].epoch, found[name].version) if name in found else outcome
        absent = [name for name in self._inputs if name not in found]
        for name in absent:
            self.losses.count(self.place, f"{name} {outcomes[name].value}", trigger.version)
        if not absent or self._partial:
            self.aligned.value = Aligned(
                {name: entry.read(stream) for name, entry in found.items()},
                {name: entry.version for name, entry in found.items()},
                outcomes,
            )
        if not absent:
            return Status.OK
        for outcome, status in ((Outcome.SHUTDOWN, Status.SHUTDOWN), (Outcome.TIMEOUT, Status.TIMEOUT)):
            if outcome in outcomes.values():
                return status
        return Status.MISS


class _CommitConfig(ProcessorConfig):
    output: str
    """The component's output to commit to."""
    policy: Literal["discard_out_of_order", "insert_sorted", "reorder", "reject", "overwrite", "force_new_epoch"] = (
        "discard_out_of_order"
    )
    """What to do with a version that is older than the newest."""
    equal: Literal["keep_first", "replace", "error"] = "keep_first"
    """What to do with a version that is there already."""
    triggers: bool | None = None
    """Whether it starts runs; null: if it becomes the newest."""
    delay_ms: float = Field(100.0, ge=0.0, le=86_400_000.0)
    """How long `reorder` holds a datum back at most [ms]."""
    depth: int = Field(4, ge=0, le=1 << 16)
    """How many data `reorder` holds back at most."""


class CommitDagProcessor(Processor):
    """A vertex that sends a datum to the mesh, at the version of the trigger.

    Where the context has a `stream`, on which processors launch, arrays on a device are committed with its
    `completion()`: readers on the host or on other streams wait until they are written.
    """

    Config = _CommitConfig

    value: In[Any]

    def check(self, config: _CommitConfig) -> None:
        """Looks whether the component has the output."""
        if config.output not in self.component_outputs:
            known = nearest(config.output, self.component_outputs)
            raise ValueError(f"the component has no output {config.output!r}; {known}")

    def init(self, config: _CommitConfig) -> None:
        """Finds the output."""
        self._output = self.component_outputs[config.output]
        self._policy: CommitPolicy | Reorder
        if config.policy == "reorder":
            self._policy = Reorder(round(config.delay_ms * 1e6), config.depth)
        else:
            self._policy = CommitPolicy[config.policy.upper()]
        self._equal = EqualVersion[config.equal.upper()]
        self._triggers = config.triggers

    def process(self, trigger: Trigger) -> Status:
        """Commits; what the policy does not keep is counted."""
        with self._output.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns, epoch=trigger.epoch)
            change.value = value = self.value.value
            if getattr(self.context, "stream", None) is not None and holds_device_array(value):
                change.completes_with(self.context.completion())
            return self._output.commit(self._policy, change, equal=self._equal, triggers=self._triggers)
