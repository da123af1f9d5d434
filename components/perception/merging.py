"""Foreground and background as one list of detections."""

from __future__ import annotations

from ...dag import In, Out, Processor, Trigger
from ...datamesh import Status
from ...models.detections import Detections
from ..messages import DetectedObjects
from .filtering import FilteredCloud

__all__ = ["MergeProcessor"]


class MergeProcessor(Processor):
    """Joins what the head and the clusters found; either may be missing, and the result says so."""

    filtered: In[FilteredCloud]
    foreground: In[Detections] = In(optional=True)
    background: In[Detections] = In(optional=True)
    detected: Out[DetectedObjects]

    def process(self, trigger: Trigger) -> Status:
        """Merges one frame."""
        ports = {"foreground": self.foreground, "background": self.background}
        parts = [port.value for port in ports.values() if port.present]
        self.detected.value = DetectedObjects(
            sensor=self.filtered.value.sensor,
            detections=Detections.concatenate(*parts) if parts else Detections.empty(),
            missing_inputs=tuple(name for name, port in ports.items() if not port.present),
        )
        return Status.OK
