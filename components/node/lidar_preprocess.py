"""The first look at a sweep: leaves out returns that are no points, and those on the vehicle itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, Input, Output, Status
from ..messages import SensorFrame

__all__ = ["LidarPreprocess", "LidarPreprocessConfig", "usable_points"]

Bounds = tuple[float, float, float, float, float, float]


class LidarPreprocessConfig(ProcessorConfig):
    """What is left out, in the sensor's frame."""

    ego_box: Bounds | None = None
    """xmin ymin zmin xmax ymax zmax of the vehicle [m], whose points are left out; null where it is not seen."""
    min_range: float = Field(0.0, ge=0.0)
    """Returns nearer than that are left out, such as those of the sensor's own housing [m]."""

    @model_validator(mode="after")
    def _in_order(self) -> LidarPreprocessConfig:
        box = self.ego_box
        if box is not None and not all(box[axis] < box[axis + 3] for axis in range(3)):
            raise ValueError(f"ego_box must be xmin ymin zmin xmax ymax zmax, each min below its max, not {box}")
        return self


def usable_points(points: np.ndarray, config: LidarPreprocessConfig) -> tuple[np.ndarray, dict[str, int]]:
    """Which points of a sweep can be used.

    Args:
        points: x y z [m] and more, in the sensor's frame, shape (n, 3 or more).
        config: What is left out.

    Returns:
        True where a point stays, shape (n,), bool; and how many were left out, by reason; a point has one reason, the
        first of non_finite, near, ego.
    """
    xyz = points[:, :3]
    finite = np.isfinite(xyz).all(axis=1)
    dropped = {"non_finite": len(points) - int(finite.sum()), "near": 0, "ego": 0}
    kept = finite
    with np.errstate(invalid="ignore", over="ignore"):
        if config.min_range > 0.0:
            far = np.einsum("ij,ij->i", xyz, xyz) >= config.min_range**2
            dropped["near"] = int((kept & ~far).sum())
            kept = kept & far
        if config.ego_box is not None:
            low, high = config.ego_box[:3], config.ego_box[3:]
            inside = np.ones(len(points), bool)
            for axis in range(3):
                inside &= (xyz[:, axis] >= low[axis]) & (xyz[:, axis] < high[axis])
            dropped["ego"] = int((kept & inside).sum())
            kept = kept & ~inside
    return kept, dropped


def _selected(frame: SensorFrame, kept: np.ndarray) -> SensorFrame:
    """The frame with some of its points, and what belongs to them."""
    truth = frame.truth
    if truth is not None:
        ground = None if truth.ground is None else truth.ground[kept]
        scored = None if truth.ground_scored is None else truth.ground_scored[kept]
        truth = replace(truth, ground=ground, ground_scored=scored)
    return replace(
        frame,
        points=frame.points[kept],
        ring=None if frame.ring is None else frame.ring[kept],
        t=None if frame.t is None else frame.t[kept],
        truth=truth,
    )


class LidarPreprocess(DataProcessComponent):
    """Gives each sweep on without the points that cannot be used; a sweep without such points is not copied."""

    Config = LidarPreprocessConfig

    raw: Input[SensorFrame]
    points: Output[SensorFrame]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = LidarPreprocessConfig()
        self._dropped: Counter[str] = Counter()
        self._sweeps = 0

    def init(self, config: LidarPreprocessConfig) -> None:
        """Keeps what is left out."""
        self._config = config

    def process(self, trigger: Trigger) -> Status:
        """Filters one sweep."""
        with self.raw.access() as snapshot:
            index = snapshot.version_index(trigger.version)
            if index < 0:
                return Status.MISS
            frame = snapshot[index]
        kept, dropped = usable_points(frame.points, self._config)
        self._dropped.update(dropped)
        self._sweeps += 1
        with self.points.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns, epoch=trigger.epoch)
            change.value = frame if not any(dropped.values()) else _selected(frame, kept)
            return self.points.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def state(self) -> Mapping[str, str | float | int]:
        """Sweeps so far, and points left out by reason."""
        return {"sweeps": self._sweeps, **{f"points {reason}": count for reason, count in self._dropped.items()}}
