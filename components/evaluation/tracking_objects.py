"""`warploom eval tracking` from scan to objects: a whole pipeline, with its own head, clusters and tracker.

On a simulator's drive with all that is true of it: how much is found, how well velocities are known once a track has
lived for a second, and whether an object that was hidden for a second comes out under its old id. On KITTI's tracking
set where scans are at hand: the same figures as for detections that others made, in the camera's view.
"""

from __future__ import annotations

import pathlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...errors import SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ...models.evaluation.hota import Hota, hota
from ...models.evaluation.tracking import TrackingSummary, TrackTable, tracking_summary
from ..messages import Obstacles, SensorFrame
from ..pipeline import Pipeline
from .kitti_objects import label_files, unpack_scan
from .kitti_tracking import TYPES, TrackingSequence
from .tracking import TrackingEvaluation, score_tracks

__all__ = ["DriveEvaluation", "evaluate_drive", "evaluate_scans", "lines_of_drive", "score_drive"]

_COUNTED = (VEHICLE, PEDESTRIAN, CYCLIST)
_LEAST_POINTS = 5  # of an object that can be found
_MOST_DISTANCE = 60.0  # [m]
_NEAR_ENOUGH = 2.0  # from the truth [m]
_SETTLED = 1_000_000_000  # age of a track from which on its velocity should be right [ns]
_HIDDEN = (600_000_000, 1_500_000_000)  # how long an occlusion lasts that counts [ns]
_PERIOD_NS = 100_000_000


@dataclass(frozen=True, kw_only=True)
class DriveEvaluation:
    """What a pipeline reached on a drive of which all is known."""

    name: str
    summary: TrackingSummary
    """Matched by the centres within 2 m; objects with at least 5 points within 60 m."""
    hota: Hota
    settled_velocity_error: float
    """Median length of the difference of velocities, of tracks from 1 s of life on [m/s]; NaN without any."""
    settled: int
    """How many rows that is the median of."""
    occlusions: int
    """Objects that were tracked, then hidden for 0.6 to 1.5 s, then found again."""
    kept: int
    """Of these, those under the same id."""

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "name": self.name,
            "recall": self.summary.recall,
            "precision": self.summary.precision,
            "IDS": self.summary.id_switches,
            "HOTA": 100 * self.hota.hota,
            "velocity_error": self.settled_velocity_error,
            "velocities": self.settled,
            "occlusions": self.occlusions,
            "ids_kept": self.kept,
        }


