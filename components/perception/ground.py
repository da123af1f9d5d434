"""Ground segmentation as a stage."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import cycle

import warp as wp

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.ground import GroundSegment, segment_ground
from ..execution import ExecutionContext, empty_cloud
from .backends import Backend, check_backend
from .filtering import FilteredCloud

__all__ = ["GroundConfig", "GroundProcessor", "GroundSurface"]


@dataclass(frozen=True, eq=False)
class GroundSurface:
    """Which points of the filtered cloud are ground, on the device; valid until the frame has left the graph."""

    mask: wp.array
    """Shape (n,), bool."""
    height: wp.array
    """Height above the ground [m], shape (n,), float32."""
    sensor_height: float
    """Of the LiDAR above the ground near it [m]."""


class GroundConfig(ProcessorConfig):
    """How the ground is found."""

    backend: Backend | None = None
    """What computes: warp, or taichi, taichi:cpu, taichi:vulkan, taichi:metal, taichi:cuda; null: what the profile
    says, or else warp."""


class GroundProcessor(Processor):
    """Tells the ground from what stands on it."""

    Config = GroundConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    ground: Out[GroundSurface]

    def check(self, config: GroundConfig) -> None:
        """Looks whether the library computes here.

        Raises:
            DeviceError: Taichi cannot compute on its device.
        """
        self._backend = config.backend or self.context.backends.get("ground", "warp")
        check_backend(self._backend, "ground")

    def init(self, config: GroundConfig) -> None:
        """Makes a plan for each frame in flight; Taichi keeps its own."""
        context = self.context
        if self._backend != "warp":
            segment_ground(empty_cloud(context.device)[0], backend=self._backend)
            return
        plans = [
            GroundSegment(capacity=context.capacity, sensor_height=context.mounting_height, device=context.device)
            for _ in range(self.in_flight)
        ]
        plans[0].launch(*empty_cloud(context.device))
        self._plans = cycle(plans)

    def process(self, trigger: Trigger) -> Status:
        """Segments one frame."""
        cloud = self.filtered.value
        if self._backend != "warp":
            found = segment_ground(cloud.xyz, sensor_height=self.context.mounting_height, backend=self._backend)
            self.ground.value = GroundSurface(found.mask, found.height, found.sensor_height)
            return Status.OK
        plan = next(self._plans)
        plan.launch(cloud.xyz, cloud.count)
        n = cloud.xyz.shape[0]
        self.ground.value = GroundSurface(plan.mask[:n], plan.height[:n], float(plan.found_height.numpy()[0]))
        return Status.OK
