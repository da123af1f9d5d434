"""How well ground is told from the rest, and which labels of the data sets are ground.

The protocol is the one that the papers on SemanticKITTI use: vegetation and what has no label stay in the input but are
left out of the score; all else counts, point by point.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

__all__ = [
    "RANGE_IMAGE_32",
    "SEMANTIC_KITTI",
    "SEMANTIC_KITTI_TRAIN",
    "GroundLabels",
    "GroundScores",
    "ground_scores",
]


@dataclass(frozen=True)
class GroundLabels:
    """Which labels of a data set are ground, and which are left out of the score."""

    ground: Collection[int]
    """Labels of ground."""
    ignored: Collection[int]
    """Labels that are not scored."""

    def masks(self, labels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Which points are ground, and which are scored; of the shape of `labels`, bool."""
        return np.isin(labels, list(self.ground)), ~np.isin(labels, list(self.ignored))


SEMANTIC_KITTI = GroundLabels(ground=(40, 44, 48, 49, 60, 72), ignored=(0, 1, 70))
"""Raw labels of SemanticKITTI (the low 16 bits): road, parking, sidewalk, other ground, lane marking and terrain are
ground; unlabelled, outlier and vegetation are not scored."""

SEMANTIC_KITTI_TRAIN = GroundLabels(ground=(9, 10, 11, 12, 17), ignored=(0, 15, 255))
"""The same in SemanticKITTI's 19 training classes, 255 = no label known."""

RANGE_IMAGE_32 = GroundLabels(ground=(0, 1), ignored=(4, 10))
"""Eleven-class range images of 32-beam sensors: road and sidewalk are ground; vegetation and none are not scored."""


@dataclass(frozen=True)
class GroundScores:
    """Point-wise scores, each in [0, 1]; NaN where there is nothing to score."""

    precision: float
    """Share of ground among the points called ground."""
    recall: float
    """Share of the ground that was called ground."""
    f1: float
    """Their harmonic mean."""


def ground_scores(mask: np.ndarray, ground: np.ndarray, scored: np.ndarray | None = None) -> GroundScores:
    """Scores a ground mask against labels.

    Args:
        mask: The points called ground, shape (n,), bool.
        ground: The points that are ground, shape (n,), bool.
        scored: The points that count, shape (n,), bool; by default all.

    Raises:
        ValueError: The shapes differ.
    """
    mask, ground = np.asarray(mask, bool), np.asarray(ground, bool)
    scored = np.ones(ground.shape, bool) if scored is None else np.asarray(scored, bool)
    if not mask.shape == ground.shape == scored.shape:
        raise ValueError(
            f"mask, ground and scored must have one shape, not {mask.shape}, {ground.shape}, {scored.shape}"
        )
    hit = int(np.count_nonzero(mask & ground & scored))
    called = int(np.count_nonzero(mask & scored))
    present = int(np.count_nonzero(ground & scored))

    def share(part: int, whole: int) -> float:
        return part / whole if whole else float("nan")

    return GroundScores(share(hit, called), share(hit, present), share(2 * hit, called + present))
