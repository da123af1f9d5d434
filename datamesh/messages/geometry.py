"""Messages of geometry: the fields are those of ROS; metres, radians, seconds; covariances row by row."""

from __future__ import annotations

from dataclasses import dataclass, field

from .codec import message
from .std import Header

__all__ = [
    "Point",
    "Point32",
    "Pose",
    "PoseStamped",
    "PoseWithCovariance",
    "Quaternion",
    "Twist",
    "TwistWithCovariance",
    "Vector3",
    "check_covariance",
]

_ZEROS = (0.0,) * 36


def check_covariance(covariance: tuple[float, ...], size: int, name: str = "covariance") -> None:
    """Refuses a covariance that is not of `size` × `size` values, row by row.

    Raises:
        ValueError: It has another number of values.
    """
    if len(covariance) != size * size:
        raise ValueError(f"{name} must have {size * size} values, {size} × {size} row by row, not {len(covariance)}")


@dataclass(frozen=True)
class _Components:
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@message("geometry_msgs.Point32")
@dataclass(frozen=True)
class Point32(_Components):
    """A point, which other systems keep in single precision [m]."""


@message("geometry_msgs.Point")
@dataclass(frozen=True)
class Point(_Components):
    """A point [m]."""


@message("geometry_msgs.Vector3")
@dataclass(frozen=True)
class Vector3(_Components):
    """A direction with a length: it is turned with its frame, and not moved with it."""


@message("geometry_msgs.Quaternion")
@dataclass(frozen=True)
class Quaternion:
    """A rotation, as a quaternion of length 1."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@message("geometry_msgs.Pose")
@dataclass(frozen=True)
class Pose:
    """Position and orientation."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@message("geometry_msgs.PoseStamped")
@dataclass(frozen=True)
class PoseStamped:
    """A pose with its time and frame."""

    header: Header = field(default_factory=Header)
    pose: Pose = field(default_factory=Pose)


@message("geometry_msgs.Twist")
@dataclass(frozen=True)
class Twist:
    """Velocities."""

    linear: Vector3 = field(default_factory=Vector3)
    """[m/s]"""
    angular: Vector3 = field(default_factory=Vector3)
    """About the axes [rad/s]."""


@message("geometry_msgs.PoseWithCovariance")
@dataclass(frozen=True)
class PoseWithCovariance:
    """A pose, and how sure it is."""

    pose: Pose = field(default_factory=Pose)
    covariance: tuple[float, ...] = _ZEROS
    """6 × 6, of x, y, z and the rotations about x, y, z."""

    def __post_init__(self) -> None:
        check_covariance(self.covariance, 6)


@message("geometry_msgs.TwistWithCovariance")
@dataclass(frozen=True)
class TwistWithCovariance:
    """Velocities, and how sure they are."""

    twist: Twist = field(default_factory=Twist)
    covariance: tuple[float, ...] = _ZEROS
    """6 × 6, of the linear velocities and the angular ones."""

    def __post_init__(self) -> None:
        check_covariance(self.covariance, 6)
