"""One scan as a file tells it, and how named columns of any type become one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...errors import SourceError

__all__ = ["Scan", "scan_from_columns"]

INTENSITY_NAMES = ("intensity", "reflectance", "reflectivity", "remission", "scalar_intensity", "intensities", "i")
RING_NAMES = ("ring", "channel", "laser_id", "line", "laser", "scan_line")
TIME_NAMES = ("t", "time", "timestamp", "time_stamp", "offset_time", "time_offset", "point_time_offset")

_ABSOLUTE = 1000.0
"""No sweep takes that long [s]: greater times are stamps of a clock, and count from the earliest of them."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Scan:
    """The points of one file, on the host."""

    points: np.ndarray
    """x y z [m], intensity; shape (n, 4), float32."""
    ring: np.ndarray | None = None
    """Laser number, shape (n,), uint16; None where the file has none."""
    t: np.ndarray | None = None
    """Time of each point after the first [s], shape (n,), float32; None where the file has none."""
    format: str = ""
    """The kind of file, for people."""
    fields: tuple[str, ...] = ()
    """The names of the file's columns."""


def scan_from_columns(columns: Mapping[str, np.ndarray], *, format: str, where: object) -> Scan:
    """Makes a scan of the columns of a file that names them.

    x, y and z are taken as metres. Intensity of an unsigned integer type of one or two bytes is scaled to [0, 1] by the
    greatest value of the type; any other is taken as it is; zeros where there is none. Times of an integer type
    are nanoseconds, others seconds; stamps of a clock become offsets from the earliest.

    Args:
        columns: Names to arrays of shape (n,), in the order of the file; case does not matter.
        format: The kind of file, for people.
        where: The file, for errors.

    Raises:
        SourceError: x, y or z is missing.
    """
    by_name = {name.lower(): column for name, column in reversed(columns.items())}
    missing = [axis for axis in "xyz" if axis not in by_name]
    if missing:
        raise SourceError(
            f"{where}: no field {', '.join(missing)} among its fields ({', '.join(columns) or 'none'}); "
            "a point cloud has the fields x, y and z"
        )
    points = np.zeros((len(by_name["x"]), 4), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for axis, name in enumerate("xyz"):
            points[:, axis] = by_name[name]
        intensity = _first(by_name, INTENSITY_NAMES)
        if intensity is not None:
            points[:, 3] = intensity
            if intensity.dtype in (np.uint8, np.uint16):
                points[:, 3] /= np.iinfo(intensity.dtype).max
    return Scan(
        points=points,
        ring=_ring(_first(by_name, RING_NAMES)),
        t=_offsets(_first(by_name, TIME_NAMES)),
        format=format,
        fields=tuple(columns),
    )


def _first(columns: Mapping[str, np.ndarray], names: tuple[str, ...]) -> np.ndarray | None:
    return next((columns[name] for name in names if name in columns), None)


def _ring(column: np.ndarray | None) -> np.ndarray | None:
    """Laser numbers, where they can be such."""
    if column is None or not len(column):
        return None if column is None else np.empty(0, np.uint16)
    low, high = column.min(), column.max()
    return column.astype(np.uint16) if low >= 0 and high <= np.iinfo(np.uint16).max else None


def _offsets(column: np.ndarray | None) -> np.ndarray | None:
    """Seconds after the first point, where every time is a number."""
    if column is None or not len(column):
        return None if column is None else np.empty(0, np.float32)
    if column.dtype.kind in "iu":
        first = column.min()
        first = first if float(first) * 1e-9 > _ABSOLUTE else column.dtype.type(0)
        return ((column - first) * 1e-9).astype(np.float32)
    if not np.isfinite(column).all():
        return None
    first = float(column.min())
    return (column.astype(np.float64) - (first if first > _ABSOLUTE else 0.0)).astype(np.float32)
