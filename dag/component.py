"""The kinds of components: generic, data process, DAG, and monotonic DAG."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from pydantic import BaseModel

from ..datamesh import DataMesh, Entry, Input, LossCounters, Output, Status, declared_handles
from .backlog import Backlog, BacklogConfig
from .engine import GraphEngine, Run, Vertex, VertexTiming
from .processor import ProcessorConfig
from .trigger import Trigger

__all__ = [
    "Component",
    "DagComponent",
    "DataProcessComponent",
    "GenericComponent",
    "MonotonicDagComponent",
]

_log = logging.getLogger(__name__)


class Component:
    """The base: a named part of a process, which the process starts and stops."""

    Config: ClassVar[type[BaseModel]] = ProcessorConfig
    """The model of its configuration; a subclass names its own."""

    def __init__(self, name: str, context: Any = None) -> None:
        """Makes an unbound component.

        Args:
            name: Unique in its process.
            context: What the process gives to all its components: devices, capacities, models.
        """
        self.name = name
        self.context = context
        self.inputs: dict[str, Input] = {}
        self.outputs: dict[str, Output] = {}
        for handle_name, handle in declared_handles(type(self)).items():
            (self.inputs if isinstance(handle, Input) else self.outputs)[handle_name] = handle  # type: ignore[assignment]
            setattr(self, handle_name, handle)
        self.losses = LossCounters()

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Connects the handles to their topics in the mesh."""
        self.losses = mesh.losses
        for name, handle in (*self.inputs.items(), *self.outputs.items()):
            handle.bind(name, mesh.window(topics[name]))

    def init(self, config: Any) -> None:
        """Prepares: `config` is an instance of `Config`."""

    def start(self) -> None:
        """Starts whatever runs."""

    def stop(self) -> None:
        """Finishes what waits, then stops; no thread of it is left."""


class GenericComponent(Component):
    """Any plain class as a component: it is made with the configuration, and its `start` and `stop`, if any, called."""

    def __init__(self, name: str, plain: type, config: Mapping[str, Any], context: Any = None) -> None:
        """Makes an instance of the class.

        Args:
            name: Unique in its process.
            plain: The class.
            config: Arguments for its constructor.
            context: As for every component.
        """
        super().__init__(name, context)
        self.instance = plain(**config)

    def start(self) -> None:
        """Calls the instance's `start`, if it has one."""
        getattr(self.instance, "start", lambda: None)()

    def stop(self) -> None:
        """Calls the instance's `stop`, if it has one."""
        getattr(self.instance, "stop", lambda: None)()


