"""What the ego vehicle feels of its own motion: IMU, GNSS and wheel speed, consistent with its poses.

Errors are those of the usual model (Woodman, "An introduction to inertial navigation", 2007): white noise by density, a
bias drawn once, and its random walk. GNSS errs by white noise and by a slow part, a Gauss–Markov process.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from .arguments import check_numbers

__all__ = ["Gnss", "GnssModel", "Imu", "ImuModel", "WheelSpeed", "WheelSpeedModel", "local_from_geodetic"]

_GRAVITY = 9.80665  # [m/s²]
_A, _E2 = 6378137.0, 6.69437999014e-3  # WGS 84: half of the long axis [m], eccentricity squared
_ORIGIN = (48.0, 11.5, 500.0)  # latitude and longitude [deg], height [m] of the world's origin
_STEP = 2e-3  # [s] of the differences that stand for derivatives

PoseAt = Callable[[float], np.ndarray]


@dataclass(frozen=True, eq=False, kw_only=True)
class Imu:
    """What an IMU at the origin of the vehicle's frame measured."""

    t: np.ndarray
    """[s], shape (n,)."""
    acceleration: np.ndarray
    """Specific force along the vehicle's axes, + 9.8 along z at rest [m/s²]; shape (n, 3)."""
    angular_rate: np.ndarray
    """About the vehicle's axes [rad/s], shape (n, 3)."""
    acceleration_bias: np.ndarray
    """Truth: what was added besides noise, shape (n, 3)."""
    angular_rate_bias: np.ndarray
    """Truth, shape (n, 3)."""


