"""The embedded simulator as a source: the same frames as from a sensor, with the truth beside them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from ..messages import SensorFrame, Truth
from .source import Source

if TYPE_CHECKING:
    from ...models.simulator import SimulatedFrame
    from .simulated_sensors import SensorSuite

__all__ = ["SimulatorSource"]


class SimulatorSource(Source):
    """A simulated drive; the same arguments give the same frames.

    Its sweeps bring what cameras and radars of the vehicle found a little before: `suite` says which there are.
    """

    def __init__(self, place: str = "street", /, *, device: str | None = None, sensors: str = "all", **options):
        """Builds the world.

        Args:
            place: Which scenario, unless `options` name one.
            device: Where the rays are cast; None: the CPU.
            sensors: `all`, or `lidar` alone.
            options: Any of scenario, seed, duration [s], rate [Hz], lidar, mounting_height [m], rain [mm/h] and
                turning: sweeps take their time, as real ones do, and bring the sensor's poses, unless it is off.

        Raises:
            ValueError: There is no such scenario or lidar, or a number makes no sense.
        """
        from ...models.simulator import PointClass, Simulator  # its kernels are compiled only when it is used
        from .simulated_sensors import SensorSuite

        if sensors not in ("all", "lidar"):
            raise ValueError(f"sensors must be all or lidar, not {sensors!r}")
        self.suite: SensorSuite | None = SensorSuite() if sensors == "all" else None
        self._unscored = (PointClass.VEGETATION, PointClass.NOISE)  # as the ground score of SemanticKITTI leaves it out
        said = "&".join(f"{key}={value}" for key, value in options.items())
        self._simulator = Simulator(
            device=device or "cpu", visibility=sensors == "all", **{"scenario": place} | options
        )
        super().__init__(f"sim:{place}" + (f"?{said}" if said else ""))

    @property
    def length(self) -> int:
        """How many frames the drive has."""
        return len(self._simulator)

    def __iter__(self) -> Iterator[SensorFrame]:
        return (self._sensor_frame(frame) for frame in self._simulator)

    def _sensor_frame(self, frame: SimulatedFrame) -> SensorFrame:
        moves = frame.pose_times[0] < frame.pose_times[-1]
        return SensorFrame(
            version=int(frame.version),
            index=int(frame.index),
            points=frame.points,
            ring=frame.ring,
            t=frame.t,
            frame_id=self.frame_id,
            pose=frame.pose,
            poses=frame.poses if moves else None,
            pose_times=frame.pose_times if moves else None,
            truth=Truth(
                boxes=np.asarray(frame.boxes, np.float32),
                classes=np.asarray(frame.classes, np.int32),
                ids=np.asarray(frame.ids, np.int64),
                velocities=np.asarray(frame.velocities, np.float32),
                points=np.asarray(frame.counts, np.int32),
                ground=frame.ground,
                ground_scored=~np.isin(frame.point_class, self._unscored),
            ),
            cameras=None if self.suite is None else self.suite.cameras_of(self._simulator, frame),
            radars=None if self.suite is None else self.suite.radars_of(self._simulator, frame),
        )
