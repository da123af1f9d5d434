"""KITTI's tracking set as tables for tracker and evaluation: labels, detections, poses; and tracks as result files.

Labels, detections and results are in the rectified frame of camera 0. Here its axes are renamed to x forward, y left,
z up, which keeps every overlap what KITTI's own evaluation has.
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...errors import SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ...models.evaluation.tracking import TrackTable
from ...models.geometry import KittiCalibration, box_corners, invert, kitti_poses, transform_boxes
from .kitti_objects import label_rows

__all__ = ["TYPES", "ObjectType", "TrackingSequence", "detection_format", "sequence_names", "write_results"]

_AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])  # renamed from the camera's
_IMAGE = (1242.0, 375.0)  # pixels
_LEAST_HEIGHT = 25.0  # pixels: what is lower in the image counts neither way
_MOST_OCCLUSION, _MOST_TRUNCATION = 2, 0
_DETECTION_COLUMNS = 15
_CAMERA = 2


@dataclass(frozen=True, kw_only=True)
class ObjectType:
    """One of the types that KITTI evaluates."""

    name: str
    """As the label files have it."""
    number: int
    """As files of detections have it."""
    neighbours: tuple[str, ...]
    """Types of labels that are neither right nor wrong to find."""
    class_index: int
    """The class in `models.classes`."""


TYPES = (
    ObjectType(name="Pedestrian", number=1, neighbours=("Person_sitting",), class_index=PEDESTRIAN),
    ObjectType(name="Car", number=2, neighbours=("Van",), class_index=VEHICLE),
    ObjectType(name="Cyclist", number=3, neighbours=(), class_index=CYCLIST),
)
"""The types that KITTI evaluates."""


def _numbers(path: pathlib.Path, delimiter: str | None = None, columns: int | None = None) -> np.ndarray:
    """The rows of a file, all with as many numbers: `columns`, or those of the first."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise SourceError(f"{path}: not a text: {error}") from error
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split(delimiter)]
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: {error}; expected rows of numbers") from error
        columns = columns or len(row)
        if len(row) != columns or not np.isfinite(row).all():
            raise SourceError(f"{path}, line {number}: expected {columns} numbers, found {line[:60]!r}")
        rows.append(row)
    return np.array(rows).reshape(len(rows), columns or 0)


def sequence_names(data: pathlib.Path, detections: pathlib.Path) -> list[str]:
    """The sequences that have both labels and detections, in order.

    Raises:
        SourceError: There are none.
    """
    names = [path.stem for path in sorted(detections.glob("*.txt")) if (data / "label_02" / path.name).exists()]
    if not names:
        raise SourceError(
            f"{detections}: no sequence that {data / 'label_02'} has labels of; expected files such as 0001.txt"
        )
    return names


