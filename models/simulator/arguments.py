"""What callers give to the simulator; what makes no sense is refused by the argument's name."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Any

import numpy as np

from ...kernels.arguments import real

__all__ = ["check_numbers", "check_pose", "check_whole"]


def check_whole(value: Any, name: str, least: int) -> None:
    """Refuses what is no whole number from `least` on.

    Raises:
        TypeError: It is not an integer.
        ValueError: It is below.
    """
    try:
        number = operator.index(value)
    except TypeError:
        raise TypeError(f"{name} must be a whole number, not {value!r}") from None
    if number < least:
        raise ValueError(f"{name} must be at least {least}, not {number}")


def check_numbers(
    given: Any, *, above_0: Sequence[str] = (), from_0: Sequence[str] = (), shares: Sequence[str] = ()
) -> None:
    """Refuses attributes that are no finite numbers of their kind.

    Args:
        given: What has them; or they themselves, by name.
        above_0: Names of those that must be above 0.
        from_0: Of those that may be 0.
        shares: Of those from 0 to 1.

    Raises:
        TypeError: One is not a number.
        ValueError: One is not finite, or out of its range.
    """
    values = given if isinstance(given, dict) else vars(given)
    for names, low, high, said in (
        (above_0, math.nextafter(0, 1), math.inf, "above 0"),
        (from_0, 0.0, math.inf, "from 0 on"),
        (shares, 0.0, 1.0, "from 0 to 1"),
    ):
        for name in names:
            value = real(values[name], name)
            if not (low <= value <= high and math.isfinite(value)):
                raise ValueError(f"{name} must be a number {said}, not {value:g}")


def check_pose(value: Any, name: str) -> None:
    """Refuses what is no pose.

    Raises:
        ValueError: It is not of shape (4, 4), or no rigid motion.
    """
    if np.shape(value) != (4, 4):
        raise ValueError(f"{name} must have shape (4, 4), not {np.shape(value)}")
    pose = np.asarray(value, np.float64)
    turn, last = pose[:3, :3], pose[3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < 1e-3 and np.abs(last - (0, 0, 0, 1)).max() < 1e-9
    if not (np.isfinite(pose).all() and rigid):
        raise ValueError(f"{name} must be a rigid motion: a rotation, a translation and 0 0 0 1, not {pose.tolist()}")
