"""Arrays in, the same family of arrays out: NumPy, torch, Warp, and any other that speaks DLPack.

Borrowing makes a Warp view of the caller's memory, without a copy where the layout allows it; giving back makes a
new array of the caller's family on the caller's device.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE

__all__ = ["Family", "Points", "adopt", "borrow", "borrow_points", "count_on", "family_of", "give"]

_FLOATS = (np.float16, np.float32, np.float64)


@dataclass(frozen=True)
class Family:
    """The library an array comes from, and the device it lies on."""

    name: str
    """`numpy`, `torch`, `warp` or `dlpack`."""
    device: str
    """The Warp name of the device."""
    namespace: Any = None
    """Of a `dlpack` array: its array-API namespace, whose `from_dlpack` makes arrays of its kind; else None."""


@dataclass(frozen=True)
class Points:
    """A borrowed cloud: views of the caller's points; `owner` keeps their memory alive."""

    xyz: wp.array
    """Positions [m], shape (n,), dtype vec3, possibly strided."""
    table: wp.array
    """All columns, shape (n, C), float32."""
    family: Family
    owner: Any

    def __len__(self) -> int:
        return self.xyz.shape[0]

    @property
    def device(self) -> str:
        """The Warp name of the device on which the points lie."""
        return self.family.device

    @property
    def intensity(self) -> wp.array | None:
        """The fourth column, shape (n,), float32, possibly strided; None when there are only three."""
        return _column(self.table, 3, wp.float32) if self.table.shape[1] > 3 else None

    @property
    def extra(self) -> wp.array:
        """The columns after the third, shape (n, C - 3), float32, possibly strided, possibly none."""
        n, columns = self.table.shape
        return wp.array(
            ptr=self.table.ptr + 12 if n and columns > 3 else None,
            dtype=wp.float32,
            shape=(n, columns - 3),
            strides=(self.table.strides[0], 4),
            device=self.table.device,
        )


def _column(table: wp.array, first: int, dtype: type) -> wp.array:
    """What begins at a column of a table, row by row."""
    n = table.shape[0]
    ptr = table.ptr + 4 * first if n else None
    return wp.array(ptr=ptr, dtype=dtype, shape=(n,), strides=(table.strides[0],), device=table.device)


@lru_cache(maxsize=64)
def count_on(count: int, device: str) -> wp.array:
    """The number `count` on a device, shape (1,), int32, kept between calls: to be read only."""
    return wp.array([count], dtype=wp.int32, device=device)


def family_of(array: Any, name: str = "array") -> Family:
    """The family and device of `array`.

    Raises:
        TypeError: It is none of the known kinds; lists and tuples are not arrays.
    """
    if isinstance(array, np.ndarray):
        return Family("numpy", DEFAULT_DEVICE)
    if isinstance(array, wp.array):
        return Family("warp", str(array.device))
    if type(array).__module__.partition(".")[0] == "torch":
        return Family("torch", str(wp.device_from_torch(array.device)))
    if hasattr(array, "__dlpack__"):
        namespace = array.__array_namespace__() if hasattr(array, "__array_namespace__") else None
        return Family("dlpack", str(wp.from_dlpack(array).device), namespace)
    raise TypeError(
        f"{name} must be a NumPy, torch, Warp or DLPack array, not {type(array).__name__}; "
        "make one with numpy.asarray(…, dtype=numpy.float32)"
    )


def _float_table(points: Any, family: Family, name: str, columns: int) -> tuple[wp.array, Any]:
    """`points` as a Warp array2d of float32 and what owns its memory; copies only where the layout demands it."""
    shape = tuple(points.shape)
    if family.name == "warp" and points.dtype == wp.vec3 and points.ndim == 1:
        points = wp.array(
            ptr=points.ptr, dtype=wp.float32, shape=(shape[0], 3), strides=(points.strides[0], 4), device=points.device
        )
        return points, points
    if len(shape) != 2 or shape[1] < columns:
        raise ValueError(f"{name} must have shape (n, {columns} or more), not {shape}")
    if family.name == "numpy":
        if points.dtype.type not in _FLOATS:
            raise TypeError(f"{name} must be of a floating type, not {points.dtype}; use {name}.astype(numpy.float32)")
        rows = np.asarray(points, dtype=np.dtype(np.float32))
        if rows.strides[1] != 4 or rows.strides[0] < 4 * rows.shape[1] or rows.strides[0] % 4:
            rows = np.ascontiguousarray(rows)
        strides = (rows.strides[0] or 4 * shape[1], 4)
        table = wp.array(
            ptr=rows.ctypes.data if rows.size else None,
            dtype=wp.float32,
            shape=rows.shape,
            strides=strides,
            device=DEFAULT_DEVICE,
        )
        return table, rows
    if family.name == "torch":
        import torch

        if not points.dtype.is_floating_point:
            raise TypeError(f"{name} must be of a floating type, not {points.dtype}; use {name}.float()")
        rows = points.detach().to(torch.float32)
        if rows.stride(1) != 1 or rows.stride(0) < rows.shape[1]:
            rows = rows.contiguous()
        return wp.from_torch(rows, dtype=wp.float32, requires_grad=False), rows
    array = points if family.name == "warp" else wp.from_dlpack(points)
    if array.dtype not in (wp.float16, wp.float32, wp.float64):
        raise TypeError(f"{name} must be of a floating type, not {array.dtype.__name__}")
    if array.dtype != wp.float32:
        converted = wp.empty(shape, dtype=wp.float32, device=array.device)
        wp.utils.array_cast(array if array.is_contiguous else array.contiguous(), converted)
        array = converted
    if array.strides[1] != 4:
        array = array.contiguous()
    return array, points


