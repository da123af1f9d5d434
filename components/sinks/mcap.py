"""Recordings: MCAP files with Foxglove's protobuf schemas, which Foxglove opens, and Rerun in part."""

from __future__ import annotations

import contextlib
import functools
import logging
import math
import os
import pathlib
import queue
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from ...errors import SinkError
from ...models.classes import CLASSES
from ...models.geometry import quaternion
from ..messages import Obstacles

if TYPE_CHECKING:
    from foxglove.messages import Color, SceneEntity

__all__ = ["CLOUD_TOPIC", "OBSTACLES_TOPIC", "TRANSFORM_TOPIC", "McapSink"]

CLOUD_TOPIC = "/lidar/points"
"""foxglove.PointCloud: x y z intensity as float32, in the frame of the obstacles."""
OBSTACLES_TOPIC = "/perception/obstacles"
"""foxglove.SceneUpdate: an entity a track, its id the track's; a cube, a label, and an arrow where it moves."""
TRANSFORM_TOPIC = "/tf"
"""foxglove.FrameTransform: where the sensor stands in `world`."""

_COLORS = {
    "vehicle": (0.16, 0.55, 1.0),
    "pedestrian": (1.0, 0.45, 0.2),
    "cyclist": (0.25, 0.85, 0.45),
    "cone": (1.0, 0.8, 0.1),
    "barrier": (0.85, 0.3, 0.75),
    "unknown": (0.65, 0.65, 0.65),
}
_SLOWEST_ARROW = 0.3  # [m/s]: below that the arrow would only flicker
_QUEUE = 8  # clouds of 2 MB each that may wait

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class _Frame:
    obstacles: Obstacles
    latency_ms: float
    cloud: bytes | None
    pose: np.ndarray | None


class _File:
    """What the writer of foxglove-sdk writes into.

    It never fails towards the writer, whose own answer to a full disk is to end the process's thread: the first error
    is kept here, and the sink tells it.
    """

    def __init__(self, path: pathlib.Path):
        self._file = path.open("wb", buffering=0)
        self._position = self._size = 0
        self.error: OSError | None = None

    def write(self, data: bytes) -> int:
        if self.error is None:
            try:
                rest = memoryview(data)
                while rest:
                    rest = rest[self._file.write(rest) :]
            except OSError as error:
                self.error = error
        self._position += len(data)
        self._size = max(self._size, self._position)
        return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        self._position = offset + (0, self._position, self._size)[whence]
        if self.error is None:
            try:
                self._file.seek(self._position)
            except OSError as error:
                self.error = error
        return self._position

    def flush(self) -> None:
        pass

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            self.error = self.error or error


