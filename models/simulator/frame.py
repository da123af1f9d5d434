"""One simulated sweep with everything that is true of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["SimulatedFrame"]


@dataclass(frozen=True, eq=False, kw_only=True)
class SimulatedFrame:
    """One sweep and its truth at the reference time `version`, when a turning sensor faces forward.

    Each point is where its beam met the thing at the point's own time, in the sensor's frame of that moment; boxes,
    velocities and `pose` are those of the reference time, along the axes of the sensor then.
    """

    version: int
    """Reference time of the sweep [ns]."""
    index: int
    """Number of the frame, from 0."""
    points: np.ndarray
    """x forward, y left, z up [m] in the sensor's frame, intensity 0 to 1; shape (n, 4), float32."""
    ring: np.ndarray
    """Laser of each point, lowest first, shape (n,), uint16."""
    t: np.ndarray
    """Time of each point after `version` [s], from minus to plus half a turn, all 0 in an instant sweep; shape (n,),
    float32."""
    point_class: np.ndarray
    """`PointClass` of each point, shape (n,), int32."""
    instance: np.ndarray
    """Id of the object a point is on, −1 for background; shape (n,), int64."""
    ground: np.ndarray
    """True on road, sidewalk and terrain, shape (n,), bool."""
    boxes: np.ndarray
    """Centre x y z, length width height [m], yaw [rad] of every object in range, tight to it; (k, 7), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    ids: np.ndarray
    """The same object has the same id in every frame, from 1; shape (k,), int64."""
    velocities: np.ndarray
    """Over ground, along the cloud's x and y [m/s]; shape (k, 2), float32."""
    counts: np.ndarray
    """Points on each object, 0 where it is hidden; shape (k,), int32."""
    seen_at: np.ndarray
    """Mean time of the points on each object, as `t` [s], 0 where there are none; shape (k,), float32."""
    visible: np.ndarray | None
    """Share of each object that nothing hides from the sensor, 0 to 1, in steps of 1 / `VISIBILITY_RAYS`; shape (k,),
    float32; None where it was not asked for."""
    pose: np.ndarray
    """World from sensor at the reference time, shape (4, 4), float64."""
    poses: np.ndarray
    """World from sensor at the beginning, at the reference time and at the end of the sweep, shape (3, 4, 4)."""
    pose_times: np.ndarray
    """When those are, as `t` [s], shape (3,), rising."""
    speed: float
    """Of the ego vehicle over ground [m/s]."""
    lidar: str
    """Name of the sensor."""
