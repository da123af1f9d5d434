"""Clustering as a stage: everything that stands on the ground, known or not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.cluster import EuclideanCluster
from ...kernels.selection import select_heights
from ..execution import ExecutionContext, empty_cloud
from .filtering import FilteredCloud
from .ground import GroundSurface

__all__ = ["ClusterConfig", "ClusterProcessor", "Clusters"]


@dataclass(frozen=True, eq=False)
class Clusters:
    """Clusters of the filtered cloud, on the device; valid until the frame has left the graph."""

    labels: wp.array
    """Shape (n,), int32; −1 where a point is in none."""
    count: int
    """How many there are; labels are 0 … count − 1."""


class ClusterConfig(ProcessorConfig):
    """What makes a cluster."""

    radius: float = Field(0.5, gt=0.0, le=10.0)
    """Points no farther apart belong together [m]."""
    min_size: int = Field(10, ge=1)
    """Clusters of fewer points are left out."""
    min_height: float = 0.1
    """Points lower above the ground are left out [m]."""
    max_height: float = 4.0
    """Points higher above the ground are left out: a vehicle passes beneath them [m]."""


class ClusterProcessor(Processor):
    """Groups the points above the ground into obstacles."""

    Config = ClusterConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    ground: In[GroundSurface]
    clusters: Out[Clusters]

    def init(self, config: ClusterConfig) -> None:
        """Makes a plan for each frame in flight."""
        capacity, device = self.context.capacity, self.context.device
        self._config = config
        self._include = wp.zeros(capacity, dtype=wp.bool, device=device)
        plans = [
            EuclideanCluster(radius=config.radius, min_size=config.min_size, capacity=capacity, device=device)
            for _ in range(self.in_flight)
        ]
        xyz, count = empty_cloud(device)
        plans[0].launch(xyz, count, self._include[:1])
        self._plans = cycle(plans)

    def process(self, trigger: Trigger) -> Status:
        """Clusters one frame."""
        cloud, ground = self.filtered.value, self.ground.value
        n = cloud.xyz.shape[0]
        include = self._include[:n]
        bounds = (self._config.min_height, self._config.max_height)
        select_heights(ground.mask, ground.height, cloud.count, bounds, include)
        plan = next(self._plans)
        plan.launch(cloud.xyz, cloud.count, include)
        self.clusters.value = Clusters(plan.labels[:n], int(plan.cluster_count.numpy()[0]))
        return Status.OK
