"""The detection head as a stage: the foreground."""

from __future__ import annotations

from typing import Literal

import numpy as np
import warp as wp
from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.gather import gather_rows
from ...models.card import default_card
from ...models.detections import Detections
from ...models.heads import open_head, read_card
from ..execution import ExecutionContext
from .filtering import FilteredCloud
from .ground import GroundSurface

__all__ = ["DetectionConfig", "DetectionProcessor"]


class DetectionConfig(ProcessorConfig):
    """What counts as found."""

    score_threshold: float | None = Field(None, ge=0.0, le=1.0)
    """Objects below are left out; null: what the head's card says."""
    providers: tuple[Literal["cpu", "cuda", "tensorrt"], ...] | None = None
    """Where the network may run, the best first; what is missing falls back to the next, which the log says; null: what
    the device has, then the CPU."""


class DetectionProcessor(Processor):
    """Finds the objects of known classes with the profile's head."""

    Config = DetectionConfig
    context: ExecutionContext

    filtered: In[FilteredCloud]
    ground: In[GroundSurface]
    foreground: Out[Detections]

    def check(self, config: DetectionConfig) -> None:
        """Looks whether the head is there and fits its card.

        Raises:
            ModelError: It is not, or does not.
        """
        read_card(self.context.detector or default_card(self.context.device))

    def init(self, config: DetectionConfig) -> None:
        """Loads the head and runs it once, so that the first frame takes no longer than the others."""
        context = self.context
        self._head = open_head(
            context.detector,
            device=context.device,
            threads=context.inference_threads,
            precision=context.precision,
            providers=config.providers,
            score_threshold=config.score_threshold,
            capacity=context.capacity,
        )
        self._head.warm_up()
        wanted = getattr(self._head, "needs_intensity", False)
        self._intensity = wp.zeros(context.capacity if wanted else 0, dtype=wp.float32, device=context.device)

    def process(self, trigger: Trigger) -> Status:
        """Detects in one frame."""
        cloud = self.filtered.value
        more = {"intensity": self._intensity_of(cloud)} if len(self._intensity) else {}
        self.foreground.value = self._head.detect(
            cloud.xyz, cloud.count, sensor_height=self.ground.value.sensor_height, **more
        )
        return Status.OK

    def _intensity_of(self, cloud: FilteredCloud) -> wp.array:
        """The fourth column of the points that passed the filter."""
        column = np.ascontiguousarray(cloud.sensor.points[:, 3])
        given = wp.array(column, dtype=wp.float32, device=self.context.device, copy=self.context.device != "cpu")
        gather_rows(given, cloud.index, cloud.count, self._intensity)
        return self._intensity[: cloud.xyz.shape[0]]
