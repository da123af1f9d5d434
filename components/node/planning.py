"""What planning does first with the obstacles of perception: which of them are in the way, and how soon."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, Input, Output, Status
from ...datamesh.messages import message
from ..messages import Obstacles

__all__ = ["CorridorReport", "ObstacleIntake", "ObstacleIntakeConfig", "corridor_report"]


@message("warploom.CorridorReport")
@dataclass(frozen=True, kw_only=True)
class CorridorReport:
    """What is ahead of the vehicle."""

    version: int
    """Version of the LiDAR frame [ns]."""
    obstacles: int
    """All objects of the frame."""
    in_corridor: int
    """Those that reach into the corridor ahead."""
    nearest_id: int
    """Track of the nearest of them; −1: there is none."""
    nearest_m: float
    """From the corridor's start to it [m]; infinite where there is none."""
    contact_s: float
    """Until it is reached if neither changes its speed [s]; infinite where it is not approached."""


class ObstacleIntakeConfig(ProcessorConfig):
    """The corridor ahead, in the frame of the obstacles."""

    half_width: float = Field(1.6, gt=0.0, le=20.0)
    """[m] to either side."""
    front: float = 2.5
    """Where the vehicle ends and the corridor begins [m]."""
    length: float = Field(60.0, gt=0.0)
    """Of the corridor [m]."""


def corridor_report(obstacles: Obstacles, config: ObstacleIntakeConfig) -> CorridorReport:
    """Which obstacles reach into a straight corridor ahead, and when the nearest is met.

    Args:
        obstacles: Of one frame; x is ahead. Velocities are those of the obstacles along x, as the frame gives them;
            where they are not known (NaN) an obstacle counts as standing.
        config: The corridor.
    """
    x, y, _, length, width, _, yaw = obstacles.boxes.T if len(obstacles) else np.empty((7, 0))
    # Half the extent of a turned box along x and y.
    along = 0.5 * (np.abs(length * np.cos(yaw)) + np.abs(width * np.sin(yaw)))
    across = 0.5 * (np.abs(length * np.sin(yaw)) + np.abs(width * np.cos(yaw)))
    gap = x - along - config.front
    inside = (np.abs(y) - across <= config.half_width) & (x + along > config.front) & (gap <= config.length)
    nearest, distance, contact = -1, float("inf"), float("inf")
    if inside.any():
        row = int(np.flatnonzero(inside)[np.argmin(gap[inside])])
        nearest, distance = int(obstacles.ids[row]), max(0.0, float(gap[row]))
        approach = -float(np.nan_to_num(obstacles.velocities[row, 0]))
        if approach > 0.1:
            contact = distance / approach
    return CorridorReport(
        version=obstacles.version,
        obstacles=len(obstacles),
        in_corridor=int(inside.sum()),
        nearest_id=nearest,
        nearest_m=distance,
        contact_s=contact,
    )


class ObstacleIntake(DataProcessComponent):
    """Takes the obstacles of every frame, in whatever process they were found."""

    Config = ObstacleIntakeConfig

    obstacles: Input[Obstacles]
    corridor: Output[CorridorReport]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = ObstacleIntakeConfig()
        self._frames = 0
        self._latest: CorridorReport | None = None

    def init(self, config: ObstacleIntakeConfig) -> None:
        """Keeps the corridor."""
        self._config = config

    def process(self, trigger: Trigger) -> Status:
        """Looks at one frame."""
        with self.obstacles.access() as snapshot:
            index = snapshot.version_index(trigger.version)
            if index < 0:
                return Status.MISS
            obstacles = snapshot[index]
        self._latest = corridor_report(obstacles, self._config)
        self._frames += 1
        with self.corridor.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns, epoch=trigger.epoch)
            change.value = self._latest
            return self.corridor.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    @property
    def idle_because(self) -> str | None:
        """No obstacles have come yet."""
        return None if self._frames else f"no data on {self.obstacles.topic} yet"

    def state(self) -> Mapping[str, str | float | int]:
        """Frames so far, and the latest one."""
        latest = self._latest
        if latest is None:
            return {"frames": 0}
        return {
            "frames": self._frames,
            "obstacles": latest.obstacles,
            "in corridor": latest.in_corridor,
            "nearest_m": round(latest.nearest_m, 2),
        }
