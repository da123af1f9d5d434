"""Ground segmentation as a stage."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import warp as wp

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.ground import GroundSegment
from ..execution import ExecutionContext, empty_cloud
from .filtering import FilteredCloud

__all__ = ["GroundProcessor", "GroundSurface"]


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Which points of the filtered cloud are ground, on the device; valid until the frame has left the graph."""

    mask: wp.array
    """Shape (n,), bool."""
    height: wp.array
    """Height above the ground [m], shape (n,), float32."""
    sensor_height: float
    """Of the LiDAR above the ground near it [m]."""


class GroundProcessor(Processor):
    """Tells the ground from what stands on it."""

    context: ExecutionContext

    filtered: In[FilteredCloud]
    ground: Out[GroundSurface]

    def init(self, config: ProcessorConfig) -> None:
        """Makes a plan for each frame in flight."""
        context = self.context
        plans = [
            GroundSegment(capacity=context.capacity, sensor_height=context.mounting_height, device=context.device)
            for _ in range(self.in_flight)
        ]
        plans[0].launch(*empty_cloud(context.device))
        self._plans = cycle(plans)

    def process(self, trigger: Trigger) -> Status:
        """Segments one frame."""
        cloud = self.filtered.value
        plan = next(self._plans)
        plan.launch(cloud.xyz, cloud.count)
        n = cloud.xyz.shape[0]
        self.ground.value = GroundSurface(plan.mask[:n], plan.height[:n], float(plan.found_height.numpy()[0]))
        return Status.OK
