"""What every source of sensor frames has in common."""

from __future__ import annotations

import abc
import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from ...errors import SourceError
from ..messages import SensorFrame

__all__ = ["FRAME_PERIOD", "FrameListSource", "SkippedFrame", "Source"]

FRAME_PERIOD = 100_000_000
"""Time between two frames of a recording that has no stamps [ns]."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SkippedFrame:
    """A frame of a recording that could not be read; those before and after it are kept."""

    index: int
    """Its number in the source, from 0."""
    path: str
    """The file, or another name of the place."""
    reason: str
    """What was wrong with it."""


class Source(abc.ABC):
    """Frames of a LiDAR in their order: `for frame in source` starts at the first one each time.

    `next(source)` works too: it goes on from where the last `next` stopped.
    """

    def __init__(self, name: str, *, frame_id: str = "lidar"):
        self.name = name
        """What it was opened from, for people."""
        self.frame_id = frame_id
        """The frame of the points and boxes."""
        self.skipped: list[SkippedFrame] = []
        """The frames that could not be read in the latest iteration."""
        self._cursor: Iterator[SensorFrame] | None = None

    @property
    @abc.abstractmethod
    def length(self) -> int | None:
        """How many frames there are, those that cannot be read included; None where nobody knows."""

    @abc.abstractmethod
    def __iter__(self) -> Iterator[SensorFrame]: ...

    def __next__(self) -> SensorFrame:
        if self._cursor is None:
            self._cursor = iter(self)
        return next(self._cursor)

    def __len__(self) -> int:
        if self.length is None:
            raise TypeError(f"{self.name}: the number of frames is not known before the end")
        return self.length

    def __repr__(self) -> str:
        frames = "unknown length" if self.length is None else f"{self.length} frames"
        return f"{type(self).__name__}({self.name!r}, {frames})"


class FrameListSource(Source):
    """A source whose frames are numbered and can each be read by itself.

    A frame that cannot be read is skipped and told in `skipped`; when there is only one frame, or none of them can be
    read, that is an error.
    """

    def __init__(self, name: str, places: Sequence[object], *, frame_id: str = "lidar"):
        super().__init__(name, frame_id=frame_id)
        self._places = [str(place) for place in places]

    @property
    def length(self) -> int:
        """How many frames there are, those that cannot be read included."""
        return len(self._places)

    @abc.abstractmethod
    def frame(self, index: int) -> SensorFrame:
        """Reads one frame by its number, from 0.

        Raises:
            SourceError: It cannot be read.
            IndexError: There is no such frame.
        """

    def __iter__(self) -> Iterator[SensorFrame]:
        self.skipped = skipped = []
        for index, place in enumerate(self._places):
            try:
                frame = self.frame(index)
            except SourceError as error:
                if len(self._places) == 1:
                    raise
                skipped.append(SkippedFrame(index, place, str(error)))
                _log.warning("frame %d is skipped: %s", index, error)
                continue
            yield frame
        if skipped and len(skipped) == len(self._places):
            raise SourceError(
                f"{self.name}: none of its {len(skipped)} scans can be read; the first: {skipped[0].reason}"
            )
