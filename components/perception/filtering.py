"""The first stage: uploads a frame, leaves out the points that cannot be used, and undoes the sensor's motion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import cycle

import numpy as np
import warp as wp
from pydantic import model_validator

from ...dag import In, Out, Processor, ProcessorConfig, Trigger
from ...datamesh import Status
from ...kernels.filters import PointFilter
from ...kernels.interop import borrow_points
from ...kernels.motion import MotionCompensation
from ..execution import ExecutionContext, empty_cloud
from ..messages import SensorFrame
from ..motion import MAX_POSES, sweep_motion

__all__ = ["FilterConfig", "FilterProcessor", "FilteredCloud"]

Bounds = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, eq=False)
class FilteredCloud:
    """The points of a frame that passed the filter, on the device; valid until the frame has left the graph."""

    sensor: SensorFrame
    """The frame as it came."""
    xyz: wp.array
    """Positions in the sensor's frame [m], shape (n,), vec3."""
    count: wp.array
    """Number of points, shape (1,), int32: n."""
    index: wp.array
    """Row of each in `sensor.points`, shape (n,), int32."""
    dropped: Mapping[str, int]
    """Points that were left out, by reason."""
    compensated: bool = False
    """True where the sensor's own motion is undone: `xyz` is as seen from where it was at the frame's version."""


class FilterConfig(ProcessorConfig):
    """What is left out, in the sensor's frame."""

    point_range: Bounds = (-100.0, -100.0, -10.0, 100.0, 100.0, 10.0)
    """xmin ymin zmin xmax ymax zmax [m], outside of which points are left out; the upper bound is open."""
    ego_box: Bounds | None = (-2.5, -1.2, -2.5, 2.5, 1.2, 0.5)
    """The vehicle itself, whose points are left out, likewise; null where the LiDAR does not see it."""
    motion_compensation: bool = True
    """Whether the sensor's own motion during the sweep is undone, where the frame knows times and poses."""

    @model_validator(mode="after")
    def _bounds_in_order(self) -> FilterConfig:
        for name in ("point_range", "ego_box"):
            box = getattr(self, name)
            if box is not None and not all(box[axis] < box[axis + 3] for axis in range(3)):
                raise ValueError(f"{name} must be xmin ymin zmin xmax ymax zmax, each min below its max, not {box}")
        return self


class FilterProcessor(Processor):
    """Leaves out points that are not finite, out of range, on the vehicle itself, or beyond the capacity.

    Then it undoes the sensor's own motion during the sweep. A frame whose points were taken at different times without
    poses is counted as the loss `not_compensated`, and its points stay where they are.
    """

    Config = FilterConfig
    context: ExecutionContext

    sensor: In[SensorFrame]
    filtered: Out[FilteredCloud]

    def init(self, config: FilterConfig) -> None:
        """Makes the plans of each frame in flight."""
        capacity, device = self.context.capacity, self.context.device
        plans = [
            PointFilter(capacity=capacity, point_range=config.point_range, ego_box=config.ego_box, device=device)
            for _ in range(self.in_flight)
        ]
        xyz, count = empty_cloud(device)
        plans[0].launch(xyz, None, count)
        motions = [MotionCompensation(capacity=1, max_poses=MAX_POSES, device=device) for _ in plans]
        motions[0].launch(xyz, wp.zeros(1, dtype=wp.float32, device=device), count, rows=plans[0].index, moved=xyz)
        self._plans = cycle(zip(plans, motions, strict=True))
        self._compensates = config.motion_compensation

    def process(self, trigger: Trigger) -> Status:
        """Uploads and filters one frame, and undoes its motion."""
        sensor = self.sensor.value
        offered = len(sensor.points)
        points = sensor.points[: self.context.capacity]
        table = (
            points if self.context.device == "cpu" else wp.array(points, dtype=wp.float32, device=self.context.device)
        )
        borrowed = borrow_points(table)
        plan, undo = next(self._plans)
        plan.launch(borrowed.xyz, borrowed.intensity, wp.array([len(points)], dtype=wp.int32, device=plan.device))
        n = int(plan.count.numpy()[0])
        non_finite, out_of_range, ego = plan.dropped.numpy().tolist()
        dropped = {
            "non_finite": non_finite,
            "out_of_range": out_of_range,
            "ego": ego,
            "over_capacity": offered - len(points),
        }
        xyz, index = plan.xyz[:n], plan.index[:n]
        motion = sweep_motion(sensor, self.losses, self.place) if self._compensates else None
        if motion is not None:
            given = np.ascontiguousarray(motion.t[: len(points)], np.float32)
            t = wp.array(given, dtype=wp.float32, device=plan.device, copy=plan.device != "cpu")
            undo.set_poses(motion.poses, motion.times, 0.0)
            undo.launch(xyz, t, plan.count, rows=index, moved=xyz)
        self.filtered.value = FilteredCloud(sensor, xyz, plan.count, index, dropped, motion is not None)
        return Status.OK
