"""`warploom eval tracking` from scan to objects: a whole pipeline, with its own head, clusters and tracker.

On a simulator's drive with all that is true of it: how much is found, how well velocities are known once a track has
lived for a second, and whether an object that was hidden for a second comes out under its old id. On KITTI's tracking
set where scans are at hand: the same figures as for detections that others made, in the camera's view.
"""

from __future__ import annotations

import json
import pathlib
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ...dag import parse_overrides
from ...errors import ConfigError, SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ...models.detections import Detections
from ...models.evaluation.hota import Hota, hota
from ...models.evaluation.tracking import TrackingSummary, TrackTable, tracking_summary
from ...models.tracker import Tracker, TrackerConfig
from ..messages import DetectedObjects, Obstacles, SensorFrame
from ..perception.tracker_settings import TrackerSettings
from ..pipeline import Pipeline
from .kitti_objects import label_files, labelled_sequences, unpack_scan
from .kitti_tracking import TYPES, ObjectType, TrackingSequence, write_results
from .tracking import TrackingEvaluation, score_tracks, write_summary

__all__ = [
    "DriveEvaluation",
    "drive_uris",
    "evaluate_drives",
    "evaluate_scans",
    "lines_of_drives",
    "score_drives",
]

_COUNTED = (VEHICLE, PEDESTRIAN, CYCLIST)
_LEAST_POINTS = 5  # of an object that can be found
_MOST_DISTANCE = 60.0  # [m]
_NEAR_ENOUGH = 2.0  # from the truth [m]
_SETTLED = 1_000_000_000  # age of a track from which on its velocity should be right [ns]
_HIDDEN = (600_000_000, 1_500_000_000)  # how long an occlusion lasts that counts [ns]
_TRACKED_FRAMES = 5  # before it, in which the object can be seen
_FOUND_AGAIN = 10  # frames after it, in which the object must be found
_SEEDS = re.compile(r"seeds=(\d+)-(\d+)")
_PERIOD_NS = 100_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class DriveEvaluation:
    """What a tracker reached on drives of which all is known."""

    name: str
    drives: int
    summary: TrackingSummary
    """Matched by the centres within 2 m; objects with at least 5 points within 60 m."""
    hota: Hota
    settled_velocity_error: float
    """Median length of the difference of velocities, of tracks from 1 s of life on [m/s]; NaN without any."""
    settled: int
    """How many rows that is the median of."""
    occlusions: int
    """Objects that were tracked, then hidden for 0.6 to 1.5 s, then to be seen again for at least half a second."""
    kept: int
    """Of these, those that were found again, first of all under the same id."""
    dropped: dict[str, int]
    """Detections that were left out, and what else was out of the ordinary, by reason."""

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            "name": self.name,
            "drives": self.drives,
            "objects": self.summary.objects,
            "recall": self.summary.recall,
            "precision": self.summary.precision,
            "IDS": self.summary.id_switches,
            "HOTA": 100 * self.hota.hota,
            "velocity_error": self.settled_velocity_error if self.settled else None,
            "velocities": self.settled,
            "occlusions": self.occlusions,
            "ids_kept": self.kept,
            "dropped": self.dropped,
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


@dataclass(frozen=True, eq=False, kw_only=True)
class _Scored:
    """One drive, frame by frame."""

    truth: TrackTable
    tracks: TrackTable
    errors: list[float]
    """Of the velocities of settled tracks."""
    lives: dict[int, list[tuple[int, bool, int]]]
    """Of each true object within range: time [ns], whether it can be seen, and the id it was found under, or 0."""


def _scored(name: str, number: int, frames: Iterable[tuple[SensorFrame, Obstacles]]) -> _Scored:
    truth_rows, track_rows, errors = [], [], []
    first_seen: dict[int, int] = {}
    lives: dict[int, list[tuple[int, bool, int]]] = {}
    for k, (sensor, objects) in enumerate(frames):
        truth = sensor.truth
        if truth is None:
            raise SourceError(f"{name}: frame {sensor.index} comes without truth, which an evaluation needs")
        known = ~objects.background
        ids, boxes, velocities = objects.ids[known], objects.boxes[known].astype(float), objects.velocities[known]
        near = np.isin(truth.classes, _COUNTED) & (np.linalg.norm(truth.boxes[:, :2], axis=1) < _MOST_DISTANCE)
        visible = near & (truth.points >= _LEAST_POINTS)
        for each in ids.tolist():
            first_seen.setdefault(each, sensor.version)
        rows = np.flatnonzero(visible)
        match = np.full(len(near), -1)
        match[rows] = _match(truth.boxes[rows], boxes)
        for row in np.flatnonzero(near):
            found = match[row]
            its = int(ids[found]) if found >= 0 else 0
            lives.setdefault(int(truth.ids[row]), []).append((sensor.version, bool(visible[row]), its))
            if found >= 0 and sensor.version - first_seen[its] >= _SETTLED:
                errors.append(float(np.linalg.norm(velocities[found] - truth.velocities[row])))
        truth_rows.append((np.full(len(near), k), truth.ids, truth.boxes, ~visible, truth.velocities))
        counted = np.linalg.norm(boxes[:, :2], axis=1) < _MOST_DISTANCE
        track_rows.append((np.full(len(ids), k), ids, boxes, ~counted, velocities))
    if not truth_rows:
        raise SourceError(f"{name}: no frames")
    return _Scored(truth=_table(truth_rows, number), tracks=_table(track_rows, number), errors=errors, lives=lives)


