"""The simulator: a LiDAR driven through a scenario, frame by frame, with ground truth."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence

import numpy as np

from ...kernels.device import resolve_device
from .arguments import check_numbers, check_whole
from .cameras import Camera, CameraFrame, CameraView
from .ego import EgoPath, mounting
from .ego_sensors import Gnss, GnssModel, Imu, ImuModel, WheelSpeed, WheelSpeedModel
from .frame import SimulatedFrame
from .library import Library
from .radar import Radar, RadarFrame
from .scenarios import build_drive
from .sensors import Lidar, lidar_model
from .sweep import START_NS, caster, observe
from .terrain import Ground
from .world import World

__all__ = ["Simulator"]

_LONGEST = 3600.0  # [s] of a drive


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
        turning: bool = True,
        rain: float = 0.0,
        visibility: bool = False,
        polish: float = 1.0,
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
            polish: How far paint and glass mirror away beams that graze them; 1 as real cars do on the whole, 0 not at
                all.
            device: Where rays are cast.

        Raises:
            TypeError: A number that is none.
            ValueError: No such scenario or sensor, a seed, rain or polish below 0, or another number not above it; or a
                drive longer than an hour.
            DeviceError: No such device.
        """
        check_whole(seed, "seed", 0)
        numbers = {
            "duration": duration,
            "rate": rate,
            "mounting_height": mounting_height,
            "rain": rain,
            "polish": polish,
        }
        check_numbers(numbers, above_0=("duration", "rate", "mounting_height"), from_0=("rain", "polish"))
        if duration > _LONGEST:
            raise ValueError(
                f"duration must be {_LONGEST:g} s at most, not {duration:g}: a drive lies ready as a whole"
            )
        self.seed, self.rate, self.duration, self.rain = seed, rate, duration, rain
        self.mounting_height, self.turning, self.visibility = mounting_height, turning, visibility
        self.lidar = lidar if isinstance(lidar, Lidar) else lidar_model(lidar)
        drive = build_drive(scenario, seed, duration)
        self.polish = polish
        self._ego = EgoPath(drive.street.ground, drive.lane, np.array(drive.motion), duration)
        library = Library(resolve_device(device), ground_faces=len(drive.street.ground.mesh()[1]))
        self._world = World(drive.street, library)
        wetness = 1.0 if rain > 0 else 0.0
        self._cast = caster(library, self.lidar, 1.0 / rate, wetness=wetness, things=1 + len(self._world))
        self._cast.set_rain(rain)
        self._mounting = mounting(mounting_height, 0.0, 0.0)
        self._views: dict[Camera, CameraView] = {}
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
                visibility=self.visibility, polish=self.polish,
            )  # fmt: skip

    def image(self, index: int, camera: Camera, *, delay: float = 0.0) -> CameraFrame:
        """What a camera sees `delay` seconds after the reference time of a frame.

        Raises:
            IndexError: There is no such frame.
            ValueError: A delay that is not finite.
        """
        if not np.isfinite(delay):
            raise ValueError(f"delay must be a number of seconds, not {delay}")
        t = self.time(index) + delay
        with self._running:
            if camera not in self._views:
                self._views[camera] = CameraView(self._world.library, camera)
            return self._views[camera].look(
                self._world, self.pose, t, version=self.version(index) + round(delay * 1e9),
                seed=self.seed * 1_000_003 + index,
            )  # fmt: skip

    def radar(self, frame: SimulatedFrame, radar: Radar) -> RadarFrame:
        """What a radar sees at the reference time of a frame of this drive."""
        return radar.measure(frame, velocity=self.velocity(frame.index), seed=self.seed * 1_000_003 + frame.index)

    def velocity(self, index: int) -> np.ndarray:
        """Of the LiDAR over ground at the reference time of a frame, along its axes [m/s], shape (3,).

        Raises:
            IndexError: There is no such frame.
        """
        t = self.time(index)
        step = self.pose(t + 1e-3)[:3, 3] - self.pose(t - 1e-3)[:3, 3]
        return self.pose(t)[:3, :3].T @ step / 2e-3

    def imu(self, model: ImuModel | None = None) -> Imu:
        """What an IMU at the vehicle's origin measures of the whole drive."""
        return (model or ImuModel()).measure(self.vehicle_pose, self.duration, self.seed)

    def gnss(self, model: GnssModel | None = None, *, outages: Sequence[tuple[float, float]] = ()) -> Gnss:
        """The GNSS fixes of the whole drive but for `outages`, beginning and end [s].

        Raises:
            ValueError: An outage that ends before it begins.
        """
        return (model or GnssModel()).measure(self.vehicle_pose, self.duration, self.seed, outages=outages)

    def wheel_speed(self, model: WheelSpeedModel | None = None) -> WheelSpeed:
        """What the wheels say of the whole drive."""
        return (model or WheelSpeedModel()).measure(self.vehicle_pose, self.duration, self.seed)
