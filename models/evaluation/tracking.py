"""How well tracks follow the truth: CLEAR MOT, and AB3DMOT's averages of it over recall.

Arrays in, numbers out: what counts as an object, as another class that is neither right nor wrong, or as outside
the labelled area is said by the `ignored` of truth and tracks; data sets' readers set it.

CLEAR MOT: Bernardin and Stiefelhagen, 2008, matched frame by frame as KITTI's evaluation does: pairs nearer than
the threshold, as many as can be and of these the nearest, whatever was matched before. sAMOTA, AMOTA, AMOTP: Weng
et al., AB3DMOT, 2020, equations 2 to 5, at 40 values of recall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..geometry import box_overlap

__all__ = [
    "AverageMot",
    "ClearMot",
    "TrackTable",
    "TrackingSummary",
    "average_mot",
    "clear_mot",
    "overlaps_by_frame",
    "tracking_summary",
]

_RECALL_VALUES = 40
_IMPOSSIBLE = 1e4


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackTable:
    """The objects of a recording, true or tracked: one row for each object in each frame."""

    frames: np.ndarray
    """Number of the frame, not falling from row to row, shape (n,), int64."""
    ids: np.ndarray
    """The same for the same object in all frames, not negative, shape (n,), int64."""
    boxes: np.ndarray
    """x y z l w h yaw [m, rad], shape (n, 7), float64."""
    scores: np.ndarray | None = None
    """Of tracks, for the averages over recall, shape (n,), float64."""
    ignored: np.ndarray | None = None
    """Truth: neither right nor wrong to find. Tracks: not wrong where nothing matches. Shape (n,), bool."""
    velocities: np.ndarray | None = None
    """Along the frame's x and y [m/s], NaN where unknown, shape (n, 2), float64."""

    def __post_init__(self):
        n = len(self.frames)
        for name in ("ids", "boxes", "scores", "ignored", "velocities"):
            value = getattr(self, name)
            if value is not None and len(value) != n:
                raise ValueError(f"{name} has {len(value)} rows for {n} frame numbers")
        if np.any(np.diff(self.frames) < 0):
            raise ValueError("frames must not fall from row to row: sort the table by frame")


