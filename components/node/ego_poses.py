"""Poses of the sensor about a sweep, from odometry that knows the vehicle's at other times."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ...datamesh.messages.nav import Odometry

__all__ = ["MOST_AHEAD", "odometry_matrix", "pose_at_reference", "poses_about"]

MOST_AHEAD = 0.25
"""For how long a vehicle is taken to go on as it did, where odometry ends before the sweep or begins after it [s]."""


def odometry_matrix(odometry: Odometry) -> np.ndarray:
    """World from the frame whose pose it is, shape (4, 4), float64.

    Raises:
        ValueError: The orientation is no rotation.
    """
    at, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
    q = np.array([turn.w, turn.x, turn.y, turn.z])
    length = np.linalg.norm(q)
    if not np.isfinite([*q, at.x, at.y, at.z]).all() or abs(length - 1.0) > 1e-3:
        raise ValueError(f"the pose must be finite, its orientation of length 1, not {odometry.pose.pose}")
    w, x, y, z = q / length
    pose = np.eye(4)
    pose[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    pose[:3, 3] = at.x, at.y, at.z
    return pose


def poses_about(
    times: Sequence[float], poses: Sequence[np.ndarray], begin: float, end: float
) -> tuple[np.ndarray, np.ndarray] | None:
    """The poses that hold a stretch of time between them.

    Where they do not reach that far, the vehicle is taken to go on, or to have come, as it went between the nearest
    two of them, for up to `MOST_AHEAD`.

    Args:
        times: Rising [s].
        poses: World from sensor then, each of shape (4, 4).
        begin: Of the stretch [s].
        end: Of the stretch [s].

    Returns:
        Times, shape (m,), and poses, shape (m, 4, 4), m ≥ 2; None where there are too few, or they are too far away.
    """
    stamps = np.asarray(times, np.float64)
    if len(stamps) < 2:
        return None
    first = max(int(np.searchsorted(stamps, begin, side="right")) - 1, 0)
    last = min(int(np.searchsorted(stamps, end)), len(stamps) - 1)
    if last <= first:  # the stretch is before or after all of them
        first, last = (0, 1) if end <= stamps[0] else (len(stamps) - 2, len(stamps) - 1)
    used, known = stamps[first : last + 1], np.stack([poses[k] for k in range(first, last + 1)])
    if used[0] - begin > MOST_AHEAD or end - used[-1] > MOST_AHEAD:
        return None
    if begin < used[0]:
        before = _beyond(known[1], known[0], (used[0] - begin) / (used[1] - used[0]))
        used, known = np.append(begin, used), np.concatenate([before[None], known])
    if end > used[-1]:
        after = _beyond(known[-2], known[-1], (end - used[-1]) / (used[-1] - used[-2]))
        used, known = np.append(used, end), np.concatenate([known, after[None]])
    return used, known


def _beyond(one: np.ndarray, other: np.ndarray, share: float) -> np.ndarray:
    """Where it is after a further share of the way from one pose to the other."""
    from scipy.spatial.transform import Rotation

    pose = np.eye(4)
    turn = Rotation.from_matrix(one[:3, :3].T @ other[:3, :3]).as_rotvec()
    pose[:3, :3] = other[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    pose[:3, 3] = other[:3, 3] + share * (other[:3, 3] - one[:3, 3])
    return pose


def pose_at_reference(times: np.ndarray, poses: np.ndarray) -> np.ndarray:
    """The pose at time 0, between those before and after it, shape (4, 4)."""
    k = min(max(int(np.searchsorted(times, 0.0, side="right")) - 1, 0), len(times) - 2)
    return _beyond(poses[k], poses[k + 1], (0.0 - times[k + 1]) / (times[k + 1] - times[k]))
