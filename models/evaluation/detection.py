"""How good detections are: matching to truth, precision and recall, average precision. Arrays in, numbers out.

Two ways to match: by the distance of centres seen from above, as nuScenes does (Caesar et al., CVPR 2020), or by
intersection over union, as KITTI does (Geiger et al., CVPR 2012). Detections are taken from best to worst score, each
is given the best truth still free in its frame; average precision is the area under the precision made monotonic,
over all recalls or, for R40, at 40 of them (Simonelli et al., ICCV 2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ...kernels.iou import iou_3d, rotated_iou_bev

__all__ = [
    "DetectionFrame",
    "Matches",
    "PrecisionRecall",
    "average_precision",
    "evaluate_class",
    "match_detections",
]

Measure = Literal["centre", "bev", "3d"]


@dataclass(frozen=True, kw_only=True)
class DetectionFrame:
    """What one frame holds and what was found in it."""

    boxes: np.ndarray
    """Found, shape (k, 7)."""
    scores: np.ndarray
    """Shape (k,)."""
    classes: np.ndarray
    """Shape (k,), indices into `models.classes.CLASSES`."""
    truth: np.ndarray
    """Shape (m, 7)."""
    truth_classes: np.ndarray
    """Shape (m,)."""
    ignore: np.ndarray | None = None
    """True objects that count neither when found nor when missed, shape (m,), bool; None: all count."""


@dataclass(frozen=True, kw_only=True)
class Matches:
    """One frame's detections against its truth."""

    truth_of: np.ndarray
    """The truth that each detection was given, −1 where none, shape (k,), int64."""
    detection_of: np.ndarray
    """The detection that each truth was given, −1 where none, shape (m,), int64."""
    value: np.ndarray
    """Distance [m] or overlap of each detection with its truth, NaN where none, shape (k,)."""


@dataclass(frozen=True, kw_only=True)
class PrecisionRecall:
    """A class over all frames."""

    scores: np.ndarray
    """Of the detections that count, best first."""
    precision: np.ndarray
    """With all detections down to that score."""
    recall: np.ndarray
    """With all detections down to that score."""
    truths: int
    """True objects that count."""
    ap: float
    """Area under the precision made monotonic; NaN where there is no truth."""
    ap_r40: float
    """Mean of that precision at recalls 1/40, 2/40 … 1; NaN where there is no truth."""

    def at(self, score: float) -> tuple[float, float]:
        """Precision and recall of the detections with at least this score."""
        kept = int((self.scores >= score).sum())
        return (float(self.precision[kept - 1]), float(self.recall[kept - 1])) if kept else (float("nan"), 0.0)


def _closeness(boxes: np.ndarray, truth: np.ndarray, measure: Measure) -> np.ndarray:
    """Shape (k, m): higher is closer; for centres the negative distance."""
    if measure == "centre":
        return -np.hypot(boxes[:, None, 0] - truth[None, :, 0], boxes[:, None, 1] - truth[None, :, 1])
    face = {"bev": rotated_iou_bev, "3d": iou_3d}[measure]
    return face(np.ascontiguousarray(boxes, np.float32), np.ascontiguousarray(truth, np.float32))


