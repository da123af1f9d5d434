"""What the components say to each other and to the world: one dataclass a kind of message."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["Obstacles", "SensorFrame", "Truth"]


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
    ground: np.ndarray | None = None
    """True where a point is on the ground, shape (n,), bool; None where no point has a label."""
    ground_scored: np.ndarray | None = None
    """True where a point counts for the ground score, shape (n,), bool; None where all do."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SensorFrame:
    """One sweep of the LiDAR as a source gives it, on the host."""

    version: int
    """Time of reception [ns]; the key by which the sweep is known everywhere."""
    index: int
    """Number of the frame in its source, from 0; frames that could not be read leave a gap."""
    points: np.ndarray
    """x y z [m] in the frame `frame_id` (x forward, y left, z up), intensity; shape (n, 4), float32."""
    ring: np.ndarray | None = None
    """Laser number from below, shape (n,), uint16; None where unknown."""
    t: np.ndarray | None = None
    """Time of each point after `version` [s], shape (n,), float32; None where unknown."""
    frame_id: str = "lidar"
    """The frame of the points."""
    pose: np.ndarray | None = None
    """World from sensor, shape (4, 4), float64; None where the ego pose is unknown."""
    truth: Truth | None = None


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

    def __len__(self) -> int:
        return len(self.ids)
