"""`warploom eval tracking`: the tracker on KITTI's tracking set, from detections to result files and scores."""

from __future__ import annotations

import json
import pathlib
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import SourceError
from ...models.evaluation.hota import Hota, hota
from ...models.evaluation.tracking import AverageMot, TrackTable, average_mot
from ...models.tracker import Tracker, TrackerConfig
from .kitti_tracking import ObjectType, TrackingSequence, detection_format, sequence_names, write_results
from .plots import draw_recall

__all__ = [
    "OVERLAPS",
    "TrackingEvaluation",
    "evaluate_tracking",
    "lines_of",
    "score_tracks",
    "track",
    "track_confidences",
    "write_summary",
]

OVERLAPS = (0.25, 0.5, 0.7)
"""3D overlaps at which a track counts as right."""

_USUAL_OVERLAP = 0.5
_PERIOD_NS = 100_000_000
_PRIOR_HITS = 2.0
_SCORE_STEPS = 2.0**20
_SUREST = 1.0 - 1e-9


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackingEvaluation:
    """What the tracker reached."""

    kind: ObjectType
    sequences: tuple[str, ...]
    averages: dict[float, AverageMot]
    """By 3D overlap."""
    hota: Hota
    """Of the tracks from the score on that gives the highest MOTA at a 3D overlap of 0.5, as AB3DMOT chooses it."""
    frames_per_second: float
    """Of the tracker alone, over all sequences; NaN where it was not measured."""
    dropped: dict[str, int]
    """Detections that were left out, and frames out of the ordinary such as a `gap`, by reason."""

    def as_dict(self) -> dict[str, Any]:
        """What `summary.json` holds: averages and MOTA in percent."""
        return {
            "type": self.kind.name,
            "sequences": list(self.sequences),
            "frames_per_second": self.frames_per_second if self.frames_per_second > 0.0 else None,
            "dropped": self.dropped,
            "hota": {
                "HOTA": 100 * self.hota.hota,
                "DetA": 100 * self.hota.detection,
                "AssA": 100 * self.hota.association,
            },
            "overlaps": {
                f"{overlap:g}": {
                    "sAMOTA": 100 * average.samota,
                    "AMOTA": 100 * average.amota,
                    "AMOTP": 100 * average.amotp,
                    "MOTA": 100 * average.best.mota,
                    "MOTP": 100 * average.best.motp,
                    "IDS": average.best.id_switches,
                    "FRAG": average.best.fragmentations,
                    "FP": average.best.false_positives,
                    "FN": average.best.misses,
                    "objects": average.best.objects,
                    "curve": {
                        "recall": average.recalls.tolist(),
                        "threshold": average.thresholds.tolist(),
                        "sMOTA": (100 * average.smotas).tolist(),
                        "MOTA": [100 * point.mota for point in average.curve],
                    },
                }
                for overlap, average in self.averages.items()
            },
        }


