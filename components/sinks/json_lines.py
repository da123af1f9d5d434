"""Obstacles as JSON lines: `objects.jsonl`, a line a frame.

A line has, in this order: `version` [ns], `frame`, `objects`, `missing_inputs`, `frame_id`, `velocity_reference`,
`latency_ms`. An object has `id`, `class` (its name), `score`, `box` [x y z l w h yaw], `velocity` [vx vy] and `kind`,
which is `foreground` or `background`. Metres, metres per second and milliseconds have three decimals, yaw and score
four; a velocity that is not known is null. The same obstacles make the same bytes.
"""

from __future__ import annotations

import json
import math
import os
import pathlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from ...errors import SinkError, SourceError
from ...models.classes import CLASSES
from ..messages import Obstacles

__all__ = ["JsonLinesSink", "ObjectsRecord", "read_objects"]

_KEYS = ("version", "frame", "objects", "missing_inputs", "frame_id", "velocity_reference", "latency_ms")


@dataclass(frozen=True, eq=False)
class ObjectsRecord:
    """One line of `objects.jsonl`."""

    obstacles: Obstacles
    latency_ms: float
    """From the frame's arrival to its obstacles [ms]."""


class JsonLinesSink:
    """Writes `objects.jsonl`; a line is in the file when `write` returns: a run that breaks off leaves whole ones."""

    def __init__(self, path: str | os.PathLike):
        """Creates the file, and its folder where there is none; a file of that name is replaced.

        Raises:
            SinkError: It cannot be created.
        """
        self.path = pathlib.Path(path)
        self.written = 0
        """Frames that were taken."""
        self.dropped = 0
        """Frames that were left out: none, as a line is written at once."""
        self.refused = 0
        """Objects that were left out, as a number of their box or their score was not finite."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("wb", buffering=0)
        except OSError as error:
            raise SinkError(f"{self.path}: cannot be created: {error.strerror or error}") from None

    def write(
        self,
        obstacles: Obstacles,
        *,
        latency_ms: float,
        points: np.ndarray | None = None,
        pose: np.ndarray | None = None,
    ) -> None:
        """Writes one line; the cloud and the pose are left out.

        Raises:
            SinkError: The sink is closed, or the disk is full or gone.
        """
        if self._file.closed:
            raise SinkError(f"{self.path}: closed: nothing more can be written")
        line, refused = _line(obstacles, latency_ms)
        data = line.encode() + b"\n"
        try:
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            raise SinkError(
                f"{self.path}: frame {obstacles.frame} cannot be written: {error.strerror or error}"
            ) from None
        self.written += 1
        self.refused += refused

    def close(self) -> None:
        """Closes the file. Twice is no harm."""
        try:
            self._file.close()
        except OSError as error:
            raise SinkError(f"{self.path}: cannot be written to its end: {error.strerror or error}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc_info: object) -> None:
        self.close()


def _rounded(values: np.ndarray, decimals: int) -> np.ndarray:
    # Adding zero turns −0.0 into 0.0: one number, one text.
    return np.round(np.asarray(values, np.float64), decimals) + 0.0


def _line(obstacles: Obstacles, latency_ms: float) -> tuple[str, int]:
    """The line, and how many objects are not in it."""
    boxes = np.asarray(obstacles.boxes, np.float64).reshape(-1, 7)
    keep = np.flatnonzero(np.isfinite(boxes).all(axis=1) & np.isfinite(obstacles.scores))
    places, yaws = _rounded(boxes[:, :6], 3).tolist(), _rounded(boxes[:, 6], 4).tolist()
    scores, velocities = _rounded(obstacles.scores, 4).tolist(), _rounded(obstacles.velocities, 3).tolist()
    objects = [
        {
            "id": int(obstacles.ids[k]),
            "class": CLASSES[int(obstacles.classes[k])],
            "score": scores[k],
            "box": [*places[k], yaws[k]],
            "velocity": [v if math.isfinite(v) else None for v in velocities[k]],
            "kind": "background" if obstacles.background[k] else "foreground",
        }
        for k in keep.tolist()
    ]
    record = {
        "version": int(obstacles.version),
        "frame": int(obstacles.frame),
        "objects": objects,
        "missing_inputs": list(obstacles.missing_inputs),
        "frame_id": obstacles.frame_id,
        "velocity_reference": obstacles.velocity_reference,
        "latency_ms": round(float(latency_ms), 3) if math.isfinite(latency_ms) else None,
    }
    return json.dumps(record, separators=(",", ":"), ensure_ascii=False, allow_nan=False), len(boxes) - len(keep)


def read_objects(path: str | os.PathLike) -> Iterator[ObjectsRecord]:
    """Reads `objects.jsonl` line by line.

    Raises:
        SourceError: The file cannot be read, or a line is not such a record: says which and why.
    """
    path = pathlib.Path(path)
    try:
        with path.open("rb") as file:
            for number, line in enumerate(file, 1):
                try:
                    yield _record(line)
                except (
                    ValueError,
                    TypeError,
                    KeyError,
                    IndexError,
                    AttributeError,
                    OverflowError,
                    RecursionError,
                ) as error:
                    what = f"no key {error}" if isinstance(error, KeyError) else str(error)
                    raise SourceError(f"{path}, line {number}: not a record of objects: {what}") from None
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from None


def _record(line: bytes) -> ObjectsRecord:
    record = json.loads(line)
    if not isinstance(record, dict):
        raise ValueError(f"expected an object with the keys {', '.join(_KEYS)}")
    objects = record["objects"]
    velocities = [[math.nan if v is None else v for v in entry["velocity"]] for entry in objects]
    kinds = [entry["kind"] for entry in objects]
    if not set(kinds) <= {"foreground", "background"}:
        raise ValueError("kind is neither foreground nor background")
    count = len(objects)
    return ObjectsRecord(
        obstacles=Obstacles(
            version=int(record["version"]),
            frame=int(record["frame"]),
            frame_id=str(record["frame_id"]),
            velocity_reference=str(record["velocity_reference"]),
            ids=np.array([entry["id"] for entry in objects], np.int64),
            classes=np.array([CLASSES.index(entry["class"]) for entry in objects], np.int32),
            scores=np.array([entry["score"] for entry in objects], np.float32),
            boxes=np.array([entry["box"] for entry in objects], np.float32).reshape(count, 7),
            velocities=np.array(velocities, np.float32).reshape(count, 2),
            background=np.array([kind == "background" for kind in kinds], bool),
            missing_inputs=tuple(str(name) for name in record["missing_inputs"]),
        ),
        latency_ms=math.nan if record["latency_ms"] is None else float(record["latency_ms"]),
    )
