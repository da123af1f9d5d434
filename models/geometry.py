"""Rigid motions, oriented boxes, and KITTI's frames, in NumPy.

A box is centre x y z, length width height [m], yaw about z from x [rad]; it may carry further columns, which
every function leaves as they are. A transform `T` is a 4 × 4 matrix "to from from": `p_to = T @ p_from`.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import SourceError

__all__ = [
    "KittiCalibration",
    "box_corners",
    "box_corners_bev",
    "box_overlap",
    "invert",
    "kitti_poses",
    "points_in_boxes",
    "quaternion",
    "rigid",
    "rotation_vector",
    "transform_boxes",
    "transform_points",
    "transform_yaw",
    "turned",
    "wrap_angle",
]

_EARTH_RADIUS = 6378137.0  # [m], WGS 84's equator, as KITTI's development kit has it

# Corners of the unit box, counter-clockwise from above beginning at front left; the four below, then the four above.
_CORNERS_BEV = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
_CORNERS = np.concatenate([np.c_[_CORNERS_BEV, np.full(4, -0.5)], np.c_[_CORNERS_BEV, np.full(4, 0.5)]])


def wrap_angle(angle):
    """Angles brought into [−π, π) [rad]; a number or an array of any shape."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def rigid(translation=(0.0, 0.0, 0.0), *, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0) -> np.ndarray:
    """A rigid motion from a translation [m] and angles [rad], rotating about x, then y, then z; shape (4, 4)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    T = np.eye(4)
    T[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    T[:3, 3] = translation
    return T


def invert(T: np.ndarray) -> np.ndarray:
    """The inverse of rigid motions, shape (…, 4, 4); cheaper and more exact than a general inverse."""
    T = np.asarray(T, np.float64)
    inverse = np.zeros_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, 3] = 1.0
    return inverse


def quaternion(turn: np.ndarray) -> np.ndarray:
    """The unit quaternion w x y z of a rotation matrix, shape (4,); the first that is not 0 is positive.

    Of the four formulas the one by the largest part (Shepperd, "Quaternion from rotation matrix", 1978).
    """
    m = np.asarray(turn, np.float64)
    x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2]
    a, b, c = np.diag(m)
    # Each row is the quaternion, times four of its parts.
    rows = np.array(
        [[1 + a + b + c, x, y, z], [x, 1 + a - b - c, xy, xz], [y, xy, 1 - a + b - c, yz], [z, xz, yz, 1 - a - b + c]]
    )
    row = rows[np.diag(rows).argmax()]
    row = row / np.linalg.norm(row)
    return -row if row[np.flatnonzero(row)[0]] < 0 else row


def rotation_vector(turn: np.ndarray) -> np.ndarray:
    """Axis times angle [rad], up to π, of a rotation matrix, shape (3,)."""
    q = quaternion(turn)
    sine = np.linalg.norm(q[1:])
    return q[1:] * (2.0 * np.arctan2(sine, q[0]) / sine) if sine > 0 else np.zeros(3)


def turned(vector: np.ndarray) -> np.ndarray:
    """The rotation matrix of an axis times an angle [rad], shape (3, 3) (Rodrigues)."""
    x, y, z = np.asarray(vector, np.float64)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    share = np.linalg.norm((x, y, z)) / np.pi
    # NumPy's sinc(s) is sin(πs) / πs, and 1 at 0.
    return np.eye(3) + np.sinc(share) * cross + 0.5 * np.sinc(0.5 * share) ** 2 * cross @ cross


def transform_points(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Points moved by `T`.

    Args:
        points: x y z [m] and any further columns, which stay; shape (n, 3 + c).
        T: Shape (4, 4).

    Returns:
        A new array of the same shape; float32 for float32 points, else float64.
    """
    points = np.asarray(points)
    moved = points.astype(np.float32 if points.dtype == np.float32 else np.float64)
    moved[:, :3] = points[:, :3].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    return moved


