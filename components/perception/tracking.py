"""Tracking as a stage: detections of one frame after the other become objects with identity and velocity."""

from __future__ import annotations

import numpy as np

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
        boxes = tracks.boxes.astype(np.float32)
        # A cluster is as large as what is seen of it now: its track gives it an id, and its own box stays.
        seen = tracks.background & (tracks.detections >= 0)
        boxes[seen] = detections.boxes[tracks.detections[seen]]
        self.obstacles.value = Obstacles(
            version=sensor.version,
            frame=sensor.index,
            frame_id=sensor.frame_id,
            velocity_reference="ego" if sensor.pose is None else "world",
            ids=tracks.ids,
            classes=tracks.classes,
            scores=tracks.scores.astype(np.float32),
            boxes=boxes,
            velocities=tracks.velocities.astype(np.float32),
            background=tracks.background,
            missing_inputs=detected.missing_inputs,
        )
        return Status.OK
