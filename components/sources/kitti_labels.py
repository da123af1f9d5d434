"""What KITTI and SemanticKITTI say is there: label files as truth, in the frame of the lidar."""

from __future__ import annotations

import pathlib
from dataclasses import dataclass

import numpy as np

from ...errors import SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from ...models.geometry import KittiCalibration, points_in_boxes
from ..messages import Truth

__all__ = ["GROUND_LABELS", "KITTI_CLASSES", "UNSCORED_LABELS", "KittiLabels", "read_labels", "read_point_labels"]

KITTI_CLASSES = {
    "Car": VEHICLE,
    "Van": VEHICLE,
    "Truck": VEHICLE,
    "Tram": VEHICLE,
    "Pedestrian": PEDESTRIAN,
    "Person_sitting": PEDESTRIAN,
    "Person": PEDESTRIAN,
    "Cyclist": CYCLIST,
    "Misc": UNKNOWN,
}
"""KITTI's types of objects as classes of ours; DontCare marks regions of the image, and is no object."""

GROUND_LABELS = (40, 44, 48, 49, 60, 72)
"""SemanticKITTI: road, parking, sidewalk, other ground, lane marking, terrain."""

UNSCORED_LABELS = (0, 1, 70)
"""SemanticKITTI: unlabelled, outlier and vegetation, which the ground score leaves out."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiLabels:
    """The objects of one frame, in the frame of KITTI's rectified camera 0."""

    camera_boxes: np.ndarray
    """h w l x y z ry, shape (k, 7), float64."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    ids: np.ndarray
    """Track ids, shape (k,), int64; −1 where the set has none."""

    def truth(self, calibration: KittiCalibration, points: np.ndarray) -> Truth:
        """Boxes in the lidar frame, and how many points each holds; velocities are not known.

        KITTI labels only what the left colour camera sees: beyond its view the absence of a box says nothing.
        """
        boxes = calibration.boxes_from_camera(self.camera_boxes).astype(np.float32)
        return Truth(
            boxes=boxes,
            classes=self.classes,
            ids=self.ids,
            velocities=np.full((len(boxes), 2), np.nan, np.float32),
            points=points_in_boxes(points, boxes).sum(axis=1).astype(np.int32),
            complete=False,
        )


def read_labels(path: pathlib.Path, *, tracking: bool) -> dict[int, KittiLabels]:
    """Reads a label file.

    Args:
        path: The file.
        tracking: Each line starts with a frame and a track id; else the whole file is of frame 0.

    Returns:
        Objects by frame; a frame without objects may be missing.

    Raises:
        SourceError: It cannot be read, or a line is not a label.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: cannot read the labels: {reason or error}") from None
    rows: dict[int, list[tuple[int, int, list[float]]]] = {}
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        label = _parse(words if tracking else ["0", "-1", *words])
        if label is None:
            form = ("frame track " if tracking else "") + "type trunc occ alpha x1 y1 x2 y2 h w l x y z ry"
            raise SourceError(f"{path}, line {number}: not a KITTI label: {line[:60]!r}; expected {form}")
        frame, track, kind, numbers = label
        objects = rows.setdefault(frame, [])
        if kind != "DontCare":
            objects.append((KITTI_CLASSES[kind], track, numbers))
    return {
        frame: KittiLabels(
            camera_boxes=np.array([values for _, _, values in objects], np.float64).reshape(-1, 7),
            classes=np.array([index for index, _, _ in objects], np.int32),
            ids=np.array([track for _, track, _ in objects], np.int64),
        )
        for frame, objects in rows.items()
    }


def _parse(words: list[str]) -> tuple[int, int, str, list[float]] | None:
    """Frame, track, type and h w l x y z ry of a line; None when it is no label."""
    try:
        frame, track, kind = int(words[0]), int(words[1]), words[2]
        numbers = [float(word) for word in words[10:17]]
    except (ValueError, IndexError):
        return None
    known = kind in KITTI_CLASSES or kind == "DontCare"
    return (frame, track, kind, numbers) if known and len(numbers) == 7 and np.isfinite(numbers).all() else None


def read_point_labels(path: pathlib.Path, count: int) -> Truth:
    """Reads SemanticKITTI's labels of the points of one scan as truth about the ground; there are no boxes.

    Raises:
        SourceError: It cannot be read, or does not have a label a point.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot read the labels: {error.strerror or error}") from None
    if len(data) != 4 * count:
        raise SourceError(f"{path}: {len(data)} bytes, expected 4 for each of the {count} points of its scan")
    kinds = np.frombuffer(data, "<u4") & 0xFFFF
    return Truth(
        boxes=np.empty((0, 7), np.float32),
        classes=np.empty(0, np.int32),
        ids=np.empty(0, np.int64),
        velocities=np.empty((0, 2), np.float32),
        points=np.empty(0, np.int32),
        complete=False,
        ground=np.isin(kinds, GROUND_LABELS),
        ground_scored=~np.isin(kinds, UNSCORED_LABELS),
    )
