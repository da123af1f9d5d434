"""Spinning LiDARs: where their lasers point, how fast they turn, how far and how well they see.

Elevations and azimuths of the lasers are the nominal ones of the makers' manuals, written here as the steps they are
made of: Velodyne VLP-16, HDL-32E, VLP-32C and Alpha Prime (VLS-128), Hesai Pandar40P, Pandar64, PandarXT-32 and
PandarQT, Ouster OS1-128. The HDL-64E has its two blocks in even steps, for its real ones are the calibration of each
device; the 90 lines of `pandar90` are synthetic (a documented formula). Divergences are the manuals' where they give
one, else the 3 mrad that is usual.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from .arguments import check_numbers

__all__ = ["LIDARS", "Lidar", "lidar_model"]


def _dense(count: int, low: float, high: float, centre: float, sharpness: float) -> np.ndarray:
    """Elevations [deg] from `low` to `high`, denser about `centre` by a hyperbolic sine."""
    a, b = np.arcsinh((low - centre) / sharpness), np.arcsinh((high - centre) / sharpness)
    return centre + sharpness * np.sinh(np.linspace(a, b, count))


@dataclass(frozen=True, eq=False, kw_only=True)
class Lidar:
    """One type of spinning LiDAR."""

    name: str
    """The name by which `lidar_model` finds it."""
    elevation: np.ndarray
    """Elevation of each laser, lowest first [deg]; shape (lines,)."""
    azimuth_step: float
    """Between two firings of one laser [deg]."""
    min_range: float = 0.9
    """[m]."""
    max_range: float = 120.0
    """[m]."""
    reach: float = 60.0
    """Where a target of 10 % reflectivity, face on, is seen half of the time [m]."""
    range_noise: float = 0.012
    """Standard deviation of a range [m]."""
    drop_out: float = 0.015
    """Share of the echoes that are lost for no reason."""
    divergence: float = 3.0
    """Width of a beam [mrad]: what lies within it gives one echo."""
    pulse: float = 0.5
    """Surfaces nearer to each other along a beam than this give one echo, in between [m]: half of how far light goes
    while a pulse of some 3 ns lasts."""
    azimuth_offset: np.ndarray | float = 0.0
    """Of each laser to the left of where the sensor faces [deg]; shape (lines,), or one for all."""

    def __post_init__(self):
        check_numbers(
            self, above_0=("azimuth_step", "max_range", "reach"), shares=("drop_out",),
            from_0=("min_range", "range_noise", "divergence", "pulse"),
        )  # fmt: skip
        if np.ndim(self.elevation) != 1 or len(self.elevation) == 0 or not np.isfinite(self.elevation).all():
            raise ValueError(f"elevation must be finite, of shape (lines,), not {self.elevation!r}")
        if np.shape(self.azimuth_offset) not in ((), (self.lines,)) or not np.isfinite(self.azimuth_offset).all():
            raise ValueError(
                f"azimuth_offset must be finite, one for all or ({self.lines},), not {self.azimuth_offset!r}"
            )
        if self.azimuth_step > 360:
            raise ValueError(f"azimuth_step must be at most 360 degrees, not {self.azimuth_step}")
        if self.min_range >= self.max_range:
            raise ValueError(f"min_range must be below max_range, {self.max_range}, not {self.min_range}")

    @property
    def lines(self) -> int:
        """Number of lasers."""
        return len(self.elevation)

    @property
    def columns(self) -> int:
        """Firings of each laser in one turn."""
        return round(360.0 / self.azimuth_step)

    @property
    def edge_share(self) -> float:
        """Share of the beams whose footprint reaches into the next beam's, 0 to 1."""
        return min(1.0, self.divergence / 1000.0 / np.deg2rad(self.azimuth_step))

    @cached_property
    def beams(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The beams of one turn, laser by laser in the order of firing.

        Returns:
            Unit directions, shape (n, 3), float32; laser of each, shape (n,), uint16; time as a fraction of the
            turn, shape (n,), float32. The turn begins backwards and runs clockwise seen from above.
        """
        columns, lines = self.columns, self.lines
        line, column = np.divmod(np.arange(columns * lines), columns)
        shift = np.broadcast_to(self.azimuth_offset, lines)
        azimuth = np.pi - np.deg2rad(column * (360.0 / columns) - shift[line])
        elevation = np.deg2rad(self.elevation)[line]
        level = np.cos(elevation)
        directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], 1)
        return directions.astype(np.float32), line.astype(np.uint16), (column / columns).astype(np.float32)


def _cycle(pattern: tuple[float, ...], lines: int, first: int = 0) -> np.ndarray:
    """A pattern over and over, for `lines` lasers of which the first takes number `first` of it."""
    return np.array([pattern[(first + k) % len(pattern)] for k in range(lines)])


# Manual of the VLP-32C: a third of a degree about the horizon, farther apart above and below.
_VLP32 = np.array([-25, -15.639, -11.31, -8.843, -7.254, -6.148, -5.333, -4.667, *np.arange(-12, 6) / 3, 2.333, 3.333,
                   4.667, 7, 10.333, 15])  # fmt: skip
_VLP32_AZIMUTH = np.array([-1.4, 1.4, -1.4, 1.4, -1.4, 1.4, -4.2, *_cycle((-1.4, 1.4, 4.2, -4.2), 19), -1.4, 1.4, -1.4,
                           1.4, -1.4, 1.4])  # fmt: skip
# Manual of the Alpha Prime (VLS-128): 0.11° from −6.5° to 4.83°.
_VLS128 = np.array([-25, -19.582, -16.042, -13.565, -11.742, -10.346, -9.244, -8.352, -7.65, -7.15, -6.85, -6.65,
                    *(-6.5 + 0.11 * np.arange(104)), 4.98, 5.18, 5.43, 5.73, 6.08, 6.48, 6.98, 7.58, 8.43, 9.7, 11.75,
                    15])  # fmt: skip
_VLS128_AZIMUTH = _cycle((0.911, 2.732, 4.548, 6.354, -6.354, -4.548, -2.732, -0.911), 128)
# Manuals of the Pandar40P and Pandar64: a third and a sixth of a degree between −6° and 2°, whole ones outside. Hesai
# counts offsets clockwise.
_PANDAR_BELOW, _PANDAR_ABOVE = np.array([-25, -19, *range(-14, -6)], float), np.array([3.0, 5, 8, 11, 15])
_PANDAR40 = np.concatenate([_PANDAR_BELOW, np.linspace(-6, 2, 25), _PANDAR_ABOVE])
_PANDAR64 = np.concatenate([_PANDAR_BELOW, np.linspace(-6, 2, 49), _PANDAR_ABOVE])
_PANDAR64_AZIMUTH = np.full(64, -1.042)
_PANDAR64_AZIMUTH[10:59] = _cycle((-1.042, -3.125, -5.208, 5.208, 3.125, 1.042), 49)
# Manual of the PandarQT: 104° in all, the steps grow with the elevation.
_QT64_HALF = np.array([0.725, 2.175, 3.626, 5.079, 6.534, 7.993, 9.456, 10.923, 12.397, 13.877, 15.365, 16.861, 18.368,
                       19.885, 21.415, 22.959, 24.524, 26.101, 27.697, 29.315, 30.957, 32.627, 34.328, 36.064, 37.84,
                       39.662, 41.537, 43.475, 45.487, 47.587, 49.795, 52.133])  # fmt: skip

LIDARS: dict[str, Lidar] = {
    lidar.name: lidar
    for lidar in (
        Lidar(name="vlp16", elevation=np.arange(-15.0, 15.1, 2.0), azimuth_step=0.2, max_range=100.0, reach=45.0),
        Lidar(
            name="hdl32",
            elevation=np.linspace(-30.67, 10.67, 32), azimuth_step=0.33, max_range=100.0, reach=45.0, divergence=2.8,
        ),
        Lidar(
            name="vlp32",
            elevation=_VLP32, azimuth_step=0.2, max_range=200.0, reach=80.0, azimuth_offset=_VLP32_AZIMUTH,
        ),
        Lidar(
            name="xt32",
            elevation=np.linspace(-16.0, 15.0, 32), azimuth_step=0.18, max_range=120.0, reach=80.0, min_range=0.5,
            range_noise=0.006,
        ),
        Lidar(name="pandar40", elevation=_PANDAR40, azimuth_step=0.2, max_range=200.0, reach=80.0),
        Lidar(
            name="hdl64",
            # Two blocks of 32: steps of half a degree below −8°, of a third of a degree above.
            elevation=np.concatenate([np.linspace(-24.2, -8.35, 32), np.linspace(-7.9, 2.6, 32)]),
            azimuth_step=0.167, reach=60.0, drop_out=0.03, divergence=2.0,
            # Calibrated away in what is recorded, but for a remainder that differs between neighbours.
            azimuth_offset=0.08 * (1.0 - ((np.arange(64) * 7) % 8) / 3.5),
        ),
        Lidar(
            name="pandar64",
            elevation=_PANDAR64, azimuth_step=0.2, max_range=200.0, reach=80.0, azimuth_offset=-_PANDAR64_AZIMUTH,
        ),
        Lidar(
            name="qt64",
            elevation=np.concatenate([-_QT64_HALF[::-1], _QT64_HALF]), azimuth_step=0.6, min_range=0.1, max_range=60.0,
            reach=20.0,
        ),
        Lidar(
            name="pandar90",
            elevation=_dense(90, -25.0, 15.0, -2.0, 4.0), azimuth_step=0.2, max_range=200.0, reach=80.0,
        ),
        Lidar(
            name="vls128",
            elevation=_VLS128, azimuth_step=0.2, max_range=245.0, reach=90.0, azimuth_offset=_VLS128_AZIMUTH,
        ),
        Lidar(
            name="os1_128",
            elevation=np.linspace(-22.5, 22.5, 128), azimuth_step=0.3515625, min_range=0.5, max_range=120.0, reach=50.0,
            range_noise=0.02, divergence=4.0,
        ),
    )
}  # fmt: skip


def lidar_model(name: str) -> Lidar:
    """The sensor of this name.

    Raises:
        ValueError: There is none; the message lists those there are.
    """
    if not isinstance(name, str) or name not in LIDARS:
        raise ValueError(f"lidar must be one of {', '.join(LIDARS)}, not {name!r}")
    return LIDARS[name]