def _occlusions(life: list[tuple[int, bool, int]]) -> tuple[int, int]:
    """How often one object was hidden for about a second after it was tracked, and how often it came out as before."""
    cases = kept = 0
    k = 0
    while k < len(life):
        if life[k][1]:
            k += 1
            continue
        first = k
        while k < len(life) and not life[k][1]:
            k += 1
        before, after = life[max(first - _TRACKED_FRAMES, 0) : first], life[k : k + _FOUND_AGAIN]
        if k == len(life) or not first:
            continue
        hidden = life[k][0] - life[first - 1][0]
        numbers = [number for _, _, number in before if number]
        # Visible and tracked before, and not just flickering at the limit of what can be seen.
        steady = len(before) == _TRACKED_FRAMES and all(seen for _, seen, _ in before)
        back = len(after) == _FOUND_AGAIN and sum(seen for _, seen, _ in after) >= _FOUND_AGAIN // 2
        if _HIDDEN[0] <= hidden <= _HIDDEN[1] and steady and back and len(numbers) > _TRACKED_FRAMES // 2:
            again = [number for _, _, number in after if number]
            cases += 1
            kept += bool(again) and again[0] == numbers[-1]
    return cases, kept


def score_drives(
    name: str, drives: Iterable[Iterable[tuple[SensorFrame, Obstacles]]], *, dropped: dict[str, int] | None = None
) -> DriveEvaluation:
    """Scores the objects of the frames of some drives whose truth is known.

    Raises:
        SourceError: A frame has no truth.
    """
    scored = [_scored(name, number, frames) for number, frames in enumerate(drives)]
    cases = [_occlusions(life) for drive in scored for life in drive.lives.values()]
    errors = [error for drive in scored for error in drive.errors]
    return DriveEvaluation(
        name=name,
        drives=len(scored),
        summary=tracking_summary(
            _joined([d.truth for d in scored]), _joined([d.tracks for d in scored]), threshold=_NEAR_ENOUGH
        ),
        hota=hota([d.truth for d in scored], [d.tracks for d in scored]),
        settled_velocity_error=float(np.median(errors)) if errors else float("nan"),
        settled=len(errors),
        occlusions=sum(case for case, _ in cases),
        kept=sum(kept for _, kept in cases),
        dropped=dropped or {},
    )


def _table(rows: Sequence[tuple[np.ndarray, ...]], drive: int) -> TrackTable:
    """Frames and ids are those of one drive alone."""
    frames, ids, boxes, ignored, velocities = (np.concatenate(part) for part in zip(*rows, strict=True))
    return TrackTable(
        frames=frames + drive * 10**6, ids=ids + drive * 10**9, boxes=boxes.astype(float), ignored=ignored,
        velocities=velocities,
    )  # fmt: skip


def _joined(tables: Sequence[TrackTable]) -> TrackTable:
    names = ("frames", "ids", "boxes", "ignored", "velocities")
    return TrackTable(**{name: np.concatenate([getattr(table, name) for table in tables]) for name in names})


def drive_uris(uri: str) -> list[str]:
    """The drives that a URI stands for: `seeds=1-8` in it is one for each seed.

    Raises:
        ConfigError: There is no seed between the two.
    """
    seeds = _SEEDS.search(uri)
    if seeds is None:
        return [uri]
    first, last = int(seeds[1]), int(seeds[2])
    if last < first:
        raise ConfigError(f"{uri}: seeds={first}-{last} holds no seed; write the lower one first")
    return [uri.replace(seeds[0], f"seed={seed}") for seed in range(first, last + 1)]


