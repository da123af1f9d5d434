"""`warploom eval detection`: a detection head on data sets with truth and on the simulator, from scans to scores.

Frames of one kind, and of one sensor where there are several, are scored together: KITTI's by its own average precision
and, in the camera's view, by what is found and what is false; the simulator's and nuScenes' all round, by nuScenes'
measures too; range images by the points of cars that lie in boxes.
"""

from __future__ import annotations

import json
import pathlib
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ...errors import ConfigError, SourceError
from ...models.classes import UNKNOWN
from ...models.detections import Detections
from ...models.geometry import points_in_boxes
from ...models.heads import LidarHead
from .detection_figures import figures_of
from .detection_frames import EvaluationFrame, evaluation_frames
from .detection_outcomes import FrameOutcome, judge
from .detection_reviews import Review
from .kitti_objects import KITTI_CLASS_OF_TYPE, read_results

__all__ = ["LEAST_SCORE", "DetectionEvaluation", "FalseDetection", "evaluate_detection", "lines_of", "write_summary"]

LEAST_SCORE = 0.1
"""Detections below do not count for any average precision."""


@dataclass(frozen=True, kw_only=True)
class FalseDetection:
    """A vehicle that is not there, or has no label."""

    frame: str
    box: tuple[float, ...]
    score: float
    points: int
    """In the box."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DetectionEvaluation:
    """What a head reached."""

    head: dict[str, Any]
    """Card, sha256, provider, score in question; where detections were read instead: the folder."""
    outcomes: list[FrameOutcome]
    score: float
    dropped: int = 0
    """Detections above `LEAST_SCORE` that were beyond the head's limits."""
    sets: dict[str, dict[str, Any]] = field(default_factory=dict)
    """Figures by kind of the frames, or by kind and sensor (`sim vlp16`) where a kind's are of several."""

    @property
    def false(self) -> list[FalseDetection]:
        """All false vehicles, in the order of the frames."""
        return [
            FalseDetection(
                frame=outcome.frame.name,
                box=tuple(round(float(v), 3) for v in outcome.found.boxes[k]),
                score=round(float(outcome.found.scores[k]), 4),
                points=int(points_in_boxes(outcome.frame.points, outcome.found.boxes[k : k + 1]).sum()),
            )
            for outcome in self.outcomes
            for k in outcome.false
        ]

    def as_dict(self) -> dict[str, Any]:
        """What `summary.json` holds."""
        return {
            "head": self.head,
            "score": self.score,
            "dropped": self.dropped,
            "sets": self.sets,
            "false_vehicles": [vars(each) | {"box": list(each.box)} for each in self.false],
        }


def _read_detections(folder: pathlib.Path, frame: EvaluationFrame) -> Detections:
    """KITTI result files as detections."""
    if frame.kitti is None:
        raise ConfigError(f"{folder}: result files are of KITTI's sets; {frame.name} is of another")
    path = folder / f"{frame.name.rpartition('/')[2]}.txt"
    if not path.is_file():
        raise ConfigError(f"{path}: not there; each scan has a result file, an empty one where nothing was found")
    try:
        boxes, scores, types = read_results(path, frame.kitti.calibration)
    except SourceError as error:
        raise ConfigError(str(error)) from None
    return Detections(
        boxes=boxes.astype(np.float32),
        scores=scores.astype(np.float32),
        classes=np.array([KITTI_CLASS_OF_TYPE.get(kind, UNKNOWN) for kind in types], np.int32),
        velocities=np.full((len(boxes), 2), np.nan, np.float32),
        background=np.zeros(len(boxes), bool),
    )


def evaluate_detection(
    data: Sequence[str],
    head: LidarHead | pathlib.Path,
    *,
    score: float | None = None,
    also: Sequence[float] = (),
    review: Review | None = None,
) -> DetectionEvaluation:
    """Detects in every frame, and scores it.

    Args:
        data: URIs, see `detection_frames`.
        head: Made with a score threshold of `LEAST_SCORE`; or a folder of KITTI result files to score instead.
        score: From which detections count as found or false; None is what the head's card says.
        also: Further scores to count at.
        review: Of false vehicles that are real though unlabelled.

    Raises:
        ConfigError: A URI that makes no sense, no such data, or result files that are missing or damaged.
        SourceError: Data that are damaged.
        ValueError: A folder of results without a score.
    """
    if not isinstance(head, pathlib.Path):
        score = _score_of(head.card) if score is None else score
        said = {
            "name": head.card.name,
            "sha256": head.card.sha256,
            "provider": head.provider,
            "fallback": head.fallback,
        }
        head.warm_up()
    elif score is None:
        raise ValueError("score must be given where detections are read from files")
    elif not head.is_dir():
        what = "is no folder" if head.exists() else "is not there"
        raise ConfigError(f"{head} {what}; expected one of KITTI's result files, 000000.txt for scan 000000 and so on")
    else:
        said = {"name": str(head)}
    outcomes, dropped = [], 0
    for uri in data:
        for frame in evaluation_frames(uri):
            began = time.perf_counter()
            if not isinstance(head, pathlib.Path):
                found = head.detect_points(frame.points, frame.sensor_height)
                dropped += head.overflow
            else:
                found = _read_detections(head, frame)
            outcomes.append(judge(frame, found, time.perf_counter() - began, score, review))
    if not outcomes:
        raise ConfigError(f"{', '.join(data) or 'no data'}: no frames to evaluate")
    sets = {
        name: figures_of(some[0].frame.kind, some, score, also, review) for name, some in _by_sensor(outcomes).items()
    }
    return DetectionEvaluation(head=said, outcomes=outcomes, score=score, dropped=dropped, sets=sets)


