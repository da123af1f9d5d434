"""Folders of the KITTI family: object, raw, odometry and tracking sets, SemanticKITTI, or bare `.bin` scans."""

from __future__ import annotations

import logging
import pathlib
import re
from collections.abc import Callable

import numpy as np

from ...errors import SourceError
from ...models.geometry import KittiCalibration, invert, kitti_poses
from ..messages import SensorFrame, Truth
from .kitti_labels import read_labels, read_point_labels
from .scan_files import read_scan, scan_files, versions_for
from .source import FrameListSource

__all__ = ["KittiSource"]

_log = logging.getLogger(__name__)
_SCANS = (".bin",)


class KittiSource(FrameListSource):
    """The scans of a KITTI folder with whatever stands beside them: times, labels, ego poses.

    Known layouts, told apart by what is in the folder:

    - tracking: `velodyne/SSSS/*.bin`, and `calib/SSSS.txt`, `label_02/SSSS.txt`, `oxts/SSSS.txt` where present;
    - raw: `velodyne_points/data/*.bin`, `velodyne_points/timestamps.txt`, `oxts/data/*.txt`, and
      `calib_imu_to_velo.txt` there or one folder up; a drive below the folder is named as the sequence;
    - object: `velodyne/*.bin`, with `calib/*.txt`, and `label_2/*.txt`;
    - odometry: `velodyne/*.bin`, `times.txt`, `calib.txt`, `poses.txt` (or `poses/SS.txt` two folders up),
      SemanticKITTI's `labels/*.label`; below `sequences/SS` or `SS` with a sequence named;
    - bare: `*.bin`, `*.label` beside them.

    A scan whose labels are damaged is given without truth, and the log says so.
    """

    def __init__(self, folder: str | pathlib.Path, *, sequence: str | None = None):
        """Finds the layout and reads what belongs to the whole sequence.

        Args:
            folder: As above.
            sequence: The sequence or drive, where the folder holds several.

        Raises:
            SourceError: No scans, no such sequence, or a file of the sequence that is damaged.
        """
        root = pathlib.Path(folder).expanduser()
        if not root.is_dir():
            raise SourceError(f"{root}: no such folder" if not root.exists() else f"{root}: a file; expected a folder")
        self.paths: list[pathlib.Path] = []
        self.layout = ""
        """Which of the layouts it is: tracking, raw, object, odometry or bare."""
        self._poses: np.ndarray | None = None
        self._truth: Callable[[int, np.ndarray], Truth | None] | None = None
        root, times = self._find(root, sequence)
        super().__init__(f"{root}" + (f", sequence {sequence}" if self.layout == "tracking" else ""), self.paths)
        self.versions = versions_for(self.paths, times)
        if self._poses is not None and len(self._poses) != len(self.paths):
            self._poses = self._rows_for_scans(self._poses)

    def frame(self, index: int) -> SensorFrame:
        """Reads one scan by its number, from 0."""
        scan = read_scan(self.paths[index])
        truth = None
        if self._truth is not None:
            try:
                truth = self._truth(index, scan.points)
            except SourceError as error:
                _log.warning("frame %d has no truth: %s", index, error)
        return SensorFrame(
            version=self.versions[index],
            index=index,
            points=scan.points,
            frame_id=self.frame_id,
            pose=None if self._poses is None else self._poses[index],
            continues=self.layout != "object",
            truth=truth,
        )

    def _find(self, root: pathlib.Path, sequence: str | None) -> tuple[pathlib.Path, pathlib.Path | None]:
        """Takes the folder as the first layout that fits; returns the folder of the sequence and the time file."""
        tracks = _folders(root / "velodyne", lambda path: bool(scan_files(path, _SCANS)))
        if tracks:
            name = _choose(root, tracks, sequence)
            self._open_tracking(root, name)
            return root, None
        if sequence is not None:
            parent = root / "sequences" if (root / "sequences").is_dir() else root
            drives = _folders(
                parent, lambda path: any((path / name).is_dir() for name in ("velodyne", "velodyne_points"))
            )
            root = parent / _choose(root, drives, sequence)
        if (root / "velodyne_points" / "data").is_dir():
            self._open_raw(root)
            return root, _existing(root / "velodyne_points" / "timestamps.txt")
        scans = root / "velodyne"
        if scans.is_dir() and ((root / "calib").is_dir() or (root / "label_2").is_dir()):
            self.layout, self.paths = "object", self._scans(scans)
            if (root / "calib").is_dir() and (root / "label_2").is_dir():
                self._truth = lambda index, points: self._object_truth(root, index, points)
            return root, _existing(root / "times.txt")
        if scans.is_dir():
            self._open_odometry(root)
            return root, _existing(root / "times.txt")
        self.layout, self.paths = "bare", self._scans(root)
        self._use_point_labels(root)
        return root, _existing(root / "times.txt", root / "timestamps.txt")

    def _scans(self, folder: pathlib.Path) -> list[pathlib.Path]:
        found = scan_files(folder, _SCANS)
        if not found:
            below = _folders(
                folder, lambda path: any((path / name).is_dir() for name in ("velodyne", "velodyne_points"))
            )
            hint = f"; name one of its sequences: ?sequence={', '.join(below[:20])}" if below else ""
            raise SourceError(f"{folder}: no .bin scans in this folder{hint}")
        return found

    def _open_tracking(self, root: pathlib.Path, name: str) -> None:
        self.layout, self.paths = "tracking", self._scans(root / "velodyne" / name)
        calibration_file, labels_file = root / "calib" / f"{name}.txt", root / "label_02" / f"{name}.txt"
        calibration = KittiCalibration.read(calibration_file) if calibration_file.is_file() else None
        if calibration is not None and labels_file.is_file():
            labels = read_labels(labels_file, tracking=True)

            def truth(index: int, points: np.ndarray) -> Truth | None:
                found = labels.get(_number(self.paths[index]))
                return None if found is None else found.truth(calibration, points)

            self._truth = truth
        oxts = root / "oxts" / f"{name}.txt"
        if oxts.is_file() and calibration is not None and calibration.lidar_from_imu is not None:
            self._poses = kitti_poses(_numbers(oxts, 6), calibration.lidar_from_imu)

    def _open_raw(self, root: pathlib.Path) -> None:
        self.layout, self.paths = "raw", self._scans(root / "velodyne_points" / "data")
        calibration = _existing(root / "calib_imu_to_velo.txt", root.parent / "calib_imu_to_velo.txt")
        records = [root / "oxts" / "data" / f"{path.stem}.txt" for path in self.paths]
        if calibration is not None and all(path.is_file() for path in records):
            rows = [_numbers(path, 6)[0] for path in records]
            self._poses = kitti_poses(np.array([row[:6] for row in rows]), _raw_transform(calibration))

    def _open_odometry(self, root: pathlib.Path) -> None:
        self.layout, self.paths = "odometry", self._scans(root / "velodyne")
        calibration, poses = (
            root / "calib.txt",
            _existing(root / "poses.txt", root.resolve().parent.parent / "poses" / f"{root.name}.txt"),
        )
        if calibration.is_file() and poses is not None:
            camera_from_lidar = _odometry_transform(calibration)
            rows = _numbers(poses, 12)
            if rows.shape[1] != 12:
                raise SourceError(f"{poses}: {rows.shape[1]} numbers a line; a pose has 12")
            cameras = np.tile(np.eye(4), (len(rows), 1, 1))
            cameras[:, :3] = rows.reshape(-1, 3, 4)
            self._poses = invert(camera_from_lidar) @ cameras @ camera_from_lidar
        self._use_point_labels(root / "labels")

    def _use_point_labels(self, folder: pathlib.Path) -> None:
        labels = [folder / f"{path.stem}.label" for path in self.paths]
        if any(path.is_file() for path in labels):
            self._truth = lambda index, points: (
                read_point_labels(labels[index], len(points)) if labels[index].is_file() else None
            )

    def _object_truth(self, root: pathlib.Path, index: int, points: np.ndarray) -> Truth | None:
        name = f"{self.paths[index].stem}.txt"
        if not (root / "label_2" / name).is_file():
            return None
        labels = read_labels(root / "label_2" / name, tracking=False).get(0)
        return None if labels is None else labels.truth(KittiCalibration.read(root / "calib" / name), points)

    def _rows_for_scans(self, rows: np.ndarray) -> np.ndarray | None:
        """Of poses for a whole sequence, those of the scans that are here."""
        numbers = [_number(path) for path in self.paths]
        if max(numbers) < len(rows):
            return rows[numbers]
        _log.warning("%s: %d poses do not fit its %d scans: no ego pose", self.name, len(rows), len(numbers))
        return None