@dataclass(frozen=True, kw_only=True)
class ClearMot:
    """CLEAR MOT of a set of recordings."""

    mota: float
    """1 − (misses + false positives + id switches) / objects."""
    motp: float
    """Mean overlap of the matches, or mean distance [m]."""
    recall: float
    precision: float
    id_switches: int
    fragmentations: int
    true_positives: int
    """Matches with objects that count."""
    false_positives: int
    misses: int
    objects: int
    """True objects that count, over all frames."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AverageMot:
    """The averages over recall, and the curves they are of."""

    samota: float
    amota: float
    amotp: float
    best: ClearMot
    """At the score with the highest MOTA: what a table of results gives as MOTA, IDS, FRAG."""
    recalls: np.ndarray
    """Values of recall that were reached, shape (r,), float64; up to 40."""
    thresholds: np.ndarray
    """The mean score of a track that leads to each, shape (r,), float64."""
    smotas: np.ndarray
    """Scaled MOTA at each, shape (r,), float64."""
    curve: tuple[ClearMot, ...]
    """CLEAR MOT at each."""


@dataclass(frozen=True, kw_only=True)
class TrackingSummary:
    """What a demonstration says about its objects."""

    recall: float
    """Of true objects in frames, how many were found."""
    precision: float
    """Of objects reported in frames, how many are true."""
    id_switches: int
    fragmentations: int
    velocity_error: float
    """Median length of the difference of velocities over matches where the truth has one [m/s]; NaN without any."""
    position_error: float
    """Mean distance of the centres of matches on the ground [m]; NaN without any."""
    objects: int
    """True objects that count, over all frames."""


def clear_mot(
    truth: TrackTable | Sequence[TrackTable],
    tracks: TrackTable | Sequence[TrackTable],
    *,
    measure: str = "iou_3d",
    threshold: float = 0.5,
) -> ClearMot:
    """CLEAR MOT over one recording or several.

    Args:
        truth: A table for each recording.
        tracks: Likewise, in the same order.
        measure: What must be reached for a match: `iou_3d`, `iou_bev`, or `distance`, that of centres on the ground.
        threshold: The least overlap, or the largest distance [m].

    Raises:
        ValueError: The numbers of recordings differ, or there is no such measure.
    """
    return _score([_Recording(*pair, measure, threshold) for pair in _paired(truth, tracks)], None)


def average_mot(
    truth: TrackTable | Sequence[TrackTable],
    tracks: TrackTable | Sequence[TrackTable],
    *,
    measure: str = "iou_3d",
    threshold: float = 0.25,
) -> AverageMot:
    """AB3DMOT's averages over recall; arguments as `clear_mot`, and the tracks need scores.

    A track's confidence is the mean of its scores. Recall counts matches with ignored objects too, as the published
    program does. Values of recall that no score reaches count zero.
    """
    recordings = [_Recording(*pair, measure, threshold) for pair in _paired(truth, tracks)]
    if any(recording.tracks.scores is None for recording in recordings):
        raise ValueError("tracks have no scores; averages over recall need the score of every row")
    matches = [recording.match(None) for recording in recordings]
    found = np.concatenate([r.confidence[m[m >= 0]] for r, m in zip(recordings, matches, strict=True)] or [[]])
    missed = sum(int(((m < 0) & ~r.truth_ignored).sum()) for r, m in zip(recordings, matches, strict=True))
    thresholds, recalls = _thresholds(found, len(found) + missed)
    curve = tuple(_score(recordings, t) for t in thresholds)
    smotas = np.array([
        np.clip(1.0 - (c.misses + c.false_positives + c.id_switches - (1.0 - r) * c.objects) / (r * c.objects), 0, 1)
        for c, r in zip(curve, recalls, strict=True)
    ])  # fmt: skip
    best = max(curve, key=lambda c: c.mota, default=None)
    return AverageMot(
        samota=float(smotas.sum()) / _RECALL_VALUES,
        amota=sum(c.mota for c in curve) / _RECALL_VALUES,
        amotp=sum(c.motp for c in curve) / _RECALL_VALUES,
        best=best or _score(recordings, None),
        recalls=np.array(recalls),
        thresholds=np.array(thresholds),
        smotas=smotas,
        curve=curve,
    )


def tracking_summary(truth: TrackTable, tracks: TrackTable, *, threshold: float = 2.0) -> TrackingSummary:
    """The figures of a short table: matched by the distance of centres on the ground, up to `threshold` [m]."""
    recording = _Recording(truth, tracks, "distance", threshold)
    match = recording.match(None)
    rows = np.flatnonzero((match >= 0) & ~recording.truth_ignored)
    errors = np.empty(0)
    if truth.velocities is not None and tracks.velocities is not None and len(rows):
        errors = np.linalg.norm(truth.velocities[rows] - tracks.velocities[match[rows]], axis=1)
        errors = errors[np.isfinite(errors)]
    places = np.linalg.norm(truth.boxes[rows, :2] - tracks.boxes[match[rows], :2], axis=1)
    score = _score([recording], None)
    return TrackingSummary(
        recall=score.recall,
        precision=score.precision,
        id_switches=score.id_switches,
        fragmentations=score.fragmentations,
        velocity_error=float(np.median(errors)) if len(errors) else float("nan"),
        position_error=float(places.mean()) if len(places) else float("nan"),
        objects=score.objects,
    )


def _paired(truth, tracks) -> list[tuple[TrackTable, TrackTable]]:
    truth = [truth] if isinstance(truth, TrackTable) else list(truth)
    tracks = [tracks] if isinstance(tracks, TrackTable) else list(tracks)
    if len(truth) != len(tracks):
        raise ValueError(f"{len(truth)} recordings of truth, {len(tracks)} of tracks")
    return list(zip(truth, tracks, strict=True))


class _Recording:
    """One recording with the likeness of all its pairs, computed once for every threshold of score."""

    def __init__(self, truth: TrackTable, tracks: TrackTable, measure: str, threshold: float):
        self.truth, self.tracks = truth, tracks
        n = len(truth.frames)
        self.truth_ignored = np.zeros(n, bool) if truth.ignored is None else np.asarray(truth.ignored, bool)
        self.tracks_ignored = (
            np.zeros(len(tracks.frames), bool) if tracks.ignored is None else np.asarray(tracks.ignored, bool)
        )
        _, self.track_of = np.unique(tracks.ids, return_inverse=True)
        scores = np.zeros(len(tracks.frames)) if tracks.scores is None else np.asarray(tracks.scores, np.float64)
        mean = np.bincount(self.track_of, scores) / np.maximum(np.bincount(self.track_of), 1)
        self.confidence = mean[self.track_of]
        self._frames = self._likeness(measure, threshold)

    def _likeness(self, measure: str, threshold: float) -> list[tuple[slice, slice, np.ndarray]]:
        """For each frame with truth and tracks: their rows, and the cost of each pair (`_IMPOSSIBLE` if too far)."""
        blocks, i, j = _pairs_by_frame(self.truth, self.tracks)
        a, b = self.truth.boxes[i], self.tracks.boxes[j]
        distance = np.linalg.norm(a[:, :2] - b[:, :2], axis=1)
        cost = np.full(len(i), _IMPOSSIBLE)
        if measure == "distance":
            near = distance <= threshold
            cost[near] = distance[near]
        elif measure in ("iou_3d", "iou_bev"):
            overlap, touching = _overlap(a, b, bev=measure == "iou_bev")
            near = (overlap >= threshold) & touching
            cost[near] = 1.0 - overlap[near]
        else:
            raise ValueError(f"no measure {measure!r}; there are: iou_3d, iou_bev, distance")
        self.measure = measure
        return [
            (rows, columns, part)
            for (rows, columns), part in zip(blocks, _cut(cost, blocks), strict=True)
            if (part < _IMPOSSIBLE).any()
        ]

    def match(self, least_confidence: float | None) -> np.ndarray:
        """The row of the track for each row of the truth, −1 where it was not found."""
        # Two thirds of a second, which a run without truth need not wait for.
        from scipy.optimize import linear_sum_assignment

        match = np.full(len(self.truth.frames), -1)
        self.cost = np.zeros(len(match))
        for rows, columns, cost in self._frames:
            chosen = np.arange(columns.start, columns.stop)
            if least_confidence is not None:
                kept = self.confidence[columns] >= least_confidence
                chosen, cost = chosen[kept], cost[:, kept]
            r, c = linear_sum_assignment(cost)
            price = cost[r, c]
            made = price < _IMPOSSIBLE
            match[rows.start + r[made]] = chosen[c[made]]
            self.cost[rows.start + r[made]] = price[made]
        return match


def overlaps_by_frame(truth: TrackTable, tracks: TrackTable) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each frame with truth and tracks: rows of the truth (a,), of the tracks (b,), overlaps in space (a, b)."""
    blocks, i, j = _pairs_by_frame(truth, tracks)
    overlap, _ = _overlap(truth.boxes[i], tracks.boxes[j], bev=False)
    return [
        (np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop), part)
        for (rows, columns), part in zip(blocks, _cut(overlap, blocks), strict=True)
    ]


