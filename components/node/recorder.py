"""Records topics of a node: whatever its inputs name, of its own process or of another."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

from ...dag.component import Component
from ...dag.processor import ProcessorConfig
from ...datamesh import DataMesh, Entry
from ...datamesh.recording import GAPS, Recorder
from ...datamesh.recording_reader import Recording
from ...errors import SourceError

__all__ = ["TopicRecorder", "TopicRecorderConfig"]

_log = logging.getLogger(__name__)


class TopicRecorderConfig(ProcessorConfig):
    """Where and how."""

    path: str
    """The file; each start makes a new one, with time and process in its name: run-20260102T030405-71.mcap."""
    write_through: bool = True
    """Nothing is collected before it is written, so that a killed process leaves all but what waited in the queue."""
    compression: Literal["none", "lz4", "zstd"] = "lz4"
    """Of what is collected; only with `write_through: false`."""
    when_full: Literal["drop", "block"] = "drop"
    """What happens to a commit when the disk is too slow: it is left out and counted, or its producer waits."""


class TopicRecorder(Component):
    """A generic component: `inputs: {any_name: topic}` names what it records, and it may record any topic.

    Where its process was killed it goes on in a further file, which names the one before (`continues` in its metadata).
    What was committed meanwhile comes first, as far as its producer keeps it; of a topic of which that does not reach
    back to the end of the file before, the gap is in the recording (the topic `warploom/gaps`), counted and logged.
    """

    Config = TopicRecorderConfig
    takes_any_input: ClassVar[bool] = True

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._recorder: Recorder | None = None
        self._ends: dict[str, tuple[int, int]] = {}
        self._before = ""
        self._gaps = 0

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Notes the mesh."""
        super().bind(mesh, topics)
        self._mesh = mesh

    def init(self, config: TopicRecorderConfig) -> None:
        """Takes the configuration."""
        self._config = config

    def start(self) -> None:
        """Creates the file and records from here on.

        Raises:
            SinkError: It cannot be created.
        """
        assert self._mesh is not None, "the process binds it first"
        path = Path(self._config.path)
        session = _session()
        self._find_before(path, session)
        stamp = time.strftime("%Y%m%dT%H%M%S")
        path = path.with_name(f"{path.stem}-{stamp}-{os.getpid()}{path.suffix or '.mcap'}")
        self._recorder = Recorder(
            path,
            compression=self._config.compression,
            when_full=self._config.when_full,
            write_through=self._config.write_through,
            metadata={"recorder": self.name, "session": session, "continues": self._before},
        )
        topics = [handle.topic for handle in self.inputs.values()]
        for topic in self._ends.keys() & set(topics):
            self._mesh.window(topic).subscribe(partial(self._look_for_gap, topic), lambda version, epoch: None)
        self._recorder.watch(self._mesh, topics)

    def _find_before(self, path: Path, session: str) -> None:
        """Looks for the file of a life before that was killed."""
        self._ends, self._before = {}, ""
        found = [one for one in path.parent.glob(f"{path.stem}-*{path.suffix or '.mcap'}") if one.is_file()]
        for one in sorted(found, key=lambda one: one.stat().st_mtime_ns, reverse=True):
            try:
                recording = Recording(one)
                if recording.metadata.get("recorder") != self.name or recording.metadata.get("session") != session:
                    continue
                if not recording.closed:
                    self._ends, self._before = recording.ends(), one.name
            except SourceError as error:  # one of somebody else, or a life that ended before it had begun
                _log.debug("%s: %s", one, error)
                continue
            return

    def _look_for_gap(self, topic: str, entry: Entry) -> None:
        """Looks at the first commit since the start: is it later than the last of the file before?"""
        end = self._ends.pop(topic, None)
        if end is None or (entry.epoch, entry.version) <= end:
            return
        assert self._recorder is not None, "it records by now"
        self._gaps += 1
        self.losses.count(f"recorder {topic}", "gap", entry.version)
        self._recorder.log(GAPS, entry.epoch, entry.version, (topic, *end, entry.version, self._before))
        _log.warning("%s: %s holds versions up to %d, this file from %d on", topic, self._before, end[1], entry.version)

    def stop(self) -> None:
        """Writes what waits, and closes the file."""
        if self._recorder is not None:
            self._recorder.close()

    @property
    def idle_because(self) -> str | None:
        """Why nothing is recorded; None while something is."""
        if not self.inputs:
            return "its inputs name no topic"
        failure = None if self._recorder is None else self._recorder.failure
        return None if failure is None else f"the recording broke off: {failure}"

    def state(self) -> dict[str, str | float | int]:
        """The file, and how many commits are in it or were lost."""
        if self._recorder is None:
            return {}
        lost = self._recorder.dropped.total()
        said: dict[str, str | float | int] = {"file": str(self._recorder.path), "commits": self._recorder.written}
        if self._before:
            said["continues"] = self._before
        if self._gaps:
            said["gaps"] = self._gaps
        if lost:
            said["lost"] = lost
        return said


def _session() -> str:
    """What all lives of a process have in common that one supervisor starts: the supervisor, and when it began."""
    import psutil

    parent = os.getppid()
    return f"{parent}-{psutil.Process(parent).create_time():.2f}"
