"""HOTA: how well tracks find objects and keep them apart, in one number.

Luiten et al., HOTA: A Higher Order Metric for Evaluating Multi-Object Tracking, IJCV 2021; computed as by its authors:
one assignment a frame, for all thresholds, that prefers pairs of ids which agree over the whole recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from .tracking import TrackTable, overlaps_by_frame

__all__ = ["Hota", "hota"]

_THRESHOLDS = np.arange(0.05, 0.99, 0.05)
_IGNORED_OVERLAP = 0.5


@dataclass(frozen=True, kw_only=True)
class Hota:
    """HOTA and its two halves, each the mean over the thresholds 0.05, 0.10 … 0.95 of overlap."""

    hota: float
    """The mean of √(DetA · AssA)."""
    detection: float
    """DetA: matches over matches, misses and false positives."""
    association: float
    """AssA: how much of what belongs together was kept together, over all matches."""


def hota(truth: TrackTable | Sequence[TrackTable], tracks: TrackTable | Sequence[TrackTable]) -> Hota:
    """HOTA by overlap in space over one recording or several.

    True objects that are ignored are taken out beforehand, and with each the track's row that overlaps it most, if by
    half or more; rows of tracks that are ignored are taken out where nothing matches them by half.

    Args:
        truth: A table for each recording.
        tracks: Likewise, in the same order.

    Raises:
        ValueError: The numbers of recordings differ.
    """
    truth = [truth] if isinstance(truth, TrackTable) else list(truth)
    tracks = [tracks] if isinstance(tracks, TrackTable) else list(tracks)
    if len(truth) != len(tracks):
        raise ValueError(f"{len(truth)} recordings of truth, {len(tracks)} of tracks")
    found = np.zeros(len(_THRESHOLDS))
    agreed = np.zeros(len(_THRESHOLDS))
    objects = reported = 0
    for recording in zip(truth, tracks, strict=True):
        matches, agreement, n, m = _of_recording(*recording)
        found += matches
        agreed += agreement
        objects += n
        reported += m
    detection = found / np.maximum(objects + reported - found, 1.0)
    association = agreed / np.maximum(found, 1.0)
    return Hota(
        hota=float(np.sqrt(detection * association).mean()),
        detection=float(detection.mean()),
        association=float(association.mean()),
    )


def _of_recording(truth: TrackTable, tracks: TrackTable) -> tuple[np.ndarray, np.ndarray, int, int]:
    """Per threshold the matches and the sum of their association; the objects and the rows of tracks that count."""
    _, object_of = np.unique(truth.ids, return_inverse=True)
    _, track_of = np.unique(tracks.ids, return_inverse=True)
    overlaps = overlaps_by_frame(truth, tracks)
    counted, reported = _without_ignored(truth, tracks, overlaps)
    shape = int(object_of.max(initial=-1)) + 1, int(track_of.max(initial=-1)) + 1
    objects, rows = (
        np.bincount(object_of[counted], minlength=shape[0]),
        np.bincount(track_of[reported], minlength=shape[1]),
    )

    frames = []
    together = np.zeros(shape)
    for i, j, overlap in overlaps:
        i, overlap = i[counted[i]], overlap[counted[i]]
        j, overlap = j[reported[j]], overlap[:, reported[j]]
        if overlap.size and overlap.max() > 0.0:
            share = overlap.sum(0)[None] + overlap.sum(1)[:, None] - overlap
            pairs = np.ix_(object_of[i], track_of[j])
            together[pairs] += np.where(overlap > 0.0, overlap / np.maximum(share, 1e-12), 0.0)
            frames.append((pairs, overlap))
    alignment = together / np.maximum(objects[:, None] + rows[None] - together, 1e-12)

    matched = np.zeros((len(_THRESHOLDS), *shape))
    for pairs, overlap in frames:
        r, c = linear_sum_assignment(-alignment[pairs] * overlap)
        reached = overlap[r, c][None] >= _THRESHOLDS[:, None] - np.finfo(float).eps
        matched[:, pairs[0][r, 0], pairs[1][0, c]] += reached
    association = matched / np.maximum(objects[None, :, None] + rows[None, None] - matched, 1.0)
    return matched.sum((1, 2)), (matched * association).sum((1, 2)), int(objects.sum()), int(rows.sum())


def _without_ignored(
    truth: TrackTable, tracks: TrackTable, overlaps: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """The rows that count of truth and of tracks."""
    counted = np.ones(len(truth.frames), bool) if truth.ignored is None else ~np.asarray(truth.ignored, bool)
    reported = np.ones(len(tracks.frames), bool) if tracks.ignored is None else ~np.asarray(tracks.ignored, bool)
    for i, j, overlap in overlaps:
        r, c = linear_sum_assignment(-np.where(overlap >= _IGNORED_OVERLAP, overlap, 0.0))
        made = overlap[r, c] >= _IGNORED_OVERLAP
        reported[j[c[made]]] = counted[i[r[made]]]
    return counted, reported
