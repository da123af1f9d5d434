"""The lossless binary form of messages: what is decoded equals what was encoded, to the bit of every float.

A value is one byte that says its kind, then its content, little-endian:

    N None · T True · F False · i int (8 bytes) · I int (length, two's complement) · f float (8 bytes) · s str · b bytes
    a array (dtype, number of dimensions, shape, bytes in C order) · n NumPy scalar (dtype, bytes)
    t tuple · l list · d dict (count, then the values, or keys and values in their order)
    m message: the name of its type, count of fields, then name and value of each
    r array by reference (dtype, number of dimensions, shape, number of a memory, offset in it), where `encode` is given
      a place for arrays; who decodes gives the memories

Lengths and counts are 4 bytes, the sizes of arrays 8. The same value makes the same bytes, so that bytes, or a hash of
them, can be compared in place of values. Nothing is ever executed: only registered types are made, by their fields.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import json
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from ..payload import host_array, is_device_array

__all__ = ["Decoder", "MessageType", "decode", "encode", "message", "message_type"]

T = TypeVar("T", bound=type)
Place = Callable[[np.ndarray], "tuple[int, int] | None"]

_DEEPEST = 64
_INT = struct.Struct("<q")
_FLOAT = struct.Struct("<d")
_COUNT = struct.Struct("<I")
_PLACE = struct.Struct("<IQ")
_STR = ord("s")
_forms: dict[bytes, tuple[np.dtype, int, struct.Struct]] = {}
"""Types of arrays with their numbers of dimensions, by their bytes."""
_references: dict[bytes, tuple[np.dtype, Callable[..., tuple], int]] = {}
"""The same of arrays by reference, with what unpacks shape and place, and the size of these [B]."""


@dataclass(frozen=True)
class MessageType:
    """A type that can be encoded, and made again from its fields."""

    cls: type
    name: str
    """How recordings call it; it must stay the same when the code moves."""
    fields: tuple[str, ...]
    optional: frozenset[str]
    """Fields with a default, which an older recording may lack."""
    make: Callable[[dict[str, Any]], Any]

    def schema(self) -> str:
        """The fields and their types as JSON, for people and for other readers."""
        hints = getattr(self.cls, "__annotations__", {})
        fields = {name: hints[name] if isinstance(hints.get(name), str) else "" for name in self.fields}
        return json.dumps({"name": self.name, "fields": fields})


_by_class: dict[type, MessageType] = {}
_by_name: dict[str, MessageType] = {}


def message(name: str) -> Callable[[T], T]:
    """Registers a dataclass, a named tuple or an enumeration as a message, under a name of its own.

        @message("my_robot.Battery")
        @dataclass(frozen=True)
        class Battery:
            volts: float

    Raises:
        TypeError: The class is none of these, or has a field that its constructor does not take.
        ValueError: The name stands for another class already.
    """

    def register(cls: T) -> T:
        known = _by_name.get(name)
        if known is not None and known.cls is not cls and known.cls.__qualname__ != cls.__qualname__:
            raise ValueError(f"the message name {name!r} stands for {known.cls.__qualname__} already")
        kind = _describe(cls, name)
        _by_class[cls], _by_name[name] = kind, kind
        return cls

    return register


def message_type(cls: type) -> MessageType | None:
    """What is known of a class; None where it is not registered."""
    return _by_class.get(cls)


def _describe(cls: type, name: str) -> MessageType:
    if dataclasses.is_dataclass(cls):
        fields = dataclasses.fields(cls)
        hidden = [field.name for field in fields if not field.init]
        if hidden:
            raise TypeError(f"{cls.__name__} cannot be a message: its constructor does not take {', '.join(hidden)}")
        missing = dataclasses.MISSING
        optional = [f.name for f in fields if f.default is not missing or f.default_factory is not missing]
        return MessageType(
            cls, name, tuple(field.name for field in fields), frozenset(optional), lambda values: cls(**values)
        )
    if issubclass(cls, enum.Enum):
        return MessageType(cls, name, ("value",), frozenset(), lambda values: cls(values["value"]))
    if issubclass(cls, tuple) and hasattr(cls, "_fields"):
        optional = frozenset(getattr(cls, "_field_defaults", {}))
        return MessageType(cls, name, tuple(cls._fields), optional, lambda values: cls(**values))
    raise TypeError(f"{cls.__name__} is neither a dataclass nor a named tuple nor an enumeration: it has no fields")


def encode(value: Any, place: Place | None = None) -> bytes:
    """The bytes of a value.

    Args:
        value: None, bool, int, float, str, bytes, arrays and scalars of NumPy, tuples, lists, dicts, and messages.
        place: Says where an array lies that is not to be among the bytes: number of a memory that `decode` is given,
            and offset in it; None where it is to be. Arrays on a device then count too, as their copies on the host.

    Raises:
        TypeError: It holds something else; says where, and of which type.
    """
    parts: list[Any] = []
    _put(value, parts, 0, place)
    return b"".join(parts)


def _put(value: Any, parts: list[Any], depth: int, place: Place | None = None) -> None:
    if depth > _DEEPEST:
        raise TypeError(f"it is nested deeper than {_DEEPEST} levels")
    cls = type(value)
    if cls is np.ndarray:
        _put_array(value, parts, place)
    elif value is None:
        parts.append(b"N")
    elif cls is bool:
        parts.append(b"T" if value else b"F")
    elif cls is int:
        if -(1 << 63) <= value < 1 << 63:
            parts.append(b"i" + _INT.pack(value))
        else:
            _put_bytes(b"I", value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True), parts)
    elif cls is float:
        parts.append(b"f" + _FLOAT.pack(value))
    elif cls is str:
        _put_bytes(b"s", value.encode("utf-8", "surrogatepass"), parts)
    elif cls is bytes:
        _put_bytes(b"b", value, parts)
    elif cls is tuple or cls is list:
        parts.append((b"t" if cls is tuple else b"l") + _COUNT.pack(len(value)))
        for index, item in enumerate(value):
            try:
                _put(item, parts, depth + 1, place)
            except TypeError as error:
                raise TypeError(f"[{index}]: {error}") from None
    elif cls is dict:
        parts.append(b"d" + _COUNT.pack(len(value)))
        for key, item in value.items():
            try:
                _put(key, parts, depth + 1)
            except TypeError as error:
                raise TypeError(f"a key: {error}") from None
            try:
                _put(item, parts, depth + 1, place)
            except TypeError as error:
                raise TypeError(f"[{key!r}]: {error}") from None
    elif (kind := _by_class.get(cls)) is not None:
        head, names = _heads(kind)
        parts.append(head)
        for name, field in zip(kind.fields, names):  # noqa: B905  (as long as each other; strict takes longer)
            parts.append(field)
            try:
                _put(getattr(value, name), parts, depth + 1, place)
            except TypeError as error:
                raise TypeError(f"{cls.__name__}.{name}: {error}") from None
    elif isinstance(value, np.generic) and not value.dtype.hasobject:
        parts.append(b"n")
        _put(_dtype_text(value.dtype), parts, depth + 1)
        _put_bytes(b"", value.tobytes(), parts)
    elif place is not None and is_device_array(value):
        _put_array(host_array(value), parts, place)
    else:
        raise TypeError(
            f"{cls.__module__}.{cls.__qualname__} is not a message: register it with warploom.datamesh.messages.message"
        )


@functools.lru_cache(maxsize=1024)
def _heads(kind: MessageType) -> tuple[bytes, tuple[bytes, ...]]:
    """What stands before the fields of a message, and before each of them."""
    parts: list[Any] = []
    _put_bytes(b"m", kind.name.encode(), parts)
    names = [name.encode() for name in kind.fields]
    return b"".join((*parts, _COUNT.pack(len(names)))), tuple(_COUNT.pack(len(name)) + name for name in names)


def _put_bytes(kind: bytes, content: bytes, parts: list[Any]) -> None:
    if len(content) >= 1 << 32:
        raise TypeError(f"{len(content)} bytes in one text: at most 4 GiB")
    parts.append(kind + _COUNT.pack(len(content)))
    parts.append(content)


def _put_array(array: np.ndarray, parts: list[Any], place: Place | None) -> None:
    if array.dtype.hasobject:
        raise TypeError(f"an array of {array.dtype}: Python objects have no bytes of their own")
    where = None if place is None or not array.size else place(array)
    shape = array.shape
    if where is not None:
        head, pack = _reference_head(array.dtype, len(shape))
        parts.append(head + pack(*shape, *where))
        return
    parts.append(b"a" + _dtype_bytes(array.dtype) + struct.pack(f"<I{len(shape)}Q", len(shape), *shape))
    # A view of the memory: it is copied once, when the parts are joined. Dates have no buffer, bytes have.
    parts.append(np.ascontiguousarray(array).reshape(-1).view(np.uint8).data if array.size else b"")


@functools.lru_cache(maxsize=256)
def _reference_head(dtype: np.dtype, dimensions: int) -> tuple[bytes, Callable[..., bytes]]:
    """What stands before the shape of an array by reference, and what packs its shape and where it lies."""
    return b"r" + _dtype_bytes(dtype) + _COUNT.pack(dimensions), struct.Struct(f"<{dimensions}QIQ").pack


@functools.lru_cache(maxsize=256)
def _dtype_bytes(dtype: np.dtype) -> bytes:
    return encode(_dtype_text(dtype))


def _dtype_text(dtype: np.dtype) -> Any:
    """A dtype as plain values: a text, or for a record the list of its fields."""
    described = np.lib.format.dtype_to_descr(dtype)
    return described if isinstance(described, str) else [list(map(_plain, field)) for field in described]


def _plain(part: Any) -> Any:
    return [_plain(inner) for inner in part] if isinstance(part, (tuple, list)) else part


def _dtype_of(text: Any) -> np.dtype:
    return _dtype_named(text) if isinstance(text, str) else _dtype_described(text)


@functools.lru_cache(maxsize=256)
def _dtype_named(text: str) -> np.dtype:
    return _dtype_described(text)


def _dtype_described(text: Any) -> np.dtype:
    try:
        dtype = np.lib.format.descr_to_dtype(text if isinstance(text, str) else _fields_of(text))
    except Exception as error:
        raise ValueError(f"{text!r} is no type of an array") from error
    if dtype.hasobject or dtype.itemsize == 0:
        raise ValueError(f"{text!r} is no type of an array that has bytes")
    return dtype


def _fields_of(fields: Any) -> list[tuple]:
    result = []
    for field in fields:
        name, kind, *shape = field
        kind = kind if isinstance(kind, str) else _fields_of(kind)
        result.append((tuple(name) if isinstance(name, list) else name, kind, *(tuple(size) for size in shape)))
    return result


def decode(data: bytes | memoryview, memories: Sequence[np.ndarray] = ()) -> Any:
    """The value that was encoded; arrays are copies with memory of their own, those by reference are views.

    Args:
        data: The bytes.
        memories: Where arrays by reference lie, each of shape (size,), uint8.

    Raises:
        ValueError: The bytes are truncated or damaged, refer to memory that is not there, or hold a message of a type
            that is not registered.
    """
    decoder = Decoder(data, memories)
    value = decoder.value()
    if decoder.position != len(decoder.data):
        raise ValueError(f"{len(decoder.data) - decoder.position} bytes are left behind the value")
    return value


class Decoder:
    """Reads values one after the other; never beyond the end, and never more than the bytes can hold."""

    def __init__(self, data: bytes | memoryview, memories: Sequence[np.ndarray] = ()) -> None:
        self.data = data if type(data) is bytes else memoryview(data).cast("B")
        self.position = 0
        self._memories = memories

    def _take(self, size: int) -> bytes:
        position = self.position
        self.position = end = position + size
        if end > len(self.data):
            raise ValueError(f"truncated: {size} bytes expected at byte {position} of {len(self.data)}")
        return bytes(self.data[position:end])

    def _count(self) -> int:
        position = self.position
        if position + 4 > len(self.data):
            self._take(4)
        self.position = position + 4
        return _COUNT.unpack_from(self.data, position)[0]

    def _bytes(self) -> bytes:
        return self._take(self._count())

    def _text(self) -> str:
        return self._take(self._count()).decode("utf-8", "surrogatepass")

    def value(self, depth: int = 0) -> Any:
        """The next value.

        Raises:
            ValueError: As for `decode`.
        """
        if depth > _DEEPEST:
            raise ValueError(f"nested deeper than {_DEEPEST} levels")
        place = self.position
        if place >= len(self.data):
            self._take(1)
        kind = self.data[place]
        read = _READERS.get(kind)
        if read is None:
            raise ValueError(f"no kind of value is called {bytes((kind,))!r}, at byte {place}")
        self.position = place + 1
        return read(self, depth + 1)

    def _items(self, depth: int) -> list[Any]:
        return [self.value(depth) for _ in range(self._within(self._count()))]

    def _within(self, count: int) -> int:
        """A count of things, each of which takes at least a byte."""
        if count > len(self.data) - self.position:
            raise ValueError(f"truncated: {count} values expected in {len(self.data) - self.position} bytes")
        return count

    def _dict(self, depth: int) -> dict[Any, Any]:
        result = {}
        for _ in range(self._within(self._count())):
            key = self.value(depth)
            try:
                hash(key)
            except TypeError as error:
                raise ValueError(f"{type(key).__name__} cannot be a key") from error
            result[key] = self.value(depth)
        return result

    def _form(self, depth: int) -> tuple[np.dtype, tuple[int, ...], int]:
        """Type, shape, and number of bytes of an array."""
        data, position = self.data, self.position
        size = data[position + 1] if position + 1 < len(data) and data[position] == _STR else 0
        if size and (form := _forms.get(bytes(data[position : position + size + 9]))):
            self.position = position + size + 9  # the usual case: a type and number of dimensions that came before
        else:
            form = self._new_form(depth, position)
        dtype, itemsize, shapes = form
        position = self.position
        if position + shapes.size > len(data):
            self._take(shapes.size)
        self.position = position + shapes.size
        shape = shapes.unpack_from(data, position)
        size = math.prod(shape)
        if size == 0 and max(shape) >= 1 << 62:
            raise ValueError(f"an array of shape {shape}")
        return dtype, shape, size * itemsize

    def _new_form(self, depth: int, start: int) -> tuple[np.dtype, int, struct.Struct]:
        """Type, size of an element, and how the shape is packed."""
        dtype = _dtype_of(self.value(depth))
        dimensions = self._count()
        if dimensions > 32:
            raise ValueError(f"an array of {dimensions} dimensions")
        form = dtype, dtype.itemsize, struct.Struct(f"<{dimensions}Q")
        if self.data[start] == _STR and len(_forms) < 256:
            _forms[bytes(self.data[start : self.position])] = form
        return form

    def _array(self, depth: int) -> np.ndarray:
        dtype, shape, size = self._form(depth)
        return np.frombuffer(self._take(size), dtype).reshape(shape).copy()

    def _reference(self, depth: int) -> np.ndarray:
        data, position = self.data, self.position
        size = data[position + 1] if position + 1 < len(data) and data[position] == _STR else 0
        form = _references.get(bytes(data[position : position + size + 9])) if size else None
        if form is None:
            form = self._new_reference(depth, position)
            position = self.position
        else:  # the usual case: a type and number of dimensions that came before
            position += size + 9
        dtype, unpack_from, size = form
        self.position = end = position + size
        if end > len(data):
            raise ValueError(f"truncated: {size} bytes expected at byte {position} of {len(data)}")
        *shape, number, offset = unpack_from(data, position)
        try:
            return np.ndarray(shape, dtype, self._memories[number], offset)
        except IndexError:
            count = len(self._memories)
            raise ValueError(f"an array in memory {number}, of which there are {count} here") from None
        except (TypeError, ValueError, OverflowError):
            end, size = offset + math.prod(shape) * dtype.itemsize, len(self._memories[number])
            raise ValueError(f"an array at {offset} to {end} of a memory of {size} bytes") from None

    def _new_reference(self, depth: int, start: int) -> tuple[np.dtype, Callable[..., tuple], int]:
        """Type, what unpacks shape and place, and the size of these [B]."""
        dtype, _, shapes = self._new_form(depth, start)
        packed = struct.Struct(f"{shapes.format}IQ")
        form = dtype, packed.unpack_from, packed.size
        if self.data[start] == _STR and len(_references) < 256:
            _references[bytes(self.data[start : self.position])] = form
        return form

    def _scalar(self, depth: int) -> Any:
        dtype = _dtype_of(self.value(depth))
        data = self._bytes()
        if len(data) != dtype.itemsize:
            raise ValueError(f"{len(data)} bytes for one {dtype}")
        return np.frombuffer(data, dtype)[0]

    def _message(self, depth: int) -> Any:
        name = self._text()
        kind = _by_name.get(name)
        expected = () if kind is None else _heads(kind)[1]
        values = {}
        for number in range(self._within(self._count())):
            position = self.position
            end = position + len(expected[number]) if number < len(expected) else position
            if end > position and self.data[position:end] == expected[number]:  # the usual case is not read
                field = kind.fields[number]
                self.position = end
            else:
                field = self._text()
            values[field] = self.value(depth)
        if kind is None:
            raise ValueError(f"no type is registered as message {name!r}: import the module that defines it")
        if tuple(values) != kind.fields:
            missing = [field for field in kind.fields if field not in values and field not in kind.optional]
            unknown = [field for field in values if field not in kind.fields]
            if missing or unknown:
                raise ValueError(f"message {name!r}: fields missing: {missing or 'none'}; unknown: {unknown or 'none'}")
        try:
            return kind.make(values)
        except Exception as error:
            raise ValueError(f"message {name!r} cannot be made: {type(error).__name__}: {error}") from error


_READERS: Mapping[int, Callable[[Decoder, int], Any]] = {
    ord(kind): read
    for kind, read in {
        "N": lambda decoder, depth: None,
        "T": lambda decoder, depth: True,
        "F": lambda decoder, depth: False,
        "i": lambda decoder, depth: _INT.unpack(decoder._take(8))[0],
        "I": lambda decoder, depth: int.from_bytes(decoder._bytes(), "little", signed=True),
        "f": lambda decoder, depth: _FLOAT.unpack(decoder._take(8))[0],
        "s": lambda decoder, depth: decoder._text(),
        "b": lambda decoder, depth: decoder._bytes(),
        "t": lambda decoder, depth: tuple(decoder._items(depth)),
        "l": Decoder._items,
        "d": Decoder._dict,
        "a": Decoder._array,
        "r": Decoder._reference,
        "n": Decoder._scalar,
        "m": Decoder._message,
    }.items()
}