def track_confidences(ids: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """One score for all rows of a track, as averages over recall rank whole tracks.

    The mean of −log(1 − score) over its detections: for sure ones it grows as their logit does. It is less for a track
    of few: times n / (n + 2) for n detections. Rounded to 2⁻²⁰, so that the mean over a track's rows, which evaluations
    take, is the number itself.

    Args:
        ids: Of the track of each row, shape (n,).
        scores: Of the detection, in [0, 1]; NaN in rows without one; shape (n,).

    Returns:
        Shape (n,), float64.
    """
    _, which = np.unique(ids, return_inverse=True)
    seen = np.isfinite(scores)
    hits = np.bincount(which, seen)
    surely = -np.log1p(-np.minimum(np.where(seen, scores, 0.0), _SUREST))
    confidence = np.bincount(which, surely) / (hits + _PRIOR_HITS)
    return (np.rint(confidence * _SCORE_STEPS) / _SCORE_STEPS)[which]


def track(sequence: TrackingSequence, kind: ObjectType, tracker: Tracker) -> tuple[TrackTable, float]:
    """The tracks of a sequence, in its renamed frame, and the seconds that the tracker took; frames are 0.1 s apart."""
    parts, seconds = [], 0.0
    for k, frame in enumerate(sequence.frames):
        pose = None if sequence.poses is None else sequence.poses[k]
        boxes = sequence.boxes[k]
        started = time.perf_counter()
        found = tracker.update(
            int(frame) * _PERIOD_NS, boxes, sequence.scores[k], np.full(len(boxes), kind.class_index), pose=pose
        )
        seconds += time.perf_counter() - started
        scores = np.where(found.coasted, np.nan, np.append(sequence.scores[k], np.nan)[found.detections])
        parts.append((np.full(len(found), frame), found.ids, found.boxes, scores))
    frames, ids, boxes, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
    table = TrackTable(
        frames=frames,
        ids=ids,
        boxes=boxes,
        scores=track_confidences(ids, scores),
        ignored=sequence.ignorable(frames, boxes),
    )
    return table, seconds


def _best_score(average: AverageMot) -> float:
    """The score that gives the highest MOTA."""
    if not average.curve:
        return 0.0
    return float(average.thresholds[int(np.argmax([point.mota for point in average.curve]))])


def _from_score(table: TrackTable, score: float) -> TrackTable:
    """The tracks of this score or a higher one."""
    assert table.scores is not None
    assert table.ignored is not None
    kept = table.scores >= score
    return TrackTable(
        frames=table.frames[kept],
        ids=table.ids[kept],
        boxes=table.boxes[kept],
        scores=table.scores[kept],
        ignored=table.ignored[kept],
    )


def score_tracks(
    kind: ObjectType,
    names: Sequence[str],
    truth: list[TrackTable],
    tables: list[TrackTable],
    *,
    frames_per_second: float,
    dropped: dict[str, int],
) -> TrackingEvaluation:
    """All figures of the tracks of some sequences."""
    averages = {overlap: average_mot(truth, tables, threshold=overlap) for overlap in OVERLAPS}
    best = _best_score(averages[_USUAL_OVERLAP])
    return TrackingEvaluation(
        kind=kind,
        sequences=tuple(names),
        averages=averages,
        hota=hota(truth, [_from_score(table, best) for table in tables]),
        frames_per_second=frames_per_second,
        dropped=dropped,
    )


def evaluate_tracking(
    data: pathlib.Path,
    detections: pathlib.Path,
    out: pathlib.Path,
    *,
    sequences: Sequence[str] = (),
    config: TrackerConfig | None = None,
) -> TrackingEvaluation:
    """Tracks the detections, writes the result files, `summary.json` and `recall.png`, and scores the tracks.

    Args:
        data: KITTI's tracking set: `label_02/`, `calib/`, `oxts/`.
        detections: Folder of `NAME.txt` with the detections of one type; or its name in `data`.
        out: Folder for what is written.
        sequences: Names; none are all that have labels and detections.
        config: Of the tracker.

    Raises:
        SourceError: Data or detections are missing or damaged, or there is no such sequence.
    """
    if not data.is_dir():
        raise SourceError(f"{data}: no such folder; expected KITTI's tracking set with label_02/ and calib/")
    folder = detections if detections.is_dir() else data / detections
    if not folder.is_dir():
        beside = sorted(path.name for path in data.iterdir() if path.is_dir())
        raise SourceError(f"{detections}: no such folder, nor in {data}, which has: {', '.join(beside)}")
    known = sequence_names(data, folder)
    unknown = [name for name in sequences if name not in known]
    if unknown:
        raise SourceError(f"no sequence {', '.join(unknown)} with labels and detections; there are: {', '.join(known)}")
    names = list(sequences) or known
    kind, logits = detection_format(folder, names)
    read = [TrackingSequence.read(data, folder, name, kind, logits=logits) for name in names]
    if all(sequence.truth.ignored is None or sequence.truth.ignored.all() for sequence in read):
        raise SourceError(f"{data / 'label_02'}: no {kind.name} that counts is labelled in {', '.join(names)}")

    out.mkdir(parents=True, exist_ok=True)
    tables, seconds, dropped = [], 0.0, Counter()
    for sequence in read:
        tracker = Tracker(config)
        table, took = track(sequence, kind, tracker)
        write_results(out / f"{sequence.name}.txt", (sequence, kind, table))
        tables.append(table)
        seconds += took
        dropped.update(tracker.dropped + tracker.incidents)
    speed = sum(len(sequence.frames) for sequence in read) / max(seconds, 1e-9)
    truth = [sequence.truth for sequence in read]
    result = score_tracks(kind, names, truth, tables, frames_per_second=speed, dropped=dropped)
    (out / "summary.json").write_text(json.dumps(result.as_dict(), indent=2) + "\n")
    draw_recall(out / "recall.png", result.kind.name, result.averages)
    return result


def write_summary(out: pathlib.Path, results: Sequence[TrackingEvaluation]) -> None:
    """Writes what several types reached: `summary.json` with an entry for each, and a `recall_TYPE.png` for each."""
    summary = {result.kind.name: result.as_dict() for result in results}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    for result in results:
        draw_recall(out / f"recall_{result.kind.name}.png", result.kind.name, result.averages)


def _speed(frames_per_second: float) -> str:
    return f": {frames_per_second:,.0f} frames/s" if frames_per_second > 0.0 else ""


def lines_of(result: TrackingEvaluation) -> list[str]:
    """The scores as a table for people."""
    names = ("sAMOTA", "AMOTA", "AMOTP", "MOTA", "MOTP", "IDS", "FRAG", "FP", "FN")
    rows = [["3D overlap", *names]]
    for overlap, scores in result.as_dict()["overlaps"].items():
        rows.append([overlap, *(f"{v:.2f}" if isinstance(v := scores[name], float) else str(v) for name in names)])
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        f"{result.kind.name}, sequences {' '.join(result.sequences)}" + _speed(result.frames_per_second),
        *("  ".join(text.rjust(width) for text, width in zip(row, widths, strict=True)) for row in rows),
        f"HOTA {100 * result.hota.hota:.2f}, DetA {100 * result.hota.detection:.2f}, "
        f"AssA {100 * result.hota.association:.2f}, of the tracks with the highest MOTA at 0.5",
        *(f"{count} dropped: {reason}" for reason, count in result.dropped.items() if count),
    ]
