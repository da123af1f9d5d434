"""A box around every cluster: beside the detection head, as it needs nothing of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.boxes import FitBoxes
from ..execution import ExecutionContext, empty_cloud
from .clustering import Clusters
from .filtering import FilteredCloud

__all__ = ["ClusterBoxConfig", "ClusterBoxProcessor", "ClusterBoxes"]


@dataclass(frozen=True, eq=False)
class ClusterBoxes:
    """Clusters, long ones cut into pieces, and their boxes."""

    labels: np.ndarray
    """Of each point of the filtered cloud, −1 for none, shape (n,), int32."""
    boxes: np.ndarray
    """x y z l w h [m], yaw [rad] by label; NaN where a label has no points; shape (k, 7), float32."""
    sizes: np.ndarray
    """Points by label, shape (k,), int64."""


class ClusterBoxConfig(ProcessorConfig):
    """How clusters become boxes."""

    split_length: float = Field(10.0, gt=0.0)
    """Longer clusters, such as walls and hedges, are cut into pieces of about this length [m]."""
    max_boxes: int = Field(1024, ge=1, le=1 << 16)
    """Boxes that there is room for; the clusters farther down the list get none, and are counted."""


class ClusterBoxProcessor(Processor):
    """Fits a box to each cluster."""

    Config = ClusterBoxConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    clusters: In[Clusters]
    cluster_boxes: Out[ClusterBoxes]

    def init(self, config: ClusterBoxConfig) -> None:
        """Makes the plan."""
        self._config = config
        self._fit = BoxFit(self.context, config.max_boxes)

    def process(self, trigger: Trigger) -> Status:
        """Boxes for one frame."""
        cloud, config = self.filtered.value, self._config
        labels = self.clusters.value.labels.numpy()
        boxes = self._fit(cloud.xyz, self.clusters.value.labels, self.clusters.value.count)
        long = np.flatnonzero(boxes[:, 3] > 1.5 * config.split_length)
        if len(long):
            labels, pieces = _cut(cloud.xyz.numpy(), labels, boxes, long, config.split_length)
            rows = rows_of(labels, pieces)
            boxes = np.concatenate([boxes, np.full((labels.max() + 1 - len(boxes), 7), np.nan, np.float32)])
            boxes[pieces] = self._fit.some(cloud.xyz, rows, np.searchsorted(pieces, labels[rows]), len(pieces))
        lost = max(self.clusters.value.count, len(boxes)) - config.max_boxes
        if lost > 0:
            self.losses.count(self.place, "over_capacity", trigger.version, lost)
        sizes = np.bincount(labels[labels >= 0], minlength=len(boxes))
        self.cluster_boxes.value = ClusterBoxes(labels, boxes, sizes[: len(boxes)])
        return Status.OK


class BoxFit:
    """The plan that fits boxes, with the few lines around it that both stages of the background need."""

    def __init__(self, context: ExecutionContext, max_boxes: int) -> None:
        self._device = context.device
        self._plan = FitBoxes(capacity=context.capacity, max_clusters=max_boxes, device=context.device)
        xyz, count = empty_cloud(context.device)
        self._plan.launch(xyz, wp.full(1, -1, dtype=wp.int32, device=context.device), count)

    def __call__(self, xyz: wp.array, labels: wp.array, clusters: int) -> np.ndarray:
        """The boxes of the labels 0 … `clusters` − 1, as many as there is room for, shape (k, 7)."""
        self._plan.launch(xyz, labels, wp.array([xyz.shape[0]], dtype=wp.int32, device=self._device))
        return self._plan.boxes.numpy()[: min(clusters, self._plan.max_clusters)].copy()

    def some(self, xyz: wp.array, rows: np.ndarray, labels: np.ndarray, clusters: int) -> np.ndarray:
        """The boxes of some of the points, labelled anew, shape (clusters, 7); NaN beyond the room that there is."""
        points = wp.array(xyz.numpy()[rows], dtype=wp.vec3, device=self._device)
        boxes = np.full((clusters, 7), np.nan, np.float32)
        fitted = self(points, wp.array(labels, dtype=wp.int32, device=self._device), clusters)
        boxes[: len(fitted)] = fitted
        return boxes


def rows_of(labels: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """The places at which `labels` are among `chosen`, rising."""
    is_chosen = np.zeros(max(int(labels.max(initial=-1)), int(chosen.max(initial=-1))) + 2, bool)
    is_chosen[chosen] = True  # the last entry stays False, and is what the label −1 finds
    return np.flatnonzero(is_chosen[labels])


def _cut(
    xyz: np.ndarray, labels: np.ndarray, boxes: np.ndarray, long: np.ndarray, length: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cuts the clusters named by `long` across into pieces of equal length, at most 1.5 `length`.

    Returns:
        The new labels, the first piece keeping the old one, and the labels of all pieces, rising.
    """
    labels = labels.copy()
    free = max(len(boxes), int(labels.max(initial=-1)) + 1)
    pieces = [long]
    for label in long:
        x, y, _, whole, _, _, yaw = boxes[label]
        rows = np.flatnonzero(labels == label)
        along = (xyz[rows, 0] - x) * np.cos(yaw) + (xyz[rows, 1] - y) * np.sin(yaw)
        parts = round(float(whole / length))
        part = np.clip(((along / whole + 0.5) * parts).astype(np.int32), 0, parts - 1)
        labels[rows] = np.where(part == 0, label, free + part - 1)
        pieces.append(np.arange(free, free + parts - 1))
        free += parts - 1
    return labels, np.concatenate(pieces)
