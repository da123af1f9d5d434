"""The few things of an ONNX file that are read, or set, without the onnx package: it is a tree of protobuf messages.

Field numbers are those of `onnx.proto`: of ModelProto `graph` 7, `opset_import` 8, `metadata_props` 14; of GraphProto
`node` 1, `initializer` 5, `input` 11, `output` 12, `value_info` 13. A truncated or hostile file is an error in bounded
time: every number is at most ten bytes, every part lies inside its whole, and nothing is followed without end.
"""

from __future__ import annotations

from collections.abc import Iterator

__all__ = ["NotOnnxError", "external_data", "opset", "stamp", "with_batch"]

_GRAPH, _OPSETS = 7, 8
_INITIALIZERS, _SHAPED = 5, (11, 12, 13)
_DATA_LOCATION, _EXTERNAL = 14, 1
_VARINT_BYTES = 10


class NotOnnxError(ValueError):
    """The bytes are no ONNX model."""


def _varint(data: bytes, at: int, end: int) -> tuple[int, int]:
    value = 0
    for k in range(_VARINT_BYTES):
        if at >= end:
            raise NotOnnxError("it ends within a number")
        byte = data[at]
        value |= (byte & 0x7F) << (7 * k)
        at += 1
        if byte < 0x80:
            return value, at
    raise NotOnnxError("a number of more than ten bytes")


def _fields(data: bytes, at: int, end: int) -> Iterator[tuple[int, int, int, int]]:
    """The fields of a message: number, value of a plain number (else 0), and where its bytes begin and end."""
    while at < end:
        key, at = _varint(data, at, end)
        kind, value = key & 7, 0
        start = at
        if kind == 0:
            value, at = _varint(data, at, end)
        elif kind == 2:
            size, start = _varint(data, at, end)
            at = start + size
        elif kind in (1, 5):
            at += 8 if kind == 1 else 4
        else:
            raise NotOnnxError(f"a field of the unknown kind {kind}")
        if at > end:
            raise NotOnnxError("a part is longer than the whole")
        yield key >> 3, value, start, at


def _parts(data: bytes, spans: list[tuple[int, int]], *numbers: int) -> list[tuple[int, int]]:
    """The places of all fields of these numbers within messages at places."""
    return [(a, b) for start, end in spans for number, _, a, b in _fields(data, start, end) if number in numbers]


def opset(data: bytes) -> int:
    """The version of the default operator set.

    Raises:
        NotOnnxError: It is no ONNX model.
    """
    whole = [(0, len(data))]
    for start, end in _parts(data, whole, _OPSETS):
        fields = {number: (value, a, b) for number, value, a, b in _fields(data, start, end)}
        domain = fields.get(1, (0, 0, 0))
        if domain[1] == domain[2] and 2 in fields and _parts(data, whole, _GRAPH):
            return fields[2][0]
    raise NotOnnxError("it has no graph of the default operator set")


def external_data(data: bytes) -> bool:
    """Whether weights lie in other files, which the sha256 of this one says nothing of.

    Raises:
        NotOnnxError: It is no ONNX model.
    """
    tensors = _parts(data, _parts(data, [(0, len(data))], _GRAPH), _INITIALIZERS)
    return any(
        number == _DATA_LOCATION and value == _EXTERNAL
        for start, end in tensors
        for number, value, _, _ in _fields(data, start, end)
    )


def with_batch(data: bytes, batch: int) -> bytes:
    """The same network for several inputs at once, where its batch is written as 1.

    Only for networks that treat each input by itself, as convolutions do.

    Args:
        data: An ONNX model whose every input, output and known shape begins with 1.
        batch: 1 to 127.

    Raises:
        NotOnnxError: It is no ONNX model.
        ValueError: The batch is out of range.
    """
    if not 1 <= batch <= 127:
        raise ValueError(f"batch must be 1 to 127, not {batch}")
    changed = bytearray(data)
    graphs = _parts(data, [(0, len(data))], _GRAPH)
    # ValueInfoProto.type 2 . TypeProto.tensor_type 1 . shape 2 . dim 1 . dim_value 1
    tensors = _parts(data, _parts(data, _parts(data, graphs, *_SHAPED), 2), 1)
    for start, end in _parts(data, tensors, 2):
        first = _parts(data, [(start, end)], 1)[:1]
        for a, b in first:
            for number, value, at, _ in _fields(data, a, b):
                if number == 1 and value == 1:
                    changed[at] = batch
    return bytes(changed)


def stamp(data: bytes, **notes: str) -> bytes:
    """The model with notes in its metadata, which ONNX Runtime gives back as `custom_metadata_map`."""

    def length(size: int) -> bytes:
        out = bytearray()
        while size > 0x7F:
            out.append(size & 0x7F | 0x80)
            size >>= 7
        return bytes([*out, size])

    def text(number: int, value: str) -> bytes:
        encoded = value.encode()
        return bytes([number << 3 | 2]) + length(len(encoded)) + encoded

    for key, value in notes.items():
        entry = text(1, key) + text(2, value)
        data += bytes([14 << 3 | 2]) + length(len(entry)) + entry
    return data
