"""Tracking and fusion as one stage: the LiDAR's detections with the latest of cameras and radars become obstacles."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from ...dag import In, Out, Processor, Trigger
from ...datamesh import Status
from ...models.association import assign
from ...models.fusion import Fusion, FusionConfig
from ..messages import CameraObjects, CameraSet, DetectedObjects, Obstacles, RadarObjects, RadarSet
from .tracker_settings import TrackerSettings
from .tracking import Troubles

__all__ = ["FusionProcessor", "FusionSettings"]


class FusionSettings(TrackerSettings):
    """How objects are tracked, and how sensors are joined; the keys are those of `models.fusion.FusionConfig`."""

    sensors: tuple[str, ...] = ()
    """Names of the cameras and radars there should be; those without recent data are told as missing."""
    max_age: float | None = Field(None, gt=0.0)
    """Older data of a camera or radar is not used [s]."""
    camera_overlap: float | None = Field(None, gt=0.0, lt=1.0)
    """The least overlap in the image of what belongs together."""
    camera_weight: float | None = Field(None, gt=0.0, lt=1.0)
    """How much of a camera's score counts for existence."""
    radar_weight: float | None = Field(None, gt=0.0, lt=1.0)
    """How much of a radar's score counts for existence."""
    radar_gate: float | None = Field(None, gt=0.0)
    """How far from a box its radar targets may be [m]."""
    radar_speed_std: float | None = Field(None, gt=0.0)
    """Of a radial speed [m/s]."""
    least_radar_speed: float | None = Field(None, ge=0.0)
    """Over ground, of a target that is an object without the LiDAR [m/s]."""
    least_existence: float | None = Field(None, ge=0.0, lt=1.0)
    """Objects of lower probability of existence do not pass the gate."""

    def fusion_config(self) -> FusionConfig:
        """The fusion's configuration with these settings in place."""
        names = {each.name for each in dataclasses.fields(FusionConfig)} & set(type(self).model_fields)
        return FusionConfig(tracker=self.tracker_config(), **self.model_dump(exclude_none=True, include=names))


class FusionProcessor(Processor):
    """Tracks, fuses, and lets through what exists. Belongs in a monotonic component, whose LiDAR frames trigger it.

    `cameras` and `radars` take a message, a set or several in a tuple, the latest before the trigger, as
    `GetRecentDagProcessor` gives them; without them it works on, and says in `missing_inputs` what there should have
    been. Data that were too old or from the future are counted as losses, by reason, and so is what the tracker counts.
    """

    Config = FusionSettings

    detected: In[DetectedObjects]
    cameras: In[Any] = In(optional=True)
    radars: In[Any] = In(optional=True)
    obstacles: Out[Obstacles]

    def init(self, config: FusionSettings) -> None:
        """Starts without objects."""
        self._fusion = fusion = Fusion(config.fusion_config())
        self._troubles = Troubles(
            fusion.incidents, fusion.tracker.dropped, fusion.tracker.incidents,
            fusion.radar_tracker.dropped, fusion.radar_tracker.incidents,
        )  # fmt: skip
        self._epoch: int | None = None
        self._ages: dict[str, float] = {}
        self._missing: tuple[str, ...] = fusion.sensors
        if fusion.sensors:  # a vehicle: it loads SciPy now, half a second that a frame would wait for
            assign(np.empty((0, 0)))

    def process(self, trigger: Trigger) -> Status:
        """Takes up the detections of one frame."""
        detected = self.detected.value
        sensor, detections = detected.sensor, detected.detections
        if not sensor.continues or trigger.epoch != self._epoch:
            self._fusion.clear()
            self._epoch = trigger.epoch
        fused = self._fusion.update(
            sensor.version,
            detections.boxes,
            detections.scores,
            detections.classes,
            background=detections.background,
            velocities=detections.velocities,
            pose=sensor.pose,
            cameras=_messages(self.cameras, CameraObjects),
            radars=_messages(self.radars, RadarObjects),
        )
        self._troubles.tell(self.losses, self.place, trigger.version)
        self._ages, self._missing = fused.ages, fused.missing
        self.obstacles.value = Obstacles.of_frame(
            detected, fused, rows=fused.lidar, scores=fused.existence, missing=fused.missing
        )
        return Status.OK

    def state(self) -> Mapping[str, str | float | int]:
        """How many tracks there are, and which sensors joined the LiDAR in the latest frame, how old [ms]."""
        joined = " ".join(f"{name} {1000 * age:.0f} ms" for name, age in self._ages.items())
        return {
            "tracks": len(self._fusion.tracker),
            "joined": joined or "the LiDAR alone",
            **({"missing": " ".join(self._missing)} if self._missing else {}),
        }


def _messages(port: In[Any], kind: type) -> tuple[Any, ...]:
    """What is at a port, as a tuple of messages."""
    if not port.present:
        return ()
    value = port.value
    if isinstance(value, CameraSet):
        value = value.cameras
    elif isinstance(value, RadarSet):
        value = value.radars
    messages = value if isinstance(value, tuple) else (value,)
    for each in messages:
        if not isinstance(each, kind):
            raise TypeError(f"port {port.name} holds {type(each).__name__}; expected {kind.__name__}")
    return messages