def _match(truth: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """The row of the object of each true one, −1 for none: nearest pairs first."""
    match = np.full(len(truth), -1)
    apart = np.linalg.norm(truth[:, None, :2] - boxes[None, :, :2], axis=2)
    while apart.size and apart.min() < _NEAR_ENOUGH:
        row, column = np.unravel_index(apart.argmin(), apart.shape)
        match[row] = column
        apart[row], apart[:, column] = np.inf, np.inf
    return match


def score_drive(name: str, frames: Iterable[tuple[SensorFrame, Obstacles]]) -> DriveEvaluation:
    """Scores the objects of frames whose truth is known.

    Raises:
        SourceError: A frame has no truth.
    """
    truth_rows, track_rows, errors = [], [], []
    first_seen: dict[int, int] = {}
    last: dict[int, tuple[int, int]] = {}  # of true objects: the id they had, and when they were last visible
    occlusions = kept = 0
    for k, (sensor, objects) in enumerate(frames):
        truth = sensor.truth
        if truth is None:
            raise SourceError(f"{name}: frame {sensor.index} comes without truth, which an evaluation needs")
        known = ~objects.background
        ids, boxes, velocities = objects.ids[known], objects.boxes[known].astype(float), objects.velocities[known]
        near = np.isin(truth.classes, _COUNTED) & (np.linalg.norm(truth.boxes[:, :2], axis=1) < _MOST_DISTANCE)
        visible = near & (truth.points >= _LEAST_POINTS)
        for number in ids.tolist():
            first_seen.setdefault(number, sensor.version)
        rows = np.flatnonzero(visible)
        match = _match(truth.boxes[rows], boxes)
        for row, found in zip(rows, match, strict=True):
            who = int(truth.ids[row])
            if found < 0:
                continue
            number = int(ids[found])
            if who in last:
                before, when = last[who]
                if _HIDDEN[0] <= sensor.version - when <= _HIDDEN[1]:
                    occlusions += 1
                    kept += number == before
            if sensor.version - first_seen[number] >= _SETTLED:
                errors.append(float(np.linalg.norm(velocities[found] - truth.velocities[row])))
            last[who] = (number, sensor.version)
        for row in rows[match < 0]:  # seen, but not found: no occlusion
            last.pop(int(truth.ids[row]), None)
        truth_rows.append((np.full(len(near), k), truth.ids, truth.boxes, ~visible, truth.velocities))
        counted = np.linalg.norm(boxes[:, :2], axis=1) < _MOST_DISTANCE
        track_rows.append((np.full(len(ids), k), ids, boxes, ~counted, velocities))
    if not truth_rows:
        raise SourceError(f"{name}: no frames")
    truth_table, tracks = _table(truth_rows), _table(track_rows)
    return DriveEvaluation(
        name=name,
        summary=tracking_summary(truth_table, tracks, threshold=_NEAR_ENOUGH),
        hota=hota([truth_table], [tracks]),
        settled_velocity_error=float(np.median(errors)) if errors else float("nan"),
        settled=len(errors),
        occlusions=occlusions,
        kept=kept,
    )


def _table(rows: Sequence[tuple[np.ndarray, ...]]) -> TrackTable:
    frames, ids, boxes, ignored, velocities = (np.concatenate(part) for part in zip(*rows, strict=True))
    return TrackTable(frames=frames, ids=ids, boxes=boxes.astype(float), ignored=ignored, velocities=velocities)


def evaluate_drive(uri: str, *, profile: str = "cpu", settings: Iterable[str] = ()) -> DriveEvaluation:
    """Runs a profile's pipeline over a source that knows the truth, such as `sim:street?seed=3`.

    Raises:
        SourceError: The source cannot be read, or knows no truth.
        ConfigError: Profile or settings are bad.
    """
    from ..sources.opening import open_source

    with Pipeline.from_profile(profile, settings=settings) as pipeline:
        return score_drive(uri, ((frame.sensor, frame.objects) for frame in pipeline.run(open_source(uri))))


def lines_of_drive(result: DriveEvaluation) -> list[str]:
    """The figures for people."""
    summary = result.summary
    hidden = f"{result.kept} of {result.occlusions} ids kept through an occlusion of 0.6 to 1.5 s"
    return [
        f"{result.name}: {summary.objects} objects in frames",
        f"recall {100 * summary.recall:.1f} %, precision {100 * summary.precision:.1f} %, IDS {summary.id_switches}, "
        f"HOTA {100 * result.hota.hota:.1f}",
        f"velocity error {result.settled_velocity_error:.2f} m/s (median of {result.settled}, tracks from 1 s on)",
        hidden if result.occlusions else "no occlusion of 0.6 to 1.5 s",
    ]


def _scans(sequence: TrackingSequence, data: pathlib.Path) -> Iterator[SensorFrame]:
    """The scans of a sequence that are there."""
    from ..sources.scan_files import read_scan

    for path, _, _ in label_files(data, sequence.name):
        number = int(path.stem)
        at = np.flatnonzero(sequence.frames == number)
        pose = None
        if sequence.poses is not None and len(at):
            pose = sequence.poses[at[0]] @ sequence.renamed_from_lidar
        points = unpack_scan(path) if path.suffix == ".npz" else read_scan(path).points
        yield SensorFrame(
            version=(number + 1) * _PERIOD_NS, index=number, points=np.ascontiguousarray(points[:, :4], np.float32),
            pose=pose,
        )  # fmt: skip


def evaluate_scans(
    data: pathlib.Path, name: str, *, profile: str = "cpu", settings: Iterable[str] = ()
) -> list[TrackingEvaluation]:
    """Runs a profile's pipeline over the scans of a sequence of KITTI's tracking set, and scores each type.

    Args:
        data: With `velodyne/` or `velodyne_packed/`, `label_02/`, `calib/` and, for the ego's poses, `oxts/`.
        name: Of the sequence.
        profile: A hardware profile.
        settings: Changes to it, as texts `key=value`.

    Raises:
        SourceError: Data are missing or damaged.
        ConfigError: Profile or settings are bad.
    """
    sequences = {kind.name: TrackingSequence.read(data, None, name, kind) for kind in TYPES}
    some = next(iter(sequences.values()))
    with Pipeline.from_profile(profile, settings=settings) as pipeline:
        frames = [(frame.index, frame.objects) for frame in pipeline.run(_scans(some, data))]
    numbers = np.array([number for number, _ in frames])
    results = []
    for kind in TYPES:
        sequence = sequences[kind.name]
        parts = []
        for number, objects in frames:
            chosen = (objects.classes == kind.class_index) & ~objects.background
            boxes = sequence.renamed(objects.boxes[chosen])
            parts.append((np.full(len(boxes), number), objects.ids[chosen], boxes, objects.scores[chosen]))
        at, ids, boxes, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
        table = TrackTable(
            frames=at, ids=ids, boxes=boxes, scores=_of_whole_tracks(ids, scores),
            ignored=sequence.ignorable(at, boxes) | ~sequence.in_view(boxes),
        )  # fmt: skip
        there = np.isin(sequence.truth.frames, numbers)
        truth = TrackTable(
            **{each: getattr(sequence.truth, each)[there] for each in ("frames", "ids", "boxes", "ignored")}
        )
        if (~truth.ignored).any():
            results.append(score_tracks(kind, (name,), [truth], [table], frames_per_second=float("nan"), dropped={}))
    return results


def _of_whole_tracks(ids: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """The mean score of a track, in all its rows."""
    _, which = np.unique(ids, return_inverse=True)
    mean = np.bincount(which, scores) / np.maximum(np.bincount(which), 1)
    return (np.rint(mean * 2.0**20) / 2.0**20)[which] if len(ids) else np.empty(0)