def _by_sensor(outcomes: Sequence[FrameOutcome]) -> dict[str, list[FrameOutcome]]:
    """The frames that are scored together, by the name of their figures."""
    sensors: dict[str, dict[str, list[FrameOutcome]]] = {}
    for each in outcomes:
        sensors.setdefault(each.frame.kind, {}).setdefault(each.frame.sensor, []).append(each)
    return {
        kind if len(parts) == 1 else f"{kind} {sensor}": some
        for kind, parts in sensors.items()
        for sensor, some in parts.items()
    }


def _score_of(card: Any) -> float:
    """The score that a card of any kind recommends."""
    for part in (getattr(card, "decode", None), getattr(card, "read", None), card):
        if hasattr(part, "score_threshold"):
            return part.score_threshold
    raise ValueError(f"score must be given: the card of {card.name} recommends none")


def write_summary(result: DetectionEvaluation, out: pathlib.Path) -> None:
    """Writes `summary.json` into a folder, which is made where it is not there."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps(result.as_dict(), indent=2) + "\n")


def lines_of(result: DetectionEvaluation) -> list[str]:
    """The figures as a table for people."""
    lines = []
    for kind, figures in result.sets.items():
        lines.append(f"{kind}: {figures['frames']} frames, {figures['milliseconds_median']:.1f} ms median")
        for score, at in figures["at"].items():
            lines.append(f"  from score {score}")
            for name, value in at.items():
                if name == "tasks":
                    lines += [f"    {task:<34} {_share(n)}" for task, n in value.items()]
                elif isinstance(value, dict):
                    said = ", ".join(f"{key} {number:g}" for key, number in value.items())
                    lines.append(f"    {name.replace('_', ' '):<34} {said}")
                else:
                    said = "none there" if value is None else f"{value:g}"
                    lines.append(f"    {name.replace('_', ' '):<34} {said}")
        for name, recall in figures.get("recall", {}).items():
            for by, unit in (("by_range", "m"), ("by_points", "points")):
                bins = [each for each in recall[by] if each["objects"]]
                said = "  ".join(f"{_span(each)}: {each['found']}/{each['objects']}" for each in bins)
                lines.append(f"  {name} found within {recall['within_metres']:g} m, by {unit}: {said}")
        for kind_name, metrics in figures.get("kitti_ap_r40", {}).items():
            for metric, levels in metrics.items():
                said = "  ".join(f"{level} {_number(v['ap'])} (of {v['objects']})" for level, v in levels.items())
                lines.append(f"  KITTI AP R40 {kind_name} {metric}: {said}")
        for name, ap in figures.get("bev_ap", {}).items():
            line = f"  BEV AP@{ap['overlap']:g} {name}: {ap['ap']:.1f} of {ap['objects']}"
            if half := ap.get("half_visible"):
                line += f"; of what is half visible or more {half['ap']:.1f} of {half['objects']}"
            lines.append(line)
        scores = figures.get("nuscenes", {})
        for name, each in scores.get("classes", {}).items():
            distances = "  ".join(f"{key} m {_number(value, 3)}" for key, value in each["ap_by_distance"].items())
            errors = "  ".join(f"{key} {_number(value, 3)}" for key, value in each["errors"].items())
            lines.append(f"  nuScenes AP {name}: {_number(each['ap'], 3)} ({distances}); errors: {errors}")
        if scores.get("detection_score") is not None:
            lines.append(f"  nuScenes detection score: {scores['detection_score']:.3f}")
    if result.dropped:
        lines.append(f"{result.dropped} detections were beyond the limits of the head's card, which the log names")
    if result.head.get("fallback"):
        lines.append(f"provider: {result.head['fallback']}")
    return lines


def _share(task: dict[str, int]) -> str:
    return f"{task['found']}/{task['objects']}" if task["objects"] else "none there"


def _span(each: dict[str, Any]) -> str:
    return f"{each['low']:g}+" if each["high"] > 1e6 else f"{each['low']:g}–{each['high']:g}"


def _number(value: float | None, digits: int = 1) -> str:
    return "–" if value is None else f"{value:.{digits}f}"