def transform_yaw(yaw: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Headings seen in the frame that `T` leads to, in [−π, π] [rad]: the rotated heading laid onto the plane."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.arctan2(T[1, 0] * c + T[1, 1] * s, T[0, 0] * c + T[0, 1] * s)


def transform_boxes(boxes: np.ndarray, T: np.ndarray) -> np.ndarray:
    """Boxes moved by `T`: centres in full, headings about z only, as a box stays upright.

    Args:
        boxes: x y z l w h yaw and any further columns, which stay; shape (k, 7 + c).
        T: Shape (4, 4).

    Returns:
        A new array of the same shape; float32 for float32 boxes, else float64.
    """
    moved = transform_points(boxes, T)
    moved[:, 6] = transform_yaw(np.asarray(boxes[:, 6], np.float64), T)
    return moved


def box_corners_bev(boxes: np.ndarray) -> np.ndarray:
    """The corners from above, counter-clockwise: front left, rear left, rear right, front right; shape (k, 4, 2)."""
    boxes = np.asarray(boxes, np.float64)
    return box_corners(boxes)[:, :4, :2]


def box_corners(boxes: np.ndarray) -> np.ndarray:
    """The corners: the four of `box_corners_bev` at the bottom, then at the top; shape (k, 8, 3), float64."""
    boxes = np.asarray(boxes, np.float64)
    local = _CORNERS * boxes[:, None, 3:6]
    c, s = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    corners = np.empty((len(boxes), 8, 3))
    corners[..., 0] = boxes[:, None, 0] + c * local[..., 0] - s * local[..., 1]
    corners[..., 1] = boxes[:, None, 1] + s * local[..., 0] + c * local[..., 1]
    corners[..., 2] = boxes[:, None, 2] + local[..., 2]
    return corners


def points_in_boxes(points: np.ndarray, boxes: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which points lie in which box, faces included.

    Args:
        points: x y z [m] and any further columns, shape (n, 3 + c); a non-finite point is in no box.
        boxes: Shape (k, 7).
        margin: Added to every face of the boxes [m].

    Returns:
        Shape (k, n), bool.
    """
    xyz = np.asarray(points)[:, :3].astype(np.float64)
    boxes = np.asarray(boxes, np.float64)
    inside = np.zeros((len(boxes), len(xyz)), bool)
    x, y, z = np.ascontiguousarray(xyz.T)
    for row, box in zip(inside, boxes, strict=True):
        half = 0.5 * box[3:6] + margin
        # Most points are far away: the turned test is for those within the box's circle only.
        near = np.flatnonzero(
            (np.abs(x - box[0]) <= half[0] + half[1])
            & (np.abs(y - box[1]) <= half[0] + half[1])
            & (np.abs(z - box[2]) <= half[2])
        )
        dx, dy, c, s = x[near] - box[0], y[near] - box[1], np.cos(box[6]), np.sin(box[6])
        row[near] = (np.abs(c * dx + s * dy) <= half[0]) & (np.abs(c * dy - s * dx) <= half[1])
    return inside


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiCalibration:
    """How the sensors of a KITTI recording stand to each other."""

    projection: np.ndarray
    """Pixels from rectified camera frame for the cameras 0 to 3, shape (4, 3, 4); NaN where the file has none."""
    rectify: np.ndarray
    """Rectified from plain frame of camera 0, shape (4, 4)."""
    camera_from_lidar: np.ndarray
    """Plain frame of camera 0 from lidar, shape (4, 4)."""
    lidar_from_imu: np.ndarray | None
    """Shape (4, 4); None where the file has none."""

    @classmethod
    def read(cls, path: str | os.PathLike) -> KittiCalibration:
        """Reads a calibration file of KITTI's object or tracking set, or one of its raw recordings in one file.

        Raises:
            SourceError: The file is missing or unreadable, or lacks the rectification or the lidar's place.
        """
        path = Path(path)
        values = _read_kitti_keys(path)

        def matrix(shape: tuple[int, int], *names: str) -> np.ndarray | None:
            found = next((values[name] for name in names if name in values), None)
            if found is not None and found.size != shape[0] * shape[1]:
                raise SourceError(f"{path}: {names[0]} has {found.size} numbers, expected {shape[0] * shape[1]}")
            return None if found is None else found.reshape(shape)

        def homogeneous(part: np.ndarray) -> np.ndarray:
            T = np.eye(4)
            T[:3, : part.shape[1]] = part
            return T

        rectify = matrix((3, 3), "R0_rect", "R_rect", "R_rect_00")
        lidar = matrix((3, 4), "Tr_velo_to_cam", "Tr_velo_cam")
        imu = matrix((3, 4), "Tr_imu_to_velo", "Tr_imu_velo")
        if rectify is None or lidar is None:
            raise SourceError(f"{path}: a KITTI calibration needs R0_rect and Tr_velo_to_cam; found {sorted(values)}")
        projections = [matrix((3, 4), f"P{i}", f"P_rect_0{i}") for i in range(4)]
        return cls(
            projection=np.stack([np.full((3, 4), np.nan) if P is None else P for P in projections]),
            rectify=homogeneous(rectify),
            camera_from_lidar=homogeneous(lidar),
            lidar_from_imu=None if imu is None else homogeneous(imu),
        )

    @property
    def rectified_from_lidar(self) -> np.ndarray:
        """Rectified frame of camera 0 (x right, y down, z forward), where KITTI's labels are, from lidar."""
        return self.rectify @ self.camera_from_lidar

    def boxes_from_camera(self, labels: np.ndarray) -> np.ndarray:
        """KITTI's camera boxes as boxes in the lidar frame.

        Args:
            labels: h w l x y z ry as in a label file: the bottom's centre in the rectified camera frame, the
                heading about the camera's y; shape (k, 7).

        Returns:
            Boxes x y z l w h yaw in the lidar frame, shape (k, 7), float64.
        """
        labels = np.asarray(labels, np.float64).reshape(-1, 7)
        h, w, l, x, y, z, ry = labels.T  # noqa: E741 (KITTI's own names)
        lidar_from_rectified = invert(self.rectified_from_lidar)
        boxes = np.empty_like(labels)
        boxes[:, :3] = np.stack([x, y - 0.5 * h, z], axis=1) @ lidar_from_rectified[:3, :3].T
        boxes[:, :3] += lidar_from_rectified[:3, 3]
        boxes[:, 3:6] = np.stack([l, w, h], axis=1)
        heading = np.stack([np.cos(ry), np.zeros_like(ry), -np.sin(ry)], axis=1) @ lidar_from_rectified[:3, :3].T
        boxes[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
        return boxes

    def boxes_to_camera(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes of the lidar frame as KITTI's camera boxes h w l x y z ry, the inverse of `boxes_from_camera`.

        The two frames' vertical axes differ by about a degree, and a box is upright in either: headings come
        back to within 0.1°.
        """
        boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
        T = self.rectified_from_lidar
        labels = np.empty_like(boxes)
        labels[:, :3] = boxes[:, [5, 4, 3]]
        labels[:, 3:6] = boxes[:, :3] @ T[:3, :3].T + T[:3, 3]
        labels[:, 4] += 0.5 * boxes[:, 5]
        heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes))], axis=1) @ T[:3, :3].T
        labels[:, 6] = np.arctan2(-heading[:, 2], heading[:, 0])
        return labels

    def project(self, points: np.ndarray, camera: int = 2) -> tuple[np.ndarray, np.ndarray]:
        """Where points of the lidar frame fall in a camera's image.

        Returns:
            Pixels u v, shape (n, 2), and the depth along the camera's axis [m], shape (n,): not above zero for
            what is behind the camera, where u v mean nothing.
        """
        xyz1 = np.c_[np.asarray(points, np.float64)[:, :3], np.ones(len(points))]
        uvw = xyz1 @ (self.projection[camera] @ self.rectified_from_lidar).T
        with np.errstate(divide="ignore", invalid="ignore"):
            return uvw[:, :2] / uvw[:, 2:], uvw[:, 2]


def _read_kitti_keys(path: Path) -> dict[str, np.ndarray]:
    """The lines `name: numbers` (in the tracking set some lack the colon) of a calibration file."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: cannot read the calibration: {reason or error}") from error
    values = {}
    for number, line in enumerate(lines, 1):
        name, *numbers = line.split() or [""]
        if not numbers:
            continue
        try:
            values[name.rstrip(":")] = np.array([float(n) for n in numbers])
        except ValueError:
            # Raw recordings also hold a date and the like; a wanted matrix that is garbled must not pass.
            if name.startswith(("P", "R", "Tr")):
                raise SourceError(f"{path}, line {number}: {name} is not a row of numbers: {line!r}") from None
    return values


def kitti_poses(oxts: np.ndarray, lidar_from_imu: np.ndarray | None = None) -> np.ndarray:
    """Ego poses from KITTI's GPS/IMU records, by a Mercator projection as in KITTI's development kit.

    Args:
        oxts: One record a row: latitude, longitude [°], altitude [m], roll, pitch, yaw [rad], and any more;
            shape (n, 6 + c).
        lidar_from_imu: Gives the lidar's poses instead of the IMU's (`KittiCalibration.lidar_from_imu`).

    Returns:
        First frame from each frame, shape (n, 4, 4), float64; the first is the identity.
    """
    oxts = np.atleast_2d(np.asarray(oxts, np.float64))
    if oxts.ndim != 2 or oxts.shape[1] < 6:
        raise ValueError(f"oxts has shape {oxts.shape}; expected (n, 6 or more): lat lon alt roll pitch yaw")
    latitude, longitude = np.radians(oxts[:, 0]), np.radians(oxts[:, 1])
    scale = np.cos(latitude[0]) * _EARTH_RADIUS
    north = scale * np.log(np.tan(0.25 * np.pi + 0.5 * latitude))
    places = np.stack([scale * longitude, north, oxts[:, 2]], axis=1)
    places -= places[0]  # before any product, so that centimetres survive beside thousands of kilometres
    poses = np.stack([
        rigid(place, roll=r, pitch=p, yaw=y) for place, (r, p, y) in zip(places, oxts[:, 3:6], strict=True)
    ])  # fmt: skip
    if lidar_from_imu is not None:
        poses = poses @ invert(lidar_from_imu)
    return invert(poses[0]) @ poses


def box_overlap(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How pairs of boxes overlap, row by row.

    The intersection from above is found by clipping one rectangle by the other's four edges (Sutherland and
    Hodgman, 1974), all pairs at once; above zero it is exact to about 1e-12 of the area.

    Args:
        a: Boxes of positive size, shape (k, 7).
        b: Boxes of positive size, shape (k, 7).

    Returns:
        Intersection over union from above, in space, and the generalised one in space (Rezatofighi et al., 2019;
        the enclosing body here is the axis-aligned one, in the frame of `a`), each of shape (k,), float64.
    """
    a, b = np.asarray(a, np.float64).reshape(-1, 7), np.asarray(b, np.float64).reshape(-1, 7)
    # In the frame of `a`, where its faces are planes of the axes.
    c, s = np.cos(a[:, 6]), np.sin(a[:, 6])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    turn = b[:, 6] - a[:, 6]
    cosine, sine = np.cos(turn)[:, None], np.sin(turn)[:, None]
    local = _CORNERS_BEV * b[:, None, 3:5]
    px = (c * dx + s * dy)[:, None] + cosine * local[..., 0] - sine * local[..., 1]
    py = (c * dy - s * dx)[:, None] + sine * local[..., 0] + cosine * local[..., 1]
    half_length, half_width = 0.5 * a[:, 3:4], 0.5 * a[:, 4:5]

    enclosing = (np.maximum(px.max(1), half_length[:, 0]) - np.minimum(px.min(1), -half_length[:, 0])) * (
        np.maximum(py.max(1), half_width[:, 0]) - np.minimum(py.min(1), -half_width[:, 0])
    )
    qx, qy = px, py
    for limit, along_x, sign in (
        (half_length, True, 1.0),
        (half_length, True, -1.0),
        (half_width, False, 1.0),
        (half_width, False, -1.0),
    ):
        qx, qy = _clip(qx, qy, limit - sign * (qx if along_x else qy))
    area = 0.5 * np.abs((qx * np.roll(qy, -1, 1) - qy * np.roll(qx, -1, 1)).sum(1))
    area_a, area_b = a[:, 3] * a[:, 4], b[:, 3] * b[:, 4]
    top, bottom = a[:, 2] + 0.5 * a[:, 5], a[:, 2] - 0.5 * a[:, 5]
    top_b, bottom_b = b[:, 2] + 0.5 * b[:, 5], b[:, 2] - 0.5 * b[:, 5]
    volume = area * np.maximum(np.minimum(top, top_b) - np.maximum(bottom, bottom_b), 0.0)
    union = area_a * a[:, 5] + area_b * b[:, 5] - volume
    hull = enclosing * (np.maximum(top, top_b) - np.minimum(bottom, bottom_b))
    iou = volume / union
    return area / (area_a + area_b - area), iou, iou - (hull - union) / hull


def _clip(x: np.ndarray, y: np.ndarray, inside: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convex polygons cut at a line; one vertex more comes out than goes in, and the first fills unused places.

    Args:
        x: Of the vertices in order, shape (k, v).
        y: Likewise.
        inside: Signed distance of each vertex from the line, positive on the side kept, shape (k, v).
    """
    following = np.roll(inside, -1, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = inside / (inside - following)
    crosses = (inside >= 0) != (following >= 0)
    share = np.where(crosses, share, 0.0)
    x_cut, y_cut = x + share * (np.roll(x, -1, 1) - x), y + share * (np.roll(y, -1, 1) - y)
    kept = inside >= 0
    v = x.shape[1]
    valid = np.empty((len(x), 2 * v), bool)
    valid[:, 0::2], valid[:, 1::2] = kept, crosses
    x_all, y_all = np.empty(valid.shape), np.empty(valid.shape)
    x_all[:, 0::2], x_all[:, 1::2], y_all[:, 0::2], y_all[:, 1::2] = x, x_cut, y, y_cut
    # A convex polygon has at most one vertex more after a cut: pack the valid ones to the front.
    order = np.argsort(~valid, axis=1, kind="stable")[:, : v + 1]
    rows = np.arange(len(x))[:, None]
    count = valid.sum(1)
    order = np.where(np.arange(v + 1) < count[:, None], order, order[:, :1])
    empty = count == 0
    x_all[empty], y_all[empty] = 0.0, 0.0
    return x_all[rows, order], y_all[rows, order]
