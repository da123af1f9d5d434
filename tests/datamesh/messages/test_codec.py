"""The codec: what comes out is what went in, to the bit, and damaged bytes are an error and nothing worse."""

import contextlib
import enum
import math
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warploom.datamesh.messages import decode, encode, message, message_type


@message("test.Reading")
@dataclass(frozen=True, eq=False, kw_only=True)
class Reading:
    stamp: int
    values: np.ndarray
    notes: tuple[str, ...] = ()
    more: dict[str, float] = field(default_factory=dict)


@message("test.Mode")
class Mode(enum.Enum):
    IDLE = "idle"
    BUSY = "busy"


@message("test.Pair")
class Pair(NamedTuple):
    left: object
    right: object = None


def same(a, b) -> bool:
    """Equal in type and in every bit."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, np.generic):
        return a.dtype == b.dtype and a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return struct.pack("<d", a) == struct.pack("<d", b)
    if isinstance(a, (tuple, list)):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    if isinstance(a, Reading):
        return all(same(getattr(a, name), getattr(b, name)) for name in ("stamp", "values", "notes", "more"))
    return a == b


dtypes = st.one_of(
    hnp.boolean_dtypes(), hnp.integer_dtypes(endianness="?"), hnp.floating_dtypes(endianness="?"),
    hnp.complex_number_dtypes(), hnp.datetime64_dtypes(), hnp.unicode_string_dtypes(max_len=5),
    hnp.byte_string_dtypes(),
)  # fmt: skip
arrays = dtypes.flatmap(lambda dtype: hnp.arrays(dtype, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0)))
plain = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(), st.binary(), arrays, st.sampled_from(Mode)
)
keys = st.one_of(st.text(), st.integers(), st.booleans(), st.tuples(st.integers(), st.text()))
values = st.recursive(
    plain,
    lambda inner: st.one_of(
        st.lists(inner, max_size=4),
        st.lists(inner, max_size=4).map(tuple),
        st.dictionaries(keys, inner, max_size=4),
        st.builds(Pair, inner, inner),
        st.builds(Reading, stamp=st.integers(), values=arrays, notes=st.lists(st.text(), max_size=3).map(tuple)),
    ),
    max_leaves=12,
)


@given(values)
@settings(deadline=None, max_examples=150)
def test_what_comes_out_is_what_went_in_to_the_bit(value):
    data = encode(value)
    decoded = decode(data)
    assert same(decoded, value)
    assert encode(decoded) == data, "the same value makes the same bytes"


@given(values, st.data())
@settings(deadline=None, max_examples=150)
def test_damaged_bytes_are_a_value_error_or_another_value(value, data):
    whole = encode(value)
    cut = data.draw(st.integers(0, len(whole) - 1))
    with pytest.raises(ValueError, match=r"."):
        decode(whole[:cut])
    damaged = bytearray(whole)
    damaged[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    with contextlib.suppress(ValueError):
        decode(bytes(damaged))


@given(st.binary(max_size=200))
@settings(deadline=None, max_examples=150)
def test_bytes_from_anywhere_are_a_value_error_or_a_value(data):
    with contextlib.suppress(ValueError):
        decode(data)


@pytest.mark.parametrize("bits", [0x7FF8000000000001, 0xFFF0000000000001, 0x8000000000000000, 1, 0x7FF0000000000000])
def test_every_float_keeps_its_bits(bits):
    packed = struct.pack("<Q", bits)
    array = np.frombuffer(packed, "<f8")
    assert decode(encode(array)).tobytes() == packed
    assert decode(encode(array[0])).tobytes() == packed
    assert struct.pack("<d", decode(encode(-0.0))) == struct.pack("<d", -0.0)
    assert math.isnan(decode(encode(math.nan)))


def test_arrays_keep_shape_and_type_however_they_lie_in_memory():
    base = np.arange(60, dtype=np.float32).reshape(3, 4, 5)
    record = np.zeros(3, [("id", "<i8"), ("box", "<f4", (7,)), ("inner", [("x", "<f8"), ("y", "S3")])])
    record["box"] = 1.5
    for array in (base.T, base[::-1, ::2], np.asfortranarray(base), base[:, 1, 2], np.float32(3).reshape(()), record,
                  base.astype(">f8"), np.empty((0, 7), np.float32)):  # fmt: skip
        assert same(decode(encode(array)), array)
    assert decode(encode(base)).flags.writeable
    assert decode(encode(base)).flags.aligned


def test_a_field_that_an_older_recording_lacks_takes_its_default():
    data = encode(Reading(stamp=1, values=np.zeros(2), notes=("a",)))
    # Without `more`: three fields in place of four, and the last one cut off.
    name, count = b"test.Reading", struct.Struct("<I").pack
    older = data.replace(name + count(4), name + count(3))
    older = older[: older.rindex(count(4) + b"more")]
    assert decode(older).more == {}
    assert decode(older).notes == ("a",)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        (object(), "builtins.object is not a message: register it"),
        ({"a": [1, {2}]}, r"\['a'\]: \[1\]: builtins.set is not a message"),
        (Reading(stamp=1, values=np.array([None])), "Reading.values: an array of object"),
        (lambda: 0, "function is not a message"),
    ],
)
def test_what_cannot_be_encoded_is_told_with_its_place(value, said):
    with pytest.raises(TypeError, match=said):
        encode(value)


def test_a_value_in_itself_is_refused():
    loop = []
    loop.append(loop)
    with pytest.raises(TypeError, match="deeper than 64"):
        encode(loop)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "truncated"),
        (b"?", "no kind of value is called b'\\?'"),
        (b"l" + struct.pack("<I", 4_000_000_000), "4000000000 values expected in 0 bytes"),
        (b"l\x01\x00\x00\x00" * 80, "nested deeper"),
        (b"NN", "1 bytes are left"),
        (b"a" + encode("|O") + struct.pack("<I", 0), "no type of an array"),
        (b"a" + encode("<f4") + struct.pack("<IQQ", 2, 1 << 40, 1 << 40), "truncated"),
        (b"a" + encode("<f4") + struct.pack("<IQQ", 2, 0, 1 << 63), "an array of shape"),
        (b"a" + encode("<f4") + struct.pack("<I", 400), "400 dimensions"),
        (b"d\x01\x00\x00\x00" + encode([1]) + b"N", "list cannot be a key"),
        (encode(Mode.IDLE).replace(b"idle", b"lost"), "'test.Mode' cannot be made: ValueError"),
        (encode(Mode.IDLE).replace(b"test.Mode", b"test.Moda"), "no type is registered as message 'test.Moda'"),
        (encode(Mode.IDLE).replace(b"value", b"valve"), "missing: \\['value'\\]; unknown: \\['valve'\\]"),
    ],
)
def test_damage_is_told(data, said):
    with pytest.raises(ValueError, match=said):
        decode(data)


def test_only_classes_with_fields_become_messages_and_a_name_stands_for_one():
    with pytest.raises(TypeError, match="neither a dataclass nor a named tuple"):
        message("test.Plain")(type("Plain", (), {}))

    @dataclass
    class Hidden:
        total: int = field(init=False)

    with pytest.raises(TypeError, match="does not take total"):
        message("test.Hidden")(Hidden)
    with pytest.raises(ValueError, match=r"'test\.Pair' stands for Pair already"):
        message("test.Pair")(Hidden)
    assert message_type(Pair).name == "test.Pair"
    assert message_type(Hidden) is None
    assert '"name": "test.Reading"' in message_type(Reading).schema()
