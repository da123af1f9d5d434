"""Static transforms: where each sensor of the profile is on the vehicle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, Output, Status
from ...datamesh.messages import message
from ..execution import ExecutionContext

__all__ = ["StaticTransforms", "TransformPublisher", "TransformPublisherConfig", "mounting_matrix"]


@message("warploom.StaticTransforms")
@dataclass(frozen=True, eq=False, kw_only=True)
class StaticTransforms:
    """Where things are that do not move against each other."""

    parent: str
    """The frame that all of them are given in."""
    frames: tuple[str, ...]
    """Their own frames, k of them."""
    matrices: np.ndarray
    """Parent from each frame, shape (k, 4, 4), float64 [m]."""

    def __getitem__(self, frame: str) -> np.ndarray:
        """Parent from this frame, shape (4, 4).

        Raises:
            KeyError: There is no such frame.
        """
        try:
            return self.matrices[self.frames.index(frame)]
        except ValueError:
            raise KeyError(f"no transform of {frame!r}; there are: {', '.join(self.frames) or 'none'}") from None


def mounting_matrix(xyz: tuple[float, float, float], rpy_deg: tuple[float, float, float]) -> np.ndarray:
    """Vehicle from sensor.

    Args:
        xyz: The sensor's place on the vehicle [m].
        rpy_deg: Roll, pitch, yaw [deg]: turned about x, then y, then z of the vehicle.

    Returns:
        Shape (4, 4), float64.
    """
    roll, pitch, yaw = np.deg2rad(rpy_deg)
    (cr, cp, cy), (sr, sp, sy) = np.cos((roll, pitch, yaw)), np.sin((roll, pitch, yaw))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    matrix[:3, 3] = xyz
    return matrix


class TransformPublisherConfig(ProcessorConfig):
    """The frame of the vehicle."""

    parent: str = Field("vehicle", min_length=1)
    """What the vehicle's frame is called."""


class TransformPublisher(DataProcessComponent):
    """Commits the mountings of the profile's sensors, again and again, so that who starts later has them too."""

    Config = TransformPublisherConfig
    context: ExecutionContext | None

    transforms: Output[StaticTransforms]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._value = StaticTransforms(parent="vehicle", frames=(), matrices=np.empty((0, 4, 4)))
        self._unknown: list[str] = []

    def init(self, config: TransformPublisherConfig) -> None:
        """Makes the matrices."""
        sensors = (self.context or ExecutionContext()).sensors
        mounted = {name: sensor.mounting for name, sensor in sensors.items() if sensor.mounting is not None}
        self._unknown = [name for name in sensors if name not in mounted]
        matrices = [mounting_matrix(mounting.xyz, mounting.rpy_deg) for mounting in mounted.values()]
        self._value = StaticTransforms(
            parent=config.parent, frames=tuple(mounted), matrices=np.array(matrices).reshape(-1, 4, 4)
        )

    @property
    def idle_because(self) -> str | None:
        """The profile says of no sensor where it is."""
        return None if self._value.frames else "the profile gives no sensor a mounting"

    def process(self, trigger: Trigger) -> Status:
        """Commits them."""
        if not self._value.frames:
            return Status.MISS
        with self.transforms.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._value
            return self.transforms.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def state(self) -> Mapping[str, str | float | int]:
        """How many transforms there are, and which sensors have none."""
        return {"transforms": len(self._value.frames), "without mounting": ", ".join(self._unknown) or "none"}
