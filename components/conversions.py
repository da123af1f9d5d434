"""Point clouds to torch, Open3D and PCD files, and back.

The cloud is the message `sensor.PointCloud`, which goes to NumPy and back by its own `from_array` and `to_array`. Each
function says what shares memory and what is a copy.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..datamesh.messages.sensor import PointCloud
from ..datamesh.messages.std import Header
from ..errors import SinkError, SourceError
from .sinks.pcd import encode_pcd
from .sources.pcd import decode_pcd_columns

if TYPE_CHECKING:
    import open3d  # pyright: ignore[reportMissingImports]
    import torch

__all__ = ["from_open3d", "from_torch", "read_pcd", "to_open3d", "to_torch", "write_pcd"]

_POSITIONS = ("x", "y", "z")


def to_torch(cloud: PointCloud, *names: str) -> torch.Tensor | dict[str, torch.Tensor]:
    """The values of a cloud as tensors on the host, over DLPack.

    They share the cloud's memory, unless a byte order or an uneven layout forbids it. torch knows no read-only tensors:
    who writes to one writes to the cloud.

    Args:
        cloud: The points.
        names: Fields of one type that lie one behind the other, such as x, y, z; none gives all fields.

    Returns:
        With names a tensor of shape (n, their number), else a tensor of shape (n,) or (n, count) for each field.

    Raises:
        ValueError: There is no such field; those named are of several types; or as of `PointCloud.to_array`.
        ImportError: torch is not installed.
    """
    try:
        import torch
    except ImportError as error:
        raise ImportError("to_torch needs torch, which is not installed: pip install 'warploom[torch]'") from error
    points = cloud.to_array().reshape(-1)
    if names:
        return torch.from_dlpack(_exportable(_side_by_side(points, names)))
    return {name: torch.from_dlpack(_exportable(points[name])) for name in points.dtype.names or ()}


def _side_by_side(points: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Fields of one type as columns, shape (n, their number); a view where they lie at even distances."""
    fields = points.dtype.fields or {}
    missing = [name for name in names if name not in fields]
    if missing:
        raise ValueError(f"the cloud has no field {missing[0]!r}; it has: {', '.join(fields)}")
    kinds = {fields[name][0] for name in names}
    kind = kinds.pop()
    if kinds or kind.subdtype is not None:
        told = ", ".join(f"{name}: {fields[name][0]}" for name in names)
        raise ValueError(f"the fields of one tensor must be single values of one type, not {told}")
    offsets = [fields[name][1] for name in names]
    steps = {after - before for before, after in itertools.pairwise(offsets)} or {kind.itemsize}
    if len(steps) > 1 or min(steps) <= 0:
        return np.stack([points[name] for name in names], axis=1)
    first = points[names[0]]
    shape, strides = (len(points), len(names)), (first.strides[0], steps.pop())
    return np.lib.stride_tricks.as_strided(first, shape, strides, writeable=first.flags.writeable)


def _exportable(values: np.ndarray) -> np.ndarray:
    """The same, in native byte order and at steps of whole values, as DLPack needs it."""
    if not values.dtype.isnative or any(step % values.dtype.itemsize for step in values.strides):
        return np.ascontiguousarray(values, values.dtype.newbyteorder("="))
    return values


def from_torch(
    points: torch.Tensor, header: Header | None = None, names: Sequence[str] = ("x", "y", "z", "intensity")
) -> PointCloud:
    """A cloud of a tensor; it shares the memory of one that is on the host and contiguous.

    Any array that speaks DLPack is taken. One that requires a gradient is detached, one on a device copied to the host.

    Args:
        points: Shape (n, k).
        header: Time and frame.
        names: Of the values: the first k of them.

    Raises:
        ValueError: The shape is another, or PointCloud2 has no such type.
    """
    detached: Any = points.detach().cpu() if hasattr(points, "detach") else points
    return PointCloud.from_array(np.from_dlpack(detached), header, names)


