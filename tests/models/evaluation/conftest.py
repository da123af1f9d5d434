"""KITTI's tracking sequences and PointRCNN's detections on them, as tables for tracker and evaluation.

Labels and detections are in the rectified camera frame. Here its axes are renamed (x forward, y left, z up), which
keeps every overlap what KITTI's own evaluation has.
"""

import dataclasses
import pathlib

import numpy as np
import pytest

from warploom.models.evaluation.tracking import TrackTable
from warploom.models.geometry import KittiCalibration, box_corners, invert, kitti_poses

TUNING = ("0000", "0002", "0003", "0004", "0007", "0011", "0017", "0020")
CHECKING = ("0001", "0012", "0013", "0014", "0016", "0019")
NEIGHBOURS = {"Car": ("Van",), "Pedestrian": ("Person_sitting",), "Cyclist": ()}
TYPE = {"Pedestrian": 1, "Car": 2, "Cyclist": 3}
AXES = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Renamed from camera axes."""
IMAGE = (1242.0, 375.0)


def renamed(camera_boxes: np.ndarray) -> np.ndarray:
    """h w l x y z ry as x y z l w h yaw."""
    h, w, length, x, y, z, ry = np.asarray(camera_boxes, float).reshape(-1, 7).T
    return np.stack([z, -x, 0.5 * h - y, length, w, h, -ry - 0.5 * np.pi], axis=1)


@dataclasses.dataclass
class Sequence:
    truth: TrackTable
    frames: np.ndarray
    """Numbers of all frames, in order."""
    boxes: list
    scores: list
    """Detections for each of `frames`; the network's scores are logits, here brought into [0, 1]."""
    poses: np.ndarray
    """World from the renamed camera frame for each of `frames`."""
    dont_care: dict
    projection: np.ndarray

    def track(self, tracker, class_index, with_pose=True) -> TrackTable:
        """What a tracker makes of the detections, at 10 Hz."""
        out = []
        for frame, boxes, scores, pose in zip(self.frames, self.boxes, self.scores, self.poses, strict=True):
            tracks = tracker.update(
                int(frame) * 100_000_000,
                boxes,
                scores,
                np.full(len(boxes), class_index),
                pose=pose if with_pose else None,
            )
            out.append((np.full(len(tracks), frame), tracks.ids, tracks.boxes, tracks.scores))
        frames, ids, boxes, scores = (np.concatenate(part) for part in zip(*out, strict=True))
        return TrackTable(frames=frames, ids=ids, boxes=boxes, scores=scores, ignored=self.ignorable(frames, boxes))

    def ignorable(self, frames, boxes) -> np.ndarray:
        """KITTI's rule: not above 25 pixels high, or more than half in an area without labels."""
        corners = box_corners(boxes) @ AXES[:3, :3]  # back into the camera's axes
        homogeneous = np.concatenate([corners, np.ones((*corners.shape[:2], 1))], axis=2) @ self.projection.T
        uv = homogeneous[..., :2] / np.maximum(homogeneous[..., 2:], 0.1)
        low, high = (np.clip(edge, 0.0, IMAGE) for edge in (uv.min(1), uv.max(1)))
        ignored = high[:, 1] - low[:, 1] <= 25.0
        for row, frame in enumerate(frames):
            area = np.prod(high[row] - low[row])
            for x1, y1, x2, y2 in self.dont_care.get(int(frame), ()):
                inner = np.minimum(high[row], (x2, y2)) - np.maximum(low[row], (x1, y1))
                if (inner > 0).all() and inner.prod() > 0.5 * area:
                    ignored[row] = True
        return ignored


def read(folder: pathlib.Path, name: str, kind: str) -> Sequence:
    """One sequence with the detections of one class (`Car`, `Pedestrian`, `Cyclist`)."""
    calibration = KittiCalibration.read(folder / "calib" / f"{name}.txt")
    oxts = np.loadtxt(folder / "oxts" / f"{name}.txt", ndmin=2)
    first = 40 if name == "0000" else 0
    frames = np.arange(first, first + len(oxts))
    lidar_poses = kitti_poses(oxts, calibration.lidar_from_imu)
    rows, dont_care = [], {}
    for line in (folder / "label_02" / f"{name}.txt").read_text().splitlines():
        field = line.split()
        if field[2] == "DontCare":
            dont_care.setdefault(int(field[0]), []).append([float(v) for v in field[6:10]])
        elif field[2] == kind or field[2] in NEIGHBOURS[kind]:
            outside = field[2] != kind or int(field[4]) > 2 or int(float(field[3])) > 0
            rows.append([float(field[0]), float(field[1]), outside, *(float(v) for v in field[10:17])])
    table = np.array(rows).reshape(-1, 10)
    table = table[np.argsort(table[:, 0], kind="stable")]
    truth = TrackTable(
        frames=table[:, 0].astype(int),
        ids=table[:, 1].astype(int),
        boxes=renamed(table[:, 3:]),
        ignored=table[:, 2] > 0,
    )
    file = folder / f"pointrcnn_{kind}" / f"{name}.txt"
    found = np.loadtxt(file, delimiter=",", ndmin=2) if file.exists() and file.stat().st_size else np.empty((0, 15))
    found = found.reshape(-1, 15)
    found = found[found[:, 1] == TYPE[kind]]
    each = [found[found[:, 0] == frame] for frame in frames]
    return Sequence(
        truth=truth,
        frames=frames,
        boxes=[renamed(rows[:, 7:14]) for rows in each],
        scores=[1.0 / (1.0 + np.exp(-rows[:, 6])) for rows in each],
        poses=lidar_poses @ invert(calibration.rectified_from_lidar) @ AXES.T,
        dont_care=dont_care,
        projection=calibration.projection[2],
    )


@pytest.fixture(scope="session")
def kitti_sequences(shared_data):
    """A function that reads `tuning` or `checking` sequences with detections of a class."""
    folder = shared_data / "kitti_tracking"
    if not folder.is_dir():
        pytest.skip("KITTI's tracking sequences (../shared/data/kitti_tracking) are not here")
    return lambda names, kind: [read(folder, name, kind) for name in {"tuning": TUNING, "checking": CHECKING}[names]]
