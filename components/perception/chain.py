"""Filter, ground and clusters as one stage: the kernels of a frame in one recorded launch."""

from __future__ import annotations

from itertools import cycle

from ...dag import In, Out, Processor, Trigger
from ...datamesh import Status
from ...kernels.chain import ChainConfig, KernelChain
from ..execution import ExecutionContext
from ..messages import SensorFrame
from ..motion import MAX_POSES, sweep_motion
from .clustering import ClusterConfig, Clusters
from .filtering import FilterConfig, FilteredCloud
from .ground import GroundSurface

__all__ = ["ChainProcessor", "ChainProcessorConfig"]


class ChainProcessorConfig(FilterConfig, ClusterConfig):
    """What is left out, and what makes a cluster: the settings of the stages that this one stands for."""

    captured: bool | None = None
    """Whether the kernels are recorded once and replayed; left out: yes on a GPU, on a CPU where it is safe."""


class ChainProcessor(Processor):
    """Filters a frame, finds its ground and groups what stands on it, without a wait in between.

    It gives what the stages `filter`, `ground` and `cluster` give, to the bit. What follows the ground alone starts
    later than with single stages: this suits a GPU, where each launch and each count that is read costs a wait.
    """

    Config = ChainProcessorConfig
    context: ExecutionContext

    sensor: In[SensorFrame]
    filtered: Out[FilteredCloud]
    ground: Out[GroundSurface]
    clusters: Out[Clusters]

    def check(self, config: ChainProcessorConfig) -> None:
        """Looks whether Warp computes all of it.

        Raises:
            ValueError: The backend is not Warp.
        """
        for backend in (config.backend, *self.context.backends.values()):
            if backend not in (None, "warp"):
                raise ValueError(f"backend must be 'warp' in a chain, not {backend!r}; single stages have others")

    def init(self, config: ChainProcessorConfig) -> None:
        """Makes a chain for each frame in flight."""
        context = self.context
        stages = ChainConfig(
            stages=("cluster",),
            point_range=config.point_range,
            ego_box=config.ego_box,
            max_poses=MAX_POSES if config.motion_compensation else 0,
            sensor_height=context.mounting_height,
            radius=config.radius,
            radius_per_metre=config.radius_per_metre,
            min_size=config.min_size,
            min_height=config.min_height,
            max_height=config.max_height,
        )
        what = {"config": stages, "capacity": context.capacity, "device": context.device, "captured": config.captured}
        self._chains = cycle([KernelChain(**what) for _ in range(self.in_flight)])

    def process(self, trigger: Trigger) -> Status:
        """Uploads one frame and runs the chain on it."""
        sensor = self.sensor.value
        chain = next(self._chains)
        motion = sweep_motion(sensor, self.losses, self.place) if chain.config.max_poses else None
        if motion is None:
            chain.upload(sensor.points)
        else:
            chain.upload(sensor.points, t=motion.t, poses=motion.poses, times=motion.times)
        chain.launch()
        counts, sensor_height = chain.read_counts()
        n = counts["kept"]
        dropped = {reason: counts[reason] for reason in ("non_finite", "out_of_range", "ego", "over_capacity")}
        xyz, index = chain.xyz[:n], chain.index[:n]
        self.filtered.value = FilteredCloud(sensor, xyz, chain.kept, index, dropped, motion is not None)
        self.ground.value = GroundSurface(chain.ground[:n], chain.height[:n], sensor_height)
        assert chain.labels is not None  # the chain has the stage
        self.clusters.value = Clusters(chain.labels[:n], counts["clusters"])
        return Status.OK
