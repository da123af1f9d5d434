"""Messages of navigation: the fields are those of ROS."""

from __future__ import annotations

from dataclasses import dataclass, field

from .codec import message
from .geometry import PoseStamped, PoseWithCovariance, TwistWithCovariance
from .std import Header

__all__ = ["Odometry", "Path"]


@message("nav_msgs.Odometry")
@dataclass(frozen=True)
class Odometry:
    """Where a vehicle is, and how it moves."""

    header: Header = field(default_factory=Header)
    """Its frame is that of the pose."""
    child_frame_id: str = ""
    """The frame of the velocities, usually the vehicle's."""
    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@message("nav_msgs.Path")
@dataclass(frozen=True)
class Path:
    """The poses of a way, one after the other."""

    header: Header = field(default_factory=Header)
    poses: tuple[PoseStamped, ...] = ()
