"""What the mesh asks of a payload: that it can be made read-only once it is committed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol, runtime_checkable

import numpy as np

__all__ = ["Freezable", "freeze"]


@runtime_checkable
class Freezable(Protocol):
    """A payload that knows itself how to become read-only."""

    def freeze(self) -> None:
        """Makes every way to write to it raise, as far as its memory can be protected."""
        ...


def freeze(value: Any) -> None:
    """Makes a committed payload read-only: NumPy arrays in it refuse to be written from here on.

    Goes through dataclasses, mappings, lists and tuples. Arrays of Warp and torch cannot be protected.
    """
    if isinstance(value, np.ndarray):
        value.setflags(write=False)
    elif isinstance(value, Freezable):
        value.freeze()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for field in dataclasses.fields(value):
            freeze(getattr(value, field.name))
    elif isinstance(value, Mapping):
        for part in value.values():
            freeze(part)
    elif isinstance(value, (list, tuple)):
        for part in value:
            freeze(part)
