"""Slabs: an allocator that never gives the same memory twice, and views that keep what they show."""

import gc
import os

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from warploom.datamesh.transport.slabs import PAGE, Region, SlabArena, SlabPool

SIZE = 64 * PAGE


@pytest.fixture
def pool():
    pool = SlabPool(SIZE)
    yield pool
    pool.close()


class Allocations(RuleBasedStateMachine):
    """Takes and lets go in any order; a plain list of ranges is the reference."""

    def __init__(self):
        super().__init__()
        self.pool = SlabPool(SIZE)
        self.held = []

    @rule(size=st.integers(0, SIZE + PAGE))
    def take(self, size):
        slab = self.pool.take(size)
        if slab is None:
            needed = max(PAGE, 1 << (size - 1).bit_length() if size else 0)
            taken = {page for one in self.held for page in range(one.offset // PAGE, (one.offset + one.size) // PAGE)}
            aligned = range(0, SIZE, needed) if needed <= SIZE else ()
            blocks = [set(range(at // PAGE, (at + needed) // PAGE)) for at in aligned]
            assert all(block & taken for block in blocks), f"{size} bytes were refused, and there is room"
            return
        slab.holders += 1
        assert slab.size >= size
        assert slab.offset % slab.size == 0
        assert 0 <= slab.offset <= SIZE - slab.size
        for other in self.held:
            assert slab.offset + slab.size <= other.offset or other.offset + other.size <= slab.offset
        self.held.append(slab)

    @rule(data=st.data())
    def release(self, data):
        if self.held:
            self.pool.release(self.held.pop(data.draw(st.integers(0, len(self.held) - 1))))

    @invariant()
    def it_knows_what_is_used(self):
        assert self.pool.used == len(self.held)

    def teardown(self):
        for slab in self.held:
            self.pool.release(slab)
        whole = self.pool.take(SIZE)
        assert whole is not None, "all is given back, and yet it is not one piece again"
        self.pool.close()


TestAllocations = Allocations.TestCase
TestAllocations.settings = settings(max_examples=40, stateful_step_count=25, deadline=None)


@pytest.mark.parametrize("size", [0, 100, PAGE - 1, 3 * PAGE])
def test_a_memory_is_a_power_of_two_of_pages(size):
    with pytest.raises(ValueError, match="power of two"):
        SlabPool(size)


def test_a_slab_is_free_again_when_the_last_array_of_it_is_gone(pool):
    slab = pool.take(PAGE)
    array = pool.lease(slab).bytes()
    part = array[10:20].view(np.uint8)[::2]
    del array
    gc.collect()
    assert used(pool) == 1
    assert part.base is not None
    del part
    gc.collect()
    assert used(pool) == 0


def test_any_array_of_a_change_keeps_its_slab_and_is_located_however_it_was_cut(pool):
    slab = pool.take(PAGE)
    arena = SlabArena(lambda size: pool.lease(slab), PAGE, lambda: None)
    first, second = arena.array((8, 3), np.float32), arena.array(5, np.int64)
    del arena
    assert pool.locate(first) == (slab, 0)
    assert pool.locate(second) == (slab, 128)
    assert pool.locate(first[2:6]) == (slab, 24)
    assert pool.locate(second[:3].view(np.uint8)) == (slab, 128)
    assert pool.locate(first[:, 1]) is None
    part = second[1:].reshape(2, 2)
    del first, second
    gc.collect()
    assert used(pool) == 1
    del part
    gc.collect()
    assert used(pool) == 0


def test_a_slab_that_a_reader_holds_stays_when_the_arrays_are_gone(pool):
    slab = pool.take(PAGE)
    lease = pool.lease(slab)
    slab.holders += 1
    del lease
    gc.collect()
    assert used(pool) == 1
    pool.release(slab)
    assert used(pool) == 0


def test_an_array_is_located_where_it_is_in_one_piece(pool):
    slab = pool.take(2 * PAGE)
    values = pool.lease(slab).bytes().view(np.float32).reshape(-1, 4)
    assert pool.locate(values) == (slab, 0)
    assert pool.locate(values[3:]) == (slab, 48)
    assert pool.locate(values[:, :3]) is None, "its rows are not one piece"
    assert pool.locate(values.copy()) is None
    assert pool.locate(np.zeros(4)) is None


def test_a_reader_sees_what_the_writer_writes_and_cannot_write(pool):
    slab = pool.take(PAGE)
    written = pool.lease(slab).bytes()
    written[:] = 7
    region = Region(pool.fd, SIZE, writable=False)
    read = region.lease(slab.offset, slab.size, None, lambda _: None).bytes()
    assert (read == 7).all()
    written[5] = 8
    assert read[5] == 8, "it is the same memory"
    with pytest.raises(ValueError, match="read-only"):
        read[0] = 1
    with pytest.raises(ValueError, match="WRITEABLE"):
        read.setflags(write=True)


def test_the_descriptor_that_readers_get_cannot_be_mapped_for_writing(pool):
    with pytest.raises(PermissionError):
        Region(pool.fd, SIZE, writable=True)
    with pytest.raises(OSError, match=r"Bad file descriptor|Invalid argument|Operation not permitted"):
        os.ftruncate(pool.fd, 0)


@pytest.mark.parametrize("said", [SIZE * 2, SIZE // 2, 0])
def test_a_memory_of_another_size_than_its_writer_says_is_refused(pool, said):
    with pytest.raises(ValueError, match="were said"):
        Region(pool.fd, said, writable=False)


def test_a_memory_that_its_writer_could_cut_is_refused():
    fd = os.memfd_create("cut", os.MFD_ALLOW_SEALING | os.MFD_CLOEXEC)
    try:
        os.ftruncate(fd, PAGE)
        with pytest.raises(ValueError, match="cut while it is read"):
            Region(fd, PAGE, writable=False)
    finally:
        os.close(fd)


def used(pool):
    """How many slabs are used, now."""
    pool.collect()
    return pool.used


def arena_of(pool, expected=0):
    full = []

    def lease(size):
        slab = pool.take(size)
        return None if slab is None else pool.lease(slab)

    return SlabArena(lease, expected, lambda: full.append(1)), full


def test_the_arrays_of_a_change_lie_in_one_slab_where_its_size_is_known(pool):
    arena, _ = arena_of(pool, expected=3 * PAGE)
    arrays = [arena.array((n, 3), np.float32) for n in (10, 100, 500)]
    located = [pool.locate(array) for array in arrays]
    assert len({slab.offset for slab, _ in located}) == 1
    ends = [offset + array.nbytes for (_, offset), array in zip(located, arrays, strict=True)]
    assert all(end <= offset for end, (_, offset) in zip(ends, located[1:], strict=False))
    assert all(offset % 64 == 0 for _, offset in located)


def test_an_array_for_which_there_is_no_room_lies_elsewhere_and_is_counted(pool):
    arena, full = arena_of(pool)
    array = arena.array(SIZE + 1, np.uint8)
    assert array.shape == (SIZE + 1,)
    assert pool.locate(array) is None
    assert full == [1]


@pytest.mark.parametrize(
    ("shape", "dtype"), [(5, "f8"), ((2, 0, 3), "i4"), ([4, 4], "u1"), ((), "f4"), (np.int64(3), [("a", "f4")])]
)
def test_arrays_have_the_shape_and_type_asked_for(pool, shape, dtype):
    array = arena_of(pool)[0].array(shape, dtype)
    expected = np.empty(shape, dtype)
    assert (array.shape, array.dtype) == (expected.shape, expected.dtype)
    assert array.flags.writeable


@pytest.mark.parametrize("shape", [-1, (3, -2)])
def test_a_shape_that_makes_no_sense_is_refused(pool, shape):
    with pytest.raises(ValueError, match="shape"):
        arena_of(pool)[0].array(shape, np.float32)
