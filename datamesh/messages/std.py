"""Messages of single values, and the header of those that have a time and a frame: the fields are those of ROS."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

from .codec import message

__all__ = ["Byte", "Float", "Header", "Int32", "Int64", "String", "Time"]

_SECOND = 1_000_000_000


def _check_range(value: int, low: int, high: int, name: str) -> None:
    if not low <= value < high:
        raise ValueError(f"{name} must be from {low} to {high - 1}, not {value}")


@message("builtin_interfaces.Time")
@dataclass(frozen=True, order=True)
class Time:
    """A time, in whole seconds and nanoseconds beyond them."""

    sec: int = 0
    """[s]"""
    nanosec: int = 0
    """From 0 to 999,999,999 [ns]."""

    def __post_init__(self) -> None:
        _check_range(self.nanosec, 0, _SECOND, "nanosec")

    @classmethod
    def from_ns(cls, ns: int) -> Self:
        """The time of a version [ns]."""
        return cls(*divmod(ns, _SECOND))

    @property
    def ns(self) -> int:
        """As the version of a topic [ns]."""
        return self.sec * _SECOND + self.nanosec


@message("std_msgs.Header")
@dataclass(frozen=True)
class Header:
    """When, and in which frame of coordinates."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@message("std_msgs.Byte")
@dataclass(frozen=True)
class Byte:
    """A number from 0 to 255."""

    data: int = 0

    def __post_init__(self) -> None:
        _check_range(self.data, 0, 256, "data")


@message("std_msgs.String")
@dataclass(frozen=True)
class String:
    """A text."""

    data: str = ""


@message("std_msgs.Int32")
@dataclass(frozen=True)
class Int32:
    """A whole number of 32 bits."""

    data: int = 0

    def __post_init__(self) -> None:
        _check_range(self.data, -(1 << 31), 1 << 31, "data")


@message("std_msgs.Int64")
@dataclass(frozen=True)
class Int64:
    """A whole number of 64 bits."""

    data: int = 0

    def __post_init__(self) -> None:
        _check_range(self.data, -(1 << 63), 1 << 63, "data")


@message("std_msgs.Float64")
@dataclass(frozen=True)
class Float:
    """A real number, in double precision."""

    data: float = 0.0
