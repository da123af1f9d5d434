"""Tracking as a stage: detections of one frame after the other become objects with identity and velocity."""

from __future__ import annotations

from ...dag import In, Out, Processor, Trigger
from ...datamesh import Status
from ...models.tracker import Tracker
from ..messages import DetectedObjects, Obstacles
from .tracker_settings import TrackerSettings

__all__ = ["TrackingProcessor"]


class TrackingProcessor(Processor):
    """Keeps the tracks. Belongs in a monotonic component: it takes the frames one by one, in the order of versions."""

    Config = TrackerSettings

    detected: In[DetectedObjects]
    obstacles: Out[Obstacles]

    def init(self, config: TrackerSettings) -> None:
        """Starts without tracks."""
        self._tracker = Tracker(config.tracker_config())
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
        self.obstacles.value = Obstacles.of_frame(detected, tracks, rows=tracks.detections, scores=tracks.scores)
        return Status.OK