def borrow_points(points: Any, name: str = "points") -> Points:
    """Views an array of points as Warp arrays, without a copy for float32 rows.

    Args:
        points: Shape (n, C), C ≥ 3, floating: x y z [m] and, as the fourth column where there is one, intensity.
            A Warp array of vec3, shape (n,), also does.
        name: What the message of an error calls it.

    Raises:
        TypeError: `points` is not an array, or not of a floating type.
        ValueError: It is not two-dimensional, or has fewer than three columns.
    """
    family = family_of(points, name)
    table, owner = _float_table(points, family, name, columns=3)
    return Points(_column(table, 0, wp.vec3), table, family, (owner, table))


def borrow(array: Any, dtype: type, shape: tuple[int | None, ...], name: str) -> tuple[wp.array, Any]:
    """Views any array as a contiguous Warp array of one type, converting where needed.

    Args:
        array: NumPy, torch, Warp or DLPack.
        dtype: The Warp scalar type wanted.
        shape: The shape wanted; None stands for any length.
        name: What the message of an error calls it.

    Returns:
        The Warp array, on the array's device, and the owner of its memory, which must outlive it.

    Raises:
        TypeError: It is not an array, or floating where integers are wanted.
        ValueError: Another shape.
    """
    family = family_of(array, name)
    have = tuple(array.shape)
    if len(have) != len(shape) or any(want is not None and want != got for want, got in zip(shape, have, strict=True)):
        wanted = ", ".join("n" if length is None else str(length) for length in shape)
        raise ValueError(f"{name} must have shape ({wanted}), not {have}")
    numpy_dtype = np.dtype(wp.dtype_to_numpy(dtype))
    if family.name == "numpy":
        if numpy_dtype.kind in "iu" and array.dtype.kind not in "iub":
            raise TypeError(f"{name} must be of an integer type, not {array.dtype}")
        if array.dtype.kind not in "fiub":
            raise TypeError(f"{name} must be numeric, not {array.dtype}")
        owner = np.ascontiguousarray(array, dtype=numpy_dtype)
        view = wp.array(
            ptr=owner.ctypes.data if owner.size else None, dtype=dtype, shape=owner.shape, device=DEFAULT_DEVICE
        )
        return view, owner
    if family.name == "torch":
        owner = array.detach().to(wp.dtype_to_torch(dtype)).contiguous()
        return wp.from_torch(owner, dtype=dtype, requires_grad=False), owner
    source = array if family.name == "warp" else wp.from_dlpack(array)
    source = source if source.is_contiguous else source.contiguous()
    if source.dtype != dtype:
        converted = wp.empty(source.shape, dtype=dtype, device=source.device)
        wp.utils.array_cast(source, converted)
        source = converted
    return source, array


def give(array: wp.array, family: Family) -> Any:
    """A copy of a Warp array as an array of `family`, on the device of `array`.

    Arrays of vectors become one dimension more: vec3, shape (n,), becomes (n, 3), except in the Warp family.
    """
    if family.name == "numpy":
        return array.numpy().copy() if array.device.is_cpu else array.numpy()
    copy = wp.clone(array)
    if family.name == "warp":
        return copy
    if family.name == "torch":
        return wp.to_torch(copy, requires_grad=False)
    return family.namespace.from_dlpack(copy) if family.namespace is not None else copy


def adopt(host: np.ndarray, family: Family) -> Any:
    """A fresh NumPy array as an array of `family`, without a copy; for results that were made on the host."""
    if family.name == "numpy":
        return host
    if family.name == "torch":
        import torch

        return torch.from_numpy(host)
    if family.name == "warp" or family.namespace is None:
        return wp.array(host, copy=False, device=DEFAULT_DEVICE)
    return family.namespace.from_dlpack(host)
