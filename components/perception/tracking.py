"""Tracking as a stage: detections of one frame after the other become objects with identity and velocity."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from ...dag import In, MonotonicDagComponent, Out, Processor, Trigger
from ...datamesh import Input, LossCounters, Status
from ...models.tracker import Tracker
from ..messages import CameraSet, DetectedObjects, Obstacles, RadarSet
from .tracker_settings import TrackerSettings

__all__ = ["TrackingComponent", "TrackingProcessor", "Troubles"]

_AS_CONFIGURED = "low score"  # what the settings leave out is no loss


class Troubles:
    """Tells a processor's losses what a tracker or a fusion counted since the last frame."""

    def __init__(self, *counters: Counter[str]):
        self._counters = counters
        self._told: Counter[str] = Counter()

    def tell(self, losses: LossCounters, place: str, version: int) -> None:
        """Counts what is new, by reason."""
        now = sum(self._counters, Counter())
        if now != self._told:
            for reason, count in (now - self._told).items():
                if reason != _AS_CONFIGURED:
                    losses.count(place, reason, version, count)
            self._told = now


class TrackingProcessor(Processor):
    """Keeps the tracks. Belongs in a monotonic component: it takes the frames one by one, in the order of versions.

    Detections that the tracker cannot use, gaps in time and frames without the pose that others had are counted as
    losses, by reason.
    """

    Config = TrackerSettings

    detected: In[DetectedObjects]
    obstacles: Out[Obstacles]

    def init(self, config: TrackerSettings) -> None:
        """Starts without tracks."""
        self._tracker = Tracker(config.tracker_config())
        self._troubles = Troubles(self._tracker.dropped, self._tracker.incidents)
        self._epoch: int | None = None

    def process(self, trigger: Trigger) -> Status:
        """Takes up the detections of one frame."""
        detected = self.detected.value
        sensor, detections = detected.sensor, detected.detections
        if not sensor.continues or trigger.epoch != self._epoch:
            self._tracker.clear()
            self._epoch = trigger.epoch
        tracks = self._tracker.update(
            sensor.version,
            detections.boxes,
            detections.scores,
            detections.classes,
            background=detections.background,
            velocities=detections.velocities,
            pose=sensor.pose,
        )
        self._troubles.tell(self.losses, self.place, trigger.version)
        self.obstacles.value = Obstacles.of_frame(detected, tracks, rows=tracks.detections, scores=tracks.scores)
        return Status.OK

    def state(self) -> Mapping[str, str | float | int]:
        """How many tracks there are."""
        return {"tracks": len(self._tracker)}


class TrackingComponent(MonotonicDagComponent):
    """The monotonic component of tracking and fusion; a vehicle may be without cameras and radars.

    `warploom ps` shows what its processors say of themselves.
    """

    cameras: Input[CameraSet] = Input(optional=True)
    radars: Input[RadarSet] = Input(optional=True)

    def state(self) -> Mapping[str, str | float | int]:
        """What each processor with a `state` says."""
        told: dict[str, Any] = {}
        for vertex in self.vertices:
            tell = getattr(vertex.processor, "state", None)
            if callable(tell):
                told.update(tell())  # type: ignore[call-overload]
        return told
