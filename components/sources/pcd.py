"""PCD files: point clouds of the Point Cloud Library, as text, binary or compressed binary.

Source: the PCD file format, version 0.7, https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

import io

import numpy as np

from ...errors import SourceError
from ..lzf import lzf_decompress
from .scan import Scan, scan_from_columns

__all__ = ["decode_pcd", "decode_pcd_columns"]

_MAX_HEADER = 65536
_KEYS = ("VERSION", "FIELDS", "COLUMNS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")
_TYPES = {("F", 4): "<f4", ("F", 8): "<f8"} | {
    (kind, size): f"<{kind.lower()}{size}" for kind in "IU" for size in (1, 2, 4, 8)
}


def decode_pcd(data: bytes, where: object) -> Scan:
    """Decodes the bytes of a PCD file. The sensor's pose (VIEWPOINT) is not applied.

    Args:
        data: The whole file.
        where: The file, for errors.

    Raises:
        SourceError: The header is not that of a PCD file, or there are fewer points than it says.
    """
    columns, _, kind = decode_pcd_columns(data, where)
    plain = {name: column for name, column in columns.items() if column.ndim == 1}
    return scan_from_columns(plain, format=f"PCD, {kind}", where=where)


def decode_pcd_columns(data: bytes, where: object) -> tuple[dict[str, np.ndarray], int, str]:
    """Decodes all fields of a PCD file but padding: the columns, how many rows the points lie in, and the kind of file.

    Args:
        data: The whole file.
        where: The file, for errors.

    Returns:
        Columns of shape (n,) or (n, count) in the types of the file, by name; rows, 1 where the points have no order;
        ascii, binary or binary_compressed.

    Raises:
        SourceError: As of `decode_pcd`.
    """
    header, body = _header(data, where)
    names, layout = _layout(header, where)
    points = _points(header, where)
    kind = header["DATA"][0].lower()
    if kind == "ascii":
        columns = _ascii(body, layout, points, where)
    elif kind == "binary":
        if len(body) < points * layout.itemsize:
            raise SourceError(
                f"{where}: truncated: {points} points of {layout.itemsize} bytes are {points * layout.itemsize} bytes, "
                f"and {len(body)} follow the header"
            )
        table = np.frombuffer(body, layout, count=points)
        columns = {name: table[name] for name in layout.names or ()}
    elif kind == "binary_compressed":
        columns = _compressed(body, layout, points, where)
    else:
        raise SourceError(f"{where}: DATA is {kind!r}; known are ascii, binary and binary_compressed")
    rows = _integers(header, "HEIGHT", where)[0] if "HEIGHT" in header else 1
    ordered = rows > 1 and "WIDTH" in header and _integers(header, "WIDTH", where)[0] * rows == points
    named = {name: columns[key] for key, name in names.items() if name != "_"}
    return named, rows if ordered else 1, kind


def _header(data: bytes, where: object) -> tuple[dict[str, list[str]], memoryview]:
    header: dict[str, list[str]] = {}
    start = 0
    while "DATA" not in header:
        end = data.find(b"\n", start, _MAX_HEADER)
        if end < 0:
            raise SourceError(f"{where}: not a PCD file, or truncated: its header has no line DATA")
        words = data[start:end].decode("latin-1").split()
        start = end + 1
        if not words or words[0].startswith("#"):
            continue
        key = words[0].upper()
        if key not in _KEYS:
            raise SourceError(f"{where}: not a PCD file: a line of its header starts with {words[0][:30]!r}")
        if len(words) < 2:
            raise SourceError(f"{where}: line {key} of its header is empty")
        header["FIELDS" if key == "COLUMNS" else key] = words[1:]
    return header, memoryview(data)[start:]


def _integers(header: dict[str, list[str]], key: str, where: object) -> list[int]:
    try:
        values = [int(word) for word in header[key]]
    except ValueError:
        values = [-1]
    if min(values) < 0 or max(values) >= 1 << 40:
        raise SourceError(f"{where}: {key} is {' '.join(header[key])[:60]!r}; expected whole numbers")
    return values


def _layout(header: dict[str, list[str]], where: object) -> tuple[dict[str, str], np.dtype]:
    """Keys of the columns to the names of the fields, and the layout of a point."""
    for key in ("FIELDS", "SIZE", "TYPE"):
        if key not in header:
            raise SourceError(f"{where}: its header has no line {key}")
    fields, kinds = header["FIELDS"], header["TYPE"]
    sizes = _integers(header, "SIZE", where)
    counts = _integers(header, "COUNT", where) if "COUNT" in header else [1] * len(fields)
    if not len(fields) == len(sizes) == len(kinds) == len(counts):
        raise SourceError(
            f"{where}: FIELDS, SIZE, TYPE and COUNT have {len(fields)}, {len(sizes)}, {len(kinds)} and {len(counts)} "
            "entries; one of each a field is expected"
        )
    columns = []
    for index, (kind, size, count) in enumerate(zip(kinds, sizes, counts, strict=True)):
        dtype = _TYPES.get((kind.upper(), size))
        if dtype is None or not 1 <= count <= 4096:
            raise SourceError(
                f"{where}: field {fields[index]!r} has TYPE {kind}, SIZE {size}, COUNT {count}: no such type"
            )
        columns.append((f"{index}", dtype) if count == 1 else (f"{index}", dtype, (count,)))
    return {f"{index}": name for index, name in enumerate(fields)}, np.dtype(columns)


def _points(header: dict[str, list[str]], where: object) -> int:
    if "POINTS" in header:
        return _integers(header, "POINTS", where)[0]
    if "WIDTH" not in header:
        raise SourceError(f"{where}: its header has neither POINTS nor WIDTH")
    height = _integers(header, "HEIGHT", where)[0] if "HEIGHT" in header else 1
    return _integers(header, "WIDTH", where)[0] * height


def _ascii(body: memoryview, layout: np.dtype, points: int, where: object) -> dict[str, np.ndarray]:
    widths = [int(np.prod(layout[name].shape, dtype=np.int64)) for name in layout.names or ()]
    if points:
        try:
            table = np.loadtxt(io.BytesIO(body), np.float64, ndmin=2, max_rows=points)
        except (ValueError, UnicodeDecodeError) as error:
            raise SourceError(f"{where}: its points cannot be read as text: {error}") from None
    else:
        table = np.empty((0, sum(widths)))
    if len(table) < points:
        raise SourceError(f"{where}: truncated: the header says {points} points, and {len(table)} lines follow")
    if table.shape[1] != sum(widths):
        raise SourceError(f"{where}: a line has {table.shape[1]} numbers; the header's fields make {sum(widths)}")
    starts = np.cumsum([0, *widths])
    columns = {}
    for name, start, width in zip(layout.names or (), starts, widths, strict=False):
        base = layout[name].base
        column = table[:, start] if width == 1 else table[:, start : start + width]
        # NaN and numbers beyond the type cannot be integers: such a column stays what it was read as.
        if base.kind in "iu" and len(column):
            limits = np.iinfo(base)
            if not (np.isfinite(column).all() and column.min() >= limits.min and column.max() < float(limits.max) + 1):
                raise SourceError(f"{where}: a number does not fit the type {base} of its field")
        with np.errstate(over="ignore"):
            columns[name] = column.astype(base)
    return columns


def _compressed(body: memoryview, layout: np.dtype, points: int, where: object) -> dict[str, np.ndarray]:
    """Fields one after the other, packed together."""
    if len(body) < 8:
        raise SourceError(f"{where}: truncated: the sizes of the compressed data are missing")
    packed, size = (int(value) for value in np.frombuffer(body[:8], "<u4"))
    if size != points * layout.itemsize:
        raise SourceError(
            f"{where}: {points} points of {layout.itemsize} bytes are {points * layout.itemsize} bytes, "
            f"and the compressed data says {size}"
        )
    if len(body) < 8 + packed:
        raise SourceError(f"{where}: truncated: {packed} bytes of compressed data expected, {len(body) - 8} follow")
    try:
        raw = lzf_decompress(bytes(body[8 : 8 + packed]), size)
    except ValueError as error:
        raise SourceError(f"{where}: {error}") from None
    columns, start = {}, 0
    for name in layout.names or ():
        part = layout[name]
        column = np.frombuffer(raw, part.base, count=points * (part.itemsize // part.base.itemsize), offset=start)
        columns[name] = column.reshape(points, *part.shape)
        start += points * part.itemsize
    return columns
