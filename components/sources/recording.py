"""Recordings of the mesh as a source: the LiDAR frames that were committed, to the bit."""

from __future__ import annotations

import os
from collections.abc import Iterator

from ...datamesh.recording import EventKind
from ...datamesh.recording_reader import Recording
from ...errors import SourceError
from ..messages import SensorFrame
from .source import SkippedFrame, Source

__all__ = ["RecordingSource"]


class RecordingSource(Source):
    """The LiDAR frames of a recording; of one that loops or seeks, those of the first epoch."""

    def __init__(self, path: str | os.PathLike, *, topic: str = "lidar/points") -> None:
        """Looks at what is in the recording.

        Args:
            path: An MCAP file that `warploom record` made.
            topic: Where the frames were committed.

        Raises:
            SourceError: There is no such file, it is no such recording, or has no values of the topic.
        """
        self._recording = Recording(path)
        self._topic = topic
        kinds = [(event.topic, event.epoch) for event in self._recording if _is_value(event)]
        first = next((epoch for name, epoch in kinds if name == topic), None)
        if first is None:
            known = ", ".join(sorted({name for name, _ in kinds})) or "nothing"
            raise SourceError(f"{os.fspath(path)}: no values of topic {topic!r} in the recording; there are: {known}")
        self._epoch = first
        self._length = kinds.count((topic, first))
        super().__init__(f"mcap:{os.fspath(path)}")

    @property
    def length(self) -> int:
        """How many frames there are, up to the break where the file was cut off."""
        return self._length

    def __iter__(self) -> Iterator[SensorFrame]:
        """Reads the frames; one that cannot be decoded is skipped.

        Raises:
            SourceError: What was committed to the topic are no LiDAR frames, or the file cannot be read any more.
        """
        self.skipped = skipped = []
        number = 0
        for event in self._recording:
            if event.topic != self._topic or event.epoch != self._epoch or not _is_value(event):
                continue
            try:
                value = event.value
            except ValueError as error:
                skipped.append(SkippedFrame(number, f"{self._recording.path} at {event.version}", str(error)))
            else:
                if not isinstance(value, SensorFrame):
                    raise SourceError(
                        f"{self._recording.path}: topic {self._topic!r} has {type(value).__name__}, not SensorFrame"
                    )
                yield value
            number += 1


def _is_value(event) -> bool:
    return event.kind is EventKind.COMMIT and event.payload is not None
