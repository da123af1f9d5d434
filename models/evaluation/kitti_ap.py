"""KITTI's average precision for objects, as its development kit computes it. Arrays in, numbers out.

After `evaluate_object_3d_offline.cpp` (Geiger et al., CVPR 2012) with 40 recalls (Simonelli et al., ICCV 2019), rule by
rule: a neighbouring type (Van for Car, Person_sitting for Pedestrian) and an object beyond the difficulty's occlusion,
truncation or height in the image are neither hit nor missed; a detection lower in the image than the difficulty's
height is neither right nor wrong; one inside a DontCare area is not wrong, which the kit applies to boxes in the image
alone, as DontCare has none in space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..geometry import box_overlap

__all__ = [
    "DIFFICULTIES",
    "KITTI_TYPES",
    "Difficulty",
    "KittiCurve",
    "KittiDetections",
    "KittiTruth",
    "KittiType",
    "kitti_average_precision",
]

Metric = Literal["image", "bev", "3d"]
_RECALLS = 40


@dataclass(frozen=True, kw_only=True)
class KittiType:
    """A type of objects that KITTI evaluates."""

    name: str
    """As in label files."""
    neighbour: str
    """The type that is neither right nor wrong to find; empty: none."""
    overlap: float
    """Least intersection over union of a hit, which must be exceeded."""


@dataclass(frozen=True, kw_only=True)
class Difficulty:
    """What an object must be like to count."""

    name: str
    least_height: float
    """In the image [pixels], which must be exceeded."""
    most_occlusion: int
    """0 fully visible, 1 partly occluded, 2 largely occluded."""
    most_truncation: float
    """Share outside the image."""


KITTI_TYPES = (
    KittiType(name="Car", neighbour="Van", overlap=0.7),
    KittiType(name="Pedestrian", neighbour="Person_sitting", overlap=0.5),
    KittiType(name="Cyclist", neighbour="", overlap=0.5),
)
"""The types with the overlaps that the benchmark asks for."""

DIFFICULTIES = (
    Difficulty(name="easy", least_height=40.0, most_occlusion=0, most_truncation=0.15),
    Difficulty(name="moderate", least_height=25.0, most_occlusion=1, most_truncation=0.3),
    Difficulty(name="hard", least_height=25.0, most_occlusion=2, most_truncation=0.5),
)


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiTruth:
    """The labels of one frame."""

    types: tuple[str, ...]
    """m of them, DontCare among them."""
    boxes: np.ndarray
    """x y z l w h yaw, upright in any one frame of the detections too, shape (m, 7); of a DontCare row unused."""
    image_boxes: np.ndarray
    """Left, top, right, bottom [pixels], shape (m, 4)."""
    truncation: np.ndarray
    """Shape (m,)."""
    occlusion: np.ndarray
    """Shape (m,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiDetections:
    """What was found in one frame."""

    types: tuple[str, ...]
    """k of them."""
    boxes: np.ndarray
    """Shape (k, 7), in the frame of the truth."""
    image_boxes: np.ndarray
    """Shape (k, 4)."""
    scores: np.ndarray
    """Shape (k,)."""


@dataclass(frozen=True, eq=False, kw_only=True)
class KittiCurve:
    """Precision over recall of one type, metric and difficulty."""

    ap: float
    """Mean of the precision, made monotonic, at the recalls 1/40 … 1, in percent; NaN where no object counts."""
    precision: np.ndarray
    """At the recalls 0, 1/40 … 1, made monotonic; 0 where they are not reached; shape (41,)."""
    thresholds: np.ndarray
    """Scores at which they were sampled, descending, as many as recalls were reached."""
    objects: int
    """That count."""


def _image_overlap(a: np.ndarray, b: np.ndarray, *, of_first: bool = False) -> np.ndarray:
    """Intersection over union, or over the first box's area, of areas of the image; shape (len(a), len(b))."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    common = np.prod(np.maximum(high - low, 0.0), axis=2)
    area_a, area_b = np.prod(a[:, 2:] - a[:, :2], axis=1)[:, None], np.prod(b[:, 2:] - b[:, :2], axis=1)[None]
    whole = np.broadcast_to(area_a, common.shape) if of_first else area_a + area_b - common
    return np.divide(common, whole, out=np.zeros_like(common), where=whole > 0)


def _overlaps(metric: Metric, truth: KittiTruth, found: KittiDetections) -> np.ndarray:
    """Of each object with each detection, shape (m, k)."""
    if metric == "image":
        return _image_overlap(truth.image_boxes, found.image_boxes)
    values = np.zeros((len(truth.types), len(found.types)))
    # Only pairs whose circles meet overlap; a DontCare row has no size, and so no circle.
    a, b = np.asarray(truth.boxes, np.float64), np.asarray(found.boxes, np.float64)
    reach = 0.5 * (np.hypot(a[:, 3], a[:, 4])[:, None] + np.hypot(b[:, 3], b[:, 4])[None])
    near = np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1]) <= reach
    near &= (a[:, 3:6] > 0).all(axis=1)[:, None] & (b[:, 3:6] > 0).all(axis=1)[None]
    rows, columns = np.nonzero(near)
    if len(rows):
        bev, space, _ = box_overlap(a[rows], b[columns])
        values[rows, columns] = bev if metric == "bev" else space
    return values


@dataclass(frozen=True, eq=False)
class _Frame:
    """One frame as the matching needs it: objects and detections that take part."""

    overlaps: np.ndarray
    ignored: np.ndarray
    """Of each object: found or not, it does not count."""
    scores: np.ndarray
    low: np.ndarray
    """Of each detection: too low in the image to be right or wrong."""
    excused: np.ndarray
    """Of each detection: inside a DontCare area."""


def _frame(
    kind: KittiType, difficulty: Difficulty, metric: Metric, least: float, truth: KittiTruth, found: KittiDetections
) -> _Frame:
    types = np.array(truth.types, object)
    own, neighbour = types == kind.name, types == kind.neighbour
    height = truth.image_boxes[:, 3] - truth.image_boxes[:, 1]
    hard = (
        (np.asarray(truth.occlusion) > difficulty.most_occlusion)
        | (np.asarray(truth.truncation) > difficulty.most_truncation)
        | (height <= difficulty.least_height)
    )
    objects = np.flatnonzero(own | neighbour)
    # The kit drops fractions of a detection's height; a low one takes part whatever its type.
    tall = np.floor(np.abs(found.image_boxes[:, 3] - found.image_boxes[:, 1]))
    low = tall < difficulty.least_height
    taken = np.flatnonzero(low | (np.array(found.types, object) == kind.name))
    excused = np.zeros(len(taken), bool)
    areas = truth.image_boxes[types == "DontCare"]
    if metric == "image" and len(areas) and len(taken):
        excused = (_image_overlap(found.image_boxes[taken], areas, of_first=True) > least).any(axis=1)
    return _Frame(
        overlaps=_overlaps(metric, truth, found)[np.ix_(objects, taken)],
        ignored=(neighbour | hard)[objects],
        scores=np.asarray(found.scores, np.float64)[taken],
        low=low[taken],
        excused=excused,
    )


def _scores_of_hits(frame: _Frame, least: float) -> list[float]:
    """Scores of the objects found, each given the surest of the detections that overlap it enough."""
    free = np.ones(len(frame.scores), bool)
    hits = []
    for overlaps, ignored in zip(frame.overlaps, frame.ignored, strict=True):
        fit = np.flatnonzero(free & (overlaps > least))
        if len(fit) == 0:
            continue
        best = fit[np.argmax(frame.scores[fit])]
        free[best] = False
        if not ignored and not frame.low[best]:
            hits.append(float(frame.scores[best]))
    return hits


def _count(frame: _Frame, least: float, score: float) -> tuple[int, int]:
    """Hits and false ones among the detections with at least this score."""
    there = frame.scores >= score
    free = there.copy()
    hits = 0
    for overlaps, ignored in zip(frame.overlaps, frame.ignored, strict=True):
        fit = np.flatnonzero(free & (overlaps > least))
        if len(fit) == 0:
            continue
        whole = fit[~frame.low[fit]]
        # The closest of those that count; where there is none, the first of the others.
        best = whole[np.argmax(overlaps[whole])] if len(whole) else fit[0]
        free[best] = False
        hits += bool(not ignored and not frame.low[best])
    return hits, int((free & ~frame.low & ~frame.excused).sum())


def _sampled(scores: list[float], objects: int) -> np.ndarray:
    """The scores at which the recall passes the multiples of 1/40."""
    ranked = sorted(scores, reverse=True)
    kept, recall = [], 0.0
    for i, score in enumerate(ranked):
        last = i == len(ranked) - 1
        left = (i + 1) / objects
        right = left if last else (i + 2) / objects
        if right - recall < recall - left and not last:
            continue
        kept.append(score)
        recall += 1.0 / _RECALLS
    return np.array(kept[: _RECALLS + 1])


def kitti_average_precision(
    frames: Sequence[tuple[KittiTruth, KittiDetections]],
    kind: KittiType,
    difficulty: Difficulty,
    metric: Metric = "3d",
    *,
    overlap: float | None = None,
) -> KittiCurve:
    """KITTI's average precision of one type.

    Args:
        frames: Labels and detections of each.
        kind: One of `KITTI_TYPES`.
        difficulty: One of `DIFFICULTIES`.
        metric: How boxes are compared: `image`, `bev` (from above) or `3d`.
        overlap: Least intersection over union in place of the type's.

    Raises:
        ValueError: No such metric, or an overlap outside [0, 1).
    """
    if metric not in ("image", "bev", "3d"):
        raise ValueError(f"metric must be 'image', 'bev' or '3d', not {metric!r}")
    least = kind.overlap if overlap is None else overlap
    if not 0.0 <= least < 1.0:
        raise ValueError(f"overlap must be in [0, 1), not {overlap}")
    prepared = [_frame(kind, difficulty, metric, least, *pair) for pair in frames]
    objects = sum(int((~frame.ignored).sum()) for frame in prepared)
    precision = np.zeros(_RECALLS + 1)
    if objects == 0:
        return KittiCurve(ap=float("nan"), precision=precision, thresholds=np.empty(0), objects=0)
    thresholds = _sampled([score for frame in prepared for score in _scores_of_hits(frame, least)], objects)
    for i, score in enumerate(thresholds):
        counts = np.array([_count(frame, least, score) for frame in prepared]).sum(axis=0)
        precision[i] = counts[0] / max(counts.sum(), 1)
    precision = np.maximum.accumulate(precision[::-1])[::-1]
    return KittiCurve(
        ap=float(100.0 * precision[1:].mean()), precision=precision, thresholds=thresholds, objects=objects
    )
