"""The detection head as a stage: the foreground."""

from __future__ import annotations

from pydantic import Field

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...models.card import DEFAULT_CARD, load_card
from ...models.detections import Detections
from ...models.head import DetectionHead
from ..execution import ExecutionContext
from .filtering import FilteredCloud
from .ground import GroundSurface

__all__ = ["DetectionConfig", "DetectionProcessor"]


class DetectionConfig(ProcessorConfig):
    """What counts as found."""

    score_threshold: float | None = Field(None, ge=0.0, le=1.0)
    """Objects below are left out; null: what the head's card says."""


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
        load_card(self.context.detector or DEFAULT_CARD)

    def init(self, config: DetectionConfig) -> None:
        """Loads the head and runs it once, so that the first frame takes no longer than the others."""
        context = self.context
        self._head = DetectionHead(
            context.detector,
            device=context.device,
            threads=context.inference_threads,
            precision=context.precision,
            score_threshold=config.score_threshold,
            capacity=context.capacity,
        )
        self._head.warm_up()

    def process(self, trigger: Trigger) -> Status:
        """Detects in one frame."""
        cloud = self.filtered.value
        self.foreground.value = self._head.detect(cloud.xyz, cloud.count, sensor_height=self.ground.value.sensor_height)
        return Status.OK
