"""Numbers that callers give, as kernels take them; what is no such number is refused by the argument's name."""

from __future__ import annotations

import operator
from typing import Any

import numpy as np

__all__ = ["real", "reals", "several", "table", "whole", "wholes"]


def real(value: Any, name: str) -> float:
    """A number as a float.

    Raises:
        TypeError: It is not a number.
        ValueError: It is too large for a float.
    """
    if not isinstance(value, str | bytes):
        try:
            return float(value)
        except OverflowError:
            raise ValueError(f"{name} must be a number that a float can hold, not {value!r}") from None
        except (TypeError, ValueError):
            pass
    raise TypeError(f"{name} must be a number, not {value!r}")


def whole(value: Any, name: str, bits: int = 32) -> int:
    """A whole number as an int; floats that are whole will do.

    Args:
        value: The number.
        name: What the message of an error calls it.
        bits: How many the number may have, with its sign.

    Raises:
        TypeError: It is not a number.
        ValueError: It is not whole, or too large.
    """
    try:
        number = operator.index(value)
    except TypeError:
        wide = real(value, name)
        if not wide.is_integer():
            raise ValueError(f"{name} must be a whole number, not {value!r}") from None
        number = int(wide)
    if not abs(number) < 1 << (bits - 1):
        raise ValueError(f"{name} must be a whole number of {bits} bits, not {value!r}")
    return number


def reals(values: Any, name: str) -> tuple[float, ...]:
    """Several numbers, as floats.

    Raises:
        TypeError: They are not numbers.
        ValueError: One is too large for a float.
    """
    return tuple(real(value, name) for value in several(values, name))


def wholes(values: Any, name: str) -> tuple[int, ...]:
    """Several whole numbers of 32 bits, as ints.

    Raises:
        TypeError: They are not numbers.
        ValueError: One is not whole, or too large.
    """
    return tuple(whole(value, name) for value in several(values, name))


def table(values: Any, name: str) -> np.ndarray:
    """Numbers of any shape, float64; not copied where they are that already.

    Raises:
        TypeError: They are not numbers, or their rows are of different lengths.
    """
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.empty(0, object)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name} must be numbers, not {values!r}")
    return array.astype(np.float64, copy=False)


def several(values: Any, name: str) -> list[Any]:
    """Things in a row, as a list.

    Raises:
        TypeError: They are not in a row.
    """
    if not isinstance(values, str | bytes):
        try:
            return list(values)
        except TypeError:
            pass
    raise TypeError(f"{name} must be a sequence, not {values!r}")
