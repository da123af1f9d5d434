"""What a frame knows of the sensor's own motion while it was taken, as the kernels take it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ..datamesh import LossCounters
from .messages import SensorFrame

__all__ = ["MAX_POSES", "SweepMotion", "sweep_motion"]

MAX_POSES = 64
"""Poses of a sweep that are used; of more, such as those of an IMU at 1 kHz, so many that are spread evenly."""

_NEAR_ENOUGH = 1e-3  # [s] before or after the poses, a point takes the nearest without a word


class SweepMotion(NamedTuple):
    """How a sensor moved while its points were taken."""

    t: np.ndarray
    """Time of each point after the frame's version [s], shape (n,)."""
    poses: np.ndarray
    """World from sensor, shape (m, 4, 4)."""
    times: np.ndarray
    """When those were, likewise [s], shape (m,), rising."""


def sweep_motion(sensor: SensorFrame, losses: LossCounters | None = None, place: str = "") -> SweepMotion | None:
    """The motion to undo, so that all points of a frame are seen from where the sensor was at its version.

    Args:
        sensor: The frame.
        losses: Counts, as `not_compensated`, a frame whose points were taken at different times without poses that
            hold its version, and as `beyond_poses` the points that are more than a millisecond before or after the
            poses and take the nearest.
        place: Who counts.

    Returns:
        None where nothing is to be undone, or nothing is known.

    Raises:
        ValueError: Times or poses are not as many as they must be.
    """
    t = sensor.t
    if t is None or not t.any():
        return None
    if t.shape != (len(sensor.points),):
        raise ValueError(f"t must have shape ({len(sensor.points)},), as there are points, not {t.shape}")
    poses, times = sensor.poses, sensor.pose_times
    if poses is None or times is None or len(times) < 2 or not times[0] <= 0.0 <= times[-1]:
        if losses is not None:
            losses.count(place, "not_compensated", sensor.version)
        return None
    if np.shape(poses) != (len(times), 4, 4):
        raise ValueError(f"poses must have shape ({len(times)}, 4, 4), as there are pose_times, not {np.shape(poses)}")
    begin, end = float(t.min()), float(t.max())
    if losses is not None and (begin < times[0] - _NEAR_ENOUGH or end > times[-1] + _NEAR_ENOUGH):
        beyond = (t < times[0] - _NEAR_ENOUGH) | (t > times[-1] + _NEAR_ENOUGH)
        losses.count(place, "beyond_poses", sensor.version, int(beyond.sum()))
    # The poses from the last one before the points and the version to the first one after them.
    first = max(int(np.searchsorted(times, min(begin, 0.0), side="right")) - 1, 0)
    last = min(int(np.searchsorted(times, max(end, 0.0))), len(times) - 1)
    used = np.arange(first, max(last, first + 1) + 1)
    if len(used) > MAX_POSES:
        used = used[np.linspace(0, len(used) - 1, MAX_POSES).round().astype(int)]
    return SweepMotion(t, poses[used], times[used])
