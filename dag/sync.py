"""Processors that connect a graph to the DataMesh: weak sync, strong sync, and the commit."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from ..datamesh import CURRENT_EPOCH, CommitPolicy, EqualVersion, Input, Outcome, Reorder, Status, Waiting
from .processor import In, Out, Processor, ProcessorConfig
from .trigger import Trigger

__all__ = ["AlignDagProcessor", "Aligned", "CommitDagProcessor", "GetRecentDagProcessor"]


def _input_of(processor: Processor, name: str) -> Input:
    if name not in processor.component_inputs:
        known = ", ".join(processor.component_inputs) or "none"
        raise ValueError(f"the component has no input {name!r}; it has: {known}")
    return processor.component_inputs[name]


class _GetRecentConfig(ProcessorConfig):
    input: str
    """The component's input to look at."""
    max_age_ms: float | None = Field(None, ge=0.0)
    """How much older than the trigger the datum may be [ms]; null is any age."""


class GetRecentDagProcessor(Processor):
    """Weak sync: looks, and returns at once. The newest datum that is not newer than the trigger, if there is one.

    Of an epoch before the trigger's, the newest is taken where `max_age_ms` is null: ages do not reach across epochs.
    """

    Config = _GetRecentConfig

    value: Out[Any]
    version: Out[int]

    def init(self, config: _GetRecentConfig) -> None:
        """Finds the input.

        Raises:
            ValueError: The component has no such input.
        """
        self._input = _input_of(self, config.input)
        self._max_age = None if config.max_age_ms is None else round(config.max_age_ms * 1e6)

    def process(self, trigger: Trigger) -> Status:
        """Gives value and version, or neither, which is a MISS."""
        current = self._input.window.epoch
        epoch = current if trigger.epoch == CURRENT_EPOCH else min(trigger.epoch, current)
        with self._input.access(epoch, getattr(self.context, "stream", None)) as snapshot:
            if trigger.epoch in (epoch, CURRENT_EPOCH):
                index = snapshot.until(trigger.version)
                old = index >= 0 and self._max_age is not None
                if old and trigger.version - snapshot.versions[index] > (self._max_age or 0):
                    index = -1
            else:
                index = len(snapshot) - 1 if self._max_age is None else -1
            if index < 0:
                return Status.MISS
            self.value.value, self.version.value = snapshot[index], snapshot.versions[index]
        return Status.OK


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
    timeout_ms: float = Field(ge=0.0)
    """From the trigger to the end of the wait [ms]; at zero it only looks."""
    tolerance_ms: float = Field(0.0, ge=0.0)
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

    def init(self, config: _AlignConfig) -> None:
        """Finds the inputs.

        Raises:
            ValueError: The component has no such input.
        """
        self._inputs = {name: _input_of(self, name) for name in config.inputs}
        self._timeout, self._tolerance = round(config.timeout_ms * 1e6), round(config.tolerance_ms * 1e6)
        self._partial = config.partial
        self._waits: dict[str, Waiting] = {}

    def begin(self, trigger: Trigger, resume: Callable[[], None]) -> bool:
        """Waits for all inputs at once."""
        lock = threading.Lock()
        left, waits = len(self._inputs), False

        def on_end(_: Waiting) -> None:
            nonlocal left
            with lock:
                left -= 1
                over = left == 0 and waits
            if over:
                resume()

        for name, handle in self._inputs.items():
            clock = handle.window.clock
            self._waits[name] = handle.when(
                trigger.version,
                on_end,
                due_ns=(clock.monotonic_ns() if trigger.at_ns is None else trigger.at_ns) + self._timeout,
                tolerance_ns=self._tolerance,
                epoch=trigger.epoch,
            )
        with lock:
            waits = left > 0
        return waits

    def process(self, trigger: Trigger) -> Status:
        """Gives what was found. OK if all was; else SHUTDOWN, TIMEOUT or MISS, and what is absent is counted."""
        waits, self._waits = self._waits, {}
        stream = getattr(self.context, "stream", None)
        outcomes = {name: waiting.outcome or Outcome.TIMEOUT for name, waiting in waits.items()}
        found = {name: waiting.entry for name, waiting in waits.items() if waiting.entry is not None}
        absent = [name for name in waits if name not in found]
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
    delay_ms: float = Field(100.0, ge=0.0)
    """How long `reorder` holds a datum back at most [ms]."""
    depth: int = Field(4, ge=0)
    """How many data `reorder` holds back at most."""


class CommitDagProcessor(Processor):
    """A vertex that sends a datum to the mesh, at the version of the trigger."""

    Config = _CommitConfig

    value: In[Any]

    def init(self, config: _CommitConfig) -> None:
        """Finds the output.

        Raises:
            ValueError: The component has no such output.
        """
        if config.output not in self.component_outputs:
            known = ", ".join(self.component_outputs) or "none"
            raise ValueError(f"the component has no output {config.output!r}; it has: {known}")
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
            change.value = self.value.value
            return self._output.commit(self._policy, change, equal=self._equal, triggers=self._triggers)
