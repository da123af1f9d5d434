"""PCD files: point clouds of the Point Cloud Library, as text, binary or compressed binary.

Source: the PCD file format, version 0.7, https://pointclouds.org/documentation/tutorials/pcd_file_format.html;
the compression is Marc Lehmann's LibLZF.
"""

from __future__ import annotations

import io

import numpy as np

from ...errors import SourceError
from .scan import Scan, scan_from_columns

__all__ = ["decode_pcd", "lzf_decompress"]

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
    named = {name: columns[key] for key, name in names.items() if columns[key].ndim == 1}
    return scan_from_columns(named, format=f"PCD, {kind}", where=where)


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
        columns[name] = column.astype(base) if base.kind in "iu" else column
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


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Unpacks LZF data.

    A control byte below 32 is followed by that many bytes and one more, taken as they are; any other is a copy of what
    was unpacked before: its upper three bits are the length less two (seven: one more byte is added), its lower five
    bits and the next byte the distance back less one.

    Args:
        data: The packed bytes.
        size: How many bytes they make.

    Raises:
        ValueError: They are damaged, or do not make that many bytes.
    """
    # The longest copy makes 264 bytes of three: more than that in all is a lie, told before memory is taken for it.
    if size > 88 * len(data):
        raise ValueError(f"damaged: {len(data)} compressed bytes cannot make {size}")
    out = bytearray(size)
    position = made = 0
    end = len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:
                length = control + 1
                if position + length > end or made + length > size:
                    raise IndexError
                out[made : made + length] = data[position : position + length]
                position += length
            else:
                length = control >> 5
                if length == 7:
                    length += data[position]
                    position += 1
                length += 2
                begin = made - ((control & 31) << 8) - data[position] - 1
                position += 1
                if begin < 0 or made + length > size:
                    raise IndexError
                distance = made - begin
                if distance >= length:
                    out[made : made + length] = out[begin : begin + length]
                else:  # the copy runs into itself: a pattern that repeats
                    pattern = out[begin:made]
                    out[made : made + length] = (pattern * (length // distance + 1))[:length]
            made += length
    except IndexError:
        raise ValueError(f"damaged compressed data near byte {position}") from None
    if made != size:
        raise ValueError(f"damaged: the compressed data makes {made} bytes, not {size}")
    return bytes(out)