def detection_format(detections: pathlib.Path, names: list[str]) -> tuple[ObjectType, bool]:
    """The one type of object that the detections are of, and whether their scores are logits.

    They are where any score of any sequence lies outside [0, 1].

    Raises:
        SourceError: There are none, or they are of none that KITTI evaluates, or of several.
    """
    tables = [rows for name in names if (rows := _read_detections(detections, name)).size]
    if not tables:
        raise SourceError(f"{detections}: no detection in {', '.join(f'{name}.txt' for name in names)}")
    numbers = {int(number) for rows in tables for number in np.unique(rows[:, 1])}
    found = [kind for kind in TYPES if kind.number in numbers]
    if len(numbers) != 1 or not found:
        known = ", ".join(f"{kind.number} {kind.name}" for kind in TYPES)
        raise SourceError(f"{detections}: types {sorted(numbers)} in the second column; expected one of {known}")
    return found[0], any(bool(((rows[:, 6] < 0.0) | (rows[:, 6] > 1.0)).any()) for rows in tables)


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackingSequence:
    """One sequence of the set with the detections of one type."""

    name: str
    frames: np.ndarray
    """Numbers of all frames, in order, shape (f,), int64."""
    truth: TrackTable
    """Objects of the type, those to be ignored among them."""
    boxes: list[np.ndarray]
    """Detections of each frame, x y z l w h yaw, renamed axes, shapes (n, 7)."""
    scores: list[np.ndarray]
    """Their scores in [0, 1], shapes (n,)."""
    poses: np.ndarray | None
    """World from the renamed frame for each of `frames`, shape (f, 4, 4); None without GPS/IMU records."""
    dont_care: dict[int, np.ndarray]
    """By frame the areas of the image without labels: left, top, right, bottom [pixels], shape (k, 4)."""
    projection: np.ndarray
    """Pixels of the left colour camera from the rectified frame, shape (3, 4)."""
    renamed_from_lidar: np.ndarray
    """Shape (4, 4)."""

    @classmethod
    def read(
        cls, data: pathlib.Path, detections: pathlib.Path | None, name: str, kind: ObjectType, *, logits: bool = False
    ) -> TrackingSequence:
        """Reads a sequence.

        Objects are ignored, as KITTI and AB3DMOT do it, that are of a neighbouring type (Van for Car, Person_sitting
        for Pedestrian), occluded to the third degree, or cut off by the image's edge.

        Args:
            data: Folder with `label_02/`, `calib/` and, for the ego poses, `oxts/`.
            detections: Folder with `NAME.txt`: frame, type, image box (4), score, h w l x y z ry, alpha; None: without.
            name: Of the sequence, such as `0001`.
            kind: The type to read.
            logits: Whether scores are logits, as `detection_format` tells.

        Raises:
            SourceError: A file is missing or damaged.
        """
        calibration = KittiCalibration.read(data / "calib" / f"{name}.txt")
        labels, dont_care = _read_labels(data / "label_02" / f"{name}.txt", kind)
        found = np.empty((0, _DETECTION_COLUMNS)) if detections is None else _read_detections(detections, name)
        found = found[found[:, 1] == kind.number]
        oxts = data / "oxts" / f"{name}.txt"
        poses, first = None, 0
        # The last frame may hold no object of the type: areas without labels, which most frames have, tell it too.
        named = np.concatenate([labels[:, 0], found[:, 0], list(dont_care)]).astype(int)
        count = int(named.max(initial=-1)) + 1
        if oxts.exists():
            records = _numbers(oxts)
            # A part of a sequence has its records alone, the last of which is of the last frame.
            first = max(count - len(records), 0)
            count = first + len(records)
            if named.min(initial=first) < first:
                raise SourceError(
                    f"{oxts}: {len(records)} records, which are of the frames {first} to {count - 1} if the last is of "
                    f"the last frame; but labels or detections begin at frame {named.min()}"
                )
            poses = kitti_poses(records, calibration.lidar_from_imu)
            poses = poses @ invert(calibration.rectified_from_lidar) @ _AXES.T
        frames = np.arange(first, count)
        scores = 1.0 / (1.0 + np.exp(-found[:, 6])) if logits else found[:, 6]
        each = [np.flatnonzero(found[:, 0] == frame) for frame in frames]
        return cls(
            name=name,
            frames=frames,
            truth=TrackTable(
                frames=labels[:, 0].astype(int),
                ids=labels[:, 1].astype(int),
                boxes=_renamed(labels[:, 3:]),
                ignored=labels[:, 2] > 0,
            ),
            boxes=[_renamed(found[rows, 7:14]) for rows in each],
            scores=[scores[rows] for rows in each],
            poses=poses,
            dont_care=dont_care,
            projection=calibration.projection[_CAMERA],
            renamed_from_lidar=_AXES @ calibration.rectified_from_lidar,
        )

    def renamed(self, boxes: np.ndarray) -> np.ndarray:
        """Boxes of the lidar's frame in the renamed one, shape (k, 7)."""
        return transform_boxes(np.asarray(boxes, np.float64), self.renamed_from_lidar)

    def in_view(self, boxes: np.ndarray) -> np.ndarray:
        """Whether the centres of boxes are before the camera and in its image, shape (k,), bool."""
        centre = np.asarray(boxes, np.float64)[:, :3] @ _AXES[:3, :3]
        u, v, w = (np.c_[centre, np.ones(len(centre))] @ self.projection.T).T
        with np.errstate(divide="ignore", invalid="ignore"):
            inside = (u / w >= 0.0) & (u / w <= _IMAGE[0]) & (v / w >= 0.0) & (v / w <= _IMAGE[1])
        return (w > 0.0) & inside

    def image_boxes(self, boxes: np.ndarray) -> np.ndarray:
        """Left, top, right, bottom of boxes in the image, cut at its edges [pixels], shape (k, 4)."""
        corners = box_corners(boxes) @ _AXES[:3, :3]  # back into the camera's axes
        homogeneous = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=2) @ self.projection.T
        uv = homogeneous[..., :2] / np.maximum(homogeneous[..., 2:], 0.1)
        return np.concatenate([np.clip(edge, 0.0, _IMAGE) for edge in (uv.min(1), uv.max(1))], axis=1)

    def ignorable(self, frames: np.ndarray, boxes: np.ndarray) -> np.ndarray:
        """KITTI's rule for results: not above 25 pixels high, or more than half in an area without labels."""
        low, high = np.split(self.image_boxes(boxes), 2, axis=1)
        ignored = high[:, 1] - low[:, 1] <= _LEAST_HEIGHT
        area = np.prod(high - low, axis=1)
        for row, frame in enumerate(frames):
            areas = self.dont_care.get(int(frame))
            if areas is not None:
                inner = np.minimum(high[row], areas[:, 2:]) - np.maximum(low[row], areas[:, :2])
                ignored[row] |= bool((inner.clip(0).prod(1) > 0.5 * area[row]).any())
        return ignored


