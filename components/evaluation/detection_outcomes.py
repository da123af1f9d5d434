"""One scan of an evaluation judged: which true objects were found, and which detections are false."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...models.classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from ...models.detections import Detections
from ...models.evaluation.recall import nearest_detections
from ...models.geometry import points_in_boxes
from .detection_frames import EvaluationFrame
from .detection_reviews import Review

__all__ = ["BOXES_GROWN", "FOUND_DISTANCE", "FrameOutcome", "judge"]

FOUND_DISTANCE = {VEHICLE: 1.0, PEDESTRIAN: 0.5, CYCLIST: 0.5, CONE: 0.5, BARRIER: 1.0}
"""By class: between the centres of an object and of a detection that finds it, seen from above [m]."""

BOXES_GROWN = 0.1
"""By so much on every side boxes are grown where points are counted in them [m]."""

_FARTHEST_FALSE = 70.0
_FALSE_DISTANCE = 2.0  # metres: farther than this from every labelled vehicle, a vehicle is false
_IN_DONT_CARE = 0.5  # share of a detection's area in the image
_IMAGE_WIDTH = 1242
_FEWEST_VEHICLE_POINTS = 3


@dataclass(frozen=True, eq=False, kw_only=True)
class FrameOutcome:
    """One scan, what was found in it, and how that was judged at the score in question."""

    frame: EvaluationFrame
    found: Detections
    """From the least score on."""
    seen: np.ndarray
    """Of the detections: where there are labels, which is the camera's view in KITTI's sets less the DontCare areas,
    and in range images where at least half of a box's points have a label; shape (k,), bool."""
    in_dont_care: np.ndarray
    """Indices of vehicles at the score in question that would be false but for a DontCare area or lacking labels."""
    seconds: float
    """From points to boxes."""
    false: np.ndarray
    """Indices of vehicles at the score in question that are not there, those reviewed as real left out."""
    excused: np.ndarray
    """Indices of those that a review found to be real though unlabelled."""

    def hits(self, score: float) -> np.ndarray:
        """Which true objects were found at a score: nearer than 1 m (0.5 m for small ones); shape (m,), bool."""
        found = np.zeros(len(self.frame.boxes), bool)
        for index, distance in FOUND_DISTANCE.items():
            own = self.frame.classes == index
            boxes = self.found.boxes[(self.found.classes == index) & (self.found.scores >= score)]
            found[own] = nearest_detections(self.frame.boxes[own], boxes).distance < distance
        return found


def _views(frame: EvaluationFrame, found: Detections) -> tuple[np.ndarray, np.ndarray]:
    """Which detections have their centre in the camera's image, and which of these lie outside of DontCare areas.

    Of a range image all are seen, and those in question where points have labels: SemanticKITTI's end at 50 m.
    """
    if frame.point_labels is not None:
        within = points_in_boxes(frame.points, found.boxes, margin=BOXES_GROWN)
        return np.ones(len(found), bool), 2 * (within & frame.point_labels.known).sum(axis=1) >= within.sum(axis=1)
    if frame.kitti is None:
        return np.ones(len(found), bool), np.ones(len(found), bool)
    pixels, depth = frame.kitti.calibration.project(found.boxes) if len(found) else (np.empty((0, 2)), np.empty(0))
    seen = (depth > 0) & (depth < _FARTHEST_FALSE) & (pixels[:, 0] > 0) & (pixels[:, 0] < _IMAGE_WIDTH)
    labelled = seen.copy()
    areas = frame.kitti.dont_care
    if len(areas) and len(found):
        boxes = frame.kitti.in_image(found.boxes)
        size = np.maximum(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1), 1e-9)
        inner = np.minimum(boxes[:, None, 2:], areas[None, :, 2:]) - np.maximum(boxes[:, None, :2], areas[None, :, :2])
        share = np.prod(np.maximum(inner, 0.0), axis=2).max(axis=1) / size
        labelled &= share <= _IN_DONT_CARE
    return seen, labelled


def _false_vehicles(frame: EvaluationFrame, found: Detections, seen: np.ndarray, score: float) -> np.ndarray:
    """Indices of vehicles found at a score, where there are labels, that are none."""
    vehicles = np.flatnonzero((found.classes == VEHICLE) & (found.scores >= score) & seen)
    boxes = found.boxes[vehicles]
    if frame.point_labels is not None:
        within = points_in_boxes(frame.points, boxes, margin=BOXES_GROWN)
        return vehicles[(within & frame.point_labels.vehicle).sum(axis=1) < _FEWEST_VEHICLE_POINTS]
    # Misc of KITTI is a trailer or the like: to call it a vehicle is not wrong.
    there = (frame.classes == VEHICLE) | (frame.classes == UNKNOWN)
    return vehicles[nearest_detections(boxes, frame.boxes[there]).distance > _FALSE_DISTANCE]


def judge(
    frame: EvaluationFrame, found: Detections, seconds: float, score: float, review: Review | None
) -> FrameOutcome:
    """Judges what was found in a frame from a score on.

    A vehicle is false in KITTI's sets where the camera sees it, within 70 m, outside of DontCare areas, and no labelled
    vehicle is within 2 m; elsewhere wherever no vehicle is within 2 m; in range images where its box, grown by 0.1 m,
    holds fewer than 3 points of vehicles, and half of its points have a label.
    """
    seen, labelled = _views(frame, found)
    all_false = _false_vehicles(frame, found, seen, score)
    false = all_false[labelled[all_false]]
    real = np.array([review is not None and review.is_real(frame.name, found.boxes[k]) for k in false], bool)
    return FrameOutcome(
        frame=frame,
        found=found,
        seen=labelled,
        in_dont_care=all_false[~labelled[all_false]],
        seconds=seconds,
        false=false[~real],
        excused=false[real],
    )
