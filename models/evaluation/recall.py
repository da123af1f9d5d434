"""What was found of what there is: how far from each object the nearest detection is, and how its box differs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["Nearest", "RecallBin", "box_errors", "nearest_detections", "recall_by"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Nearest:
    """For each object the nearest detection, which may be the nearest of another too."""

    distance: np.ndarray
    """Of the centres, seen from above [m]; infinite where nothing was found; shape (m,)."""
    index: np.ndarray
    """Of the detection; 0 where nothing was found; shape (m,), int64."""


@dataclass(frozen=True, kw_only=True)
class RecallBin:
    """Objects of one range of some quantity."""

    low: float
    high: float
    """Open."""
    objects: int
    found: int


def nearest_detections(truth: np.ndarray, boxes: np.ndarray) -> Nearest:
    """The detection nearest to each object.

    Args:
        truth: Shape (m, 7): x y z l w h yaw.
        boxes: Shape (k, 7).
    """
    truth, boxes = np.asarray(truth, np.float64).reshape(-1, 7), np.asarray(boxes, np.float64).reshape(-1, 7)
    if len(boxes) == 0:
        return Nearest(distance=np.full(len(truth), np.inf), index=np.zeros(len(truth), np.int64))
    apart = np.hypot(truth[:, None, 0] - boxes[None, :, 0], truth[:, None, 1] - boxes[None, :, 1])
    return Nearest(distance=apart.min(axis=1), index=apart.argmin(axis=1))


def box_errors(truth: np.ndarray, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How boxes differ from those that they are of, row by row.

    Returns:
        The angle between the axes, front and back alike [rad], shape (n,), in [0, π/2]; and the found length, width and
        height minus the true ones [m], shape (n, 3).
    """
    truth, boxes = np.asarray(truth, np.float64).reshape(-1, 7), np.asarray(boxes, np.float64).reshape(-1, 7)
    turn = np.abs((boxes[:, 6] - truth[:, 6] + 0.5 * np.pi) % np.pi - 0.5 * np.pi)
    return turn, boxes[:, 3:6] - truth[:, 3:6]


def recall_by(values: np.ndarray, found: np.ndarray, edges: Sequence[float]) -> list[RecallBin]:
    """How many objects there are, and were found, by ranges of a quantity such as distance or number of points.

    Args:
        values: Of each object, shape (m,).
        found: Shape (m,), bool.
        edges: Ascending; what is below the first or not below the last is left out.

    Raises:
        ValueError: Edges that do not ascend, or shapes that do not fit.
    """
    if len(edges) < 2 or any(not a < b for a, b in itertools.pairwise(edges)):
        raise ValueError(f"edges must be two or more that ascend, not {list(edges)}")
    values, found = np.asarray(values), np.asarray(found, bool)
    if values.shape != found.shape:
        raise ValueError(f"found must be of the shape of values, {values.shape}, not {found.shape}")
    bins = []
    for low, high in itertools.pairwise(edges):
        within = (values >= low) & (values < high)
        bins.append(
            RecallBin(low=float(low), high=float(high), objects=int(within.sum()), found=int((within & found).sum()))
        )
    return bins
