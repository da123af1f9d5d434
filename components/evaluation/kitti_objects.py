"""KITTI's object and tracking sets for scoring detections: scans, whole label rows, boxes in the image."""

from __future__ import annotations

import logging
import math
import pathlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ...errors import ConfigError, SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ...models.evaluation.kitti_ap import KittiDetections, KittiTruth
from ...models.geometry import KittiCalibration, box_corners, points_in_boxes
from ..sources.kitti_labels import KITTI_CLASSES

__all__ = [
    "KITTI_CLASS_OF_TYPE",
    "KITTI_TYPE_OF_CLASS",
    "KittiLabels",
    "kitti_detections",
    "label_files",
    "label_rows",
    "labelled_sequences",
    "read_results",
    "unpack_scan",
]

KITTI_CLASS_OF_TYPE = {"Car": VEHICLE, "Pedestrian": PEDESTRIAN, "Cyclist": CYCLIST}
"""The types that KITTI evaluates."""

KITTI_TYPE_OF_CLASS = {index: name for name, index in KITTI_CLASS_OF_TYPE.items()}

_log = logging.getLogger(__name__)

_IMAGE = (1242.0, 375.0)  # pixels
_CAMERA = 2
_TYPES = (*KITTI_CLASSES, "DontCare")
_COLUMNS = "trunc occ alpha x1 y1 x2 y2 h w l x y z ry"
_NEAREST = 0.1  # metres before the camera's plane, where what lies behind is cut
# The edges of a box, as pairs of the corners that `box_corners` gives.
_EDGES = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)])


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiLabels:
    """The rows of one frame's labels, DontCare among them."""

    types: tuple[str, ...]
    truncation: np.ndarray
    """Shape (m,)."""
    occlusion: np.ndarray
    """Shape (m,)."""
    image_boxes: np.ndarray
    """Left, top, right, bottom [pixels], shape (m, 4)."""
    camera_boxes: np.ndarray
    """h w l x y z ry in the rectified camera frame, shape (m, 7)."""
    calibration: KittiCalibration

    @property
    def truth(self) -> KittiTruth:
        """As the average precision takes it: upright in the camera's axes renamed, so that overlaps are the kit's."""
        return KittiTruth(
            types=self.types,
            boxes=_renamed(self.camera_boxes),
            image_boxes=self.image_boxes,
            truncation=self.truncation,
            occlusion=self.occlusion,
        )

    @property
    def dont_care(self) -> np.ndarray:
        """Areas of the image without labels, shape (d, 4)."""
        return self.image_boxes[np.array([kind == "DontCare" for kind in self.types], bool)]

    def points_in(self, points: np.ndarray) -> np.ndarray:
        """How many points of the lidar's frame each labelled box holds, in the frame where the labels are upright.

        Returns:
            Shape (m,), int64; 0 for DontCare.
        """
        T = self.calibration.rectified_from_lidar
        rectified = np.asarray(points, np.float64)[:, :3] @ T[:3, :3].T + T[:3, 3]
        return points_in_boxes(rectified[:, [2, 0, 1]] * (1.0, -1.0, -1.0), _renamed(self.camera_boxes)).sum(axis=1)

    def in_image(self, boxes: np.ndarray) -> np.ndarray:
        """Left, top, right, bottom of boxes of the lidar's frame in the image, cut at its edges [pixels].

        Returns:
            Shape (k, 4); without area where nothing of a box is in the image.
        """
        return _image_boxes(self.calibration, boxes)


def _renamed(camera_boxes: np.ndarray) -> np.ndarray:
    """KITTI's h w l x y z ry as x y z l w h yaw, x along the camera's z, y against its x, z against its y."""
    h, w, length, x, y, z, ry = np.asarray(camera_boxes, float).reshape(-1, 7).T
    return np.stack([z, -x, 0.5 * h - y, length, w, h, -ry - 0.5 * np.pi], axis=1)


