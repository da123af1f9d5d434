"""PLY files: the vertices of a polygon file as a point cloud, as text or binary of either byte order.

Source: Greg Turk, The PLY Polygon File Format, 1994.
"""

from __future__ import annotations

import io
import itertools

import numpy as np

from ...errors import SourceError
from .scan import Scan, scan_from_columns

__all__ = ["decode_ply"]

_MAX_HEADER = 65536
_MAX_COUNT = 1 << 40
_FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"}
_TYPES |= {"float32": "f4", "float64": "f8"}


class _Element:
    """One kind of thing in the file: how many there are, and the names and types of their properties."""

    def __init__(self, name: str, count: int):
        self.name, self.count = name, count
        self.properties: list[tuple[str, str]] = []
        self.has_list = False


def decode_ply(data: bytes, where: object) -> Scan:
    """Decodes the bytes of a PLY file; faces and other elements are left out.

    Args:
        data: The whole file.
        where: The file, for errors.

    Raises:
        SourceError: The header is not that of a PLY file, or there are fewer vertices than it says.
    """
    format, elements, body = _header(data, where)
    before = list(itertools.takewhile(lambda element: element.name != "vertex", elements))
    if len(before) == len(elements):
        raise SourceError(f"{where}: it has no element vertex, so no points")
    vertex = elements[len(before)]
    if vertex.has_list or (format != "ascii" and any(element.has_list for element in before)):
        raise SourceError(f"{where}: a list among the vertices, or before them in a binary file, is not supported")
    names = [name for name, _ in vertex.properties]
    if len(set(names)) < len(names):
        raise SourceError(f"{where}: two properties of its vertices have the same name")
    if format == "ascii":
        columns = _ascii(body, sum(element.count for element in before), vertex, where)
    else:
        order = _FORMATS[format]
        start = sum(element.count * _layout(element, order).itemsize for element in before)
        layout = _layout(vertex, order)
        expected = start + vertex.count * layout.itemsize
        if len(body) < expected:
            raise SourceError(f"{where}: truncated: {expected} bytes expected after the header, {len(body)} follow")
        table = np.frombuffer(body[start:expected], layout)
        columns = {name: table[name].astype(table[name].dtype.newbyteorder("=")) for name in names}
    return scan_from_columns(columns, format=f"PLY, {format}", where=where)


def _layout(element: _Element, order: str) -> np.dtype:
    return np.dtype([(f"{name}", order + kind) for name, kind in element.properties])


def _header(data: bytes, where: object) -> tuple[str, list[_Element], memoryview]:
    format, elements = "", list[_Element]()
    start, first = 0, True
    while True:
        end = data.find(b"\n", start, _MAX_HEADER)
        line = data[start : end if end >= 0 else start].decode("latin-1").strip()
        if end < 0 or (first and line != "ply"):
            raise SourceError(
                f"{where}: not a PLY file, or truncated: its header does not go from 'ply' to 'end_header'"
            )
        start, first = end + 1, False
        match line.split():
            case ["ply"] | [] | ["comment", *_] | ["obj_info", *_]:
                pass
            case ["format", str(word), _] if word in _FORMATS:
                format = word
            case ["element", str(name), str(count)] if count.isdecimal() and int(count) < _MAX_COUNT:
                elements.append(_Element(name, int(count)))
            case ["property", "list", _, _, _] if elements:
                elements[-1].has_list = True
            case ["property", str(kind), str(name)] if kind in _TYPES and elements:
                elements[-1].properties.append((name, _TYPES[kind]))
            case ["end_header"]:
                break
            case _:
                raise SourceError(f"{where}: its header has a line that is not known: {line[:60]!r}")
    if not format:
        raise SourceError(f"{where}: its header has no line 'format'")
    return format, elements, memoryview(data)[start:]


def _ascii(body: memoryview, skip: int, vertex: _Element, where: object) -> dict[str, np.ndarray]:
    width = len(vertex.properties)
    table = np.empty((0, width))
    if vertex.count:
        lines = io.BytesIO(body)
        if sum(1 for _ in itertools.islice(lines, skip)) < skip:
            raise SourceError(f"{where}: truncated before its vertices")
        try:
            table = np.loadtxt(lines, np.float64, ndmin=2, max_rows=vertex.count)
        except (ValueError, UnicodeDecodeError) as error:
            raise SourceError(f"{where}: its vertices cannot be read as text: {error}") from None
    if len(table) < vertex.count:
        raise SourceError(f"{where}: truncated: the header says {vertex.count} vertices, and {len(table)} lines follow")
    if table.shape[1] != width:
        raise SourceError(f"{where}: a line has {table.shape[1]} numbers; a vertex has {width} properties")
    columns = {}
    for index, (name, kind) in enumerate(vertex.properties):
        column, dtype = table[:, index], np.dtype(kind)
        if dtype.kind in "iu" and len(column):
            limits = np.iinfo(dtype)
            if not (np.isfinite(column).all() and column.min() >= limits.min and column.max() <= limits.max):
                raise SourceError(f"{where}: a number does not fit the type of the property {name!r}")
            column = column.astype(dtype)
        columns[name] = column
    return columns
