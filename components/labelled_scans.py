"""Labelled scans of a data set as files that a head learns from: what is not labelled is cut away."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import SourceError
from ..models.classes import UNKNOWN
from ..models.geometry import points_in_boxes
from ..models.training.frames import labelled_frame, save_frame
from .evaluation.detection_frames import EvaluationFrame, evaluation_frames

__all__ = ["write_labelled_scans"]

_IMAGE = (1242.0, 375.0)
_AROUND = 0.1


def write_labelled_scans(uri: str, folder: Path) -> int:
    """Writes each labelled scan of a data set to a file of a folder, and tells how many.

    Of KITTI's only the points that the camera sees have labels: the others are left out, and so are those in DontCare
    areas of the image and on things of no class that a head knows (Misc), which else were learnt to be nothing.

    Args:
        uri: As of `warploom eval detection`: `kitti:DIR?sequence=0000&every=5`, `nuscenes:DIR` ….
        folder: Is made where it is not there; files of the same scan are written anew.

    Raises:
        ConfigError: No such data set.
        SourceError: It is damaged, or has labels of points, not boxes, or no scan.
    """
    folder.mkdir(parents=True, exist_ok=True)
    count = 0
    for frame in evaluation_frames(uri):
        if frame.point_labels is not None:
            raise SourceError(f"{uri}: it labels points, but boxes are needed to learn from")
        labelled = frame.points[_labelled(frame)]
        known = frame.classes != UNKNOWN
        scan = labelled_frame(
            labelled, frame.boxes[known], frame.classes[known], frame.sensor_height, frame.velocities[known]
        )
        save_frame(folder / f"{frame.name.replace('/', '-')}.npz", scan)
        count += 1
    if not count:
        raise SourceError(f"{uri}: no labelled scan")
    return count


def _labelled(frame: EvaluationFrame) -> np.ndarray:
    """Which points lie where everything has a label, shape (n,), bool."""
    points = frame.points
    keep = ~points_in_boxes(points, frame.boxes[frame.classes == UNKNOWN], margin=_AROUND).any(axis=0)
    keep &= np.isfinite(points[:, :3]).all(axis=1)
    if frame.kitti is not None:
        pixels, depth = frame.kitti.calibration.project(points)
        keep &= (depth > 0) & (pixels >= 0).all(axis=1) & (pixels < _IMAGE).all(axis=1)
        for left, top, right, bottom in frame.kitti.dont_care:
            inside = (pixels >= (left, top)).all(axis=1) & (pixels <= (right, bottom)).all(axis=1)
            keep &= ~inside
    return keep