def _existing(*paths: pathlib.Path) -> pathlib.Path | None:
    return next((path for path in paths if path.is_file()), None)


def _folders(parent: pathlib.Path, wanted: Callable[[pathlib.Path], bool]) -> list[str]:
    return sorted(path.name for path in parent.iterdir() if path.is_dir() and wanted(path)) if parent.is_dir() else []


def _choose(root: pathlib.Path, there: list[str], sequence: str | None) -> str:
    if sequence in there:
        return sequence
    if sequence is None and len(there) == 1:
        return there[0]
    problem = "which sequence?" if sequence is None else f"no sequence {sequence!r} with scans."
    listed = ", ".join(there[:20]) + (" …" if len(there) > 20 else "")
    raise SourceError(f"{root}: {problem} There are: {listed or 'none'}; write kitti:DIR?sequence=NAME")


def _number(path: pathlib.Path) -> int:
    """The number of a scan in its name."""
    found = re.findall(r"\d+", path.stem)
    return int(found[-1]) if found else -1


def _numbers(path: pathlib.Path, columns: int) -> np.ndarray:
    """A text file of numbers, at least so many a line."""
    try:
        lines = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: cannot be read as rows of numbers: {reason or error}") from None
    rows: list[list[float]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = [float(word) for word in line.split()]
        except ValueError as error:
            raise SourceError(f"{path}, line {number}: cannot be read as rows of numbers: {error}") from None
        if len(row) != len((rows or [row])[0]) or len(row) < columns or not np.isfinite(row).all():
            raise SourceError(
                f"{path}, line {number}: damaged: expected lines of the same {columns} or more finite numbers"
            )
        rows.append(row)
    if not rows:
        raise SourceError(f"{path}: damaged: expected lines of the same {columns} or more finite numbers")
    return np.array(rows)


def _keyed(path: pathlib.Path, keys: dict[str, int]) -> list[np.ndarray]:
    """The lines `key: numbers` of a calibration file."""
    try:
        lines = [line.partition(":") for line in path.read_text("utf-8").splitlines()]
        found = {key.strip(): np.array(text.split(), np.float64) for key, _, text in lines if key.strip() in keys}
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise SourceError(f"{path}: cannot read the calibration: {reason or error}") from None
    for key, count in keys.items():
        if key not in found or len(found[key]) != count:
            raise SourceError(f"{path}: no line '{key}:' of {count} numbers")
    return [found[key] for key in keys]


def _raw_transform(path: pathlib.Path) -> np.ndarray:
    rotation, translation = _keyed(path, {"R": 9, "T": 3})
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation.reshape(3, 3), translation
    return T


def _odometry_transform(path: pathlib.Path) -> np.ndarray:
    T = np.eye(4)
    T[:3] = _keyed(path, {"Tr": 12})[0].reshape(3, 4)
    return T
