"""A processor of one's own: the distance to the nearest object, from the tracked obstacles."""

import numpy as np

from warploom.components.messages import Obstacles
from warploom.dag import In, Out, Processor, ProcessorConfig, Status, Trigger


class NearestConfig(ProcessorConfig):
    """Objects below this score do not count."""

    min_score: float = 0.3


class NearestObject(Processor):
    """Gives the distance from the LiDAR to the centre of the nearest object [m]; infinite without any."""

    Config = NearestConfig
    obstacles: In[Obstacles]
    distance: Out[float]

    def init(self, config: NearestConfig) -> None:
        self.min_score = config.min_score

    def process(self, trigger: Trigger) -> Status:
        objects = self.obstacles.value
        sure = objects.boxes[objects.scores >= self.min_score]
        self.distance.value = float(np.hypot(sure[:, 0], sure[:, 1]).min(initial=np.inf))
        return Status.OK