def _pairs_by_frame(truth: TrackTable, tracks: TrackTable) -> tuple[list[tuple[slice, slice]], np.ndarray, np.ndarray]:
    """For each frame with truth and tracks their rows; and of all pairs in these the row of each."""
    frames = np.intersect1d(truth.frames, tracks.frames)
    bounds = [
        (np.searchsorted(t.frames, frames), np.searchsorted(t.frames, frames, side="right")) for t in (truth, tracks)
    ]
    blocks = [(slice(a, b), slice(c, d)) for a, b, c, d in zip(*bounds[0], *bounds[1], strict=True)]
    grids = [np.mgrid[rows, columns].reshape(2, -1) for rows, columns in blocks]
    i, j = np.concatenate(grids, axis=1) if grids else np.empty((2, 0), np.int64)
    return blocks, i, j


def _cut(values: np.ndarray, blocks: list[tuple[slice, slice]]) -> list[np.ndarray]:
    """Values of all pairs as a matrix for each frame."""
    shapes = [(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in blocks]
    ends = np.cumsum([a * b for a, b in shapes])
    return (
        [part.reshape(shape) for part, shape in zip(np.split(values, ends[:-1]), shapes, strict=True)] if blocks else []
    )


def _overlap(a: np.ndarray, b: np.ndarray, *, bev: bool) -> tuple[np.ndarray, np.ndarray]:
    """Overlap of pairs of boxes, from above or in space, and whether they are near enough to have any."""
    distance = np.linalg.norm(a[:, :2] - b[:, :2], axis=1)
    touching = distance < 0.5 * (np.hypot(a[:, 3], a[:, 4]) + np.hypot(b[:, 3], b[:, 4]))
    overlap = np.zeros(len(a))
    overlap[touching] = box_overlap(a[touching], b[touching])[0 if bev else 1]
    return overlap, touching


def _score(recordings: list[_Recording], least_confidence: float | None) -> ClearMot:
    """CLEAR MOT of the tracks from a confidence on."""
    matches = misses = false_positives = objects = switches = fragments = counted = 0
    likeness = 0.0
    for r in recordings:
        match = r.match(least_confidence)
        found = match >= 0
        present = np.ones(len(r.confidence), bool) if least_confidence is None else r.confidence >= least_confidence
        taken = np.zeros(len(present), bool)
        taken[match[found]] = True
        matches += int(found.sum())
        counted += int((found & ~r.truth_ignored).sum())
        misses += int((~found & ~r.truth_ignored).sum())
        false_positives += int((present & ~taken & ~r.tracks_ignored).sum())
        objects += int((~r.truth_ignored).sum())
        likeness += float((r.cost if r.measure == "distance" else 1.0 - r.cost)[found].sum())
        ids = np.full(len(match), -1)
        ids[found] = r.tracks.ids[match[found]]
        changes = _changes(r.truth.ids, ids, r.truth_ignored)
        switches += changes[0]
        fragments += changes[1]
    return ClearMot(
        mota=1.0 - (misses + false_positives + switches) / objects if objects else float("nan"),
        motp=likeness / matches if matches else 0.0,
        recall=matches / (matches + misses) if matches + misses else 0.0,
        precision=matches / (matches + false_positives) if matches + false_positives else 0.0,
        id_switches=switches,
        fragmentations=fragments,
        true_positives=counted,
        false_positives=false_positives,
        misses=misses,
        objects=objects,
    )


def _changes(objects: np.ndarray, ids: np.ndarray, ignored: np.ndarray) -> tuple[int, int]:
    """Id switches and fragmentations, as KITTI counts them: along each object's frames, ignored ones interrupt."""
    switches = fragments = 0
    order = np.argsort(objects, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(objects[order])) + 1):
        got, skip = ids[rows].tolist(), ignored[rows].tolist()
        if not got or all(skip) or max(got) < 0:
            continue
        last = got[0]
        for k in range(1, len(got)):
            if skip[k]:
                last = -1
                continue
            if last != got[k] and last != -1 and got[k] != -1 and got[k - 1] != -1:
                switches += 1
            ends = k == len(got) - 1
            if got[k] != got[k - 1] and got[k] != -1 and (ends or (last != -1 and got[k + 1] != -1)):
                fragments += 1
            if got[k] != -1:
                last = got[k]
    return switches, fragments


def _thresholds(confidences: np.ndarray, objects: int) -> tuple[list[float], list[float]]:
    """The confidences at which recall comes nearest to 1/40, 2/40 …, and those values of recall."""
    ordered = np.sort(confidences)[::-1]
    thresholds, recalls, recall = [], [], 0.0
    for i, confidence in enumerate(ordered):
        here = (i + 1) / objects
        following = (i + 2) / objects if i < len(ordered) - 1 else here
        if following - recall < recall - here and i < len(ordered) - 1:
            continue
        thresholds.append(float(confidence))
        recalls.append(recall)
        recall += 1.0 / _RECALL_VALUES
    return thresholds[1:], recalls[1:]
