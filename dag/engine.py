"""The graph engine: runs the vertices of a graph for each frame, branches side by side, several frames in flight.

A vertex is one processor. It starts as soon as its inputs are there, serves one frame at a time, and takes the frames
in the order of their versions; so whatever it keeps from frame to frame, and the order of what it commits, do not
depend on how many workers there are. A vertex that waits for data of the mesh gives its worker back meanwhile.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, NamedTuple

from ..datamesh import Status
from .deadline import FrameDeadline
from .logs import component_logger
from .processor import Processor, Wiring
from .recorded_reads import Read
from .trigger import Trigger

__all__ = ["GraphEngine", "Run", "Vertex", "VertexTiming"]


class VertexTiming(NamedTuple):
    """How one vertex, or a data process, ran for one frame; times from `time.perf_counter_ns`."""

    component: str
    vertex: str
    version: int
    ready_ns: int
    """When its inputs were there."""
    start_ns: int
    end_ns: int
    status: Status
    late: bool = False
    """Whether it ended later after `ready_ns` than its deadline allows."""
    epoch: int = 0
    reads: Mapping[str, Read] = MappingProxyType({})
    """What it read of inputs that did not trigger it, by input."""

    @property
    def wait_ms(self) -> float:
        """Time in the queue, and waiting for data of the mesh [ms]."""
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
    config: Any = None
    """What its processor is initialised with, again when a component that was stopped starts."""
    deadline_ns: int | None = None
    """From when its inputs are there to its end; what takes longer is counted [ns]."""
    expendable: bool = False
    """Whether it is left out in a frame past its deadline, where the component degrades such frames."""
    left_out: Container[tuple[int, int]] = ()
    """Epochs and versions of the frames in which it is left out in any case: a replay says them."""
    number: int = 0
    """Its place in the graph."""
    wiring: Wiring | None = None
    successors: list[Vertex] = field(default_factory=list)
    predecessors: int = 0
    queue: deque[Run] = field(default_factory=deque)
    """Frames that it has not started, in the order of versions."""
    running: Run | None = None


@dataclass(eq=False, slots=True)
class Run:
    """One frame on its way through the graph."""

    trigger: Trigger
    data: dict[str, Any]
    on_done: Callable[[Run], None]
    waiting: list[int]
    """Predecessors that have yet to finish, by the vertex's number."""
    ready_ns: list[int]
    """When the inputs of each vertex were there."""
    remaining: int
    """Vertices that have yet to finish."""
    error: BaseException | None = None
    failed_vertex: str = ""
    deadline: FrameDeadline | None = None


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
            ValueError: There is no vertex, or no worker.
        """
        if workers < 1:
            raise ValueError(f"workers must be >= 1, not {workers}: nobody would run the graph of {name!r}")
        if not vertices:
            raise ValueError(f"the graph of {name!r} has no vertices: nothing would ever finish a frame")
        self.name = name
        self._vertices = vertices
        self._worker_count = workers
        self._on_timing = on_timing
        self._ready: deque[tuple[Vertex, Run, bool]] = deque()
        self._lock = threading.Lock()
        # A queue in C wakes its thread in half the time that a condition does.
        self._wakes: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._sleepers = 0
        self._stopping = False
        self._threads: list[threading.Thread] = []
        producers = {datum: vertex for vertex in vertices for datum in vertex.outputs.values()}
        for number, vertex in enumerate(vertices):
            vertex.number = number
            vertex.wiring = Wiring(vertex.processor, vertex.inputs, vertex.outputs)
            sources = {id(producers[d]): producers[d] for d in vertex.inputs.values() if d in producers}
            vertex.predecessors = len(sources)
            for source in sources.values():
                source.successors.append(vertex)
        self._predecessors = [vertex.predecessors for vertex in vertices]
        self._roots = [vertex for vertex in vertices if vertex.predecessors == 0]

    def start(self) -> None:
        """Starts the workers.

        Raises:
            RuntimeError: A worker from before the last stop still hangs in a processor.
        """
        hanging = self.running()
        if hanging:
            raise RuntimeError(f"{self.name} cannot start again: {hanging} still runs since the last stop")
        for vertex in self._vertices:
            vertex.queue.clear()
        self._stopping = False
        for number in range(self._worker_count):
            thread = threading.Thread(target=self._work, name=f"{self.name}-worker-{number}", daemon=True)
            self._threads.append(thread)
            thread.start()

    def stop(self, timeout: float | None = None) -> bool:
        """Lets the running vertices finish, drops what is queued, and joins the workers.

        Args:
            timeout: How long running vertices may take [s]; None is for ever.

        Returns:
            Whether they all finished. Workers that did not are left to themselves.
        """
        with self._lock:
            self._stopping = True
            self._ready.clear()
            sleepers, self._sleepers = self._sleepers, 0
        for _ in range(sleepers):
            self._wakes.put(None)
        until = None if timeout is None else time.monotonic() + timeout
        for thread in self._threads:
            thread.join(None if until is None else max(0.0, until - time.monotonic()))
        finished = not any(thread.is_alive() for thread in self._threads)
        self._threads.clear()
        if finished:
            for vertex in self._vertices:
                vertex.running = None
        return finished

    def running(self) -> dict[str, int]:
        """The vertices that are at work, and the versions that they are at work on."""
        with self._lock:
            return {v.name: v.running.trigger.version for v in self._vertices if v.running is not None}

    def submit(
        self,
        trigger: Trigger,
        data: dict[str, Any],
        on_done: Callable[[Run], None],
        deadline: FrameDeadline | None = None,
        *,
        serves: bool = False,
    ) -> None:
        """Starts a frame. Frames must be submitted in the order of versions.

        Args:
            trigger: Of the frame.
            data: The component's inputs by name; those that are missing are absent.
            on_done: Called in a worker's thread when every vertex has run or was skipped.
            deadline: By which the frame is to be done; what has not started by then may be left out.
            serves: The caller serves the graph next, so one worker fewer is woken.
        """
        vertices = self._vertices
        ready_ns = [time.perf_counter_ns()] * len(vertices)
        run = Run(trigger, data, on_done, self._predecessors.copy(), ready_ns, len(vertices), None, "", deadline)
        ready = 0
        with self._lock:
            for vertex in vertices:
                vertex.queue.append(run)
            for vertex in self._roots:
                if vertex.running is None:
                    vertex.running = vertex.queue.popleft()
                    self._ready.append((vertex, vertex.running, False))
                    ready += 1
            ready -= serves
            wakes = ready if ready < self._sleepers else self._sleepers
            if wakes > 0:
                self._sleepers -= wakes
        while wakes > 0:
            self._wakes.put(None)
            wakes -= 1

    def _offer(self, vertex: Vertex) -> int:
        """Makes the vertex's next frame ready to run if both are; gives how many it made. Called with the lock held."""
        if vertex.running is not None or not vertex.queue or vertex.queue[0].waiting[vertex.number] > 0:
            return 0
        vertex.running = run = vertex.queue.popleft()
        self._ready.append((vertex, run, False))
        return 1

    def _claim(self, ready: int) -> int:
        """How many sleeping workers to wake for so many ready vertices. Called with the lock held."""
        wakes = min(ready, self._sleepers) if ready > 0 else 0
        self._sleepers -= wakes
        return wakes

    def _work(self) -> None:
        while True:
            with self._lock:
                if self._stopping:
                    return
                sleeps = not self._ready
                self._sleepers += sleeps
            if sleeps:
                self._wakes.get()
            self.serve()

    def serve(self) -> None:
        """Runs what is ready, in the calling thread, until nothing is."""
        while True:
            with self._lock:
                if not self._ready or self._stopping:
                    return
                vertex, run, resumed = self._ready.popleft()
            if not self._execute(vertex, run, resumed):
                continue
            now = time.perf_counter_ns()
            with self._lock:
                vertex.running = None
                if self._stopping:  # it hung, and nobody waits for its frame any more
                    return
                run.remaining -= 1
                done = run.remaining == 0
                ready = 0
                for successor in vertex.successors:
                    number = successor.number
                    run.waiting[number] -= 1
                    if run.waiting[number] == 0:
                        run.ready_ns[number] = now
                        ready += self._offer(successor)
                ready += self._offer(vertex)
                # One is for this thread, without a change of threads, unless it has a frame to hand over first.
                wakes = self._claim(ready if done else ready - 1)
            for _ in range(wakes):
                self._wakes.put(None)
            if done:
                self._tell(run.on_done, run)
            del vertex, run  # a worker that waits must not keep a frame alive

    def _resume(self, vertex: Vertex, run: Run) -> None:
        """Makes a vertex that waited ready to run."""
        with self._lock:
            if self._stopping:
                return
            self._ready.append((vertex, run, True))
            wakes = self._claim(1)
        if wakes:
            self._wakes.put(None)

    def _tell(self, callback: Callable[[Any], None], event: Any) -> None:
        """Calls back; a worker outlives whatever it calls, or the frames behind it would never end."""
        try:
            callback(event)
        except Exception:
            component_logger(self.name).exception("%s: a callback failed", self.name)

    def _execute(self, vertex: Vertex, run: Run, resumed: bool) -> bool:
        """Runs a vertex for a frame; False where it waits, and goes on later."""
        processor, wiring = vertex.processor, vertex.wiring
        assert wiring is not None
        start = time.perf_counter_ns()
        if (run.deadline is not None or vertex.left_out) and _is_left_out(vertex, run):
            status = Status.CUT
        elif not resumed and not wiring.fill(run.data):
            status = Status.SKIPPED
        else:
            try:
                if processor.waits and not resumed:
                    if processor.begin(run.trigger, lambda: self._resume(vertex, run)):
                        return False
                    start = time.perf_counter_ns()
                status = processor.process(run.trigger)
                if not isinstance(status, Status):
                    raise TypeError(f"process of {type(processor).__name__} returned {status!r}, not a Status")
                wiring.collect(run.data)
            except BaseException as error:  # also SystemExit: only the process as a whole may end a worker
                status = Status.FAILED
                run.error, run.failed_vertex = error, vertex.name
                log = component_logger(f"{self.name}.{vertex.name}")
                log.exception("%s.%s failed at version %d", self.name, vertex.name, run.trigger.version)
        wiring.clear()
        reads = processor.reads
        if reads:
            processor.reads = {}
        end, ready = time.perf_counter_ns(), run.ready_ns[vertex.number]
        late = vertex.deadline_ns is not None and end - ready > vertex.deadline_ns
        if late:
            processor.losses.count(processor.place, "deadline", run.trigger.version)
        if self._on_timing is not None:
            version, epoch = run.trigger.version, run.trigger.epoch
            timing = VertexTiming(self.name, vertex.name, version, ready, start, end, status, late, epoch, reads)
            self._tell(self._on_timing, timing)
        return True


def _is_left_out(vertex: Vertex, run: Run) -> bool:
    trigger = run.trigger
    if (trigger.epoch, trigger.version) in vertex.left_out:
        return True
    return run.deadline is not None and run.deadline.leaves_out(vertex.expendable)
