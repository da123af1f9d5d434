"""The background: boxes around everything that stands on the ground and is none of the known objects."""

from __future__ import annotations

import numpy as np
import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.boxes import FitBoxes
from ...kernels.selection import label_outside_boxes
from ...models.classes import UNKNOWN
from ...models.detections import Detections
from ..execution import ExecutionContext, empty_cloud
from .clustering import Clusters
from .filtering import FilteredCloud

__all__ = ["BackgroundConfig", "BackgroundProcessor"]


class BackgroundConfig(ProcessorConfig):
    """What makes a background box."""

    min_size: int = Field(10, ge=1)
    """Points that must be left of a cluster, once those of known objects are taken out."""
    min_height: float = Field(0.3, ge=0.0)
    """Lower boxes are left out [m]."""
    split_length: float = Field(10.0, gt=0.0)
    """Longer clusters, such as walls and hedges, are cut into pieces of about this length [m]."""
    margin: float = Field(0.2, ge=0.0)
    """By how much the box of a known object is grown, when its points are taken out [m]."""
    max_boxes: int = Field(1024, ge=1)
    """Boxes that there is room for; the clusters farther down the list are left out, and counted."""


class BackgroundProcessor(Processor):
    """Clusters less the points of the foreground, each with its box."""

    Config = BackgroundConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    clusters: In[Clusters]
    foreground: In[Detections] = In(optional=True)
    background: Out[Detections]

    def init(self, config: BackgroundConfig) -> None:
        """Makes the plan."""
        capacity, device = self.context.capacity, self.context.device
        self._config = config
        self._labels = wp.empty(capacity, dtype=wp.int32, device=device)
        self._fit = FitBoxes(capacity=capacity, max_clusters=config.max_boxes, device=device)
        xyz, count = empty_cloud(device)
        labels = wp.full(1, -1, dtype=wp.int32, device=device)
        label_outside_boxes(xyz, labels, count, np.zeros((1, 7), np.float32), config.margin, self._labels[:1])
        self._fit.launch(xyz, labels, count)

    def process(self, trigger: Trigger) -> Status:
        """Boxes for one frame."""
        cloud, clusters, config = self.filtered.value, self.clusters.value, self._config
        labels = self._labels[: cloud.xyz.shape[0]]
        known = self.foreground.value.boxes if self.foreground.present else np.empty((0, 7), np.float32)
        label_outside_boxes(cloud.xyz, clusters.labels, cloud.count, known, config.margin, labels)
        host_labels = labels.numpy()
        boxes = self._boxes(cloud, labels, clusters.count, trigger)
        long = np.flatnonzero(boxes[:, 3] > 1.5 * config.split_length)
        if len(long):
            host_labels = _cut(cloud.xyz.numpy(), host_labels, boxes, long, config.split_length)
            labels = wp.array(host_labels, dtype=wp.int32, device=self.context.device)
            boxes = self._boxes(cloud, labels, int(host_labels.max(initial=-1)) + 1, trigger)
        sizes = np.bincount(host_labels[host_labels >= 0], minlength=len(boxes))[: len(boxes)]
        kept = (sizes >= config.min_size) & (boxes[:, 5] >= config.min_height)
        boxes, sizes = boxes[kept], sizes[kept]
        self.background.value = Detections(
            boxes=boxes,
            scores=(1.0 - np.exp(-sizes / 20.0)).astype(np.float32),  # the more points, the surer that it is there
            classes=np.full(len(boxes), UNKNOWN, np.int32),
            velocities=np.full((len(boxes), 2), np.nan, np.float32),
            background=np.ones(len(boxes), bool),
        )
        return Status.OK

    def _boxes(self, cloud: FilteredCloud, labels: wp.array, count: int, trigger: Trigger) -> np.ndarray:
        """The boxes of the labels 0 … count − 1, as many as there is room for."""
        if count > self._config.max_boxes:
            self.losses.count(self.place, "over_capacity", trigger.version, count - self._config.max_boxes)
        self._fit.launch(cloud.xyz, labels, cloud.count)
        return self._fit.boxes.numpy()[: min(count, self._config.max_boxes)].copy()


def _cut(xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray, long: np.ndarray, length: float) -> np.ndarray:
    """Labels in which the clusters named by `long` are cut across into pieces of equal length, at most 1.5 `length`."""
    labels = labels.copy()
    free = len(boxes)
    for label in long:
        x, y, _, whole, _, _, yaw = boxes[label]
        rows = np.flatnonzero(labels == label)
        along = (xyz[rows, 0] - x) * np.cos(yaw) + (xyz[rows, 1] - y) * np.sin(yaw)
        pieces = round(float(whole / length))
        piece = np.clip(((along / whole + 0.5) * pieces).astype(np.int32), 0, pieces - 1)
        labels[rows] = np.where(piece == 0, label, free + piece - 1)
        free += pieces - 1
    return labels
