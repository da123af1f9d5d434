"""What the components say to each other and to the world: one dataclass a kind of message."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np

from ..datamesh.messages import message
from ..models.classes import CLASSES
from ..models.detections import Detections

__all__ = [
    "CameraObjects",
    "CameraSet",
    "DetectedObjects",
    "Obstacle",
    "Obstacles",
    "PointLabels",
    "RadarObjects",
    "RadarSet",
    "SensorFrame",
    "Truth",
]

message("warploom.Detections")(Detections)


@message("warploom.Truth")
@dataclass(frozen=True, eq=False, kw_only=True)
class Truth:
    """What is really there in one frame, as a simulator or the labels of a data set tell it."""

    boxes: np.ndarray
    """Centre x y z, length width height [m], yaw [rad], in the cloud's frame; shape (k, 7), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    ids: np.ndarray
    """The same object has the same id in every frame; shape (k,), int64; −1 where unknown."""
    velocities: np.ndarray
    """Over ground, along the cloud's x and y [m/s]; NaN where unknown; shape (k, 2), float32."""
    points: np.ndarray
    """Points of the cloud on the object, shape (k,), int32; −1 where unknown."""
    complete: bool = True
    """False where there may be objects without a box, as where labels cover a camera's view only: then an object that
    was found and fits no box need not be wrong."""
    ground: np.ndarray | None = None
    """True where a point is on the ground, shape (n,), bool; None where no point has a label."""
    ground_scored: np.ndarray | None = None
    """True where a point counts for the ground score, shape (n,), bool; None where all do."""


@message("warploom.SensorFrame")
@dataclass(frozen=True, eq=False, kw_only=True)
class SensorFrame:
    """One sweep of the LiDAR as a source gives it, on the host."""

    version: int
    """Time of reception [ns]; the key by which the sweep is known everywhere."""
    index: int
    """Number of the frame in its source, from 0; frames that could not be read leave a gap."""
    points: np.ndarray
    """x y z [m] in the frame `frame_id` (x forward, y left, z up) as it was at each point's own time, intensity; shape
    (n, 4), float32."""
    ring: np.ndarray | None = None
    """Laser number from below, shape (n,), uint16; None where unknown."""
    t: np.ndarray | None = None
    """Time of each point after `version` [s], shape (n,), float32; None where unknown, or where a data set has undone
    the sensor's motion already."""
    frame_id: str = "lidar"
    """The frame of the points."""
    pose: np.ndarray | None = None
    """World from sensor at `version`, shape (4, 4), float64; None where the ego pose is unknown."""
    poses: np.ndarray | None = None
    """World from sensor at `pose_times`, by which perception undoes the sensor's own motion during the sweep, shape
    (m, 4, 4), float64; None where unknown."""
    pose_times: np.ndarray | None = None
    """When the sensor had these poses, after `version` [s], rising, from before the sweep to after it; shape (m,)."""
    continues: bool = True
    """False where it has nothing to do with the frame before, as in a data set of single scans: tracks begin anew."""
    truth: Truth | None = None
    cameras: CameraSet | None = None
    """What the cameras of the same vehicle found since the sweep before, where the source knows it."""
    radars: RadarSet | None = None
    """Likewise the targets of its radars."""


@message("warploom.DetectedObjects")
@dataclass(frozen=True, eq=False, kw_only=True)
class DetectedObjects:
    """The boxes found in one frame, before tracking."""

    sensor: SensorFrame
    """The LiDAR frame."""
    detections: Detections
    missing_inputs: tuple[str, ...] = ()
    """Inputs that this frame had to do without."""


@message("warploom.CameraObjects")
@dataclass(frozen=True, eq=False, kw_only=True)
class CameraObjects:
    """The objects that a detector found in one image of a camera."""

    version: int
    """Time of the exposure [ns], on the LiDAR's clock."""
    sensor: str
    """Name of the camera."""
    boxes: np.ndarray
    """Left, top, right, bottom in the image [pixels], shape (k, 4), float32."""
    scores: np.ndarray
    """Confidence in [0, 1], shape (k,), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    projection: np.ndarray
    """Homogeneous pixels from the LiDAR's frame, both at rest: u w, v w, w, where w is the depth [m] and above zero
    before the camera; shape (3, 4), float64."""
    size: tuple[int, int]
    """Width and height of the image [pixels]."""
    pose: np.ndarray | None = None
    """World from the LiDAR's frame at the time of the exposure, shape (4, 4), float64; None where unknown."""


@message("warploom.RadarObjects")
@dataclass(frozen=True, eq=False, kw_only=True)
class RadarObjects:
    """The targets that a radar saw in one cycle."""

    version: int
    """Time of the measurement [ns], on the LiDAR's clock."""
    sensor: str
    """Name of the radar."""
    positions: np.ndarray
    """x y z in the radar's own frame [m], shape (k, 3), float32; z is 0 where it measures no elevation."""
    radial_velocities: np.ndarray
    """As measured: relative to the radar and along the line of sight, positive for what goes away [m/s]; shape (k,),
    float32."""
    scores: np.ndarray
    """Probability that there is something, in [0, 1], shape (k,), float32."""
    mounting: np.ndarray
    """LiDAR's frame from the radar's, shape (4, 4), float64."""
    velocity: np.ndarray | None = None
    """Of the radar itself over ground, along the axes of its frame [m/s], shape (3,), float64; None where unknown."""
    pose: np.ndarray | None = None
    """World from the LiDAR's frame at the time of the measurement, shape (4, 4), float64; None where unknown."""
    cross_section: np.ndarray | None = None
    """Radar cross section [dBm²], shape (k,), float32; None where unknown."""


