"""nuScenes' detection metrics: average precision by the distance of centres, and the errors of what was found.

After `nuscenes.eval.detection.algo` (Caesar et al., CVPR 2020): detections of all frames from the best score down are
each given the nearest free object of their frame, seen from above; precision at 101 recalls, those up to 10 % and
precision up to 10 % left out. Arrays in, numbers out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = [
    "DISTANCES",
    "ERRORS",
    "NuscenesClass",
    "NuscenesFrame",
    "NuscenesMetrics",
    "detection_score",
    "nuscenes_metrics",
]

DISTANCES = (0.5, 1.0, 2.0, 4.0)
"""Of centres [m], at which average precision is taken; their mean is the AP."""

ERRORS = ("translation", "scale", "orientation", "velocity")
"""Of what was found within 2 m: distance of centres [m], 1 − overlap of the sizes, heading [rad], velocity [m/s]."""

_ERROR_DISTANCE = 2.0
_LEAST_RECALL = _LEAST_PRECISION = 0.1
_RECALLS = 101


@dataclass(frozen=True, kw_only=True)
class NuscenesClass:
    """What is scored together."""

    index: int
    """Into `models.classes.CLASSES`."""
    farthest: float
    """From the sensor, seen from above [m]; objects and detections from there on do not count."""
    half_turn: bool = False
    """Whether front and back are the same, as of a barrier."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NuscenesFrame:
    """One frame; boxes are x y z l w h yaw in the sensor's frame."""

    boxes: np.ndarray
    """Found, shape (k, 7)."""
    scores: np.ndarray
    """Shape (k,)."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,)."""
    velocities: np.ndarray
    """[m/s], NaN where unknown, shape (k, 2)."""
    truth: np.ndarray
    """Shape (m, 7)."""
    truth_classes: np.ndarray
    """Shape (m,)."""
    truth_velocities: np.ndarray
    """Shape (m, 2), NaN where unknown."""


@dataclass(frozen=True, eq=False, kw_only=True)
class NuscenesMetrics:
    """Of one class."""

    ap: dict[float, float]
    """By distance, in [0, 1]; NaN where there are no objects."""
    errors: dict[str, float]
    """By name, see `ERRORS`; NaN where it is not known, or there are no objects."""
    objects: int

    @property
    def mean_ap(self) -> float:
        """Over the distances."""
        return float(np.mean(list(self.ap.values())))


@dataclass(frozen=True, eq=False)
class _Ranked:
    """All detections of a class, best first, against the objects."""

    hit: np.ndarray
    scores: np.ndarray
    errors: dict[str, np.ndarray]
    """Of the hits, in their order."""


def _difference(a: float, b: float, period: float) -> float:
    """The angle between two headings, front and back alike where the period is half a turn."""
    return abs((a - b + 0.5 * period) % period - 0.5 * period)


def _rank(frames: Sequence[NuscenesFrame], kind: NuscenesClass, distance: float) -> tuple[_Ranked, int]:
    period = np.pi if kind.half_turn else 2.0 * np.pi
    ranked: list[tuple[float, int, int]] = []
    truths, free = [], []
    for number, frame in enumerate(frames):
        wanted = (np.asarray(frame.classes) == kind.index) & (np.hypot(*frame.boxes[:, :2].T) < kind.farthest)
        ranked += [(float(frame.scores[k]), number, int(k)) for k in np.flatnonzero(wanted)]
        there = (np.asarray(frame.truth_classes) == kind.index) & (np.hypot(*frame.truth[:, :2].T) < kind.farthest)
        truths.append(np.flatnonzero(there))
        free.append(np.ones(int(there.sum()), bool))
    # As there: equal scores from the last to the first.
    order = sorted(range(len(ranked)), key=lambda place: (ranked[place][0], place), reverse=True)
    ranked = [ranked[place] for place in order]
    hit = np.zeros(len(ranked), bool)
    errors: dict[str, list[float]] = {name: [] for name in ERRORS}
    for row, (_, number, k) in enumerate(ranked):
        frame, there = frames[number], truths[number]
        box = np.asarray(frame.boxes[k], np.float64)
        apart = np.hypot(*(np.asarray(frame.truth[there, :2], np.float64) - box[:2]).T)
        apart[~free[number]] = np.inf
        nearest = int(np.argmin(apart)) if len(apart) else -1
        if nearest < 0 or not apart[nearest] < distance:
            continue
        hit[row], free[number][nearest] = True, False
        truth = np.asarray(frame.truth[there[nearest]], np.float64)
        common = float(np.prod(np.minimum(box[3:6], truth[3:6])))
        union = float(np.prod(box[3:6]) + np.prod(truth[3:6])) - common
        velocity = np.asarray(frame.velocities[k]) - np.asarray(frame.truth_velocities[there[nearest]])
        errors["translation"].append(float(apart[nearest]))
        errors["scale"].append(1.0 - common / union)
        errors["orientation"].append(_difference(box[6], truth[6], period))
        errors["velocity"].append(float(np.hypot(*velocity)))
    scores = np.array([score for score, _, _ in ranked])
    return _Ranked(hit, scores, {name: np.array(v) for name, v in errors.items()}), sum(len(some) for some in truths)