def to_open3d(cloud: PointCloud) -> open3d.t.geometry.PointCloud:
    """A cloud of Open3D on the host, with `positions` of shape (n, 3), float32, and the other fields as attributes.

    Positions share the cloud's memory where they are float32, nothing lies between them, and it is not read-only; other
    attributes, of shape (n, 1) or (n, count), are copied. `.to_legacy()` makes the older class of it.

    Raises:
        ValueError: There is no x, y or z; or as of `PointCloud.to_array`.
        ImportError: Open3D is not installed.
    """
    try:
        import open3d as o3d  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError("to_open3d needs Open3D, which is not installed: pip install open3d") from error

    points = cloud.to_array().reshape(-1)
    xyz = np.ascontiguousarray(_side_by_side(points, _POSITIONS), np.float32)
    made = o3d.t.geometry.PointCloud(o3d.core.Tensor.from_numpy(_writable(xyz)))
    for name in points.dtype.names or ():
        if name in _POSITIONS:
            continue
        values = points[name] if points[name].ndim > 1 else points[name][:, None]
        made.point[name] = o3d.core.Tensor(np.ascontiguousarray(values, values.dtype.newbyteorder("=")))
    return made


def _writable(values: np.ndarray) -> np.ndarray:
    """The same memory, or a copy of what is read-only: Open3D takes no such array."""
    return values if values.flags.writeable else values.copy()


def from_open3d(cloud: Any, header: Header | None = None) -> PointCloud:
    """A cloud of one of Open3D, of its tensors or of the older class; on the host, a copy.

    Args:
        cloud: `open3d.t.geometry.PointCloud`, all attributes of which become fields, those of several columns with as
            many values; or `open3d.geometry.PointCloud`, of which positions are taken.
        header: Time and frame.

    Raises:
        TypeError: It is neither.
    """
    if hasattr(cloud, "points") and not hasattr(cloud, "point"):
        return PointCloud.from_array(np.asarray(cloud.points, np.float32), header, _POSITIONS)
    if not hasattr(cloud, "point"):
        raise TypeError(f"expected a point cloud of Open3D, not {type(cloud).__name__}")
    columns = {name: cloud.point[name].cpu().numpy() for name in cloud.point}
    xyz = columns.pop("positions")
    parts = {axis: xyz[:, number] for number, axis in enumerate(_POSITIONS)}
    parts |= {name: values[:, 0] if values.shape[1:] == (1,) else values for name, values in sorted(columns.items())}
    return PointCloud.from_array(_table(parts), header)


def _table(columns: dict[str, np.ndarray]) -> np.ndarray:
    """A structured array of columns."""
    layout = [(name, values.dtype.newbyteorder("="), values.shape[1:]) for name, values in columns.items()]
    table = np.empty(len(next(iter(columns.values()))), layout)
    for name, values in columns.items():
        table[name] = values
    return table


def read_pcd(path: str | os.PathLike, header: Header | None = None) -> PointCloud:
    """Reads a PCD file of any kind, with all its fields and their types.

    Args:
        path: The file: ascii, binary or binary_compressed.
        header: Time and frame, which such a file does not have.

    Raises:
        SourceError: It cannot be read, is no PCD file, or is damaged.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}") from error
    columns, rows, _ = decode_pcd_columns(data, path)
    wide = [name for name, values in columns.items() if values.dtype.kind in "iu" and values.dtype.itemsize == 8]
    if wide:
        raise SourceError(f"{path}: field {wide[0]!r} has integers of 64 bits, which a point cloud message cannot hold")
    table = _table(columns)
    return PointCloud.from_array(table.reshape(rows, -1) if rows > 1 else table, header)


def write_pcd(
    path: str | os.PathLike,
    cloud: PointCloud,
    form: Literal["ascii", "binary", "binary_compressed"] = "binary",
) -> None:
    """Writes a PCD file, version 0.7, with all fields of a cloud; one that is there is replaced once it is written.

    Args:
        path: The file.
        cloud: The points.
        form: How the points are written. Numbers in ascii are long enough to be read back to the bit.

    Raises:
        ValueError: The form is none of these; or as of `PointCloud.to_array`.
        SinkError: The file cannot be written.
    """
    data = encode_pcd(cloud.to_array(), form)
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        beside.write_bytes(data)
        beside.replace(path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise SinkError(f"{path}: cannot be written: {error.strerror}") from error
