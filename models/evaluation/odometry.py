"""How far an estimated trajectory is from the true one: absolute, relative, and as KITTI's odometry benchmark has it.

A trajectory is the world from the sensor, pose by pose, shape (n, 4, 4); both are of the same moments. Only motion
counts: where and how either world lies does not, but for the absolute error without alignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..geometry import invert

__all__ = [
    "KITTI_LENGTHS",
    "KittiOdometryError",
    "RelativePoseError",
    "TrajectoryError",
    "absolute_trajectory_error",
    "align_trajectory",
    "kitti_odometry_error",
    "path_length",
    "relative_pose_error",
]

KITTI_LENGTHS = (100, 200, 300, 400, 500, 600, 700, 800)
"""Lengths of the segments of KITTI's benchmark [m]."""

_KITTI_STEP = 10  # a segment begins at every tenth pose


@dataclass(frozen=True)
class TrajectoryError:
    """Distances of the estimated places from the true ones [m]."""

    rmse: float
    mean: float
    median: float
    max: float


@dataclass(frozen=True)
class RelativePoseError:
    """How wrong the motion over a number of frames is."""

    translation_rmse: float
    """Of the translation's error [m]."""
    translation_mean: float
    rotation_rmse: float
    """Of the angle by which the rotation is wrong [rad]."""
    rotation_mean: float


@dataclass(frozen=True)
class KittiOdometryError:
    """KITTI's two numbers; NaN where the trajectory is shorter than any segment."""

    translation: float
    """Mean error of the translation over all segments [%]."""
    rotation: float
    """Mean error of the rotation over all segments [° per metre]."""
    segments: int
    """How many segments there are."""
    by_length: dict[int, tuple[float, float]]
    """The same two by length of the segment [m], for lengths that occur."""


def _checked(estimate: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    estimate, truth = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if truth.ndim != 3 or truth.shape[1:] != (4, 4) or estimate.shape != truth.shape or not len(truth):
        raise ValueError(
            f"estimate and truth must both have shape (n, 4, 4) with n ≥ 1, not {estimate.shape} and {truth.shape}"
        )
    for name, poses in (("estimate", estimate), ("truth", truth)):
        if not np.isfinite(poses).all():
            raise ValueError(f"{name} has poses that are not finite, the first number {_first_bad(poses)}")
    return estimate, truth


def _first_bad(poses: np.ndarray) -> int:
    return int(np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2)))[0])


def path_length(poses: np.ndarray) -> float:
    """How far the way along the poses is [m]; shape (n, 4, 4)."""
    return float(np.linalg.norm(np.diff(np.asarray(poses, np.float64)[:, :3, 3], axis=0), axis=1).sum())


def align_trajectory(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """The rigid motion that brings the places of one trajectory closest to those of another (Umeyama, 1991).

    Args:
        estimate: Shape (n, 4, 4).
        truth: Shape (n, 4, 4).

    Returns:
        Truth's world from the estimate's, shape (4, 4).

    Raises:
        ValueError: The shapes differ, or a pose is not finite.
    """
    estimate, truth = _checked(estimate, truth)
    a, b = estimate[:, :3, 3], truth[:, :3, 3]
    u, _, vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    T = np.eye(4)
    T[:3, :3] = u @ mirror @ vt
    T[:3, 3] = b.mean(0) - T[:3, :3] @ a.mean(0)
    return T


def absolute_trajectory_error(estimate: np.ndarray, truth: np.ndarray, *, align: bool = True) -> TrajectoryError:
    """The absolute trajectory error (Sturm et al., 2012): distances of places of the same moment.

    Args:
        estimate: Shape (n, 4, 4).
        truth: Shape (n, 4, 4).
        align: Brings the estimate closest to the truth first, by a rigid motion.

    Raises:
        ValueError: The shapes differ, or a pose is not finite.
    """
    estimate, truth = _checked(estimate, truth)
    if align:
        estimate = align_trajectory(estimate, truth) @ estimate
    distance = np.linalg.norm(estimate[:, :3, 3] - truth[:, :3, 3], axis=1)
    return TrajectoryError(
        float(np.sqrt(np.mean(distance**2))), float(distance.mean()), float(np.median(distance)), float(distance.max())
    )


def relative_pose_error(estimate: np.ndarray, truth: np.ndarray, *, delta: int = 1) -> RelativePoseError:
    """The relative pose error (Sturm et al., 2012): how wrong the motion from each pose to a later one is.

    Args:
        estimate: Shape (n, 4, 4).
        truth: Shape (n, 4, 4).
        delta: How many poses later, 1 to n − 1.

    Raises:
        ValueError: The shapes differ, a pose is not finite, or `delta` does not fit.
    """
    estimate, truth = _checked(estimate, truth)
    if not 1 <= delta < len(truth):
        raise ValueError(f"delta must be 1 to {len(truth) - 1} for {len(truth)} poses, not {delta}")
    error = invert(invert(truth[:-delta]) @ truth[delta:]) @ (invert(estimate[:-delta]) @ estimate[delta:])
    translation = np.linalg.norm(error[:, :3, 3], axis=1)
    rotation = _angle(error)
    return RelativePoseError(
        float(np.sqrt(np.mean(translation**2))),
        float(translation.mean()),
        float(np.sqrt(np.mean(rotation**2))),
        float(rotation.mean()),
    )


def kitti_odometry_error(
    estimate: np.ndarray, truth: np.ndarray, *, lengths: tuple[int, ...] = KITTI_LENGTHS
) -> KittiOdometryError:
    """The errors of KITTI's odometry benchmark (Geiger et al., 2012), as its development kit computes them.

    From every tenth pose, over each length along the true way, the motion's error divided by the length.

    Args:
        estimate: Shape (n, 4, 4).
        truth: Shape (n, 4, 4).
        lengths: Of the segments [m]; shorter ones than KITTI's for shorter trajectories.

    Raises:
        ValueError: The shapes differ, a pose is not finite, or a length is not positive.
    """
    estimate, truth = _checked(estimate, truth)
    if not lengths or min(lengths) <= 0:
        raise ValueError(f"lengths must be positive numbers of metres, not {lengths}")
    steps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    first = np.arange(0, len(truth), _KITTI_STEP)
    by_length: dict[int, tuple[float, float]] = {}
    segments, translations, rotations = 0, 0.0, 0.0
    for length in lengths:
        last = np.searchsorted(way, way[first] + length, side="right")
        ends = last < len(truth)
        if not ends.any():
            continue
        a, b = first[ends], last[ends]
        error = invert(invert(estimate[a]) @ estimate[b]) @ (invert(truth[a]) @ truth[b])
        translation = np.linalg.norm(error[:, :3, 3], axis=1) / length
        rotation = _angle(error) / length
        by_length[length] = (100.0 * float(translation.mean()), float(np.degrees(rotation.mean())))
        segments += len(a)
        translations += float(translation.sum())
        rotations += float(rotation.sum())
    if not segments:
        return KittiOdometryError(float("nan"), float("nan"), 0, {})
    return KittiOdometryError(
        100.0 * translations / segments, float(np.degrees(rotations / segments)), segments, by_length
    )


def _angle(T: np.ndarray) -> np.ndarray:
    """The angle of each rotation [rad], exact for small ones too."""
    R = T[..., :3, :3]
    skew = np.stack([R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]], axis=-1)
    return np.arctan2(np.linalg.norm(skew, axis=-1), np.trace(R, axis1=-2, axis2=-1) - 1.0)