def match_detections(
    boxes: np.ndarray, scores: np.ndarray, truth: np.ndarray, *, measure: Measure = "centre", threshold: float = 1.0
) -> Matches:
    """Gives each detection, best score first, the closest truth still free.

    Args:
        boxes: Found, shape (k, 7): x y z l w h yaw.
        scores: Shape (k,).
        truth: Shape (m, 7).
        measure: `centre`: distance from above, at most `threshold` [m]; `bev` or `3d`: intersection over union, at
            least `threshold`.
        threshold: See `measure`.

    Raises:
        ValueError: A shape that does not fit, or no such measure.
    """
    boxes, truth = np.asarray(boxes, np.float64).reshape(-1, 7), np.asarray(truth, np.float64).reshape(-1, 7)
    if len(scores) != len(boxes):
        raise ValueError(f"scores must be one for each of the {len(boxes)} boxes, not {len(scores)}")
    if measure not in ("centre", "bev", "3d"):
        raise ValueError(f"measure must be 'centre', 'bev' or '3d', not {measure!r}")
    truth_of = np.full(len(boxes), -1, np.int64)
    detection_of = np.full(len(truth), -1, np.int64)
    value = np.full(len(boxes), np.nan)
    if len(boxes) and len(truth):
        closeness = np.array(_closeness(boxes, truth, measure), np.float64)
        least = -threshold if measure == "centre" else threshold
        free = closeness.copy()
        for k in np.argsort(-np.asarray(scores), kind="stable"):
            best = int(np.argmax(free[k]))
            if free[k, best] >= least and np.isfinite(free[k, best]):
                truth_of[k], detection_of[best] = best, k
                value[k] = abs(closeness[k, best])
                free[:, best] = -np.inf
    return Matches(truth_of=truth_of, detection_of=detection_of, value=value)


def average_precision(precision: np.ndarray, recall: np.ndarray) -> tuple[float, float]:
    """The area under a precision-recall curve made monotonic, and its mean at 40 recalls.

    Args:
        precision: With each further detection, best first, shape (k,).
        recall: The same, not falling, shape (k,).

    Returns:
        The area over all recalls, and the mean of the precision at recalls 1/40 … 1 (R40).
    """
    if len(precision) == 0:
        return 0.0, 0.0
    envelope = np.maximum.accumulate(np.asarray(precision, np.float64)[::-1])[::-1]
    area = float(np.sum(np.diff(recall, prepend=0.0) * envelope))
    at = np.arange(1, 41) / 40.0
    place = np.searchsorted(recall, at - 1e-9)
    sampled = np.where(place < len(envelope), envelope[np.minimum(place, len(envelope) - 1)], 0.0)
    return area, float(sampled.mean())


def evaluate_class(
    frames: Sequence[DetectionFrame], class_index: int, *, measure: Measure = "centre", threshold: float = 1.0
) -> PrecisionRecall:
    """Precision and recall of one class over frames.

    An unmatched detection that an ignored truth would have matched is left out.

    Args:
        frames: What was found and what there was.
        class_index: Index into `models.classes.CLASSES`.
        measure: As for `match_detections`.
        threshold: As for `match_detections`.
    """
    scores, hits, truths = [], [], 0
    for frame in frames:
        found = np.asarray(frame.classes) == class_index
        there = np.asarray(frame.truth_classes) == class_index
        ignored = (np.zeros(len(there), bool) if frame.ignore is None else np.asarray(frame.ignore, bool))[there]
        boxes, truth = np.asarray(frame.boxes)[found], np.asarray(frame.truth)[there]
        own = np.asarray(frame.scores)[found]
        # What counts comes first, so that an ignored truth takes no detection from one that counts.
        matches = match_detections(boxes, own, truth[~ignored], measure=measure, threshold=threshold)
        hit = matches.truth_of >= 0
        counts = np.ones(len(own), bool)
        if ignored.any() and (~hit).any():
            close = _closeness(boxes[~hit], truth[ignored], measure).max(axis=1)
            counts[~hit] = close < (-threshold if measure == "centre" else threshold)
        scores.append(own[counts])
        hits.append(hit[counts])
        truths += int((~ignored).sum())
    ranked = np.concatenate(scores) if scores else np.empty(0)
    right = np.concatenate(hits) if hits else np.empty(0, bool)
    order = np.argsort(-ranked, kind="stable")
    true_positives = np.cumsum(right[order])
    precision = true_positives / np.arange(1, len(order) + 1)
    recall = true_positives / max(truths, 1)
    area, r40 = average_precision(precision, recall) if truths else (float("nan"), float("nan"))
    return PrecisionRecall(scores=ranked[order], precision=precision, recall=recall, truths=truths, ap=area, ap_r40=r40)
