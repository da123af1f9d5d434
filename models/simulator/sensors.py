"""Spinning LiDARs: where their lasers point, how fast they turn, how far and how well they see.

The elevation tables follow the shape that the makers publish: even steps where the sensor has them (VLP-16, HDL-32E,
XT-32), two blocks for the HDL-64E, and lines denser around the horizon for the others, whose tables here are
synthetic (a documented formula, not the calibration of any one device).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

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
    azimuth_offset: float = 0.0
    """Largest shift of a laser's azimuth against the others [deg]; neighbouring lasers differ."""

    @property
    def lines(self) -> int:
        """Number of lasers."""
        return len(self.elevation)

    @property
    def columns(self) -> int:
        """Firings of each laser in one turn."""
        return round(360.0 / self.azimuth_step)

    @cached_property
    def beams(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The beams of one turn of 0.1 s in the order of firing.

        Returns:
            Unit directions, shape (n, 3), float32; laser of each, shape (n,), uint16; time as a fraction of the
            turn, shape (n,), float32. The turn begins backwards and runs clockwise seen from above.
        """
        columns, lines = self.columns, self.lines
        line, column = np.divmod(np.arange(columns * lines), columns)
        shift = self.azimuth_offset * (((np.arange(lines) * 7) % 8) / 3.5 - 1.0)
        azimuth = np.pi - np.deg2rad(column * (360.0 / columns) + shift[line])
        elevation = np.deg2rad(self.elevation)[line]
        level = np.cos(elevation)
        directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], 1)
        return directions.astype(np.float32), line.astype(np.uint16), (column / columns).astype(np.float32)


LIDARS: dict[str, Lidar] = {
    lidar.name: lidar
    for lidar in (
        Lidar(name="vlp16", elevation=np.arange(-15.0, 15.1, 2.0), azimuth_step=0.2, max_range=100.0, reach=45.0),
        Lidar(
            name="hdl32", elevation=np.linspace(-30.67, 10.67, 32), azimuth_step=0.33, max_range=100.0, reach=45.0
        ),
        Lidar(
            name="vlp32", elevation=_dense(32, -25.0, 15.0, -1.0, 3.0), azimuth_step=0.2, max_range=200.0, reach=80.0,
        ),
        Lidar(name="xt32", elevation=np.linspace(-16.0, 15.0, 32), azimuth_step=0.18, max_range=120.0, reach=80.0),
        Lidar(
            name="pandar40",
            elevation=_dense(40, -25.0, 15.0, -2.0, 4.0), azimuth_step=0.2, max_range=200.0, reach=80.0,
        ),
        Lidar(
            name="hdl64",
            # Two blocks of 32: steps of half a degree below −8°, of a third of a degree above.
            elevation=np.concatenate([np.linspace(-24.2, -8.35, 32), np.linspace(-7.9, 2.6, 32)]),
            azimuth_step=0.167,
            reach=60.0,
            range_noise=0.012,
            drop_out=0.03,
            azimuth_offset=0.08,
        ),
        Lidar(
            name="pandar64",
            elevation=_dense(64, -25.0, 15.0, -2.0, 3.5), azimuth_step=0.2, max_range=200.0, reach=80.0,
        ),
        Lidar(
            name="pandar90",
            elevation=_dense(90, -25.0, 15.0, -2.0, 4.0), azimuth_step=0.2, max_range=200.0, reach=80.0,
        ),
        Lidar(
            name="vls128", elevation=_dense(128, -25.0, 15.0, -2.0, 4.0), azimuth_step=0.2, max_range=245.0, reach=90.0,
        ),
    )
}  # fmt: skip


def lidar_model(name: str) -> Lidar:
    """The sensor of this name.

    Raises:
        ValueError: There is none; the message lists those there are.
    """
    try:
        return LIDARS[name]
    except KeyError:
        raise ValueError(f"lidar must be one of {', '.join(LIDARS)}, not {name!r}") from None
