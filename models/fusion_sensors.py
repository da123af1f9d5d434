"""What camera and radar say of boxes: which box each of their detections belongs to, and what it adds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .association import assign
from .geometry import box_corners, invert

__all__ = [
    "CameraView",
    "RadarView",
    "Support",
    "Targets",
    "camera_support",
    "distance_outside",
    "image_boxes",
    "radar_support",
    "radar_targets",
]

_NEAREST = 0.3  # before the camera [m]


class CameraView(Protocol):
    """The objects in one image, as `components.messages.CameraObjects`."""

    version: int
    sensor: str
    boxes: np.ndarray
    scores: np.ndarray
    classes: np.ndarray
    projection: np.ndarray
    size: tuple[int, int]
    pose: np.ndarray | None


class RadarView(Protocol):
    """The targets of one cycle, as `components.messages.RadarObjects`."""

    version: int
    sensor: str
    positions: np.ndarray
    radial_velocities: np.ndarray
    scores: np.ndarray
    mounting: np.ndarray
    velocity: np.ndarray | None
    pose: np.ndarray | None


@dataclass(frozen=True, eq=False, kw_only=True)
class Support:
    """What one sensor says of n boxes."""

    seen: np.ndarray
    """Whether it has a detection of the box, shape (n,), bool."""
    expected: np.ndarray
    """Whether the box is where the sensor looks, shape (n,), bool."""
    row: np.ndarray
    """Which detection, −1 for none, shape (n,), int64."""


def _then_from_now(pose: np.ndarray | None, then: np.ndarray | None) -> np.ndarray:
    """The sensor's frame at another time from that of now, shape (4, 4); equal where a pose is unknown."""
    return np.eye(4) if pose is None or then is None else invert(then) @ pose


def image_boxes(
    boxes: np.ndarray, camera: CameraView, pose: np.ndarray | None, velocities: np.ndarray | None, age: float
) -> tuple[np.ndarray, np.ndarray]:
    """Boxes as the camera saw them at its time.

    Args:
        boxes: In the LiDAR's frame of now, shape (n, 7).
        camera: The image's objects.
        pose: World from the LiDAR's frame now, or None.
        velocities: Over ground, by which they are taken back, shape (n, 2); None: they stood still.
        age: Of the image [s].

    Returns:
        Left, top, right, bottom, cut at the image's edges [pixels], zero for what is behind the camera, shape (n, 4);
        and whether at least a quarter of the area is in the image, shape (n,).
    """
    moved = np.array(boxes, np.float64).reshape(-1, 7)
    if velocities is not None:
        moved[:, :2] -= age * np.nan_to_num(velocities)
    T = camera.projection @ _then_from_now(pose, camera.pose)
    # A box is before the camera with all its corners, so with its centre too.
    ahead = np.flatnonzero(moved[:, :3] @ T[2, :3] + T[2, 3] > _NEAREST)
    uvw = box_corners(moved[ahead]) @ T[:, :3].T + T[:, 3]
    before = (uvw[..., 2] > _NEAREST).all(1)
    uv = uvw[..., :2] / np.maximum(uvw[..., 2:], _NEAREST)
    whole = np.concatenate([uv.min(1), uv.max(1)], axis=1)
    edges = np.array([*camera.size, *camera.size], np.float64)
    cut = np.clip(whole, 0.0, edges)
    area = np.prod(whole[:, 2:] - whole[:, :2], axis=1)
    inside = np.prod(cut[:, 2:] - cut[:, :2], axis=1)
    image, seen = np.zeros((len(moved), 4)), np.zeros(len(moved), bool)
    image[ahead], seen[ahead] = cut, before & (inside > 0.25 * area) & (inside > 1.0)
    return image, seen