def _running_mean(values: np.ndarray) -> np.ndarray:
    """Mean of the known values up to each; 0 before the first."""
    known = ~np.isnan(values)
    counts = np.cumsum(known)
    return np.divide(np.cumsum(np.where(known, values, 0.0)), counts, out=np.zeros(len(values)), where=counts > 0)


def _curve(ranked: _Ranked, objects: int) -> tuple[np.ndarray, np.ndarray]:
    """Precision and score at the 101 recalls; 0 beyond the last reached."""
    true = np.cumsum(ranked.hit).astype(float)
    recall = true / objects
    precision = true / np.arange(1, len(true) + 1)
    at = np.linspace(0.0, 1.0, _RECALLS)
    return np.interp(at, recall, precision, right=0.0), np.interp(at, recall, ranked.scores, right=0.0)


def nuscenes_metrics(frames: Sequence[NuscenesFrame], kind: NuscenesClass) -> NuscenesMetrics:
    """Average precision and errors of one class over frames."""
    first = round(100 * _LEAST_RECALL) + 1
    ap: dict[float, float] = {}
    errors = dict.fromkeys(ERRORS, float("nan"))
    objects = 0
    for distance in DISTANCES:
        ranked, objects = _rank(frames, kind, distance)
        if objects == 0:
            ap[distance] = float("nan")
            continue
        if not ranked.hit.any():
            ap[distance] = 0.0
            if distance == _ERROR_DISTANCE:
                errors = dict.fromkeys(ERRORS, 1.0)
            continue
        precision, scores = _curve(ranked, objects)
        above = np.maximum(precision[first:] - _LEAST_PRECISION, 0.0)
        ap[distance] = float(above.mean() / (1.0 - _LEAST_PRECISION))
        if distance == _ERROR_DISTANCE:
            reached = np.flatnonzero(scores)
            last = int(reached[-1]) if len(reached) else 0
            of_hits = ranked.scores[ranked.hit]
            for name, values in ranked.errors.items():
                if np.isnan(values).all():
                    continue
                if last < first:
                    errors[name] = 1.0
                    continue
                sampled = np.interp(scores[::-1], of_hits[::-1], _running_mean(values)[::-1])[::-1]
                errors[name] = float(sampled[first : last + 1].mean())
    return NuscenesMetrics(ap=ap, errors=errors, objects=objects)


def detection_score(metrics: Sequence[NuscenesMetrics]) -> float:
    """The detection score of nuScenes over classes with objects: half mean AP, half how small the errors are.

    An error that is not known counts as 1, and so does the fifth, of the attributes, which warploom does not have.
    """
    there = [each for each in metrics if each.objects]
    if not there:
        return float("nan")
    total = 5.0 * float(np.mean([each.mean_ap for each in there]))
    for name in ERRORS:
        values = np.array([each.errors[name] for each in there])
        known = values[~np.isnan(values)]
        total += 1.0 - min(1.0, float(known.mean()) if len(known) else 1.0)
    return total / 10.0
