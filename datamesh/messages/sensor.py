"""Messages of sensors: the fields are those of ROS. Point clouds and images go to NumPy, and so to OpenCV, and back."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Self

import numpy as np

from .codec import message
from .geometry import Quaternion, Vector3, check_covariance
from .std import Header

__all__ = [
    "CompressedImage",
    "CovarianceType",
    "Image",
    "Imu",
    "NavSatFix",
    "NavSatStatus",
    "PointCloud",
    "PointField",
    "PointFieldType",
]

_ZEROS = (0.0,) * 9
_ENCODINGS = {
    "mono8": ("u1", 1),
    "mono16": ("u2", 1),
    "bgr8": ("u1", 3),
    "rgb8": ("u1", 3),
    "bgra8": ("u1", 4),
    "rgba8": ("u1", 4),
    "8UC1": ("u1", 1),
    "8UC3": ("u1", 3),
    "16UC1": ("u2", 1),
    "32FC1": ("f4", 1),
    "32FC3": ("f4", 3),
}
"""Encoding → type of a value, values of a pixel."""


class PointFieldType(IntEnum):
    """Types of the values of a point, as ROS numbers them."""

    INT8 = 1
    UINT8 = 2
    INT16 = 3
    UINT16 = 4
    INT32 = 5
    UINT32 = 6
    FLOAT32 = 7
    FLOAT64 = 8


_FORMATS = dict(zip(PointFieldType, ("i1", "u1", "i2", "u2", "i4", "u4", "f4", "f8"), strict=True))
_TYPES = {np.dtype(code): kind for kind, code in _FORMATS.items()}


@message("sensor_msgs.PointField")
@dataclass(frozen=True)
class PointField:
    """What one value of a point is, and where it lies."""

    name: str
    offset: int = 0
    """From the start of the point [bytes]."""
    datatype: int = PointFieldType.FLOAT32.value
    """A number of `PointFieldType`."""
    count: int = 1
    """Values one behind the other."""


@message("sensor_msgs.PointCloud2")
@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points as bytes, in rows, with a description of what lies where: the layout of ROS' PointCloud2."""

    header: Header = field(default_factory=Header)
    height: int = 1
    """Rows; 1 where the points have no order."""
    width: int = 0
    """Points in a row."""
    fields: tuple[PointField, ...] = ()
    is_bigendian: bool = False
    point_step: int = 0
    """From point to point [bytes]."""
    row_step: int = 0
    """From row to row [bytes]."""
    data: np.ndarray = field(default_factory=lambda: np.empty(0, np.uint8))
    """The bytes, uint8, `height` × `row_step` of them."""
    is_dense: bool = True
    """Whether all points are finite."""

    @classmethod
    def from_array(
        cls, points: np.ndarray, header: Header | None = None, names: Sequence[str] = ("x", "y", "z", "intensity")
    ) -> Self:
        """Makes the message of points; without a copy where they lie in one piece.

        Args:
            points: A structured array with a field for each value, shape (n,) or (rows, n); or a plain one of numbers,
                shape (n, k).
            header: Time and frame.
            names: Of the values, where the array is a plain one: the first k of them.

        Raises:
            ValueError: It is neither, has more values than names, or values of a type that PointCloud2 has none for.
        """
        if points.dtype.names is None:
            if points.ndim != 2 or points.shape[1] > len(names):
                raise ValueError(
                    f"points must be structured, or of shape (n, k) with k at most {len(names)}, the number of names; "
                    f"not {points.dtype} of shape {points.shape}"
                )
            of_point = np.dtype([(name, points.dtype) for name in names[: points.shape[1]]])
            points = np.ascontiguousarray(points).view(of_point).reshape(len(points))
        if points.ndim not in (1, 2):
            raise ValueError(f"points must be of shape (n,) or (rows, n), not {points.shape}")
        points = np.ascontiguousarray(points)
        fields, orders, finite = [], set(), True
        for name in points.dtype.names or ():
            kind, offset = points.dtype.fields[name][:2]  # type: ignore[index]
            base, shape = kind.subdtype or (kind, ())
            datatype = _TYPES.get(base.newbyteorder("="))
            if datatype is None:
                raise ValueError(f"field {name!r} is of {base}: PointCloud2 has integers of 8 to 32 bits and floats")
            orders |= {base.newbyteorder("=") == base} if base.itemsize > 1 else set()
            fields.append(PointField(name, offset, datatype.value, int(np.prod(shape, dtype=int))))
            finite = finite and (base.kind != "f" or bool(np.isfinite(points[name]).all()))
        if len(orders) > 1:
            raise ValueError("the fields must all have one byte order")
        rows, width = (1, len(points)) if points.ndim == 1 else points.shape
        step = points.dtype.itemsize
        return cls(
            header=header if header is not None else Header(),
            height=rows,
            width=width,
            fields=tuple(fields),
            is_bigendian=orders == {sys.byteorder == "big"},
            point_step=step,
            row_step=step * width,
            data=points.reshape(-1).view(np.uint8),
            is_dense=finite,
        )

    def to_array(self) -> np.ndarray:
        """The points as a structured array, shape (n,) or, of several rows, (rows, n); a view where rows have no gaps.

        Raises:
            ValueError: The description does not fit the bytes.
        """
        if not self.fields:
            raise ValueError("the cloud says of no field where it lies")
        order = ">" if self.is_bigendian else "<"
        formats = []
        for one in self.fields:
            if one.datatype not in _FORMATS:
                raise ValueError(f"field {one.name!r} has datatype {one.datatype}, which is none of 1 to 8")
            base = np.dtype(order + _FORMATS[PointFieldType(one.datatype)])
            formats.append(base if one.count == 1 else np.dtype((base, (one.count,))))
            if one.offset < 0 or one.offset + formats[-1].itemsize > self.point_step:
                raise ValueError(f"field {one.name!r} reaches beyond its point of {self.point_step} bytes")
        if self.row_step < self.width * self.point_step or self.data.size < self.height * self.row_step:
            raise ValueError(
                f"{self.height} rows of {self.width} points need {self.width * self.point_step} bytes each; "
                f"row_step is {self.row_step}, and there are {self.data.size} bytes"
            )
        offsets = [one.offset for one in self.fields]
        names = [one.name for one in self.fields]
        layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": self.point_step}
        rows = self.data.view(np.uint8).reshape(-1)[: self.height * self.row_step].reshape(self.height, self.row_step)
        points = np.ascontiguousarray(rows[:, : self.width * self.point_step]).view(np.dtype(layout))
        return points.reshape(self.width) if self.height == 1 else points

    def to_xyz(self, *more: str) -> np.ndarray:
        """Positions [m], and further fields behind them, float32, shape (n, 3 + their number); a copy.

        Raises:
            ValueError: There is no such field, or as of `to_array`.
        """
        points = self.to_array().reshape(-1)
        names = ("x", "y", "z", *more)
        missing = [name for name in names if name not in (points.dtype.names or ())]
        if missing:
            raise ValueError(f"the cloud has no field {missing[0]!r}; it has: {', '.join(points.dtype.names or ())}")
        return np.stack([points[name].astype(np.float32) for name in names], axis=1)