def _overlaps(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection over union of image boxes, shape (n, m)."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    shared = np.prod(np.clip(high - low, 0.0, None), axis=2)
    areas = [np.prod(each[:, 2:] - each[:, :2], axis=1) for each in (a, b)]
    return shared / np.maximum(areas[0][:, None] + areas[1] - shared, 1e-9)


def camera_support(
    boxes: np.ndarray,
    first: np.ndarray,
    camera: CameraView,
    *,
    pose: np.ndarray | None,
    age: float,
    least_overlap: float,
    velocities: np.ndarray | None = None,
) -> Support:
    """Associates boxes and the objects of an image by the overlap in the image, at the least cost.

    Args:
        boxes: Shape (n, 7).
        first: Boxes that choose first; the others take what is left; shape (n,), bool.
        camera: The image's objects.
        pose: World from the LiDAR's frame now, or None.
        age: Of the image [s].
        least_overlap: Of what belongs together.
        velocities: Over ground, shape (n, 2), NaN where unknown.
    """
    projected, expected = image_boxes(boxes, camera, pose, velocities, age)
    row = np.full(len(boxes), -1)
    found = np.asarray(camera.boxes, np.float64).reshape(-1, 4)
    usable = np.isfinite(found).all(1) & np.isfinite(camera.scores) & (found[:, 2:] > found[:, :2]).all(1)
    free = np.flatnonzero(usable)
    for stage in (first, ~first):
        mine = np.flatnonzero(stage & expected)
        if not len(mine) or not len(free):
            continue
        # The farther of two boxes in line may be hidden by the nearer: the overlap decides.
        cost = (1.0 - _overlaps(projected[mine], found[free])) / (1.0 - least_overlap)
        chosen = assign(cost)
        row[mine[chosen >= 0]] = free[chosen[chosen >= 0]]
        free = np.setdiff1d(free, row[row >= 0])
    return Support(seen=row >= 0, expected=expected, row=row)


@dataclass(frozen=True, eq=False, kw_only=True)
class Targets:
    """The targets of a radar in the LiDAR's frame of now."""

    positions: np.ndarray
    """x y [m], shape (m, 2)."""
    directions: np.ndarray
    """Along the lines of sight, shape (m, 2)."""
    speeds: np.ndarray
    """Along these, over ground where the radar's own motion is known, else relative; NaN where neither is what is
    wanted; shape (m,) [m/s]."""
    scores: np.ndarray
    """Shape (m,)."""
    distances: np.ndarray
    """From the radar [m], shape (m,)."""


def radar_targets(radar: RadarView, pose: np.ndarray | None, age: float, ego_velocity: np.ndarray | None) -> Targets:
    """The targets of a radar, moved on to now.

    Args:
        radar: As it measured.
        pose: World from the LiDAR's frame now, or None: then speeds stay relative.
        age: Of the measurement [s].
        ego_velocity: Over ground along the LiDAR's axes [m/s], for a radar that does not know its own; or None.
    """
    positions = np.asarray(radar.positions, np.float64).reshape(-1, 3)
    speeds = np.asarray(radar.radial_velocities, np.float64).reshape(-1)
    scores = np.asarray(radar.scores, np.float64).reshape(-1)
    usable = np.isfinite(positions).all(1) & np.isfinite(speeds) & np.isfinite(scores)
    positions, speeds, scores = positions[usable], speeds[usable], scores[usable]
    distances = np.linalg.norm(positions, axis=1)
    rays = positions / np.maximum(distances, 1e-6)[:, None]
    own = radar.velocity
    if own is None and ego_velocity is not None:
        own = radar.mounting[:3, :3].T @ ego_velocity
    if pose is not None:
        speeds = speeds + rays @ own if own is not None else np.full(len(speeds), np.nan)
    now_from_then = invert(_then_from_now(pose, radar.pose)) @ radar.mounting
    directions = rays @ now_from_then[:3, :3].T
    moved = positions @ now_from_then[:3, :3].T + now_from_then[:3, 3]
    moved += (age * np.nan_to_num(speeds))[:, None] * directions
    flat = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1), 1e-6)[:, None]
    return Targets(positions=moved[:, :2], directions=flat, speeds=speeds, scores=scores, distances=distances)


def distance_outside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """How far points are from boxes on the ground, 0 inside, shape (n, m) [m]."""
    dx, dy = (points[None, :, k] - boxes[:, k, None] for k in (0, 1))
    c, s = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    along = np.abs(c * dx + s * dy) - 0.5 * boxes[:, 3, None]
    across = np.abs(c * dy - s * dx) - 0.5 * boxes[:, 4, None]
    return np.hypot(np.clip(along, 0.0, None), np.clip(across, 0.0, None))


def radar_support(boxes: np.ndarray, targets: Targets, *, gate: float, angle: float) -> Support:
    """Associates boxes and targets: a target belongs to the box it is in or nearest to, a box to its surest target.

    Args:
        boxes: In the LiDAR's frame, shape (n, 7).
        targets: Of one radar.
        gate: How far from a box its targets may be [m].
        angle: And besides, for each metre of distance [rad].
    """
    row = np.full(len(boxes), -1)
    if len(boxes) and len(targets.scores):
        off = distance_outside(targets.positions, np.asarray(boxes, np.float64)) / (gate + angle * targets.distances)
        owner = off.argmin(0)
        near = off[owner, np.arange(len(owner))] < 1.0
        for target in np.argsort(targets.scores, kind="stable"):
            if near[target]:
                row[owner[target]] = target
    # Whether a radar should have seen something depends on more than where it is: what it misses says nothing.
    return Support(seen=row >= 0, expected=np.zeros(len(boxes), bool), row=row)
