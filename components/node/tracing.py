"""The trace of a process: every vertex, wait, commit and loss of its first seconds, for ui.perfetto.dev."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import tempfile
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import Field

from ...dag import Component, ProcessorConfig
from ...dag.trace import Trace
from ...datamesh import DataMesh
from ...datamesh.clock import Timer
from ...errors import SinkError
from ..execution import ExecutionContext
from ..pipeline import LIDAR_TOPIC, OBSTACLES_TOPIC

__all__ = ["TraceWriter", "TraceWriterConfig"]

_KEPT = 5

_log = logging.getLogger(__name__)


def _run_base() -> Path:
    try:
        from ...dag.launch.run_folder import run_base
    except ImportError:  # it is for Linux alone
        return Path(tempfile.gettempdir())
    return run_base()


class TraceWriterConfig(ProcessorConfig):
    """Where to, and how much."""

    file: str = "trace-{name}-{pid}.json"
    """The file; one without a folder lies beside the folders of nodes, such as in $WARPLOOM_RUN, and there the newest
    five of its name are kept."""
    seconds: float = Field(30.0, ge=0.0)
    """How long is traced from the start [s]; 0: nothing. A second of perception is some 100 kB."""
    sources: tuple[str, ...] = (LIDAR_TOPIC,)
    """Topics with which a frame begins: it is on its way until it is done. Of others the commits are shown alone."""
    results: tuple[str, ...] = (OBSTACLES_TOPIC,)
    """Topics with which a frame is done: its latency is taken there."""


class TraceWriter(Component):
    """Writes it. A disk that is full or not permitted costs the trace and nothing else."""

    Config = TraceWriterConfig
    context: ExecutionContext | None

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._config = TraceWriterConfig()
        self._trace: Trace | None = None
        self._timer: Timer | None = None
        self._ending: threading.Thread | None = None
        self._failure: str | None = None
        self._done = False

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Keeps the mesh whose commits are traced."""
        super().bind(mesh, topics)
        self._mesh = mesh

    def check(self, config: TraceWriterConfig) -> None:
        """Checks the name of the file.

        Raises:
            ValueError: It holds a placeholder that is not known.
        """
        self._path(config)

    def init(self, config: TraceWriterConfig) -> None:
        """Keeps where to."""
        self._config = config

    def _path(self, config: TraceWriterConfig) -> Path:
        try:
            path = Path(config.file.format(name=self.name, pid=os.getpid()))
        except (KeyError, IndexError, ValueError) as error:
            raise ValueError(f"file: {{name}} and {{pid}} are the placeholders, not {error}") from None
        if path.parent == Path():
            path = _run_base() / path
        return path

    def _remove_old(self) -> None:
        """Each life makes a file: of those beside the folders of nodes there are to be few, this one included."""
        if Path(self._config.file).parent != Path():
            return
        before, _, after = self._config.file.format(name=self.name, pid="\0").partition("\0")
        pattern = re.compile(rf"{re.escape(before)}\d+{re.escape(after)}")
        with contextlib.suppress(OSError):
            old = [one for one in _run_base().iterdir() if pattern.fullmatch(one.name)]
            for one in sorted(old, key=lambda one: one.stat().st_mtime_ns)[: 1 - _KEPT]:
                one.unlink(missing_ok=True)

    def start(self) -> None:
        """Creates the file and begins."""
        if self._config.seconds == 0.0:
            return
        assert self._mesh is not None
        self._remove_old()
        try:
            self._trace = Trace(self._path(self._config), self.name)
        except SinkError as error:
            self._failure = str(error)
            _log.error("%s: %s", self.name, error)
            return
        topics = self._mesh.topics()
        sources, results = (
            [topic for topic in which if topic in topics] for which in (self._config.sources, self._config.results)
        )
        self._trace.watch(self._mesh, sources, results, [topic for topic in topics if topic not in sources + results])
        if self.context is not None:
            self.context.timings.watch(self._trace.on_timing)
        self._done = False
        self._timer = self.clock.call_at(self.clock.monotonic_ns() + round(self._config.seconds * 1e9), self._is_over)

    def _is_over(self) -> None:
        # Writing takes a while, and the clock has other calls to make.
        self._ending = threading.Thread(target=self._end, name=f"{self.name}-end", daemon=True)
        self._ending.start()

    def _end(self) -> None:
        trace = self._trace
        if trace is None:
            return
        self._done = True
        if self.context is not None:
            self.context.timings.forget(trace.on_timing)
        trace.close()

    def stop(self) -> None:
        """Writes the trace to its end."""
        if self._timer is not None:
            self._timer.cancel()
        if self._ending is not None:
            self._ending.join()
        self._end()

    @property
    def idle_because(self) -> str | None:
        """It is off, is done, or cannot write."""
        if self._config.seconds == 0.0:
            return f"{self.name}.seconds is 0"
        if self._trace is not None and self._trace.failure is not None:
            return f"{self._trace.path}: {self._trace.failure}"
        if self._failure is not None:
            return self._failure
        return f"the first {self._config.seconds:g} s are written" if self._done else None

    def state(self) -> Mapping[str, str | float | int]:
        """The file, and what is not in it."""
        return {"file": str(self._trace.path), "events_dropped": self._trace.dropped} if self._trace else {}
