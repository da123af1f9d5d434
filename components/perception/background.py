"""The background: boxes around everything that stands on the ground and is none of the known objects."""

from __future__ import annotations

import numpy as np
import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.selection import label_outside_boxes
from ...models.classes import UNKNOWN
from ...models.detections import Detections
from ..execution import ExecutionContext, empty_cloud
from .cluster_boxes import BoxFit, ClusterBoxes, rows_of
from .filtering import FilteredCloud

__all__ = ["BackgroundConfig", "BackgroundProcessor"]


class BackgroundConfig(ProcessorConfig):
    """What makes a background box."""

    min_size: int = Field(10, ge=1, le=1 << 24)
    """Points that must be left of a cluster, once those of known objects are taken out."""
    min_height: float = Field(0.3, ge=0.0)
    """Lower boxes are left out [m]."""
    margin: float = Field(0.2, ge=0.0)
    """By how much the box of a known object is grown, when its points are taken out [m]."""


class BackgroundProcessor(Processor):
    """Clusters less the points of the foreground: those it touches get a new box, the others keep theirs."""

    Config = BackgroundConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    cluster_boxes: In[ClusterBoxes]
    foreground: In[Detections] = In(optional=True)
    background: Out[Detections]

    def init(self, config: BackgroundConfig) -> None:
        """Makes the plan."""
        context = self.context
        self._config = config
        self._fit = BoxFit(context, 256)
        self._labels = wp.empty(context.capacity, dtype=wp.int32, device=context.device)
        xyz, count = empty_cloud(context.device)
        nowhere = np.zeros((1, 7), np.float32)
        label_outside_boxes(xyz, self._labels[:1], count, nowhere, nowhere, 0.0, self._labels[1:2])

    def process(self, trigger: Trigger) -> Status:
        """The background of one frame."""
        found = self.cluster_boxes.value
        boxes, sizes = found.boxes, found.sizes
        if self.foreground.present and len(self.foreground.value):
            boxes, sizes = self._without_foreground(found, self.foreground.value.boxes)
        kept = (sizes >= self._config.min_size) & (boxes[:, 5] >= self._config.min_height)
        boxes, sizes = boxes[kept], sizes[kept]
        self.background.value = Detections(
            boxes=boxes,
            scores=(1.0 - np.exp(-sizes / 20.0)).astype(np.float32),  # the more points, the surer that it is there
            classes=np.full(len(boxes), UNKNOWN, np.int32),
            velocities=np.full((len(boxes), 2), np.nan, np.float32),
            background=np.ones(len(boxes), bool),
        )
        return Status.OK

    def _without_foreground(self, found: ClusterBoxes, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Boxes and sizes of the clusters without the points in the boxes of known objects."""
        cloud = self.filtered.value
        rest = self._labels[: cloud.xyz.shape[0]]
        labels = wp.array(found.labels, dtype=wp.int32, device=self.context.device)
        label_outside_boxes(cloud.xyz, labels, cloud.count, known, found.boxes, self._config.margin, rest)
        left = rest.numpy()
        sizes = np.bincount(left[left >= 0], minlength=len(found.boxes))[: len(found.boxes)]
        touched = np.flatnonzero((sizes < found.sizes) & (sizes >= self._config.min_size))
        boxes = found.boxes
        if len(touched):
            rows = rows_of(left, touched)
            boxes = boxes.copy()
            boxes[touched] = self._fit.some(cloud.xyz, rows, np.searchsorted(touched, left[rows]), len(touched))
        return boxes, sizes