def _renamed(camera_boxes: np.ndarray) -> np.ndarray:
    """KITTI's h w l x y z ry as x y z l w h yaw in the renamed frame."""
    h, w, length, x, y, z, ry = np.asarray(camera_boxes, float).reshape(-1, 7).T
    return np.stack([z, -x, 0.5 * h - y, length, w, h, -ry - 0.5 * np.pi], axis=1)


def _camera_boxes(boxes: np.ndarray) -> np.ndarray:
    """The inverse of `_renamed`."""
    x, y, z, length, w, h, yaw = np.asarray(boxes, float).reshape(-1, 7).T
    ry = np.remainder(-yaw - 0.5 * np.pi + np.pi, 2.0 * np.pi) - np.pi
    return np.stack([h, w, length, -y, 0.5 * h - z, x, ry], axis=1)


def _read_detections(folder: pathlib.Path, name: str) -> np.ndarray:
    """Rows of frame, type, image box (4), score, h w l x y z ry, alpha; shape (n, 15)."""
    return _numbers(folder / f"{name}.txt", ",", _DETECTION_COLUMNS)


def _read_labels(path: pathlib.Path, kind: ObjectType) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Rows of frame, id, ignored, h w l x y z ry, by frame; and the areas without labels."""
    rows: list[list[float]] = []
    areas: dict[int, list[list[float]]] = {}
    for (frame, track), name, numbers in label_rows(path, leading=2):
        if name == "DontCare":
            areas.setdefault(frame, []).append(numbers[3:7])
        elif name == kind.name or name in kind.neighbours:
            cut_off, hidden = numbers[0] > _MOST_TRUNCATION, numbers[1] > _MOST_OCCLUSION
            rows.append([frame, track, name != kind.name or hidden or cut_off, *numbers[7:14]])
    table = np.array(rows).reshape(-1, 10)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return table, {frame: np.array(each) for frame, each in areas.items()}


def write_results(path: pathlib.Path, *tracks: tuple[TrackingSequence, ObjectType, TrackTable]) -> None:
    """Writes tracks as KITTI wants results: frame id type 0 0 alpha, image box, h w l x y z ry, score.

    Args:
        path: The file of one sequence.
        tracks: Of one type or several, each with its sequence; in the file the frames are in order.
    """
    lines = [line for each in tracks for line in _result_lines(*each)]
    lines.sort(key=lambda line: line[0])  # stable: within a frame as they came
    path.write_text("".join(text + "\n" for _, text in lines))


def _result_lines(sequence: TrackingSequence, kind: ObjectType, tracks: TrackTable) -> Iterator[tuple[int, str]]:
    camera = _camera_boxes(tracks.boxes)
    image = sequence.image_boxes(tracks.boxes)
    scores = np.zeros(len(camera)) if tracks.scores is None else tracks.scores
    alpha = camera[:, 6] - np.arctan2(camera[:, 3], camera[:, 5])
    alpha = np.remainder(alpha + np.pi, 2.0 * np.pi) - np.pi
    for k in range(len(camera)):
        frame = int(tracks.frames[k])
        numbers = " ".join(f"{v:.6f}" for v in (alpha[k], *image[k], *camera[k]))
        yield frame, f"{frame} {tracks.ids[k]} {kind.name} 0 0 {numbers} {scores[k]:.9g}"