def evaluate_drives(
    uri: str, out: pathlib.Path, *, profile: str = "cpu", settings: Iterable[str] = (), true_detections: bool = False
) -> DriveEvaluation:
    """Runs a profile's pipeline over sources that know the truth, writes `summary.json` and scores the objects.

    Args:
        uri: Such as `sim:street?seed=3`, or `sim:occlusion?seeds=1-8` for several drives.
        out: Folder for what is written.
        profile: A hardware profile.
        settings: Changes to it, as texts `key=value`.
        true_detections: Gives the tracker the true boxes of what can be seen, in place of what a pipeline finds:
            the settings are then of the tracker alone.

    Raises:
        SourceError: The source cannot be read, or knows no truth.
        ConfigError: Profile or settings are bad.
    """
    from ..sources.opening import open_source

    uris = drive_uris(uri)
    dropped: Counter[str] = Counter()
    if true_detections:
        config = TrackerSettings.model_validate(_nested(parse_overrides(settings))).tracker_config()
        drives = (_on_truth(open_source(each), config, dropped) for each in uris)
        result = score_drives(f"{uri}, true detections", drives, dropped=dropped)
    else:
        with Pipeline.from_profile(profile, settings=settings) as pipeline:

            def run(each: str) -> Iterator[tuple[SensorFrame, Obstacles]]:
                for frame in pipeline.run(open_source(each)):
                    yield frame.sensor, frame.objects
                for place, losses in pipeline.losses.items():
                    dropped.update({f"{reason} ({place})": count for reason, count in losses.items()})

            result = score_drives(uri, map(run, uris), dropped=dropped)
    out.mkdir(parents=True, exist_ok=True)
    (out / "summary.json").write_text(json.dumps(result.as_dict(), indent=2) + "\n")
    return result


def _nested(settings: dict[str, Any]) -> dict[str, Any]:
    """Values by dotted key as mappings in mappings."""
    nested: dict[str, Any] = {}
    for key, value in settings.items():
        *parents, last = key.split(".")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = value
    return nested


def _on_truth(
    source: Iterable[SensorFrame], config: TrackerConfig, dropped: Counter[str]
) -> Iterator[tuple[SensorFrame, Obstacles]]:
    """What the tracker makes of the true boxes of what can be seen."""
    tracker = Tracker(config)
    for sensor in source:
        truth = sensor.truth
        if truth is None:
            raise SourceError(f"frame {sensor.index} comes without truth, which an evaluation needs")
        seen = truth.points >= _LEAST_POINTS
        n = int(seen.sum())
        detections = Detections(
            boxes=truth.boxes[seen], scores=np.full(n, 0.9, np.float32), classes=truth.classes[seen],
            velocities=np.full((n, 2), np.nan, np.float32), background=np.zeros(n, bool),
        )  # fmt: skip
        tracks = tracker.update(
            sensor.version, detections.boxes, detections.scores, detections.classes, pose=sensor.pose
        )
        detected = DetectedObjects(sensor=sensor, detections=detections)
        yield sensor, Obstacles.of_frame(detected, tracks, rows=tracks.detections, scores=tracks.scores)
    dropped.update(tracker.dropped + tracker.incidents)


def lines_of_drives(result: DriveEvaluation) -> list[str]:
    """The figures for people."""
    summary, drives = result.summary, f"{result.drives} drives" if result.drives > 1 else "one drive"
    hidden = (
        f"{result.kept} of {result.occlusions} ids kept through an occlusion of 0.6 to 1.5 s"
        f" ({100 * result.kept / max(result.occlusions, 1):.0f} %)"
    )
    return [
        f"{result.name}: {drives}, {summary.objects} objects in frames",
        f"recall {100 * summary.recall:.1f} %, precision {100 * summary.precision:.1f} %, IDS {summary.id_switches}, "
        f"HOTA {100 * result.hota.hota:.1f}",
        f"velocity error {result.settled_velocity_error:.2f} m/s (median of {result.settled}, tracks from 1 s on)",
        hidden if result.occlusions else "no occlusion of 0.6 to 1.5 s",
        *(f"{count} dropped: {reason}" for reason, count in result.dropped.items()),
    ]


