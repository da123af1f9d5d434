"""Writes PCD files, version 0.7: as text, binary or compressed binary.

Source: https://pointclouds.org/documentation/tutorials/pcd_file_format.html.
"""

from __future__ import annotations

import io

import numpy as np

from ..lzf import lzf_compress

__all__ = ["encode_pcd"]

_KINDS = {"f": "F", "i": "I", "u": "U"}
_DIGITS = {4: "%.9g", 8: "%.17g"}
"""By size of a float: as many as are read back to the bit."""


def encode_pcd(points: np.ndarray, form: str = "binary") -> bytes:
    """The bytes of a PCD file.

    Args:
        points: A structured array with a field for each value, shape (n,) or (rows, n).
        form: ascii, binary or binary_compressed.

    Raises:
        ValueError: The form is none of these, or a field has a name or a type that PCD has none for.
    """
    if form not in ("ascii", "binary", "binary_compressed"):
        raise ValueError(f"form must be ascii, binary or binary_compressed, not {form!r}")
    rows, width = (1, len(points)) if points.ndim == 1 else points.shape
    columns: dict[str, np.ndarray] = {}
    for name in points.dtype.names or ():
        of_point = points.dtype[name].shape
        values = points[name].reshape(rows * width, int(np.prod(of_point, dtype=int)))
        if values.dtype.kind not in _KINDS or values.dtype.itemsize not in (1, 2, 4, 8) or values.dtype == np.float16:
            raise ValueError(f"field {name!r} is of {values.dtype}: PCD has integers and floats of 32 and 64 bits")
        if not name.isascii() or name.split() != [name]:
            raise ValueError(f"field {name!r}: a name in a PCD file is one word of ASCII")
        columns[name] = values.astype(values.dtype.newbyteorder("<"), copy=False)
    return _header(columns, width, rows, form) + _body(columns, rows * width, form)


def _header(columns: dict[str, np.ndarray], width: int, rows: int, form: str) -> bytes:
    lines = {
        "VERSION": ["0.7"],
        "FIELDS": columns,
        "SIZE": [values.dtype.itemsize for values in columns.values()],
        "TYPE": [_KINDS[values.dtype.kind] for values in columns.values()],
        "COUNT": [values.shape[1] for values in columns.values()],
        "WIDTH": [width],
        "HEIGHT": [rows],
        "VIEWPOINT": [0, 0, 0, 1, 0, 0, 0],
        "POINTS": [width * rows],
        "DATA": [form],
    }
    text = "".join(f"{key} {' '.join(map(str, words))}\n" for key, words in lines.items())
    return f"# .PCD v0.7 - Point Cloud Data file format\n{text}".encode("ascii")


def _body(columns: dict[str, np.ndarray], points: int, form: str) -> bytes:
    if form == "binary_compressed":
        raw = b"".join(values.tobytes() for values in columns.values())
        packed = lzf_compress(raw)
        return np.array([len(packed), len(raw)], "<u4").tobytes() + packed
    layout = [(name, values.dtype, values.shape[1:]) for name, values in columns.items()]
    table = np.empty(points, layout)
    for name, values in columns.items():
        table[name] = values
    if form == "binary":
        return table.tobytes()
    formats = [
        "%d" if values.dtype.kind in "iu" else _DIGITS[values.dtype.itemsize]
        for values in columns.values()
        for _ in range(values.shape[1])
    ]
    lines = io.StringIO()
    for row in zip(*(column for values in columns.values() for column in values.T.tolist()), strict=True):
        lines.write(" ".join(text % value for text, value in zip(formats, row, strict=True)))
        lines.write("\n")
    return lines.getvalue().encode("ascii")
