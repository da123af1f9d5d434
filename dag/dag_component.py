"""The kinds of components with a graph: DAG, and monotonic DAG."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar

from ..datamesh import Entry, Input, Output
from .component import DataProcessComponent
from .deadline import DeadlineConfig, FrameDeadline
from .engine import GraphEngine, Run, Vertex, VertexTiming
from .trigger import Trigger

__all__ = ["DagComponent", "MonotonicDagComponent"]


class DagComponent(DataProcessComponent):
    """A data process with a graph: each trigger runs the vertices, several frames may be in flight."""

    max_in_flight: ClassVar[int | None] = None
    """The most frames in flight that the kind allows; None is any number."""

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self.vertices: Sequence[Vertex] = ()
        """Of its graph."""
        self._engine: GraphEngine | None = None
        self._deadline: DeadlineConfig | None = None
        self._closed = self._stopping = False
        self._submitting = threading.Lock()
        self._given: dict[tuple[int, int], Mapping[str, Entry]] = {}
        self._free = 1
        self._slots = threading.Lock()
        self._idle = threading.Condition(self._slots)
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
        deadline: DeadlineConfig | None = None,
    ) -> None:
        """Sets the vertices, initialised, and how many frames may be in the graph at once."""
        if self.max_in_flight is not None:
            in_flight = min(in_flight, self.max_in_flight)
        self.vertices = vertices
        self._deadline = deadline
        self.in_flight = self._free = in_flight
        self._engine = GraphEngine(self.name, vertices, workers, on_timing)

    def at_work(self) -> dict[str, int]:
        """The vertices that are at work now, and the versions that they are at work on."""
        return {} if self._engine is None else self._engine.running()

    def give(self, trigger: Trigger, data: Mapping[str, Entry]) -> None:
        """Gives a trigger to a component that follows a replay, with its data."""
        self._given[trigger.epoch, trigger.version] = data
        super().give(trigger, data)

    def start(self) -> None:
        """Starts the workers. After a stop, initialises the processors once more first."""
        assert self._engine is not None, "set_graph comes first"
        self._engine.start()
        try:
            if self._closed:
                for vertex in self.vertices:
                    vertex.processor.init(vertex.config)
        except BaseException:
            self._engine.stop()
            raise
        self._closed = self._stopping = False
        self._free = self.in_flight
        super().start()

    def _start_serving(self) -> None:
        """The workers do that."""

    def _finish(self) -> None:
        """Finishes the frames that wait or are in flight, and closes the processors."""
        assert self._engine is not None
        assert self.backlog is not None
        backlog = self.backlog
        self._stopping = True
        self._advance()
        with self._idle:
            finished = self._idle.wait_for(
                lambda: self._free == self.in_flight and not backlog.waiting and not self._submitting.locked(),
                self.stop_timeout_s,
            )
        hanging = {} if finished else self._engine.running()
        ended = self._engine.stop(None if finished else 0.1)
        if not finished:
            self._hangs(hanging)
            self._drop_waiting()
        for vertex in self.vertices:
            if ended or vertex.name not in hanging:
                try:
                    vertex.processor.close()
                except Exception:
                    self.log.exception("%s.%s failed to close", self.name, vertex.name)
        self._closed = True

    def _is_busy(self) -> bool:
        return self._free == 0 or bool(self.backlog and self.backlog.waiting)

    def _takes_within_commit(self) -> Callable[[Trigger], object]:
        return self._offer

    def _offer(self, trigger: Trigger) -> None:
        backlog, inline = self.backlog, self._inline
        assert backlog is not None
        # The usual case, a frame that need not wait, goes past the backlog: between commit and start each call counts.
        if self._free > 0 and not trigger.settled and self._submitting.acquire(False):
            passes = self._free > 0 and not backlog.waiting and not backlog.closed
            try:
                if passes:
                    if backlog.on_taken is not None:
                        backlog.on_taken(trigger)
                    self._submit(trigger, inline)
            except Exception:
                self._could_not_start(trigger)
            finally:
                self._submitting.release()
            if passes:
                if inline and not self._runs_later:
                    self._advance()
                elif self._stopping:
                    self._wake_stop()
                return
        if backlog.offer(trigger) is not trigger and not self._runs_later:
            self._advance()

    def _advance(self) -> None:
        assert self.backlog is not None
        if self.backlog.waiting or self._stopping:
            self._submit_waiting(serves=self._inline)
        if self._inline and self._engine is not None:
            self._engine.serve()

    def _submit_waiting(self, *, serves: bool) -> None:
        """Submits what waits, while there is room in the graph; who calls says whether it serves the graph next."""
        assert self.backlog is not None
        while self.backlog.waiting and self._free > 0:
            with self._submitting:  # frames enter in their order
                # While no slot is free, triggers wait in the backlog, where its policy rules.
                trigger = self.backlog.take_now() if self._free > 0 else None
                if trigger is None:
                    break
                try:
                    self._submit(trigger, serves)
                except Exception:
                    self._could_not_start(trigger)
        if self._stopping:
            self._wake_stop()

    def _could_not_start(self, trigger: Trigger) -> None:
        self.log.exception("%s could not start at version %d", self.name, trigger.version)
        self.losses.count(self.name, "failed", trigger.version)
        self.settle(trigger.version, trigger.epoch)

    def _wake_stop(self) -> None:
        with self._idle:
            self._idle.notify_all()

    def _submit(self, trigger: Trigger, serves: bool) -> None:
        """Starts the graph for a trigger, or settles it. Called by one thread at a time."""
        if trigger.settled:
            self.settle(trigger.version, trigger.epoch)
            return
        data, given = {}, self._given and self._given.pop((trigger.epoch, trigger.version), None)
        for name, version in trigger.inputs.items():
            state = self._windows[name].state
            if given:
                entry = given[name]
            elif state.epoch == trigger.epoch and state.versions and state.versions[-1] == version:
                entry = state.entries[-1]  # the usual case, without a call
            else:
                entry = self._windows[name].find(version, trigger.epoch)
            if entry is None:
                miss = self._windows[name].snapshot(trigger.epoch).miss(version)
                self.losses.count(self.name, f"trigger {miss.value if miss else 'missing'}", trigger.version)
                self.settle(trigger.version, trigger.epoch)
                return
            written = entry.completion is None
            data[name] = entry.value if written else entry.read(getattr(self.context, "stream", None))
        with self._slots:
            self._free -= 1
        deadline = None
        if self._deadline is not None:
            deadline = FrameDeadline(self._deadline, trigger, self.clock, self.settle)
        assert self._engine is not None
        self._engine.submit(trigger, data, self._done, deadline, serves=serves)

    def _done(self, run: Run) -> None:
        trigger = run.trigger
        self.has_run = True
        for name, version in trigger.inputs.items():
            if self._windows[name].check:
                self._windows[name].verify_version(version, trigger.epoch)
        if run.deadline is not None and run.deadline.end():
            self.losses.count(self.name, "deadline", trigger.version)
        if run.error is not None:
            self.losses.count(f"{self.name}.{run.failed_vertex}", "failed", trigger.version)
        try:
            self.settle(trigger.version, trigger.epoch)
        finally:
            with self._slots:
                self._free += 1
            self._submit_waiting(serves=True)


class MonotonicDagComponent(DagComponent):
    """An exclusive proxy of a graph that keeps state: one frame at a time, none older than the last started."""

    max_in_flight = 1

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._last_started = (-1, -1)

    def _submit(self, trigger: Trigger, serves: bool) -> None:
        order = (trigger.epoch, trigger.version)
        if not trigger.settled:
            if order <= self._last_started:
                self.losses.count(self.name, "out_of_order", trigger.version)
                self.settle(trigger.version, trigger.epoch)
                return
            self._last_started = order
        super()._submit(trigger, serves)