def _scans(sequence: TrackingSequence, data: pathlib.Path) -> Iterator[SensorFrame]:
    """The scans of a sequence that are there."""
    from ..sources.scan_files import read_scan

    paths = [path for path, _, _ in label_files(data, sequence.name)]
    for k, path in enumerate(paths):
        number = int(path.stem)
        # A part of a sequence has records of its scans alone, wherever in the sequence these begin.
        at = [k] if sequence.poses is not None and len(sequence.poses) == len(paths) else []
        at = at or np.flatnonzero(sequence.frames == number).tolist()
        pose = None
        if sequence.poses is not None and at:
            pose = sequence.poses[at[0]] @ sequence.renamed_from_lidar
        points = unpack_scan(path) if path.suffix == ".npz" else read_scan(path).points
        yield SensorFrame(
            version=(number + 1) * _PERIOD_NS, index=number, points=np.ascontiguousarray(points[:, :4], np.float32),
            pose=pose,
        )  # fmt: skip


def evaluate_scans(
    data: pathlib.Path, names: Sequence[str], out: pathlib.Path, *, profile: str = "cpu", settings: Iterable[str] = ()
) -> list[TrackingEvaluation]:
    """Runs a profile's pipeline over the scans of sequences of KITTI's tracking set, and scores each type.

    Writes a result file a sequence with all types, `summary.json` with an entry for each type, and a
    `recall_TYPE.png` for each.

    Args:
        data: With `velodyne/` or `velodyne_packed/`, `label_02/`, `calib/` and, for the ego's poses, `oxts/`.
        names: Of the sequences; none are all that have labels and scans.
        out: Folder for what is written.
        profile: A hardware profile.
        settings: Changes to it, as texts `key=value`.

    Raises:
        SourceError: Data are missing or damaged.
        ConfigError: Profile or settings are bad.
    """
    if not data.is_dir():
        raise SourceError(f"{data}: no such folder; expected KITTI's tracking set with label_02/, calib/ and velodyne/")
    names = names or labelled_sequences(data)
    if not names:
        raise SourceError(f"{data}: no sequence of label_02/ has scans in velodyne/ or velodyne_packed/")
    read = {name: {kind: TrackingSequence.read(data, None, name, kind) for kind in TYPES} for name in names}
    found: dict[str, list[tuple[int, Obstacles]]] = {}
    dropped: Counter[str] = Counter()
    with Pipeline.from_profile(profile, settings=settings) as pipeline:
        for name, kinds in read.items():
            scans = _scans(next(iter(kinds.values())), data)
            found[name] = [(frame.index, frame.objects) for frame in pipeline.run(scans)]
            for place, losses in pipeline.losses.items():
                dropped.update({f"{reason} ({place})": count for reason, count in losses.items()})
    out.mkdir(parents=True, exist_ok=True)
    tables = {
        name: {kind: _tracks_of(kind, kinds[kind], found[name]) for kind in TYPES} for name, kinds in read.items()
    }
    for name, kinds in read.items():
        rows = [(kinds[kind], kind, tables[name][kind]) for kind in TYPES]
        write_results(out / f"{name}.txt", *rows)
    results = []
    for kind in TYPES:
        truth = [_of_frames(read[name][kind].truth, [number for number, _ in found[name]]) for name in names]
        if any((~table.ignored).any() for table in truth):
            of_kind = [tables[name][kind] for name in names]
            results.append(score_tracks(kind, names, truth, of_kind, frames_per_second=float("nan"), dropped=dropped))
    write_summary(out, results)
    return results


def _tracks_of(kind: ObjectType, sequence: TrackingSequence, frames: Sequence[tuple[int, Obstacles]]) -> TrackTable:
    """The tracks of one type, in the renamed frame."""
    parts = []
    for number, objects in frames:
        chosen = (objects.classes == kind.class_index) & ~objects.background
        boxes = sequence.renamed(objects.boxes[chosen])
        parts.append((np.full(len(boxes), number), objects.ids[chosen], boxes, objects.scores[chosen]))
    at, ids, boxes, scores = (np.concatenate(part) for part in zip(*parts, strict=True))
    view = sequence.in_view(boxes)
    at, ids, boxes, scores = at[view], ids[view], boxes[view], scores[view]
    return TrackTable(
        frames=at, ids=ids, boxes=boxes, scores=_of_whole_tracks(ids, scores), ignored=sequence.ignorable(at, boxes)
    )


def _of_frames(truth: TrackTable, numbers: Sequence[int]) -> TrackTable:
    there = np.isin(truth.frames, numbers)
    return TrackTable(**{each: getattr(truth, each)[there] for each in ("frames", "ids", "boxes", "ignored")})


def _of_whole_tracks(ids: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """The mean score of a track, in all its rows."""
    _, which = np.unique(ids, return_inverse=True)
    mean = np.bincount(which, scores) / np.maximum(np.bincount(which), 1)
    return (np.rint(mean * 2.0**20) / 2.0**20)[which] if len(ids) else np.empty(0)