@dataclass(frozen=True, kw_only=True)
class ImuModel:
    """How well an IMU measures; the numbers are of a good MEMS device."""

    rate: float = 100.0
    """[Hz]."""
    acceleration_noise: float = 1.5e-3
    """Density [m/s² / √Hz]."""
    angular_rate_noise: float = 1.0e-4
    """Density [rad/s / √Hz]."""
    acceleration_bias: float = 0.03
    """Standard deviation of the bias at the start [m/s²]."""
    angular_rate_bias: float = 1.0e-3
    """[rad/s]."""
    acceleration_walk: float = 5.0e-4
    """Random walk of the bias [m/s² / √s]."""
    angular_rate_walk: float = 2.0e-5
    """[rad/s / √s]."""

    def __post_init__(self):
        check_numbers(self, above_0=("rate",), from_0=[name for name in vars(self) if name != "rate"])

    def measure(self, pose_at: PoseAt, duration: float, seed: int) -> Imu:
        """What is measured of a motion from 0 to `duration` [s].

        Args:
            pose_at: World from vehicle at a time [s].
            duration: [s].
            seed: Of noise and biases.
        """
        random = np.random.default_rng([seed & 0x7FFFFFFF, 23])
        t = _times(duration, self.rate)
        before, here, after = (np.array([pose_at(at + h) for at in t]) for h in (-_STEP, 0.0, _STEP))
        acceleration = (after[:, :3, 3] - 2 * here[:, :3, 3] + before[:, :3, 3]) / _STEP**2
        acceleration[:, 2] += _GRAVITY
        force = np.einsum("nji,nj->ni", here[:, :3, :3], acceleration)
        turn = np.einsum("nji,njk->nik", before[:, :3, :3], after[:, :3, :3])
        rate = np.stack(
            [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], 1
        )
        rate /= 4 * _STEP  # small angles: half of the antisymmetric part is the turn
        said = []
        for truth, noise, bias, walk in (
            (force, self.acceleration_noise, self.acceleration_bias, self.acceleration_walk),
            (rate, self.angular_rate_noise, self.angular_rate_bias, self.angular_rate_walk),
        ):
            drift = np.cumsum(random.normal(0, walk / np.sqrt(self.rate), truth.shape), axis=0)
            off = random.normal(0, bias, 3) + drift
            said += [truth + off + random.normal(0, noise * np.sqrt(self.rate), truth.shape), off]
        return Imu(
            t=t, acceleration=said[0], angular_rate=said[2], acceleration_bias=said[1], angular_rate_bias=said[3]
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class Gnss:
    """Fixes of a GNSS receiver at the origin of the vehicle's frame."""

    t: np.ndarray
    """[s], shape (n,)."""
    latitude: np.ndarray
    """WGS 84 [deg], shape (n,)."""
    longitude: np.ndarray
    altitude: np.ndarray
    """Above the ellipsoid [m]."""
    velocity: np.ndarray
    """East, north, up [m/s], shape (n, 3)."""
    accuracy: float
    """Standard deviation that the receiver reports of east and of north [m]."""


@dataclass(frozen=True, kw_only=True)
class GnssModel:
    """How well a receiver does; the world's x is east, its y north."""

    rate: float = 10.0
    """[Hz]."""
    noise: float = 0.3
    """White, of east and north [m]; up has twice as much."""
    drift: float = 0.8
    """Standard deviation of the slow part [m]."""
    drift_time: float = 60.0
    """Its time constant [s]."""
    velocity_noise: float = 0.05
    """[m/s]."""

    def __post_init__(self):
        check_numbers(self, above_0=("rate", "drift_time"), from_0=("noise", "drift", "velocity_noise"))

    def measure(
        self, pose_at: PoseAt, duration: float, seed: int, *, outages: Sequence[tuple[float, float]] = ()
    ) -> Gnss:
        """The fixes from 0 to `duration` [s], none of them within `outages` (beginning and end [s])."""
        for begin, end in outages:
            if not begin <= end:
                raise ValueError(f"outages must be pairs of a beginning and an end not before it, not {(begin, end)}")
        random = np.random.default_rng([seed & 0x7FFFFFFF, 29])
        t = _times(duration, self.rate)
        position = np.array([pose_at(at)[:3, 3] for at in t])
        velocity = np.array([pose_at(at + _STEP)[:3, 3] - pose_at(at - _STEP)[:3, 3] for at in t]) / (2 * _STEP)
        keep = np.exp(-1.0 / (self.rate * self.drift_time))
        slow = np.empty_like(position)
        slow[0] = random.normal(0, self.drift, 3)
        for k in range(1, len(t)):
            slow[k] = keep * slow[k - 1] + random.normal(0, self.drift * np.sqrt(1 - keep**2), 3)
        off = (slow + random.normal(0, self.noise, position.shape)) * [1.0, 1.0, 2.0]
        latitude, longitude, altitude = _geodetic(position + off).T
        velocity += random.normal(0, self.velocity_noise, velocity.shape)
        there = np.ones(len(t), bool)
        for begin, end in outages:
            there &= (t < begin) | (t > end)
        return Gnss(
            t=t[there],
            latitude=latitude[there],
            longitude=longitude[there],
            altitude=altitude[there],
            velocity=velocity[there],
            accuracy=float(np.hypot(self.noise, self.drift)),
        )


@dataclass(frozen=True, eq=False, kw_only=True)
class WheelSpeed:
    """What the wheels say of the speed."""

    t: np.ndarray
    """[s], shape (n,)."""
    speed: np.ndarray
    """Forward [m/s], shape (n,)."""


@dataclass(frozen=True, kw_only=True)
class WheelSpeedModel:
    """How well wheels tell the speed."""

    rate: float = 50.0
    """[Hz]."""
    scale: float = 0.01
    """Standard deviation of the relative error of the tyres' circumference."""
    noise: float = 0.02
    """[m/s]."""
    step: float = 0.01
    """What one count of the encoder is [m/s]."""

    def __post_init__(self):
        check_numbers(self, above_0=("rate", "step"), from_0=("scale", "noise"))

    def measure(self, pose_at: PoseAt, duration: float, seed: int) -> WheelSpeed:
        """What the wheels say from 0 to `duration` [s]."""
        random = np.random.default_rng([seed & 0x7FFFFFFF, 31])
        t = _times(duration, self.rate)
        forward = np.array([pose_at(at)[:3, 0] for at in t])
        velocity = np.array([pose_at(at + _STEP)[:3, 3] - pose_at(at - _STEP)[:3, 3] for at in t]) / (2 * _STEP)
        speed = np.einsum("ni,ni->n", velocity, forward) * (1 + random.normal(0, self.scale))
        speed = speed + random.normal(0, self.noise, len(t))
        return WheelSpeed(t=t, speed=np.round(speed / self.step) * self.step)


def _times(duration: float, rate: float) -> np.ndarray:
    check_numbers({"duration": duration}, above_0=("duration",))
    return np.arange(max(1, round(duration * rate))) / rate


def _radii() -> tuple[float, float]:
    """Of the ellipsoid at the origin: along the meridian and along the parallel [m]."""
    sine = np.sin(np.deg2rad(_ORIGIN[0]))
    w = 1 - _E2 * sine * sine
    return _A * (1 - _E2) / w**1.5 + _ORIGIN[2], (_A / np.sqrt(w) + _ORIGIN[2]) * np.cos(np.deg2rad(_ORIGIN[0]))


def _geodetic(xyz: np.ndarray) -> np.ndarray:
    """Latitude, longitude [deg] and height [m] of world positions within a few kilometres of the origin."""
    meridian, parallel = _radii()
    return np.stack(
        [_ORIGIN[0] + np.rad2deg(xyz[:, 1] / meridian), _ORIGIN[1] + np.rad2deg(xyz[:, 0] / parallel),
         _ORIGIN[2] + xyz[:, 2]], 1,
    )  # fmt: skip


def local_from_geodetic(latitude: np.ndarray, longitude: np.ndarray, altitude: np.ndarray) -> np.ndarray:
    """World positions of fixes, shape (n, 3): the inverse of what `GnssModel` does."""
    meridian, parallel = _radii()
    return np.stack(
        [np.deg2rad(np.asarray(longitude) - _ORIGIN[1]) * parallel,
         np.deg2rad(np.asarray(latitude) - _ORIGIN[0]) * meridian, np.asarray(altitude) - _ORIGIN[2]], 1,
    )  # fmt: skip
