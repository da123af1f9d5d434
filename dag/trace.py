"""A trace of a run for Perfetto (ui.perfetto.dev) and chrome://tracing: the Trace Event Format in JSON.

Every thread has its row, on it a slice for each run of a vertex, and a short one for each commit of a source; arrows
join what ran for one version; rows of their own show how long vertices waited in their queues; lines show latency,
frames on their way and losses. Passes of Python's garbage collector are slices where they happened. A trace that breaks
off can be opened all the same.
"""

from __future__ import annotations

import json
import logging
import os
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..datamesh import DataMesh, Entry
from ..errors import SinkError
from .engine import VertexTiming
from .garbage import GarbagePause, on_pause

__all__ = ["Trace"]

_FLUSH = 0.5  # [s]
_REMEMBERED = 10_000  # frames whose arrows can go on
_MOST = 200_000  # events that may wait for the disk: some 40 MB

_log = logging.getLogger(__name__)


class Trace:
    """Collects the events of a run and writes them on a thread of its own.

    An event costs the thread in which it happens a tuple in a queue. A disk that is full or gone ends the trace and
    nothing else: what comes after is counted in `dropped`.
    """

    def __init__(self, path: str | os.PathLike, process: str = "warploom") -> None:
        """Creates the file, and its folder where there is none; a file of that name is replaced.

        Args:
            path: The file, usually `trace.json`.
            process: Name of the process in the trace.

        Raises:
            SinkError: It cannot be created.
        """
        self.path = Path(path)
        self.dropped = 0
        """Events that are not in the file."""
        self.failure: str | None = None
        self._pid = os.getpid()
        self._events: deque[tuple[Any, ...]] = deque()
        self._threads: dict[int, str] = {}
        self._numbers_of: dict[tuple[int, int], int] = {}
        self._frames = 0
        self._on_way: set[tuple[int, int]] = set()
        self._over: dict[tuple[int, int], None] = {}
        self._lost: dict[str, int] = {}
        self._numbers = 0
        self._unsubscribe: list[Callable[[], None]] = []
        self._closing = threading.Event()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("w", encoding="utf-8")
            head = {"name": "process_name", "ph": "M", "pid": self._pid, "args": {"name": process}}
            self._file.write("[\n" + json.dumps(head))
        except OSError as error:
            raise SinkError(f"{self.path}: cannot be created: {error.strerror or error}") from None
        self._unsubscribe.append(on_pause(self._on_pause))
        self._thread = threading.Thread(target=self._run, name="trace", daemon=True)
        self._thread.start()

    def watch(self, mesh: DataMesh, sources: Iterable[str], results: Iterable[str], others: Iterable[str] = ()) -> None:
        """Traces the commits of some topics, and every loss of the mesh.

        Args:
            mesh: Whose topics they are.
            sources: Topics with which a frame begins: there the arrows begin.
            results: Topics with which a frame is done: there they end, and the latency is taken.
            others: Topics whose commits are shown, and no more: a camera's make no frame that will be done.
        """
        for topic, phase in [*((topic, "s") for topic in sources), *((topic, "") for topic in others)]:
            on_commit = partial(self._on_commit, topic, phase)
            self._unsubscribe.append(mesh.window(topic).subscribe(on_commit, lambda *_: None))
        for topic in results:
            on_commit, on_settle = partial(self._on_commit, topic, "f"), partial(self._on_settle, mesh, topic)
            self._unsubscribe.append(mesh.window(topic).subscribe(on_commit, on_settle))
        mesh.losses.on_loss(partial(self._on_loss, mesh))

    def on_timing(self, timing: VertexTiming) -> None:
        """Takes up the run of a vertex; to be called in its thread."""
        self._add("run", timing)

    def _on_commit(self, topic: str, phase: str, entry: Entry) -> None:
        self._add("commit", topic, phase, entry.version, entry.epoch, entry.received_ns, entry.committed_ns)

    def _on_settle(self, mesh: DataMesh, topic: str, version: int, epoch: int) -> None:
        self._add("settle", topic, version, epoch, mesh.clock.monotonic_ns())

    def _on_loss(self, mesh: DataMesh, place: str, reason: str, version: int) -> None:
        self._add("loss", mesh.clock.monotonic_ns(), place, reason, version)

    def _on_pause(self, pause: GarbagePause) -> None:
        # In the midst of anything: without the thread's name, which a thread that just begins must be asked for.
        self._append((threading.get_ident(), "pause", pause))

    def _add(self, *event: Any) -> None:
        thread = threading.get_ident()
        name = threading.current_thread().name
        if self._threads.get(thread) != name:  # the number of a thread that ended is given to another
            self._threads[thread] = name
            self._events.append((thread, "thread", name))
        self._append((thread, *event))

    def _append(self, event: tuple[Any, ...]) -> None:
        if self.failure is not None or self._closing.is_set() or len(self._events) > _MOST:
            self.dropped += 1
        else:
            self._events.append(event)

    def _run(self) -> None:
        while not self._closing.wait(_FLUSH):
            self._flush()

    def _flush(self) -> None:
        # One by one from the front: a thread may be adding at the end meanwhile.
        events = [self._events.popleft() for _ in range(len(self._events))]
        try:
            text = "".join(
                ",\n" + json.dumps(line, separators=(",", ":")) for event in events for line in self._lines(*event)
            )
            self._file.write(text)
            self._file.flush()
        except OSError as error:
            self.failure = error.strerror or str(error)
            self.dropped += len(events)
            _log.error("%s: the trace broke off: %s", self.path, self.failure)

    def _lines(self, thread: int, kind: str, *event: Any) -> Iterator[dict[str, Any]]:
        """The lines of the file that an event makes."""
        here = {"pid": self._pid, "tid": thread}
        if kind == "thread":
            yield {"name": "thread_name", "ph": "M", **here, "args": {"name": event[0]}}
        elif kind == "run":
            yield from self._of_run(event[0], here)
        elif kind == "pause":
            yield _of_pause(event[0], here)
        elif kind == "commit":
            yield from self._of_commit(*event, here=here)
        elif kind == "settle":
            topic, version, epoch, now = event
            self._end((epoch, version))
            yield self._instant(f"nothing on {topic}", "settle", now, here, version)
            yield self._counter("frames on their way", now, {"frames": len(self._on_way)})
        else:
            now, place, reason, version = event
            what = f"{place}: {reason}"
            self._lost[what] = self._lost.get(what, 0) + 1
            yield self._instant(what, "loss", now, here, version)
            yield self._counter("losses", now, self._lost)

    def _of_run(self, timing: VertexTiming, here: dict[str, Any]) -> Iterator[dict[str, Any]]:
        name = f"{timing.component}.{timing.vertex}"
        start, end, ready = timing.start_ns / 1e3, timing.end_ns / 1e3, timing.ready_ns / 1e3
        what = {"version": timing.version, "epoch": timing.epoch, "status": timing.status.name}
        what |= {"wait_ms": timing.wait_ms, "late": timing.late}
        yield {"name": name, "cat": "vertex", "ph": "X", "ts": start, "dur": end - start, **here, "args": what}
        self._numbers += 1
        wait = {"cat": "wait", "name": f"{name} waits", "id": self._numbers, "pid": self._pid, "tid": 0}
        yield {**wait, "ph": "b", "ts": ready, "args": {"version": timing.version}}
        yield {**wait, "ph": "e", "ts": start}
        yield self._arrow(timing.version, timing.epoch, start, here, "t")

    def _of_commit(
        self, topic: str, phase: str, version: int, epoch: int, received: int, committed: int, here: dict[str, Any]
    ) -> Iterator[dict[str, Any]]:
        frame, stamp = (epoch, version), committed / 1e3
        what = {"version": version, "epoch": epoch}
        # One nanosecond long: an arrow begins and ends at a slice, and this one must not reach into the next.
        yield {"name": f"commit {topic}", "cat": "commit", "ph": "X", "ts": stamp, "dur": 0.001, **here, "args": what}
        if not phase:
            return
        yield self._arrow(version, epoch, stamp, here, phase)
        if phase == "s":
            self._begin(frame)
        else:
            self._end(frame)
            yield self._counter(f"latency of {topic} [ms]", committed, {"ms": (committed - received) / 1e6})
        yield self._counter("frames on their way", committed, {"frames": len(self._on_way)})

    def _begin(self, frame: tuple[int, int]) -> None:
        # Who is started by the commit may be done with it before the thread that commits gets to say that it has.
        if frame in self._over:
            del self._over[frame]
        else:
            self._on_way.add(frame)

    def _end(self, frame: tuple[int, int]) -> None:
        if frame in self._on_way:
            self._on_way.remove(frame)
        else:
            self._over[frame] = None
            if len(self._over) > _REMEMBERED:
                del self._over[next(iter(self._over))]

    def _arrow(self, version: int, epoch: int, stamp: float, here: dict[str, Any], phase: str) -> dict[str, Any]:
        # Versions are too large for the numbers of JSON, so the frames are numbered.
        number = self._numbers_of.get((epoch, version))
        if number is None:
            self._frames += 1
            number = self._numbers_of[epoch, version] = self._frames
            if len(self._numbers_of) > _REMEMBERED:
                del self._numbers_of[next(iter(self._numbers_of))]
        ends = {"bp": "e"} if phase == "f" else {}
        return {"name": "version", "cat": "version", "ph": phase, "id": number, "ts": stamp, **here, **ends}

    def _instant(self, name: str, kind: str, now: int, here: dict[str, Any], version: int) -> dict[str, Any]:
        return {"name": name, "ph": "i", "s": "p", "cat": kind, "ts": now / 1e3, **here, "args": {"version": version}}

    def _counter(self, name: str, now: int, values: dict[str, float]) -> dict[str, Any]:
        return {"name": name, "ph": "C", "ts": now / 1e3, "pid": self._pid, "tid": 0, "args": dict(values)}

    def close(self) -> None:
        """Writes what is left. Twice is no harm; a failure is in `failure`, and not raised."""
        if self._closing.is_set():
            return
        for unsubscribe in self._unsubscribe:
            unsubscribe()
        self._closing.set()
        self._thread.join()
        self._flush()
        try:
            self._file.write("\n]\n")
            self._file.close()
        except OSError as error:
            self.failure = self.failure or error.strerror or str(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def _of_pause(pause: GarbagePause, here: dict[str, Any]) -> dict[str, Any]:
    name, start = f"garbage collection, generation {pause.generation}", pause.start_ns / 1e3
    took = (pause.end_ns - pause.start_ns) / 1e3
    return {"name": name, "cat": "gc", "ph": "X", "ts": start, "dur": took, **here, "args": {"freed": pause.collected}}