def _image_boxes(calibration: KittiCalibration, boxes: np.ndarray) -> np.ndarray:
    """The hull in the image of what of each box is before the camera, by its twelve edges cut at the camera's plane."""
    corners = box_corners(boxes)
    T = calibration.rectified_from_lidar
    rectified = corners @ T[:3, :3].T + T[:3, 3]
    start, end = rectified[:, _EDGES[:, 0]], rectified[:, _EDGES[:, 1]]
    depth, other = start[..., 2], end[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.clip((_NEAREST - depth) / (other - depth), 0.0, 1.0)
    cut = start + share[..., None] * (end - start)
    crosses = (depth < _NEAREST) != (other < _NEAREST)
    places = np.concatenate([start, end, np.where(crosses[..., None], cut, start)], axis=1)
    before = np.concatenate([depth >= _NEAREST, other >= _NEAREST, crosses], axis=1)
    P = calibration.projection[_CAMERA]
    uvw = places @ P[:, :3].T + P[:, 3]
    uv = uvw[..., :2] / np.maximum(uvw[..., 2:], 1e-6)
    low = np.where(before[..., None], uv, np.inf).min(axis=1)
    high = np.where(before[..., None], uv, -np.inf).max(axis=1)
    return np.concatenate([np.clip(low, 0.0, _IMAGE), np.clip(high, 0.0, _IMAGE)], axis=1)


def kitti_detections(
    labels: KittiLabels, boxes: np.ndarray, scores: np.ndarray, types: tuple[str, ...]
) -> KittiDetections:
    """Boxes of the lidar's frame as KITTI's average precision takes them; those outside the image are left out."""
    boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
    image = labels.in_image(boxes)
    seen = np.flatnonzero((image[:, 2] > image[:, 0]) & (image[:, 3] > image[:, 1]))
    return KittiDetections(
        types=tuple(types[k] for k in seen),
        boxes=_renamed(labels.calibration.boxes_to_camera(boxes[seen])),
        image_boxes=image[seen],
        scores=np.asarray(scores)[seen],
    )


def unpack_scan(path: pathlib.Path) -> np.ndarray:
    """The points of a losslessly packed scan: x y z [m], reflectance; shape (n, 4), float32.

    Raises:
        SourceError: It is no such file.
    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            low, middle, high = stored["planes"].astype(np.int64)
            intensity = (stored["intensity_x100"] / 100).astype(np.float32)
    except (OSError, KeyError, ValueError, TypeError) as error:
        raise SourceError(f"{path}: not a packed scan with planes and intensity_x100: {error}") from error
    zigzag = low | middle << 8 | high << 16
    xyz = (np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T / 1000).astype(np.float32)
    return np.column_stack([xyz, intensity])


LabelRow = tuple[tuple[int, ...], str, list[float]]
LabelledScan = tuple[pathlib.Path, Callable[[], KittiLabels], pathlib.Path | None]


def label_files(root: pathlib.Path, sequence: str | None = None) -> list[LabelledScan]:
    """The scans of a folder that have labels: path, a function that reads the labels, and the image where there is one.

    Of an object set, scans without labels and labels without a scan are left out, and the log says how many.

    Raises:
        ConfigError: It is no folder of KITTI's, or a sequence must be named.
    """
    if (root / "label_2").is_dir():
        scans = _scans(root)
        pairs = [(path, root / "label_2" / f"{path.stem}.txt", root / "calib" / f"{path.stem}.txt") for path in scans]
        found = [
            (path, _reader(labels, calibration, None), _existing(root / "image_2" / f"{path.stem}.png"))
            for path, labels, calibration in pairs
            if labels.is_file()
        ]
        if not found:
            raise ConfigError(
                f"{root}: no scan in velodyne/ (.bin) has labels in label_2/ (.txt) under the same number"
            )
        labelled, scanned = {path.stem for path in (root / "label_2").glob("*.txt")}, {path.stem for path in scans}
        for names, what in (
            (scanned - labelled, "scans without labels"),
            (labelled - scanned, "labels without a scan"),
        ):
            if names:
                _log.warning("%s: %d %s are left out, such as %s", root, len(names), what, min(names))
        return found
    names = labelled_sequences(root)
    if not names:
        raise ConfigError(
            f"{root}: no KITTI set with labels: neither label_2/ beside velodyne/, as of the object set, nor "
            "label_02/SEQUENCE.txt beside velodyne/SEQUENCE/, as of the tracking set"
        )
    if sequence is None and len(names) == 1:
        sequence = names[0]
    if sequence not in names:
        what = "no sequence named" if sequence is None else f"no labelled sequence {sequence}"
        raise ConfigError(f"{root}: {what}; there are: {', '.join(names)}; add ?sequence=NAME")
    calibration = root / "calib" / f"{sequence}.txt"
    return [
        (
            path,
            _reader(root / "label_02" / f"{sequence}.txt", calibration, int(path.stem)),
            _existing(root / "image_02" / sequence / f"{path.stem}.png"),
        )
        for path in _scans(root, sequence)
    ]


def labelled_sequences(root: pathlib.Path) -> list[str]:
    """The sequences of a tracking set that have both labels and scans, in order."""
    return sorted(path.stem for path in (root / "label_02").glob("*.txt") if _scans(root, path.stem))


def _scans(root: pathlib.Path, below: str = "") -> list[pathlib.Path]:
    plain, packed = root / "velodyne" / below, root / "velodyne_packed" / below
    return sorted(plain.glob("*.bin")) if plain.is_dir() else sorted(packed.glob("*.npz"))


def _existing(path: pathlib.Path) -> pathlib.Path | None:
    return path if path.is_file() else None


def _reader(labels: pathlib.Path, calibration: pathlib.Path, frame: int | None) -> Callable[[], KittiLabels]:
    """A function that reads the labels of a scan, of `frame` where the file is of a whole sequence."""
    return lambda: _read(labels, calibration, frame)


def label_rows(path: pathlib.Path, *, leading: int = 0, score: bool = False) -> list[LabelRow]:
    """The rows of a file of labels or results.

    Args:
        path: The file.
        leading: How many whole numbers stand before the type: frame and track id of the tracking set.
        score: Whether each row ends with a score, as results do.

    Returns:
        Of each row the leading numbers, the type, and trunc occ alpha, image box (4), h w l x y z ry, with the score.

    Raises:
        SourceError: It cannot be read, or a row is none of KITTI's.
    """
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: cannot read the labels: {reason or error}") from None
    rows = []
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words:
            continue
        row = _parsed(words, leading, 15 if score else 14)
        if row is None:
            form = f"{'frame track ' * (leading > 0)}type {_COLUMNS}{' score' * score}"
            raise SourceError(
                f"{path}, line {number}: not a KITTI label: {line[:60]!r}; expected {form}, with a type of "
                f"{', '.join(_TYPES)}"
            )
        rows.append(row)
    return rows


def _parsed(words: list[str], leading: int, count: int) -> LabelRow | None:
    try:
        first = tuple(int(word) for word in words[:leading])
        kind, numbers = words[leading], [float(word) for word in words[leading + 1 : leading + 1 + count]]
    except (ValueError, IndexError):
        return None
    return (
        (first, kind, numbers)
        if kind in _TYPES and len(numbers) == count and all(map(math.isfinite, numbers))
        else None
    )


def _read(path: pathlib.Path, calibration: pathlib.Path, frame: int | None) -> KittiLabels:
    rows = label_rows(path, leading=0 if frame is None else 2)
    chosen = [(kind, numbers) for first, kind, numbers in rows if frame is None or first[0] == frame]
    numbers = np.array([numbers for _, numbers in chosen], np.float64).reshape(-1, 14)
    return KittiLabels(
        types=tuple(kind for kind, _ in chosen),
        truncation=numbers[:, 0],
        occlusion=numbers[:, 1],
        image_boxes=numbers[:, 3:7],
        camera_boxes=numbers[:, 7:14],
        calibration=KittiCalibration.read(calibration),
    )


def read_results(path: pathlib.Path, calibration: KittiCalibration) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Detections in KITTI's result format: boxes in the lidar's frame, scores, types.

    Raises:
        SourceError: It cannot be read, or a row has no score.
    """
    rows = label_rows(path, score=True)
    numbers = np.array([numbers for _, _, numbers in rows], np.float64).reshape(-1, 15)
    return calibration.boxes_from_camera(numbers[:, 7:14]), numbers[:, 14], tuple(kind for _, kind, _ in rows)
