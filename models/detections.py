"""What a detector is told of one frame, and what it says of it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..kernels.arguments import real

__all__ = ["Detections", "checked_height", "said_overflow"]


@dataclass(frozen=True, eq=False, kw_only=True)
class Detections:
    """The k objects found in one frame, in the frame of its cloud, best score first unless said otherwise."""

    boxes: np.ndarray
    """Centre x y z, length width height [m], yaw about z from x [rad]; shape (k, 7), float32."""
    scores: np.ndarray
    """Confidence in [0, 1], shape (k,), float32."""
    classes: np.ndarray
    """Indices into `models.classes.CLASSES`, shape (k,), int32."""
    velocities: np.ndarray
    """Velocity along x and y [m/s], NaN where unknown; shape (k, 2), float32."""
    background: np.ndarray
    """True where a box is from a cluster of points (no known class), shape (k,), bool."""

    def __len__(self) -> int:
        return len(self.boxes)

    @classmethod
    def empty(cls) -> Detections:
        """No objects."""
        return cls(
            boxes=np.empty((0, 7), np.float32),
            scores=np.empty(0, np.float32),
            classes=np.empty(0, np.int32),
            velocities=np.empty((0, 2), np.float32),
            background=np.empty(0, bool),
        )

    @classmethod
    def concatenate(cls, *parts: Detections) -> Detections:
        """All of them, in the order of the arguments."""
        fields = ("boxes", "scores", "classes", "velocities", "background")
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in fields})

    def select(self, which: np.ndarray) -> Detections:
        """Those that a mask or an array of indices names."""
        return Detections(
            boxes=self.boxes[which],
            scores=self.scores[which],
            classes=self.classes[which],
            velocities=self.velocities[which],
            background=self.background[which],
        )


def checked_height(sensor_height: Any) -> float | wp.array:
    """The height of a sensor above the ground as heads take it; an array stays as it is, on its device.

    Raises:
        TypeError: It is neither a number nor an array of Warp's.
        ValueError: It is not finite.
    """
    if isinstance(sensor_height, wp.array):
        return sensor_height
    height = real(sensor_height, "sensor_height")
    if not math.isfinite(height):
        raise ValueError(f"sensor_height must be a finite number of metres, not {sensor_height}")
    return height


def said_overflow(limits: Iterable[tuple[str, int, int]]) -> str:
    """Which limits of a head's card were too low for a cloud, for people.

    Args:
        limits: Of each its key on the card, what it allows, and how many were dropped beyond it.
    """
    return "; ".join(
        f"dropped {beyond} of {allowed + beyond}, for {name} is {allowed}" for name, allowed, beyond in limits if beyond
    )
