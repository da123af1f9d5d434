"""Clustering as a stage: everything that stands on the ground, known or not."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import numpy as np
import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.cluster import EuclideanCluster
from ...kernels.selection import select_heights
from ..execution import ExecutionContext, empty_cloud
from .backends import Backend, check_backend
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
    radius_per_metre: float = Field(0.0, ge=0.0, le=1.0)
    """By how much that grows per metre of range: 0, or from 1e-5."""
    min_size: int = Field(10, ge=1, le=1 << 24)
    """Clusters of fewer points are left out."""
    min_height: float = 0.1
    """Points lower above the ground are left out [m]."""
    max_height: float = 4.0
    """Points higher above the ground are left out: a vehicle passes beneath them [m]."""
    backend: Backend | None = None
    """What computes: warp, or taichi, taichi:cpu, taichi:vulkan, taichi:metal, taichi:cuda, the labels are the same;
    null: what the profile says, or else warp."""


class ClusterProcessor(Processor):
    """Groups the points above the ground into obstacles."""

    Config = ClusterConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    ground: In[GroundSurface]
    clusters: Out[Clusters]

    def check(self, config: ClusterConfig) -> None:
        """Looks whether the library computes here.

        Raises:
            DeviceError: Taichi cannot compute on its device.
        """
        self._backend = config.backend or self.context.backends.get("cluster", "warp")
        check_backend(self._backend, "cluster")

    def init(self, config: ClusterConfig) -> None:
        """Makes a plan for each frame in flight; one for Taichi, whose labels are copied."""
        capacity, device = self.context.capacity, self.context.device
        self._config = config
        self._include = wp.zeros(capacity, dtype=wp.bool, device=device)
        what = {"radius": config.radius, "radius_per_metre": config.radius_per_metre, "min_size": config.min_size}
        if self._backend != "warp":
            from ...kernels.taichi import cluster as in_taichi

            self._in_taichi = in_taichi.EuclideanCluster(**what, capacity=capacity, device=self._backend)
            self._in_taichi.launch(np.zeros((1, 3), np.float32), 0, np.zeros(1, np.int32))
            return
        plans = [EuclideanCluster(**what, capacity=capacity, device=device) for _ in range(self.in_flight)]
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
        if self._backend != "warp":
            self.clusters.value = self._cluster_in_taichi(cloud.xyz, include)
            return Status.OK
        plan = next(self._plans)
        plan.launch(cloud.xyz, cloud.count, include)
        self.clusters.value = Clusters(plan.labels[:n], int(plan.cluster_count.numpy()[0]))
        return Status.OK

    def _cluster_in_taichi(self, xyz: wp.array, include: wp.array) -> Clusters:
        n = xyz.shape[0]
        plan = self._in_taichi
        if n == 0:
            return Clusters(wp.zeros(0, dtype=wp.int32, device=self.context.device), 0)
        plan.launch(xyz.numpy(), n, include.numpy().astype(np.int32))
        labels = wp.array(plan.labels.to_numpy()[:n], dtype=wp.int32, device=self.context.device)
        return Clusters(labels, int(plan.totals.to_numpy()[2]))