class McapSink:
    """Records obstacles and clouds into an MCAP file, on a thread of its own.

    `write` copies the cloud and returns; the thread encodes, compresses and writes. At most eight frames wait. With
    `when_full="block"` the ninth waits too, so that nothing of an offline run is lost, and a disk that fails is an
    error of the next `write`. With `when_full="drop"` it is left out and counted in `dropped`, as is every frame after
    a disk failed, so that no disk ever holds up perception; `close` tells the failure.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        compression: str = "zstd",
        when_full: str = "block",
        metadata: Mapping[str, str] | None = None,
    ):
        """Creates the file, and its folder where there is none; a file of that name is replaced.

        Args:
            path: The file.
            compression: zstd, lz4 or none.
            when_full: block or drop.
            metadata: Written into the file as the record `warploom`.

        Raises:
            ValueError: compression or when_full is none of these.
            SinkError: The file cannot be created.
        """
        if compression not in ("zstd", "lz4", "none"):
            raise ValueError(f"compression is {compression!r}; expected zstd, lz4 or none")
        if when_full not in ("block", "drop"):
            raise ValueError(f"when_full is {when_full!r}; expected block or drop")
        self.path = pathlib.Path(path)
        self.written = 0
        """Frames that are in the file, or were handed to its writer."""
        self.dropped = 0
        """Frames that were left out because the thread was behind or the disk had failed."""
        self.refused = 0
        """Objects that were left out, as a number of their box was not finite."""
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _File(self.path)
        except OSError as error:
            raise SinkError(f"{self.path}: cannot be created: {error.strerror or error}") from None
        self._when_full = when_full
        self._open_writer(compression, metadata)
        self._failure: BaseException | None = None
        self._closed = False
        self._queue: queue.Queue[_Frame | None] = queue.Queue(_QUEUE)
        self._thread = threading.Thread(target=self._run, name=f"mcap {self.path.name}", daemon=True)
        self._thread.start()

    def _open_writer(self, compression: str, metadata: Mapping[str, str] | None) -> None:
        import foxglove
        from foxglove.channels import FrameTransformChannel, PointCloudChannel, SceneUpdateChannel
        from foxglove.mcap import MCAPCompression, MCAPWriteOptions
        from foxglove.messages import PackedElementField, PackedElementFieldNumericType

        kind = {"zstd": MCAPCompression.Zstd, "lz4": MCAPCompression.Lz4, "none": None}[compression]
        # Level 1: real scans shrink by a fifth at any level, and more levels cost more time than they save bytes.
        level = 1 if compression == "zstd" else 0
        options = MCAPWriteOptions(compression=kind, compression_level=level, compression_threads=0)
        self._context = context = foxglove.Context()  # without it its channels would be closed
        self._writer = foxglove.open_mcap(self._file, context=context, writer_options=options)
        if metadata:
            self._writer.write_metadata("warploom", dict(metadata))
        self._clouds = PointCloudChannel(CLOUD_TOPIC, context=context)
        self._scenes = SceneUpdateChannel(OBSTACLES_TOPIC, context=context)
        self._transforms = FrameTransformChannel(TRANSFORM_TOPIC, context=context)
        self._fields = [
            PackedElementField(name=name, offset=4 * index, type=PackedElementFieldNumericType.Float32)
            for index, name in enumerate(("x", "y", "z", "intensity"))
        ]

    def write(
        self,
        obstacles: Obstacles,
        *,
        latency_ms: float,
        points: np.ndarray | None = None,
        pose: np.ndarray | None = None,
    ) -> None:
        """Hands one frame to the thread.

        Args:
            obstacles: What perception said; must not be changed afterwards.
            latency_ms: From the frame's arrival to its obstacles [ms]; kept with each object's entity.
            points: x y z [m], intensity of the frame, shape (n, 4), copied; None: no cloud.
            pose: World from sensor, shape (4, 4); None: the sensor is the world.

        Raises:
            SinkError: The sink is closed; with `when_full="block"` also: an earlier frame could not be written.
            ValueError: points is not of that shape.
        """
        if points is not None and (points.ndim != 2 or points.shape[1] != 4):
            raise ValueError(f"points has shape {points.shape}; expected (n, 4): x y z intensity")
        if self._closed:
            raise SinkError(f"{self.path}: closed: nothing more can be written")
        if self._when_full == "block":
            self._raise_failure()
        elif self._queue.full() or self._failure or self._file.error:
            self.dropped += 1
            return
        cloud = None if points is None else np.ascontiguousarray(points, "<f4").tobytes()
        self._queue.put(
            _Frame(obstacles, float(latency_ms), cloud, None if pose is None else np.array(pose, np.float64))
        )
        self.written += 1

    def close(self) -> None:
        """Writes what waits and the file's summary. Twice is no harm.

        Raises:
            SinkError: Not all could be written.
        """
        if self._closed:
            return
        self._closed = True
        self._queue.put(None)
        self._thread.join()
        if self._failure is None:
            try:
                self._writer.close()
            except BaseException as error:
                self._failure = error
        self._file.close()
        if self.dropped:
            _log.warning("%s: %d frames were left out, as writing was too slow or failed", self.path, self.dropped)
        self._raise_failure()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *exc_info: object) -> None:
        # An error on the way out must not hide the one that is on its way.
        with contextlib.suppress(SinkError) if kind else contextlib.nullcontext():
            self.close()

    def _raise_failure(self) -> None:
        error = self._file.error or self._failure
        if isinstance(error, OSError):
            raise SinkError(f"{self.path}: the recording cannot be written: {error.strerror or error}")
        if error is not None:
            raise SinkError(f"{self.path}: the recording cannot be written: {type(error).__name__}: {error}") from error

    def _run(self) -> None:
        while (frame := self._queue.get()) is not None:
            # After an error the queue is still emptied, so that nobody waits for room in it.
            if self._failure is None and self._file.error is None:
                try:
                    self._record(frame)
                except BaseException as error:
                    self._failure = error

    def _record(self, frame: _Frame) -> None:
        from foxglove.messages import PointCloud, SceneEntityDeletion, SceneEntityDeletionType, SceneUpdate, Timestamp

        obstacles = frame.obstacles
        version = obstacles.version
        stamp = Timestamp(sec=version // 10**9, nsec=version % 10**9)
        self._transforms.log(_transform(stamp, obstacles.frame_id, frame.pose), log_time=version)
        if frame.cloud is not None:
            cloud = PointCloud(
                timestamp=stamp,
                frame_id=obstacles.frame_id,
                pose=_pose((0.0, 0.0, 0.0), 0.0),
                point_stride=16,
                fields=self._fields,
                data=frame.cloud,
            )
            self._clouds.log(cloud, log_time=version)
        finite = np.isfinite(np.asarray(obstacles.boxes, np.float64)).all(axis=1)
        self.refused += int((~finite).sum())
        # Each frame tells the whole scene: what is not in it is gone.
        deletion = SceneEntityDeletion(timestamp=stamp, type=SceneEntityDeletionType.All, id="")
        entities = [_entity(obstacles, k, stamp, frame.latency_ms) for k in np.flatnonzero(finite).tolist()]
        self._scenes.log(SceneUpdate(deletions=[deletion], entities=entities), log_time=version)


def _pose(place: tuple[float, float, float], yaw: float):
    """Foxglove's pose from a place and a heading."""
    import foxglove.messages as fox

    x, y, z = place
    turn = fox.Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    return fox.Pose(position=fox.Vector3(x=x, y=y, z=z), orientation=turn)