class DataProcessComponent(Component):
    """Computes: reads and writes the mesh, once for each message on its trigger input.

    A subclass declares handles and overrides `process`. An exception in it costs that frame, is counted and logged.
    """

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self.trigger_input: str | None = None
        self._backlog: Backlog | None = None
        self._thread: threading.Thread | None = None

    def process(self, trigger: Trigger) -> Status:
        """Runs for one trigger."""
        raise NotImplementedError

    def set_trigger(self, input_name: str, backlog: BacklogConfig) -> None:
        """Makes each commit to an input a trigger. The component must be bound."""
        self.trigger_input = input_name
        self._backlog = Backlog(self.name, backlog, self.losses)
        window = self.inputs[input_name].window
        window.subscribe(self._on_commit, self._on_settle)

    def _on_commit(self, entry: Entry) -> None:
        self._offer(Trigger(entry.version, entry.received_ns, settled=not entry.triggers))

    def _on_settle(self, version: int, epoch: int) -> None:
        self._offer(Trigger(version, settled=True))

    def _offer(self, trigger: Trigger) -> None:
        if self._backlog is not None:
            dropped = self._backlog.offer(trigger)
            if dropped is not None:
                self.settle(dropped.version)

    def settle(self, version: int) -> None:
        """Says on every output that was not committed at `version` that there will be nothing."""
        for output in self.outputs.values():
            output.settle(version)

    def start(self) -> None:
        """Starts the thread that serves the triggers."""
        if self._backlog is not None:
            self._thread = threading.Thread(target=self._serve, name=self.name, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Serves what waits, then ends the thread."""
        if self._backlog is not None:
            self._backlog.close()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _serve(self) -> None:
        assert self._backlog is not None
        while (trigger := self._backlog.take()) is not None:
            if trigger.settled:
                self.settle(trigger.version)
            else:
                self._run(trigger)

    def _run(self, trigger: Trigger) -> None:
        try:
            self.process(trigger)
        except BaseException:  # also SystemExit: only the process as a whole may end the thread
            _log.exception("%s failed at version %d", self.name, trigger.version)
            self.losses.count(self.name, "failed", trigger.version)
        self.settle(trigger.version)


class DagComponent(DataProcessComponent):
    """A data process with a graph: each trigger runs the vertices, several frames may be in flight."""

    max_in_flight: ClassVar[int | None] = None
    """The most frames in flight that the kind allows; None is any number."""

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._engine: GraphEngine | None = None
        self._vertices: Sequence[Vertex] = ()
        self._slots = threading.Semaphore(1)
        self.in_flight = 1

    def add_handles(self, inputs: Sequence[str], outputs: Sequence[str]) -> None:
        """Adds the inputs and outputs that the configuration names; the class need not declare them."""
        for name in inputs:
            self.inputs.setdefault(name, Input())
        for name in outputs:
            self.outputs.setdefault(name, Output())

    def set_graph(
        self,
        vertices: Sequence[Vertex],
        *,
        workers: int,
        in_flight: int,
        on_timing: Callable[[VertexTiming], None] | None = None,
    ) -> None:
        """Sets the vertices, initialised, and how many frames may be in the graph at once."""
        if self.max_in_flight is not None:
            in_flight = min(in_flight, self.max_in_flight)
        self._vertices = vertices
        self.in_flight = in_flight
        self._slots = threading.Semaphore(in_flight)
        self._engine = GraphEngine(self.name, vertices, workers, on_timing)

    def start(self) -> None:
        """Starts the workers and the thread that serves the triggers."""
        assert self._engine is not None, "set_graph comes first"
        self._engine.start()
        super().start()

    def stop(self) -> None:
        """Finishes the frames that wait or are in flight, then stops."""
        super().stop()
        for _ in range(self.in_flight):
            self._slots.acquire()
        self._slots.release(self.in_flight)
        if self._engine is not None:
            self._engine.stop()
        for vertex in self._vertices:
            try:
                vertex.processor.close()
            except Exception:
                _log.exception("%s.%s failed to close", self.name, vertex.name)

    def _serve(self) -> None:
        assert self._backlog is not None
        while True:
            # The slot comes first: while none is free, triggers wait in the backlog, where its policy rules.
            self._slots.acquire()
            trigger = self._backlog.take()
            if trigger is None or trigger.settled or not self._submit(trigger):
                self._slots.release()
            if trigger is None:
                return
            if trigger.settled:
                self.settle(trigger.version)

    def _submit(self, trigger: Trigger) -> bool:
        """Starts the graph for a trigger, or settles it; tells whether it started."""
        assert self._engine is not None
        assert self.trigger_input is not None
        with self.inputs[self.trigger_input].access() as snapshot:
            index = snapshot.version_index(trigger.version)
            if index < 0:
                miss = snapshot.miss(trigger.version)
                self.losses.count(self.name, f"trigger {miss.value if miss else 'missing'}", trigger.version)
                self.settle(trigger.version)
                return False
            data = {self.trigger_input: snapshot[index]}
        self._engine.submit(trigger, data, self._done)
        return True

    def _done(self, run: Run) -> None:
        if run.error is not None:
            self.losses.count(f"{self.name}.{run.failed_vertex}", "failed", run.trigger.version)
        try:
            self.settle(run.trigger.version)
        finally:
            self._slots.release()


class MonotonicDagComponent(DagComponent):
    """An exclusive proxy of a graph that keeps state: one frame at a time, none older than the last started."""

    max_in_flight = 1

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._last_started = -1

    def _submit(self, trigger: Trigger) -> bool:
        if trigger.version <= self._last_started:
            self.losses.count(self.name, "out_of_order", trigger.version)
            self.settle(trigger.version)
            return False
        self._last_started = trigger.version
        return super()._submit(trigger)