@message("warploom.CameraSet")
@dataclass(frozen=True, eq=False, kw_only=True)
class CameraSet:
    """The latest of each camera."""

    version: int
    """Of the newest [ns]."""
    cameras: tuple[CameraObjects, ...]


@message("warploom.RadarSet")
@dataclass(frozen=True, eq=False, kw_only=True)
class RadarSet:
    """The latest of each radar."""

    version: int
    """Of the newest [ns]."""
    radars: tuple[RadarObjects, ...]


@message("warploom.PointLabels")
@dataclass(frozen=True, eq=False, kw_only=True)
class PointLabels:
    """What perception says of each point of a LiDAR frame, in the order of `SensorFrame.points`."""

    ground: np.ndarray
    """True on the ground, shape (n,), bool."""
    height: np.ndarray
    """Above the ground [m], NaN where unknown, shape (n,), float32."""
    clusters: np.ndarray
    """Label of the cluster, −1 for none, shape (n,), int32."""
    dropped: Mapping[str, int]
    """Points that were left out, by reason: non_finite, out_of_range, ego, over_capacity."""
    compensated: bool = False
    """True where perception saw all points from where the sensor was at the frame's version."""

    @classmethod
    def unknown(cls, n: int) -> PointLabels:
        """Nothing known of n points."""
        return cls(
            ground=np.zeros(n, bool),
            height=np.full(n, np.nan, np.float32),
            clusters=np.full(n, -1, np.int32),
            dropped={},
        )


@message("warploom.Obstacle")
class Obstacle(NamedTuple):
    """One object of a frame."""

    id: int
    """Its track."""
    label: str
    """Name of its class."""
    score: float
    """Confidence in [0, 1]."""
    box: tuple[float, ...]
    """x y z l w h [m], yaw [rad]."""
    velocity: tuple[float, float]
    """Along x and y [m/s]."""
    kind: str
    """`foreground`: a known class; `background`: a cluster of points."""


class _Found(Protocol):
    """What a tracker or a fusion gives, as `models.tracker.Tracks`."""

    ids: np.ndarray
    boxes: np.ndarray
    velocities: np.ndarray
    classes: np.ndarray
    background: np.ndarray


@message("warploom.Obstacles")
@dataclass(frozen=True, eq=False, kw_only=True)
class Obstacles:
    """The objects around the vehicle in one frame: the output of perception."""

    version: int
    """Version of the LiDAR frame they belong to [ns]."""
    frame: int
    """Number of that frame in its source."""
    frame_id: str
    """The frame of boxes and velocities."""
    velocity_reference: str
    """`world`: velocities are over ground; `ego`: relative to the vehicle, whose motion is unknown."""
    ids: np.ndarray
    """Track ids, never used twice in a run, shape (k,), int64."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    scores: np.ndarray
    """Confidence in [0, 1], shape (k,), float32."""
    boxes: np.ndarray
    """Centre x y z, length width height [m], yaw [rad], shape (k, 7), float32."""
    velocities: np.ndarray
    """Along x and y of the frame [m/s], shape (k, 2), float32."""
    background: np.ndarray
    """True for an obstacle of no known class, from a cluster, shape (k,), bool."""
    missing_inputs: tuple[str, ...] = field(default=())
    """Inputs that this frame had to do without."""

    @classmethod
    def of_frame(
        cls,
        detected: DetectedObjects,
        found: _Found,
        *,
        rows: np.ndarray,
        scores: np.ndarray,
        missing: tuple[str, ...] = (),
    ) -> Obstacles:
        """The objects that a tracker made of a frame's detections.

        A cluster is as large as what is seen of it now: its track gives it an id, and its own box stays.

        Args:
            detected: The frame and its detections.
            found: The k objects.
            rows: The detection of each, −1 for none, shape (k,).
            scores: Confidence of each in [0, 1], shape (k,).
            missing: Inputs that were missing besides those that `detected` names.
        """
        sensor = detected.sensor
        boxes = found.boxes.astype(np.float32)
        seen = found.background & (rows >= 0)
        boxes[seen] = detected.detections.boxes[rows[seen]]
        return cls(
            version=sensor.version,
            frame=sensor.index,
            frame_id=sensor.frame_id,
            velocity_reference="ego" if sensor.pose is None else "world",
            ids=found.ids,
            classes=found.classes,
            scores=scores.astype(np.float32),
            boxes=boxes,
            velocities=found.velocities.astype(np.float32),
            background=found.background,
            missing_inputs=(*detected.missing_inputs, *missing),
        )

    @classmethod
    def lost(cls, sensor: SensorFrame) -> Obstacles:
        """No objects, because the frame was lost on the way."""
        return cls(
            version=sensor.version,
            frame=sensor.index,
            frame_id=sensor.frame_id,
            velocity_reference="ego" if sensor.pose is None else "world",
            ids=np.empty(0, np.int64),
            classes=np.empty(0, np.int32),
            scores=np.empty(0, np.float32),
            boxes=np.empty((0, 7), np.float32),
            velocities=np.empty((0, 2), np.float32),
            background=np.empty(0, bool),
            missing_inputs=("obstacles",),
        )

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[Obstacle]:
        for i in range(len(self.ids)):
            yield Obstacle(
                int(self.ids[i]),
                CLASSES[self.classes[i]],
                float(self.scores[i]),
                tuple(float(value) for value in self.boxes[i]),
                (float(self.velocities[i, 0]), float(self.velocities[i, 1])),
                "background" if self.background[i] else "foreground",
            )