@message("sensor_msgs.Image")
@dataclass(frozen=True, eq=False)
class Image:
    """A picture."""

    header: Header = field(default_factory=Header)
    height: int = 0
    """[pixels]"""
    width: int = 0
    """[pixels]"""
    encoding: str = "bgr8"
    is_bigendian: bool = False
    step: int = 0
    """From row to row [bytes]."""
    data: np.ndarray = field(default_factory=lambda: np.empty(0, np.uint8))
    """The bytes, uint8, `height` × `step` of them."""

    @classmethod
    def from_array(cls, pixels: np.ndarray, encoding: str = "bgr8", header: Header | None = None) -> Self:
        """Makes the message of a picture as OpenCV has it; without a copy where it lies in one piece.

        Args:
            pixels: Shape (height, width) or (height, width, channels).
            encoding: What the values are: bgr8, rgb8, mono8, mono16, 32FC1 …
            header: Time and frame.

        Raises:
            ValueError: The encoding is not known, or another than that of the values.
        """
        code, channels = _encoding(encoding)
        wanted = (*pixels.shape[:2], channels)
        if pixels.ndim not in (2, 3) or pixels.size != int(np.prod(wanted)) or pixels.dtype != np.dtype(code):
            raise ValueError(
                f"{encoding} is {channels} of {np.dtype(code)} for each pixel, not {pixels.dtype} {pixels.shape}"
            )
        height, width = pixels.shape[:2]
        values = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
        return cls(
            header=header if header is not None else Header(),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=sys.byteorder == "big",
            step=width * channels * np.dtype(code).itemsize,
            data=values,
        )

    def to_array(self) -> np.ndarray:
        """The picture as OpenCV takes it, (height, width) or (height, width, channels); a view where rows have no gaps.

        Raises:
            ValueError: The encoding is not known, or the bytes are too few.
        """
        code, channels = _encoding(self.encoding)
        kind = np.dtype((">" if self.is_bigendian else "<") + code)
        row = self.width * channels * kind.itemsize
        if self.step < row or self.data.size < self.height * self.step:
            raise ValueError(
                f"{self.height} rows need {row} bytes each; step is {self.step}, and there are {self.data.size} bytes"
            )
        rows = self.data.view(np.uint8).reshape(-1)[: self.height * self.step].reshape(self.height, self.step)
        pixels = np.ascontiguousarray(rows[:, :row]).view(kind)
        return pixels.reshape((self.height, self.width) + ((channels,) if channels > 1 else ()))


