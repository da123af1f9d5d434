"""What camera and radar say of boxes: which box each of their detections belongs to, and what it adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .association import assign
from .geometry import invert

__all__ = [
    "CameraView",
    "RadarView",
    "Support",
    "Targets",
    "camera_support",
    "image_boxes",
    "nearest_boxes",
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
    """What s sensors say of n boxes."""

    row: np.ndarray
    """Which of its detections belongs to the box, −1 for none, shape (s, n), int64."""
    expected: np.ndarray
    """Whether the box is where the sensor looks, shape (s, n), bool."""

    @property
    def seen(self) -> np.ndarray:
        """Whether the sensor has a detection of the box, shape (s, n), bool."""
        return self.row >= 0


def _then_from_now(pose: np.ndarray | None, views: Sequence[CameraView] | Sequence[RadarView]) -> np.ndarray:
    """The LiDAR's frame at the time of each view from that of now, shape (s, 4, 4); equal where a pose is unknown."""
    known = np.array([pose is not None and view.pose is not None for view in views], bool)
    moved = np.tile(np.eye(4), (len(views), 1, 1))
    if pose is not None and known.any():
        moved[known] = invert(np.stack([view.pose for view in views if view.pose is not None])) @ pose
    return moved


def image_boxes(
    boxes: np.ndarray,
    cameras: Sequence[CameraView],
    pose: np.ndarray | None,
    velocities: np.ndarray | None,
    ages: Sequence[float] | np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Boxes as cameras saw them at their times.

    Args:
        boxes: In the LiDAR's frame of now, shape (n, 7).
        cameras: The objects of c images.
        pose: World from the LiDAR's frame now, or None.
        velocities: Over ground, by which they are taken back, shape (n, 2); None: they stood still.
        ages: Of the images [s], shape (c,).

    Returns:
        Left, top, right, bottom, cut at the image's edges [pixels], zero for what is behind the camera or beside the
        image, shape (c, n, 4); and whether at least a quarter of the area is in the image, shape (c, n).
    """
    boxes = np.array(boxes, np.float64).reshape(-1, 7)
    c, n = len(cameras), len(boxes)
    image, seen = np.zeros((c, n, 4)), np.zeros((c, n), bool)
    if not c or not n:
        return image, seen
    T = np.stack([np.asarray(camera.projection, np.float64) for camera in cameras]) @ _then_from_now(pose, cameras)
    edges = np.array([camera.size for camera in cameras], np.float64)
    back = np.zeros((c, n, 2))
    if velocities is not None:
        back = np.asarray(ages, np.float64)[:, None, None] * np.nan_to_num(velocities)
    x, y, z = boxes[:, 0] - back[..., 0], boxes[:, 1] - back[..., 1], boxes[:, 2]
    centre = np.stack([T[:, k, 0, None] * x + T[:, k, 1, None] * y + (T[:, k, 2, None] * z + T[:, k, 3, None])
                       for k in range(3)])  # fmt: skip
    # A box is before the camera with all its corners, so with its centre too; and it is beside an edge of the image
    # where the sphere around it is.
    radius = 0.5 * np.sqrt((boxes[:, 3:6] ** 2).sum(1))
    near = centre[2] > _NEAREST
    for k in range(2):
        inner, outer = T[:, k, :3], edges[:, k, None] * T[:, 2, :3] - T[:, k, :3]
        near &= centre[k] + np.sqrt((inner**2).sum(1))[:, None] * radius > 0.0
        near &= edges[:, k, None] * centre[2] - centre[k] + np.sqrt((outer**2).sum(1))[:, None] * radius > 0.0
    of, box = np.nonzero(near)
    axes = _half_axes(boxes)[:, :, box]
    M = np.ascontiguousarray(T.transpose(1, 2, 0))[:, :3, of]
    along, across, up = (M[:, 0] * a[0] + M[:, 1] * a[1] + M[:, 2] * a[2] for a in axes)
    corners = np.stack([-along, along], 1)[:, :, None] + np.stack([-across, across], 1)[:, None]
    corners = corners[:, :, :, None] + np.stack([-up, up], 1)[:, None, None]
    uvw = corners.reshape(3, 8, len(of)) + centre[:, None, of, box]
    uv = uvw[:2] / np.maximum(uvw[2], _NEAREST)
    low, high, limit = uv.min(1), uv.max(1), edges[of].T
    cut_low, cut_high = np.clip(low, 0.0, limit), np.clip(high, 0.0, limit)
    area, inside = np.prod(high - low, axis=0), np.prod(cut_high - cut_low, axis=0)
    image[of, box] = np.concatenate([cut_low, cut_high]).T
    seen[of, box] = (uvw[2].min(0) > _NEAREST) & (inside > 0.25 * area) & (inside > 1.0)
    return image, seen


def _half_axes(boxes: np.ndarray) -> np.ndarray:
    """From the centre of each box to the middles of its front, its left side and its top, shape (3, 3, n)."""
    c, s, zero = np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))
    length, width, height = 0.5 * boxes[:, 3:6].T
    return np.array([[length * c, length * s, zero], [-width * s, width * c, zero], [zero, zero, height]])


def _overlapping(
    a: np.ndarray, b: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of pairs of image boxes those that overlap, and their intersection over union.

    Args:
        a: Left, top, right, bottom, shape (4, n).
        b: Likewise, shape (4, m).
        rows: The column in `a` of each pair, shape (k,).
        columns: Likewise in `b`.
    """
    shared = np.ones(1)
    for axis in range(2):  # most pairs are apart along the first already
        side = np.minimum(a[axis + 2][rows], b[axis + 2][columns]) - np.maximum(a[axis][rows], b[axis][columns])
        meet = np.flatnonzero(side > 0.0)
        rows, columns, shared = rows[meet], columns[meet], (shared if axis == 0 else shared[meet]) * side[meet]
    areas = [(each[2] - each[0]) * (each[3] - each[1]) for each in (a, b)]
    return rows, columns, shared / np.maximum(areas[0][rows] + areas[1][columns] - shared, 1e-9)


def _assign_pairs(rows: np.ndarray, columns: np.ndarray, cost: np.ndarray) -> np.ndarray:
    """Which pairs are made at the least cost, where all others cost 1, as much as it costs to stay alone.

    Args:
        rows: Of each pair that may be, shape (k,).
        columns: Likewise.
        cost: Below 1, likewise.

    Returns:
        Shape (k,), bool.
    """
    made = (np.bincount(rows)[rows] == 1) & (np.bincount(columns)[columns] == 1)  # nobody else wants either
    contested = np.flatnonzero(~made)
    if len(contested):
        of_row, row = np.unique(rows[contested], return_inverse=True)
        of_column, column = np.unique(columns[contested], return_inverse=True)
        table = np.ones((len(of_row), len(of_column)))
        table[row, column] = cost[contested]
        made[contested] = assign(table)[row] == column
    return made


def camera_support(
    boxes: np.ndarray,
    first: np.ndarray,
    cameras: Sequence[CameraView],
    *,
    pose: np.ndarray | None,
    ages: Sequence[float] | np.ndarray,
    least_overlap: float,
    velocities: np.ndarray | None = None,
) -> Support:
    """Associates boxes and the objects of each image by the overlap in it, at the least cost.

    Args:
        boxes: Shape (n, 7).
        first: Boxes that choose first; the others take what is left; shape (n,), bool.
        cameras: The objects of c images.
        pose: World from the LiDAR's frame now, or None.
        ages: Of the images [s], shape (c,).
        least_overlap: Of what belongs together.
        velocities: Over ground, shape (n, 2), NaN where unknown.

    Raises:
        ValueError: A camera has not as many scores and classes as boxes.
    """
    projected, expected = image_boxes(boxes, cameras, pose, velocities, ages)
    row = np.full(expected.shape, -1)
    found = [np.reshape(camera.boxes, (-1, 4)) for camera in cameras]
    for camera, each in zip(cameras, found, strict=True):
        if np.size(camera.scores) != len(each) or np.size(camera.classes) != len(each):
            raise ValueError(
                f"{camera.sensor} has {len(each)} boxes, {np.size(camera.scores)} scores and "
                f"{np.size(camera.classes)} classes; expected as many of each"
            )
    camera, box = np.nonzero(expected)
    counts = np.array([len(each) for each in found], np.int64)
    if not len(box) or not counts.sum():
        return Support(row=row, expected=expected)
    # All pairs of a box and an object of the same image.
    objects = np.ascontiguousarray(np.concatenate(found).T, np.float64)
    usable = np.isfinite(objects).all(0) & np.isfinite(np.concatenate([np.ravel(each.scores) for each in cameras]))
    usable &= (objects[2] > objects[0]) & (objects[3] > objects[1])
    objects = np.where(usable, objects, 0.0)
    begin, many = np.cumsum(counts) - counts, counts[camera]
    pair = np.repeat(np.arange(len(box)), many)
    other = np.arange(len(pair)) + np.repeat(begin[camera] - (np.cumsum(many) - many), many)
    pair, other, overlap = _overlapping(np.ascontiguousarray(projected[camera, box].T), objects, pair, other)
    # The farther of two boxes in line may be hidden by the nearer: the overlap decides.
    cost = (1.0 - overlap) / (1.0 - least_overlap)
    taken = np.zeros(objects.shape[1], bool)
    for stage in (first, ~first):
        may = np.flatnonzero((cost < 1.0) & stage[box[pair]] & ~taken[other])
        made = may[_assign_pairs(pair[may], other[may], cost[may])]
        taken[other[made]] = True
        which = camera[pair[made]]
        row[which, box[pair[made]]] = other[made] - begin[which]
    return Support(row=row, expected=expected)


@dataclass(frozen=True, eq=False, kw_only=True)
class Targets:
    """The targets of radars in the LiDAR's frame of now."""

    radar: np.ndarray
    """Which radar has it, rising, shape (m,), int64."""
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


def radar_targets(
    radars: Sequence[RadarView],
    pose: np.ndarray | None,
    ages: Sequence[float] | np.ndarray,
    ego_velocity: np.ndarray | None,
) -> Targets:
    """The targets of radars, moved on to now.

    Args:
        radars: As they measured.
        pose: World from the LiDAR's frame now, or None: then speeds stay relative.
        ages: Of the measurements [s].
        ego_velocity: Over ground along the LiDAR's axes [m/s], for a radar that does not know its own; or None.
    """
    none = np.empty((0, 3))
    positions = np.concatenate([none, *(np.asarray(each.positions, np.float64).reshape(-1, 3) for each in radars)])
    counts = np.array([np.size(each.scores) for each in radars], np.int64)
    speeds = np.concatenate([none[:, 0], *(np.reshape(each.radial_velocities, -1) for each in radars)])
    scores = np.concatenate([none[:, 0], *(np.reshape(each.scores, -1) for each in radars)])
    usable = np.isfinite(positions).all(1) & np.isfinite(speeds) & np.isfinite(scores)
    of = np.repeat(np.arange(len(radars)), counts)[usable]
    positions, speeds, scores = positions[usable], speeds[usable], scores[usable]
    distances = np.linalg.norm(positions, axis=1)
    rays = positions / np.maximum(distances, 1e-6)[:, None]
    if pose is not None:
        unknown = np.full(3, np.nan)
        own = [each.velocity for each in radars]
        if ego_velocity is not None:
            own = [
                each.mounting[:3, :3].T @ ego_velocity if known is None else known
                for each, known in zip(radars, own, strict=True)
            ]
        own = np.array([unknown if each is None else each for each in own], np.float64).reshape(-1, 3)
        speeds = speeds + (rays * own[of]).sum(1)
    mountings = np.array([each.mounting for each in radars], np.float64).reshape(-1, 4, 4)
    now_from_then = (invert(_then_from_now(pose, radars)) @ mountings)[of]
    directions = _turned(now_from_then, rays)
    moved = _turned(now_from_then, positions) + now_from_then[:, :3, 3]
    moved += (np.array(ages, np.float64)[of] * np.nan_to_num(speeds))[:, None] * directions
    flat = directions[:, :2] / np.maximum(np.linalg.norm(directions[:, :2], axis=1), 1e-6)[:, None]
    return Targets(radar=of, positions=moved[:, :2], directions=flat, speeds=speeds, scores=scores, distances=distances)


def _turned(T: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Each vector by the rotation of its own, shape (m, 3)."""
    return (T[:, :3, :3] * vectors[:, None]).sum(2)


def nearest_boxes(points: np.ndarray, boxes: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """The box on the ground that each point is in or nearest to, −1 where none is as near as its reach, shape (m,).

    Args:
        points: x y [m], shape (m, 2).
        boxes: Shape (n, 7).
        reach: Of each point [m], shape (m,).
    """
    owner = np.full(len(points), -1)
    dx, dy = (points[:, k] - boxes[:, k, None] for k in (0, 1))
    circle = 0.5 * np.sqrt(boxes[:, 3] ** 2 + boxes[:, 4] ** 2)[:, None] + reach
    box, point = np.nonzero(dx * dx + dy * dy < circle * circle)
    dx, dy = dx[box, point], dy[box, point]
    c, s = np.cos(boxes[:, 6])[box], np.sin(boxes[:, 6])[box]
    along, across = np.abs(c * dx + s * dy) - 0.5 * boxes[box, 3], np.abs(c * dy - s * dx) - 0.5 * boxes[box, 4]
    off = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    order = np.lexsort((-box, -off, point))
    order = order[off[order] < reach[point[order]]]
    owner[point[order]] = box[order]  # the last of each, which is the nearest, stays
    return owner


def radar_support(boxes: np.ndarray, targets: Targets, *, radars: int, gate: float, angle: float) -> Support:
    """Associates boxes and targets: a target belongs to the box it is in or nearest to, a box to its surest target.

    Args:
        boxes: In the LiDAR's frame, shape (n, 7).
        targets: Of all radars; rows are among these.
        radars: How many radars there are.
        gate: How far from a box its targets may be [m].
        angle: And besides, for each metre of distance [rad].
    """
    row = np.full((radars, len(boxes)), -1)
    owner = nearest_boxes(targets.positions, np.asarray(boxes, np.float64), gate + angle * targets.distances)
    order = np.argsort(targets.scores, kind="stable")
    order = order[owner[order] >= 0]
    row[targets.radar[order], owner[order]] = order  # of several the last one stays
    # Whether a radar should have seen something depends on more than where it is: what it misses says nothing.
    return Support(row=row, expected=np.zeros(row.shape, bool))
