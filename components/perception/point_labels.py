"""What was found of each point, in the order of the frame as it came."""

from __future__ import annotations

import numpy as np

from ...dag import In, Out, Processor, Trigger
from ...datamesh import Status
from ..messages import PointLabels
from .clustering import Clusters
from .filtering import FilteredCloud
from .ground import GroundSurface

__all__ = ["PointLabelsProcessor"]


class PointLabelsProcessor(Processor):
    """Brings ground and clusters back to the host, and to the points as the source gave them."""

    filtered: In[FilteredCloud]
    ground: In[GroundSurface]
    clusters: In[Clusters]
    labels: Out[PointLabels]

    def process(self, trigger: Trigger) -> Status:
        """Labels one frame."""
        cloud = self.filtered.value
        n = len(cloud.sensor.points)
        index = cloud.index.numpy()
        ground, height = np.zeros(n, bool), np.full(n, np.nan, np.float32)
        clusters = np.full(n, -1, np.int32)
        ground[index] = self.ground.value.mask.numpy()
        height[index] = self.ground.value.height.numpy()
        clusters[index] = self.clusters.value.labels.numpy()
        self.labels.value = PointLabels(
            ground=ground, height=height, clusters=clusters, dropped=cloud.dropped, compensated=cloud.compensated
        )
        return Status.OK