def _encoding(name: str) -> tuple[str, int]:
    if name not in _ENCODINGS:
        raise ValueError(f"encoding {name!r} is not known; known: {', '.join(_ENCODINGS)}")
    return _ENCODINGS[name]


@message("sensor_msgs.CompressedImage")
@dataclass(frozen=True, eq=False)
class CompressedImage:
    """A picture as a file holds it."""

    header: Header = field(default_factory=Header)
    format: str = "jpeg"
    """jpeg or png."""
    data: np.ndarray = field(default_factory=lambda: np.empty(0, np.uint8))
    """The bytes of the file, uint8."""


@message("sensor_msgs.Imu")
@dataclass(frozen=True)
class Imu:
    """What an inertial sensor measures. A covariance whose first value is −1 says that the measurement is not there."""

    header: Header = field(default_factory=Header)
    orientation: Quaternion = field(default_factory=Quaternion)
    orientation_covariance: tuple[float, ...] = _ZEROS
    """3 × 3, about x, y, z."""
    angular_velocity: Vector3 = field(default_factory=Vector3)
    """[rad/s]"""
    angular_velocity_covariance: tuple[float, ...] = _ZEROS
    linear_acceleration: Vector3 = field(default_factory=Vector3)
    """[m/s²]"""
    linear_acceleration_covariance: tuple[float, ...] = _ZEROS

    def __post_init__(self) -> None:
        for name in ("orientation_covariance", "angular_velocity_covariance", "linear_acceleration_covariance"):
            check_covariance(getattr(self, name), 3, name)


@message("sensor_msgs.NavSatStatus")
@dataclass(frozen=True)
class NavSatStatus:
    """Whether a satellite receiver has a position."""

    status: int = -1
    """−1 no fix, 0 fix, 1 with satellite-based augmentation, 2 with ground-based augmentation."""
    service: int = 0
    """The sum of those used: 1 GPS, 2 GLONASS, 4 COMPASS, 8 GALILEO."""


class CovarianceType(IntEnum):
    """How the covariance of a position was found, as ROS numbers it."""

    UNKNOWN = 0
    APPROXIMATED = 1
    DIAGONAL_KNOWN = 2
    KNOWN = 3


@message("sensor_msgs.NavSatFix")
@dataclass(frozen=True)
class NavSatFix:
    """A position of a satellite receiver, on the WGS 84 ellipsoid."""

    header: Header = field(default_factory=Header)
    status: NavSatStatus = field(default_factory=NavSatStatus)
    latitude: float = 0.0
    """North of the equator [degrees]."""
    longitude: float = 0.0
    """East of Greenwich [degrees]."""
    altitude: float = 0.0
    """Above the ellipsoid [m]."""
    position_covariance: tuple[float, ...] = _ZEROS
    """3 × 3, of east, north and up [m²]."""
    position_covariance_type: int = CovarianceType.UNKNOWN.value
    """A number of `CovarianceType`."""

    def __post_init__(self) -> None:
        check_covariance(self.position_covariance, 3, "position_covariance")
