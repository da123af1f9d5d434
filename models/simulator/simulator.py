"""The simulator: a LiDAR driven through a scenario, frame by frame, with ground truth."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import numpy as np

from ...kernels.device import resolve_device
from .ego import EgoPath, mounting
from .frame import SimulatedFrame
from .library import Library
from .scenarios import build_drive
from .sensors import Lidar, lidar_model
from .sweep import START_NS, caster, observe
from .terrain import Ground
from .world import World

__all__ = ["Simulator"]


class Simulator:
    """A drive along a simulated street; iterating gives its frames, the same ones each time."""

    def __init__(
        self,
        seed: int = 0,
        scenario: str = "street",
        lidar: str | Lidar = "hdl64",
        mounting_height: float = 1.73,
        duration: float = 10.0,
        rate: float = 10.0,
        turning: bool = False,
        rain: float = 0.0,
        visibility: bool = False,
        device: str = "cpu",
    ):
        """Builds the world.

        Args:
            seed: Chooses the street and everything on it.
            scenario: One of `SCENARIOS`.
            lidar: A sensor, or the name of one of `sensors.LIDARS`.
            mounting_height: Of the sensor above the ground [m].
            duration: Of the drive [s].
            rate: Sweeps a second.
            turning: Whether a sweep takes its time, so that the motion of sensor and things distorts it as it does a
                real one; else it is taken in an instant, and every point's time is 0.
            rain: How hard it rains [mm/h]; surfaces are wet from the first drop on.
            visibility: Whether frames say how much of each object can be seen.
            device: Where rays are cast.

        Raises:
            ValueError: No such scenario or sensor, or a length of time that is not positive.
            DeviceError: No such device.
        """
        for name, value in (("duration", duration), ("rate", rate), ("mounting_height", mounting_height)):
            if not value > 0:
                raise ValueError(f"{name} must be > 0, not {value}")
        self.seed, self.rate, self.duration, self.rain = seed, rate, duration, rain
        self.mounting_height, self.turning, self.visibility = mounting_height, turning, visibility
        self.lidar = lidar_model(lidar) if isinstance(lidar, str) else lidar
        drive = build_drive(scenario, seed, duration)
        self._ego = EgoPath(drive.street.ground, drive.lane, np.array(drive.motion), duration)
        library = Library(resolve_device(device))
        self._world = World(drive.street, library)
        self._cast = caster(library, self.lidar, 1.0 / rate, wetness=1.0 if rain > 0 else 0.0)
        self._cast.set_rain(rain)
        self._mounting = mounting(mounting_height, 0.0, 0.0)
        self._running = threading.Lock()

    def __len__(self) -> int:
        return max(1, round(self.duration * self.rate))

    def __iter__(self) -> Iterator[SimulatedFrame]:
        return (self.frame(index) for index in range(len(self)))

    @property
    def ground(self) -> Ground:
        """The height field under the street."""
        return self._world.ground

    @property
    def world(self) -> World:
        """Everything on the street."""
        return self._world

    def vehicle_pose(self, t: float) -> np.ndarray:
        """World from vehicle (x forward, y left, z up, origin on the ground) at time t [s], shape (4, 4)."""
        return self._ego.pose(t)

    def pose(self, t: float) -> np.ndarray:
        """World from sensor at time t [s], shape (4, 4)."""
        return self._ego.pose(t) @ self._mounting

    def time(self, index: int) -> float:
        """Reference time of a frame in the drive [s].

        Raises:
            IndexError: There is no such frame.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"index must be 0 to {len(self) - 1}, not {index}")
        return index / self.rate

    def version(self, index: int) -> int:
        """Reference time of a frame as its stamp [ns]."""
        return START_NS + round(index * 1e9 / self.rate)

    def frame(self, index: int) -> SimulatedFrame:
        """The frame of this number; any order does.

        Raises:
            IndexError: There is no such frame.
        """
        t = self.time(index)
        with self._running:
            return observe(
                self._world, self._cast, self.lidar, self.pose, t, turn=1.0 / self.rate if self.turning else 0.0,
                seed=self.seed * 1_000_003 + index, index=index, version=self.version(index),
                visibility=self.visibility,
            )  # fmt: skip
