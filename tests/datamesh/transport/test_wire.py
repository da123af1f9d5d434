"""Messages between writer and reader: whatever the bytes, an event comes out or a clear error."""

import hypothesis.strategies as st
import pytest
from hypothesis import given

from warploom.datamesh.messages import encode
from warploom.datamesh.transport.wire import (
    COMMIT,
    NEWEST,
    NEWEST_TRIGGERS,
    SETTLE,
    SOON,
    Event,
    pack_commit,
    pack_event,
    pack_greeting,
    pack_soon,
    read_event,
    read_greeting,
    read_soon,
    set_number,
)

MEMORY = 1 << 20
U64 = st.integers(0, (1 << 64) - 1)
TIME = st.integers(-(1 << 63), (1 << 63) - 1)
SLABS = st.lists(st.tuples(st.integers(0, MEMORY - 1), st.integers(1, MEMORY)), max_size=5).map(
    lambda slabs: tuple((offset, min(size, MEMORY - offset)) for offset, size in slabs)
)
EVENTS = st.builds(
    Event,
    kind=st.sampled_from([COMMIT, SETTLE, SOON]),
    number=U64,
    epoch=U64,
    version=U64,
    received_ns=TIME,
    committed_ns=TIME,
    triggers=st.booleans(),
    newest=st.booleans(),
    slabs=SLABS,
    body=st.binary(),
    body_size=st.just(0),
)


@given(EVENTS)
def test_an_event_is_read_as_it_was_sent(event):
    read = read_event(pack_event(event), MEMORY)
    assert read._replace(body=bytes(read.body)) == event


@given(st.integers(0, 4095), TIME, TIME)
def test_an_announcement_says_where_it_is_built_and_when_to_expect_it(core, soon, late):
    assert read_soon(pack_soon(core, soon, late)) == (core, soon, late)
    assert read_event(pack_soon(core, soon, late), MEMORY).kind == SOON


@given(st.binary(max_size=len(pack_soon(0, 0, 0)) - 1))
def test_a_short_one_is_refused(data):
    with pytest.raises(ValueError, match="truncated"):
        read_soon(data)


@given(U64, U64, U64, TIME, TIME, st.booleans(), st.integers(0, MEMORY // 2), st.integers(1, MEMORY // 2), st.binary())
def test_a_commit_in_one_slab_is_packed_the_same_way_in_one_go(
    number, epoch, version, received, committed, triggers, offset, size, body
):
    event = Event(COMMIT, number, epoch, version, received, committed, triggers, True, ((offset, size),), body)
    flags = NEWEST_TRIGGERS if triggers else NEWEST
    head = pack_commit(COMMIT, flags, 1, 0, number, epoch, version, received, committed, offset, size)
    assert head + body == pack_event(event)


@given(EVENTS, U64)
def test_an_event_is_given_another_number(event, number):
    packed = pack_event(event)
    set_number(packed, number)
    assert packed == pack_event(event._replace(number=number))


@given(EVENTS.filter(lambda event: event.slabs))
def test_a_payload_may_lie_in_the_last_slab(event):
    event = event._replace(body=b"", body_size=event.slabs[-1][1])
    assert read_event(pack_event(event), MEMORY)._replace(body=b"") == event


@given(EVENTS.map(lambda event: event._replace(body=b"")), st.data())
def test_a_truncated_event_is_refused(event, data):
    packed = pack_event(event)
    with pytest.raises(ValueError, match="truncated"):
        read_event(packed[: data.draw(st.integers(0, len(packed) - 1))], MEMORY)


@given(st.binary(max_size=300))
def test_any_bytes_are_an_event_or_refused(data):
    try:
        event = read_event(data, MEMORY)
    except ValueError:
        return
    assert all(offset >= 0 and size > 0 and offset + size <= MEMORY for offset, size in event.slabs)


@pytest.mark.parametrize("slab", [(MEMORY, 1), (0, MEMORY + 1), (MEMORY - 1, 2), ((1 << 64) - 1, 1), (5, 0)])
def test_a_slab_outside_the_memory_is_refused(slab):
    with pytest.raises(ValueError, match=r"a slab at \d+ of \d+ bytes in a memory of"):
        read_event(pack_event(Event(COMMIT, 1, 0, 0, 0, 0, slabs=(slab,))), MEMORY)


@pytest.mark.parametrize(("slabs", "size"), [((), 10), (((0, 64),), 65)])
def test_a_payload_that_is_longer_than_its_slab_is_refused(slabs, size):
    with pytest.raises(ValueError, match="a payload of"):
        read_event(pack_event(Event(COMMIT, 1, 0, 0, 0, 0, slabs=slabs, body_size=size)), MEMORY)


def test_a_greeting_is_read_as_it_was_sent():
    greeting = read_greeting(pack_greeting({"topic": "a/b", "capacity": 3}), (("topic", str), ("capacity", int)))
    assert greeting["topic"] == "a/b"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "truncated"),
        (b"GET / HTTP/1.1", "no kind of value"),
        (encode([1, 2]), "protocol None"),
        (encode({"warploom": 99, "topic": "a"}), "protocol 99"),
        (pack_greeting({"topic": 5}), "topic of the other end is 5, expected str"),
        (pack_greeting({}), "topic of the other end is None"),
    ],
)
def test_a_greeting_that_is_none_is_refused(data, message):
    with pytest.raises(ValueError, match=message):
        read_greeting(data, (("topic", str),))
