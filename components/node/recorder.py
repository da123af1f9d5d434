"""Records topics of a node: whatever its inputs name, of its own process or of another."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from ...dag.component import Component
from ...dag.processor import ProcessorConfig
from ...datamesh import DataMesh
from ...datamesh.recording import Recorder

__all__ = ["TopicRecorder", "TopicRecorderConfig"]


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
    """A generic component: `inputs: {any_name: topic}` names what it records, and it may record any topic."""

    Config = TopicRecorderConfig
    takes_any_input: ClassVar[bool] = True

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._recorder: Recorder | None = None

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
        stamp = time.strftime("%Y%m%dT%H%M%S")
        path = path.with_name(f"{path.stem}-{stamp}-{os.getpid()}{path.suffix or '.mcap'}")
        self._recorder = Recorder(
            path,
            compression=self._config.compression,
            when_full=self._config.when_full,
            write_through=self._config.write_through,
        )
        self._recorder.watch(self._mesh, [handle.topic for handle in self.inputs.values()])

    def stop(self) -> None:
        """Writes what waits, and closes the file."""
        if self._recorder is not None:
            self._recorder.close()

    @property
    def idle_because(self) -> str | None:
        """Why nothing is recorded; None while something is."""
        return None if self.inputs else "its inputs name no topic"

    def state(self) -> dict[str, str | float | int]:
        """The file, and how many commits are in it or were lost."""
        if self._recorder is None:
            return {}
        lost = self._recorder.dropped.total()
        said: dict[str, str | float | int] = {"file": str(self._recorder.path), "commits": self._recorder.written}
        if lost:
            said["lost"] = lost
        if self._recorder.failure is not None:
            said["broke off"] = self._recorder.failure
        return said