def _transform(stamp, frame_id: str, pose: np.ndarray | None):
    import foxglove.messages as fox

    T = np.eye(4) if pose is None else pose
    w, x, y, z = quaternion(T[:3, :3]).tolist()
    return fox.FrameTransform(
        timestamp=stamp,
        parent_frame_id="world",
        child_frame_id=frame_id,
        translation=fox.Vector3(x=float(T[0, 3]), y=float(T[1, 3]), z=float(T[2, 3])),
        rotation=fox.Quaternion(x=x, y=y, z=z, w=w),
    )


@functools.cache
def _color(name: str, alpha: float) -> Color:
    import foxglove.messages as fox

    r, g, b = _COLORS[name]
    return fox.Color(r=r, g=g, b=b, a=alpha)


def _entity(obstacles: Obstacles, k: int, stamp, latency_ms: float) -> SceneEntity:
    """One obstacle as a cube, its class and id above it, its velocity as an arrow."""
    import foxglove.messages as fox

    x, y, z, length, width, height, yaw = (float(value) for value in obstacles.boxes[k])
    name = CLASSES[int(obstacles.classes[k])]
    background = bool(obstacles.background[k])
    cube = fox.CubePrimitive(
        pose=_pose((x, y, z), yaw),
        size=fox.Vector3(x=length, y=width, z=height),
        color=_color(name, 0.25 if background else 0.5),
    )
    text = fox.TextPrimitive(
        pose=_pose((x, y, z + height / 2 + 0.4), 0.0),
        billboard=True,
        font_size=12.0,
        scale_invariant=True,
        color=_color(name, 1.0),
        text=f"{name} {int(obstacles.ids[k])}",
    )
    vx, vy = (float(value) for value in obstacles.velocities[k])
    speed = math.hypot(vx, vy)
    arrows = []
    if math.isfinite(speed) and speed > _SLOWEST_ARROW:
        arrows.append(
            fox.ArrowPrimitive(
                pose=_pose((x, y, z), math.atan2(vy, vx)),
                shaft_length=speed,  # where it is one second later
                shaft_diameter=0.12,
                head_length=0.5,
                head_diameter=0.35,
                color=_color(name, 1.0),
            )
        )
    metadata = {
        "class": name,
        "score": f"{float(obstacles.scores[k]):.4f}",
        "kind": "background" if background else "foreground",
        "velocity": f"{vx:.3f} {vy:.3f}",
        "velocity_reference": obstacles.velocity_reference,
        "frame": str(obstacles.frame),
        "latency_ms": f"{latency_ms:.3f}",
    }
    return fox.SceneEntity(
        timestamp=stamp,
        frame_id=obstacles.frame_id,
        id=str(int(obstacles.ids[k])),
        frame_locked=True,
        metadata=[fox.KeyValuePair(key=key, value=value) for key, value in metadata.items()],
        cubes=[cube],
        texts=[] if background else [text],
        arrows=arrows,
    )
