"""The graph engine: runs the vertices of a graph for each frame, branches side by side, several frames in flight.

A vertex is one processor. It starts as soon as its inputs are there, serves one frame at a time, and takes the frames
in the order of their versions; so whatever it keeps from frame to frame, and the order of what it commits, do not
depend on how many workers there are.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from ..datamesh import Status
from .processor import Processor
from .trigger import Trigger

__all__ = ["GraphEngine", "Run", "Vertex", "VertexTiming"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class VertexTiming:
    """How one vertex ran for one frame; times from `time.perf_counter_ns`."""

    component: str
    vertex: str
    version: int
    ready_ns: int
    """When its inputs were there."""
    start_ns: int
    end_ns: int
    status: Status

    @property
    def wait_ms(self) -> float:
        """Time in the queue [ms]."""
        return (self.start_ns - self.ready_ns) / 1e6

    @property
    def run_ms(self) -> float:
        """Time in the processor [ms]."""
        return (self.end_ns - self.start_ns) / 1e6


@dataclass(eq=False, slots=True)
class Vertex:
    """A processor in its place in the graph."""

    name: str
    processor: Processor
    inputs: Mapping[str, str]
    """In port → name of the datum."""
    outputs: Mapping[str, str]
    """Out port → name of the datum."""
    successors: list[Vertex] = field(default_factory=list)
    predecessors: int = 0
    queue: deque[Run] = field(default_factory=deque)
    """Frames that it has not started, in the order of versions."""
    busy: bool = False


@dataclass(eq=False, slots=True)
class Run:
    """One frame on its way through the graph."""

    trigger: Trigger
    data: dict[str, Any]
    on_done: Callable[[Run], None]
    waiting: dict[Vertex, int] = field(default_factory=dict)
    """Predecessors that have yet to finish, by vertex."""
    ready_ns: dict[Vertex, int] = field(default_factory=dict)
    remaining: int = 0
    error: BaseException | None = None
    failed_vertex: str = ""


class GraphEngine:
    """A pool of workers for one graph. The graph must be sound: `dag.graph` checks it."""

    def __init__(
        self,
        name: str,
        vertices: Sequence[Vertex],
        workers: int,
        on_timing: Callable[[VertexTiming], None] | None = None,
    ) -> None:
        """Connects the vertices by the names of their data; `start` starts the workers.

        Args:
            name: Of the component, for threads, logs and timings.
            vertices: All vertices; their ports are mapped to data.
            workers: Threads, ≥ 1.
            on_timing: Is told of every vertex's run, in the worker's thread.

        Raises:
            ValueError: There is no vertex.
        """
        if not vertices:
            raise ValueError(f"the graph of {name!r} has no vertices: nothing would ever finish a frame")
        self.name = name
        self._vertices = vertices
        self._worker_count = workers
        self._on_timing = on_timing
        self._ready: deque[tuple[Vertex, Run]] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._threads: list[threading.Thread] = []
        producers = {datum: vertex for vertex in vertices for datum in vertex.outputs.values()}
        for vertex in vertices:
            sources = {id(producers[d]): producers[d] for d in vertex.inputs.values() if d in producers}
            vertex.predecessors = len(sources)
            for source in sources.values():
                source.successors.append(vertex)

    def start(self) -> None:
        """Starts the workers."""
        for number in range(self._worker_count):
            thread = threading.Thread(target=self._work, name=f"{self.name}-worker-{number}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self) -> None:
        """Lets the running vertices finish, drops what is queued, and joins the workers."""
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._threads.clear()

    def submit(self, trigger: Trigger, data: dict[str, Any], on_done: Callable[[Run], None]) -> None:
        """Starts a frame. Frames must be submitted in the order of versions.

        Args:
            trigger: Of the frame.
            data: The component's inputs by name; those that are missing are absent.
            on_done: Called in a worker's thread when every vertex has run or was skipped.
        """
        run = Run(trigger, data, on_done, remaining=len(self._vertices))
        now = time.perf_counter_ns()
        with self._changed:
            for vertex in self._vertices:
                run.waiting[vertex] = vertex.predecessors
                vertex.queue.append(run)
            for vertex in self._vertices:
                if vertex.predecessors == 0:
                    run.ready_ns[vertex] = now
                    self._changed.notify(self._offer(vertex))

    def _offer(self, vertex: Vertex) -> int:
        """Makes the vertex's next frame ready to run if both are; gives how many it made. Called with the lock held."""
        if vertex.busy or not vertex.queue or vertex.queue[0].waiting[vertex] > 0:
            return 0
        vertex.busy = True
        self._ready.append((vertex, vertex.queue.popleft()))
        return 1

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._ready and not self._stopping:
                    self._changed.wait()
                if self._stopping:
                    return
                vertex, run = self._ready.popleft()
            self._execute(vertex, run)
            now = time.perf_counter_ns()
            with self._changed:
                vertex.busy = False
                run.remaining -= 1
                done = run.remaining == 0
                ready = 0
                for successor in vertex.successors:
                    run.waiting[successor] -= 1
                    if run.waiting[successor] == 0:
                        run.ready_ns[successor] = now
                        ready += self._offer(successor)
                ready += self._offer(vertex)
                # One is for this worker, without a change of threads, unless it has a frame to hand over first.
                self._changed.notify(ready if done else max(0, ready - 1))
            if done:
                self._tell(run.on_done, run)
            del vertex, run  # a worker that waits must not keep a frame alive

    def _tell(self, callback: Callable[[Any], None], event: Any) -> None:
        """Calls back; a worker outlives whatever it calls, or the frames behind it would never end."""
        try:
            callback(event)
        except Exception:
            _log.exception("%s: a callback failed", self.name)

    def _execute(self, vertex: Vertex, run: Run) -> None:
        processor = vertex.processor
        start = time.perf_counter_ns()
        runnable = True
        for name, datum in vertex.inputs.items():
            port = processor.ports[name]
            if datum in run.data:
                port.value = run.data[datum]
            else:
                port.clear()
                runnable = runnable and port.optional
        for name in vertex.outputs:
            processor.ports[name].clear()
        if not runnable:
            status = Status.SKIPPED
        else:
            try:
                status = processor.process(run.trigger)
                if not isinstance(status, Status):
                    raise TypeError(f"process of {type(processor).__name__} returned {status!r}, not a Status")
            except BaseException as error:  # also SystemExit: only the process as a whole may end a worker
                status = Status.FAILED
                run.error, run.failed_vertex = error, vertex.name
                _log.exception("%s.%s failed at version %d", self.name, vertex.name, run.trigger.version)
            else:
                for name, datum in vertex.outputs.items():
                    if processor.ports[name].present:
                        run.data[datum] = processor.ports[name].value
        for port in processor.ports.values():
            port.clear()
        if self._on_timing is not None:
            ready = run.ready_ns.get(vertex, start)
            version = run.trigger.version
            timing = VertexTiming(self.name, vertex.name, version, ready, start, time.perf_counter_ns(), status)
            self._tell(self._on_timing, timing)
