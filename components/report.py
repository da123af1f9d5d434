"""The report of a run: latency by stage, objects and ground against the truth, and every loss."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from ..models.classes import CLASSES, UNKNOWN
from ..models.evaluation.ground import ground_scores
from ..models.evaluation.tracking import TrackTable, tracking_summary
from .pipeline import PerceptionFrame

__all__ = ["RunReport"]

_MIN_POINTS = 5
_MAX_DISTANCE = 60.0
_MATCH_DISTANCE = 2.0
_PROTOCOL = (
    f"foreground objects against the true ones within {_MAX_DISTANCE:.0f} m that have at least {_MIN_POINTS} points, "
    f"matched within {_MATCH_DISTANCE:.0f} m on the ground; a true object with fewer points is neither missed nor wrong"
)


class RunReport:
    """Collects the frames of a run; `as_dict` sums them up."""

    def __init__(self) -> None:
        self.frames = 0
        self.failed = 0
        self._total_ms: list[float] = []
        self._run_ms: dict[str, list[float]] = {}
        self._wait_ms: dict[str, list[float]] = {}
        self._points: list[int] = []
        self._dropped: Counter[str] = Counter()
        self._ground_f1: list[float] = []
        self._tracks: list[tuple[np.ndarray, ...]] = []
        self._truth: list[tuple[np.ndarray, ...]] = []
        self._truth_complete = True
        self._objects: Counter[str] = Counter()
        self._ids: set[int] = set()

    def add(self, frame: PerceptionFrame) -> None:
        """Takes up one frame."""
        self.frames += 1
        self.failed += frame.failed
        self._points.append(len(frame.sensor.points))
        self._dropped.update(frame.dropped)
        if not frame.failed:
            self._total_ms.append(frame.latency.total_ms)
        for stage, latency in frame.latency.stages.items():
            self._run_ms.setdefault(stage, []).append(latency.run_ms)
            self._wait_ms.setdefault(stage, []).append(latency.wait_ms)
        objects = frame.objects
        self._ids.update(objects.ids[~objects.background].tolist())
        self._objects.update(CLASSES[c] for c in objects.classes[~objects.background])
        self._objects["background"] += int(objects.background.sum())
        if frame.sensor.truth is not None:
            self._add_truth(frame)

    def _add_truth(self, frame: PerceptionFrame) -> None:
        truth, objects = frame.sensor.truth, frame.objects
        assert truth is not None
        if truth.ground is not None:
            self._ground_f1.append(ground_scores(frame.ground, truth.ground, truth.ground_scored).f1)
        self._truth_complete &= truth.complete
        known = ~objects.background
        near = np.hypot(objects.boxes[:, 0], objects.boxes[:, 1]) <= _MAX_DISTANCE
        self._tracks.append(
            (
                np.full(known.sum(), self.frames),
                objects.ids[known],
                objects.boxes[known],
                objects.velocities[known],
                objects.classes[known],
                ~near[known],
            )
        )
        far = np.hypot(truth.boxes[:, 0], truth.boxes[:, 1]) > _MAX_DISTANCE
        hidden = (truth.points >= 0) & (truth.points < _MIN_POINTS)
        identified = truth.ids >= 0  # labels without identity are told apart by their row
        ids = np.where(identified, truth.ids, 1_000_000 * self.frames + np.arange(len(truth.ids)))
        self._truth.append(
            (np.full(len(ids), self.frames), ids, truth.boxes, truth.velocities, truth.classes, far | hidden)
        )

    def as_dict(self) -> dict[str, Any]:
        """The report as plain values."""
        report: dict[str, Any] = {
            "frames": self.frames,
            "frames_failed": self.failed,
            "points_per_frame": _median(self._points),
            "points_dropped": dict(self._dropped),
            "latency_ms": {
                "total": _statistics(self._total_ms),
                "stages": {
                    stage: {
                        **_statistics(values),
                        "wait_median": _median(self._wait_ms[stage]),
                        "wait_p99": _statistics(self._wait_ms[stage])["p99"],
                    }
                    for stage, values in self._run_ms.items()
                },
            },
            "objects_reported": dict(self._objects),
            "tracks": len(self._ids),
        }
        if self._ground_f1:
            report["ground_f1"] = _mean(self._ground_f1)
        if any(len(boxes) for _, _, boxes, *_ in self._truth):
            report["objects"] = {"protocol": _PROTOCOL, **self._against_truth()}
        return report

    def _against_truth(self) -> dict[str, Any]:
        tracks, truth = (
            [np.concatenate(column) for column in zip(*tables, strict=True)] for tables in (self._tracks, self._truth)
        )
        rows: dict[str, Any] = {}
        for class_index, name in [(None, "all"), *enumerate(CLASSES)]:
            if class_index == UNKNOWN or (class_index is not None and not np.any(truth[4] == class_index)):
                continue
            chosen = np.ones(len(tracks[0]), bool) if class_index is None else tracks[4] == class_index
            others = np.zeros(len(truth[0]), bool) if class_index is None else truth[4] != class_index
            summary = tracking_summary(
                _table(truth, np.ones(len(truth[0]), bool), truth[5] | others),
                _table(tracks, chosen, tracks[5][chosen]),
                threshold=_MATCH_DISTANCE,
            )
            if summary.objects:
                rows[name] = {
                    "objects": summary.objects,
                    "found": _rounded(summary.recall),
                    # Without a box for every object, what fits none is not known to be wrong.
                    "precision": _rounded(summary.precision) if self._truth_complete else None,
                    "id_switches": summary.id_switches,
                    "position_error_m": _rounded(summary.position_error),
                    "velocity_error_mps": _rounded(summary.velocity_error),
                }
        return rows

    def write(self, path: Path, **more: Any) -> dict[str, Any]:
        """Writes the report, and what else is said of the run, as JSON; gives what it wrote."""
        report = {**more, **self.as_dict()}
        path.write_text(json.dumps(report, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
        return report


def _table(columns: list[np.ndarray], chosen: np.ndarray, ignored: np.ndarray) -> TrackTable:
    frames, ids, boxes, velocities = (column[chosen] for column in columns[:4])
    return TrackTable(frames=frames, ids=ids, boxes=boxes, velocities=velocities, ignored=ignored)


def _statistics(values: list[float]) -> dict[str, float | None]:
    if not values:
        return {"median": None, "p90": None, "p99": None, "max": None}
    return {
        "median": _rounded(float(np.median(values))),
        "p90": _rounded(float(np.percentile(values, 90))),
        "p99": _rounded(float(np.percentile(values, 99))),
        "max": _rounded(max(values)),
    }


def _median(values: list) -> float | None:
    return _rounded(float(np.median(values))) if values else None


def _mean(values: list[float]) -> float | None:
    return _rounded(float(np.nanmean(values))) if np.isfinite(values).any() else None


def _rounded(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
