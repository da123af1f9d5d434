"""The figures of an evaluation of detections: what is found and what is false, average precisions, recall."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...models.classes import BARRIER, CLASSES, CONE, CYCLIST, PEDESTRIAN, VEHICLE
from ...models.evaluation.detection import DetectionFrame, evaluate_class
from ...models.evaluation.kitti_ap import DIFFICULTIES, KITTI_TYPES, kitti_average_precision
from ...models.evaluation.nuscenes_ap import (
    DISTANCES,
    NuscenesClass,
    NuscenesFrame,
    detection_score,
    nuscenes_metrics,
)
from ...models.evaluation.recall import box_errors, nearest_detections, recall_by
from ...models.geometry import points_in_boxes
from .detection_outcomes import BOXES_GROWN, FOUND_DISTANCE, FrameOutcome, judge
from .detection_reviews import Review
from .kitti_objects import KITTI_TYPE_OF_CLASS, kitti_detections

__all__ = ["Task", "figures_of"]

RANGE_EDGES = (0.0, 10.0, 20.0, 30.0, 40.0, 55.0, 70.0)
POINT_EDGES = (1, 5, 10, 20, 50, 100, 200, 10**9)

_NUSCENES_CLASSES = (
    NuscenesClass(index=VEHICLE, farthest=50.0),
    NuscenesClass(index=PEDESTRIAN, farthest=40.0),
    NuscenesClass(index=CYCLIST, farthest=40.0),
    NuscenesClass(index=CONE, farthest=30.0),
    NuscenesClass(index=BARRIER, farthest=30.0, half_turn=True),
)
_BEV_OVERLAPS = {VEHICLE: 0.7, PEDESTRIAN: 0.5, CYCLIST: 0.5, CONE: 0.5, BARRIER: 0.5}
_BEV_RANGE, _BEV_POINTS = 60.0, 10
_HALF_VISIBLE = 0.5


@dataclass(frozen=True, kw_only=True)
class Task:
    """Objects that are to be found, and how near."""

    name: str
    types: tuple[str, ...]
    """As the data set has them; empty: all of the class."""
    class_index: int
    least_points: int
    farthest: float
    """From the sensor, seen from above [m]."""
    distance: float
    """Between the centres, seen from above [m]."""


_TASKS = {
    "kitti": (
        Task(name="cars within 1 m", types=("Car",), class_index=VEHICLE, least_points=20, farthest=40, distance=1.0),
        Task(name="cars within 0.5 m", types=("Car",), class_index=VEHICLE, least_points=20, farthest=40, distance=0.5),
        Task(name="vans within 1.5 m", types=("Van",), class_index=VEHICLE, least_points=20, farthest=40, distance=1.5),
        Task(
            name="pedestrians within 0.5 m",
            types=("Pedestrian", "Person_sitting"),
            class_index=PEDESTRIAN,
            least_points=10,
            farthest=30,
            distance=0.5,
        ),
        Task(
            name="cyclists within 0.5 m",
            types=("Cyclist",),
            class_index=CYCLIST,
            least_points=10,
            farthest=30,
            distance=0.5,
        ),
    ),
    "nuscenes": (
        Task(name="cars within 1 m", types=("car",), class_index=VEHICLE, least_points=10, farthest=30, distance=1.0),
        Task(
            name="pedestrians within 0.5 m",
            types=("pedestrian",),
            class_index=PEDESTRIAN,
            least_points=10,
            farthest=30,
            distance=0.5,
        ),
    ),
    "sim": (
        Task(name="vehicles within 1 m", types=(), class_index=VEHICLE, least_points=20, farthest=40, distance=1.0),
        Task(
            name="pedestrians within 0.5 m",
            types=(),
            class_index=PEDESTRIAN,
            least_points=10,
            farthest=30,
            distance=0.5,
        ),
        Task(name="cyclists within 0.5 m", types=(), class_index=CYCLIST, least_points=10, farthest=30, distance=0.5),
    ),
}


def figures_of(
    kind: str, outcomes: list[FrameOutcome], score: float, also: Sequence[float], review: Review | None
) -> dict[str, Any]:
    """The figures of frames of one kind, as `summary.json` holds them.

    Args:
        kind: One of `detection_frames.KINDS`.
        outcomes: Of the frames.
        score: From which detections count as found or false.
        also: Further scores to count at.
        review: Of vehicles without a label.
    """
    times = sorted(each.seconds for each in outcomes)
    figures: dict[str, Any] = {
        "frames": len(outcomes),
        "milliseconds_median": round(1e3 * times[len(times) // 2], 2),
        "at": {f"{each:g}": _at(kind, outcomes, each, review) for each in dict.fromkeys((score, *also))},
    }
    if kind == "range":
        return figures
    figures["recall"] = {
        CLASSES[index]: _recall(outcomes, index, score)
        for index in FOUND_DISTANCE
        if any((each.frame.classes == index).any() for each in outcomes)
    }
    if kind == "kitti":
        figures["kitti_ap_r40"] = _kitti(outcomes)
    figures["nuscenes"] = _nuscenes(outcomes)
    if kind != "kitti":
        figures["bev_ap"] = _bev(outcomes)
    return figures


def _at(kind: str, outcomes: list[FrameOutcome], score: float, review: Review | None) -> dict[str, Any]:
    """What is found and what is false from one score on."""
    judged = [judge(each.frame, each.found, each.seconds, score, review) for each in outcomes]
    figures: dict[str, Any] = {
        "false_vehicles_per_frame": round(sum(len(each.false) for each in judged) / len(judged), 3),
    }
    if kind == "kitti":
        figures["and_in_dont_care_areas"] = round(sum(len(each.in_dont_care) for each in judged) / len(judged), 3)
    if review is not None:
        figures["reviewed_as_real"] = sum(len(each.excused) for each in judged)
    if kind == "range":
        figures["and_without_labels"] = round(sum(len(each.in_dont_care) for each in judged) / len(judged), 3)
        return {"car_points_in_boxes": _car_points(judged, score)} | figures
    tasks = {}
    turns, sizes = [np.empty(0)], [np.empty((0, 3))]
    for task in _TASKS[kind]:
        objects = hits = 0
        for each in judged:
            frame = each.frame
            own = (frame.classes == task.class_index) & (frame.counts >= task.least_points)
            own &= np.hypot(frame.boxes[:, 0], frame.boxes[:, 1]) < task.farthest
            if task.types:
                own &= np.array([name in task.types for name in frame.types], bool)
            boxes = each.found.boxes[(each.found.classes == task.class_index) & (each.found.scores >= score)]
            near = nearest_detections(frame.boxes[own], boxes)
            right = near.distance < task.distance
            objects, hits = objects + int(own.sum()), hits + int(right.sum())
            if task is _TASKS[kind][0] and right.any():
                turn, size = box_errors(frame.boxes[own][right], boxes[near.index[right]])
                turns.append(np.degrees(turn))
                sizes.append(size)
        tasks[task.name] = {"objects": objects, "found": hits}
    turn, size = np.concatenate(turns), np.concatenate(sizes)
    figures = {"tasks": tasks} | figures
    if len(turn):
        figures["yaw_error_degrees"] = {
            "median": round(float(np.median(turn)), 2),
            "p90": round(float(np.percentile(turn, 90)), 2),
        }
        figures["size_error_metres_mean"] = dict(
            zip(("length", "width", "height"), np.round(size.mean(axis=0), 3).tolist(), strict=True)
        )
    for name, index in (("pedestrians", PEDESTRIAN), ("cyclists", CYCLIST)):
        figures[f"false_{name}_per_frame"] = round(
            sum(_false_of(each, index, score) for each in judged) / len(judged), 3
        )
    return figures


def _false_of(outcome: FrameOutcome, index: int, score: float) -> int:
    """Detections of a small class, where there are labels, that have no person or rider within 1 m."""
    found, frame = outcome.found, outcome.frame
    own = (found.classes == index) & (found.scores >= score) & outcome.seen
    # A rider taken for a pedestrian is found, if not well: only what nobody is near is false.
    there = (frame.classes == PEDESTRIAN) | (frame.classes == CYCLIST)
    return int((nearest_detections(found.boxes[own], frame.boxes[there]).distance > 1.0).sum())


def _car_points(outcomes: list[FrameOutcome], score: float) -> float | None:
    """The share of the points on cars that lie in boxes of vehicles; None where there are no such points."""
    inside = total = 0
    for each in outcomes:
        labels = each.frame.point_labels
        if labels is None:
            continue
        points = each.frame.points
        car = labels.car & (np.hypot(points[:, 0], points[:, 1]) < _BEV_RANGE)
        boxes = each.found.boxes[(each.found.classes == VEHICLE) & (each.found.scores >= score)]
        within = points_in_boxes(points, boxes, margin=BOXES_GROWN).any(axis=0)
        inside, total = inside + int((within & car).sum()), total + int(car.sum())
    return round(inside / total, 4) if total else None


def _recall(outcomes: list[FrameOutcome], index: int, score: float) -> dict[str, Any]:
    """Of one class by range (objects with points) and by points."""
    ranges, points, found = [], [], []
    for each in outcomes:
        own = (each.frame.classes == index) & (each.frame.counts > 0)
        ranges.append(np.hypot(each.frame.boxes[own, 0], each.frame.boxes[own, 1]))
        points.append(each.frame.counts[own])
        found.append(each.hits(score)[own])
    hit = np.concatenate(found)
    return {
        "within_metres": FOUND_DISTANCE[index],
        "by_range": [vars(each) for each in recall_by(np.concatenate(ranges), hit, RANGE_EDGES)],
        "by_points": [vars(each) for each in recall_by(np.concatenate(points), hit, POINT_EDGES)],
    }


def _kitti(outcomes: list[FrameOutcome]) -> dict[str, Any]:
    """AP by type, metric and difficulty."""
    pairs = []
    for each in outcomes:
        labels = each.frame.kitti
        if labels is not None:
            types = tuple(KITTI_TYPE_OF_CLASS.get(int(index), "") for index in each.found.classes)
            pairs.append((labels.truth, kitti_detections(labels, each.found.boxes, each.found.scores, types)))
    result: dict[str, Any] = {}
    for kind in KITTI_TYPES:
        result[kind.name] = {}
        for metric in ("3d", "bev"):
            curves = [kitti_average_precision(pairs, kind, difficulty, metric) for difficulty in DIFFICULTIES]
            result[kind.name][metric] = {
                difficulty.name: {"ap": _rounded(curve.ap), "objects": curve.objects}
                for difficulty, curve in zip(DIFFICULTIES, curves, strict=True)
            }
    return result


def _rounded(value: float, digits: int = 2) -> float | None:
    return None if math.isnan(value) else round(value, digits)


def _nuscenes(outcomes: list[FrameOutcome]) -> dict[str, Any]:
    """AP by class and distance, errors, and the detection score."""
    frames = []
    for each in outcomes:
        there = each.frame.counts > 0
        found = each.found.select(each.seen)
        frames.append(
            NuscenesFrame(
                boxes=found.boxes,
                scores=found.scores,
                classes=found.classes,
                velocities=found.velocities,
                truth=each.frame.boxes[there],
                truth_classes=each.frame.classes[there],
                truth_velocities=each.frame.velocities[there],
            )
        )
    metrics = {CLASSES[kind.index]: nuscenes_metrics(frames, kind) for kind in _NUSCENES_CLASSES}
    return {
        "classes": {
            name: {
                "objects": each.objects,
                "ap": _rounded(each.mean_ap, 4),
                "ap_by_distance": {f"{distance:g}": _rounded(each.ap[distance], 4) for distance in DISTANCES},
                "errors": {error: _rounded(value, 4) for error, value in each.errors.items()},
            }
            for name, each in metrics.items()
            if each.objects
        },
        "detection_score": _rounded(detection_score(list(metrics.values())), 4),
    }


def _bev(outcomes: list[FrameOutcome]) -> dict[str, Any]:
    """AP by overlap from above: objects with 10 points within 60 m, the others neither right nor wrong to find.

    Detections beyond that range are left out, as are the true objects there, and as nuScenes' kit does with both. Where
    it is known how much of each object can be seen, the same of those that are half visible or more: KITTI's kit leaves
    out what is largely occluded.
    """
    result = _bev_where(outcomes, 0.0)
    if all(each.frame.visible is not None for each in outcomes):
        for name, figures in _bev_where(outcomes, _HALF_VISIBLE).items():
            result[name]["half_visible"] = figures
    return result


def _bev_where(outcomes: list[FrameOutcome], least_visible: float) -> dict[str, Any]:
    frames = []
    for each in outcomes:
        found = each.found.select(np.hypot(each.found.boxes[:, 0], each.found.boxes[:, 1]) < _BEV_RANGE)
        frame = each.frame
        ignore = (frame.counts < _BEV_POINTS) | (np.hypot(frame.boxes[:, 0], frame.boxes[:, 1]) >= _BEV_RANGE)
        if least_visible > 0.0:
            ignore |= np.asarray(frame.visible) < least_visible
        frames.append(
            DetectionFrame(
                boxes=found.boxes,
                scores=found.scores,
                classes=found.classes,
                truth=frame.boxes.astype(np.float32),
                truth_classes=frame.classes,
                ignore=ignore,
            )
        )
    result = {}
    for index, overlap in _BEV_OVERLAPS.items():
        curve = evaluate_class(frames, index, measure="bev", threshold=overlap)
        if curve.truths:
            result[CLASSES[index]] = {
                "overlap": overlap,
                "ap": round(100 * curve.ap, 2),
                "ap_r40": round(100 * curve.ap_r40, 2),
                "objects": curve.truths,
            }
    return result
