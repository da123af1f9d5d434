"""What the mesh asks of payloads: to become read-only, to show their bytes, to say when a device has written them."""

from __future__ import annotations

import dataclasses
import functools
import zlib
from collections.abc import Callable, Iterable, Mapping
from enum import Enum
from typing import Any, Protocol, runtime_checkable

import numpy as np

__all__ = [
    "Allocatable",
    "Arena",
    "Completion",
    "Freezable",
    "checksum",
    "freeze",
    "holds_device_array",
    "host_array",
    "is_device_array",
]


@runtime_checkable
class Freezable(Protocol):
    """A payload that knows itself how to become read-only."""

    def freeze(self) -> None:
        """Makes every way to write to it raise, as far as its memory can be protected."""
        ...


@runtime_checkable
class Allocatable(Protocol):
    """A payload that knows which arrays it consists of, so that a change can build it in place."""

    @classmethod
    def allocate(cls, array: Callable[..., np.ndarray], *arguments: Any, **options: Any) -> Any:
        """Makes one, not written yet.

        Args:
            array: Makes an array of a shape and dtype; of it come all arrays of the payload.
            arguments: As the payload needs them, such as a capacity.
            options: The same.
        """
        ...


class Arena(Protocol):
    """Memory in which the payload of one change is built."""

    def array(self, shape: Any, dtype: Any) -> np.ndarray:
        """An array in it, not written yet."""
        ...


class Completion(Protocol):
    """The event after which a payload on a device is written: an event of Warp or torch behind two methods."""

    stream: Any
    """The stream that writes it; who reads on it need not wait."""

    def synchronize(self) -> None:
        """The calling thread waits for it."""
        ...

    def wait_on(self, stream: Any) -> None:
        """What is queued on `stream` from now on waits for it; the calling thread does not."""
        ...


_OF_A_CLASS_STATEMENT = 1 << 9
"""Py_TPFLAGS_HEAPTYPE: of a type's flags, the one that those written in C do not have."""


@functools.lru_cache(maxsize=1024)
def _kind(of: type) -> str:
    if issubclass(of, np.ndarray):
        return "array"
    if callable(getattr(of, "freeze", None)):
        return "freezable"
    if dataclasses.is_dataclass(of):
        return "dataclass"
    if issubclass(of, Mapping):
        return "mapping"
    if issubclass(of, (list, tuple)):
        return "sequence"
    if callable(getattr(of, "numpy", None)):
        return "device array"
    if of.__dictoffset__ and of.__flags__ & _OF_A_CLASS_STATEMENT and not issubclass(of, (type, Enum)):
        return "object"
    return "leaf"


def _parts(value: Any, kind: str) -> Iterable[Any]:
    """What a payload consists of."""
    if kind == "dataclass":
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    if kind == "mapping":
        return value.values()
    if kind == "object":  # not what is in further objects: it may well be somebody else's
        return [part for part in vars(value).values() if _kind(type(part)) != "object"]
    return value if kind == "sequence" else ()


def freeze(value: Any) -> None:
    """Makes a committed payload read-only: NumPy arrays in it refuse to be written from here on.

    Goes through dataclasses, mappings, lists and tuples, and the attributes of any other object, but not through
    further objects among those: such a class has a method `freeze`. Arrays of Warp and torch cannot be protected: a
    mesh with `check=True` compares their checksums.
    """
    if type(value) is np.ndarray:  # the usual case, without a call
        value.setflags(write=False)
        return
    kind = _kind(type(value))
    if kind == "leaf" or kind == "device array":
        return
    if kind == "array":
        value.setflags(write=False)
    elif kind == "freezable":
        value.freeze()
    else:
        for part in _parts(value, kind):
            freeze(part)


def is_device_array(value: Any) -> bool:
    """Whether it is an array of Warp or torch, on whatever device."""
    return _kind(type(value)) == "device array"


def holds_device_array(value: Any) -> bool:
    """Whether there is an array of Warp or torch anywhere in a payload."""
    kind = _kind(type(value))
    if kind == "freezable" and dataclasses.is_dataclass(value):
        kind = "dataclass"
    return kind == "device array" or any(holds_device_array(part) for part in _parts(value, kind))


def host_array(value: Any) -> np.ndarray:
    """An array of Warp or torch as one of NumPy; a copy where it is not on the host."""
    return (value.detach().cpu() if hasattr(value, "detach") else value).numpy()


def checksum(value: Any, start: int = 0) -> int:
    """CRC-32 of the bytes of all arrays in a payload, those on a device too, and of its plain numbers and texts."""
    kind = _kind(type(value))
    if kind == "freezable" and dataclasses.is_dataclass(value):
        kind = "dataclass"
    if kind == "device array":
        value = host_array(value)
        kind = "array"
    if kind == "array":
        if value.dtype.hasobject:
            return start
        return zlib.crc32(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data, start)
    if isinstance(value, (int, float, complex, str, bytes, bool, type(None))):
        return zlib.crc32(repr(value).encode(), start)
    if kind == "mapping":
        start = checksum([str(key) for key in value], start)
    for part in _parts(value, kind):
        start = checksum(part, start)
    return start
