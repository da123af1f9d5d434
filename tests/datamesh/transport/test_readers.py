"""What a writer knows of a reader: how many payloads it holds, in whichever slabs they lie."""

import socket

import pytest
from hypothesis import given
from hypothesis import strategies as st

from warploom.datamesh.snapshot import Entry
from warploom.datamesh.transport.readers import Reader
from warploom.datamesh.transport.slabs import PAGE, Slab


def slab(number):
    return Slab(None, number * PAGE, 0)  # in which memory is not what a reader asks


@pytest.fixture
def reader():
    ours, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, other:
        yield Reader(ours, "reader", 3, blocks=False)


def test_a_payload_in_several_slabs_is_one_until_all_are_let_go_of(reader):
    slabs = [slab(0), slab(1)]
    reader.holds(slabs)
    assert (reader.held, [one.holders for one in slabs]) == (1, [1, 1])
    assert reader.lets_go(0)
    assert reader.held == 1
    assert reader.lets_go(PAGE)
    assert reader.held == 0
    assert reader.slabs() == []


def test_what_it_does_not_hold_it_cannot_let_go_of(reader):
    reader.holds([slab(0)])
    assert not reader.lets_go(PAGE)
    assert reader.lets_go(0)
    assert not reader.lets_go(0)
    assert reader.held == 0


def test_a_payload_without_slabs_is_not_held(reader):
    reader.holds(())
    assert reader.held == 0
    assert not reader.is_full


def test_what_it_has_let_go_of_it_has_read(reader):
    for version in range(3):
        reader.holds([slab(version)])
        reader.has_sent(Entry(version, None, 0, 0), 0, True)
    assert reader.is_full
    reader.lets_go(0)
    assert [entry.version for entry in reader.flight] == [1, 2]
    assert reader.reached == (0, 2)


@given(st.lists(st.sets(st.integers(0, 4), min_size=1, max_size=4), max_size=12), st.integers(0, 12))
def test_of_payloads_that_share_slabs_and_go_in_order_the_count_is_exact(payloads, gone):
    ours, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, other:
        reader = Reader(ours, "reader", 3, blocks=False)
        for numbers in payloads:
            reader.holds([slab(number) for number in sorted(numbers)])
        for numbers in payloads[:gone]:
            for number in sorted(numbers, reverse=True):
                assert reader.lets_go(number * PAGE)
        left = payloads[gone:]
        assert reader.held == len(left)
        assert sorted(reader.slabs()) == sorted(number * PAGE for numbers in left for number in numbers)
