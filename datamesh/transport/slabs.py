"""Slabs: blocks of shared memory in which payloads are built and read in place.

The memory of a topic is one anonymous file (`memfd_create`), which the writer hands to its readers as a descriptor that
can only be read. It has no name, so nothing of it is left when the last process that maps it ends, however it ends; it
is sealed against shrinking, so that no reader can run past its end. Its size is address space: pages come as they are
first written.
"""

from __future__ import annotations

import fcntl
import math
import mmap
import os
from bisect import bisect_right, insort
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

__all__ = ["PAGE", "Lease", "Region", "Slab", "SlabArena", "SlabPool", "Usage"]

PAGE = 4096
"""The smallest slab [B]; each is a power of two of them, and lies at a multiple of its size."""

_ALIGNMENT = 64
"""Of each array in a slab [B]: a cache line, and the widest vector."""


class Lease(np.ndarray):
    """A part of a region, shape (size,), uint8, kept for as long as an array of it lives.

    Arrays are made of it by `np.ndarray(shape, dtype, lease, offset)`. They hold it as their base: it is of a class of
    its own, and so is what it is cut from, so that NumPy does not look for a base further down.
    """

    key: Any = None
    """What `on_end` is told."""
    begin = 0
    """Where it begins in the region [B]."""
    whole: Lease | None = None
    """The lease that it is a part of, and keeps."""
    on_end: Callable[[Any], None] | None = None
    """Is called when the last array is gone, in any thread and at any place: it must take no lock."""

    def __del__(self) -> None:
        if self.on_end is not None:
            self.on_end(self.key)

    def bytes(self) -> np.ndarray:
        """The part as an array that keeps it; a slice of the lease itself would not."""
        return np.ndarray(self.shape, np.uint8, self)

    def part(self, begin: int, size: int) -> Lease:
        """A part of it, which keeps it."""
        part = self[begin : begin + size]
        part.begin = self.begin + begin
        part.key = self.key
        part.whole = self
        return part


class Region:
    """The memory of one topic, mapped as a whole."""

    def __init__(self, fd: int, size: int, *, writable: bool) -> None:
        """Maps it; the descriptor stays with the caller.

        Args:
            fd: Of the file.
            size: Of the file [B].
            writable: Whether to write; otherwise a write is refused by NumPy, and by the processor.

        Raises:
            ValueError: The file is not of this size, or could be cut while it is read.
        """
        if os.fstat(fd).st_size != size or size <= 0 or size % PAGE:
            raise ValueError(f"a shared memory of {os.fstat(fd).st_size} bytes, where {size} were said")
        if not fcntl.fcntl(fd, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
            raise ValueError("a shared memory that its writer can cut while it is read")
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        self.size = size
        self.writable = writable
        self._map = mmap.mmap(fd, size, mmap.MAP_SHARED, protection)
        # The array holds the map, and with it the memory, and is held by what is cut from it.
        self._bytes = np.frombuffer(self._map, np.uint8).view(Lease)
        self.address: int = self._bytes.__array_interface__["data"][0]

    @staticmethod
    def create(size: int) -> tuple[int, Region]:
        """A new memory: its descriptor, which can only be read, and its mapping for the writer.

        Args:
            size: A multiple of `PAGE` [B].
        """
        fd = os.memfd_create("warploom", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        try:
            os.ftruncate(fd, size)
            fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            region = Region(fd, size, writable=True)
            return os.open(f"/proc/self/fd/{fd}", os.O_RDONLY | os.O_CLOEXEC), region
        finally:
            os.close(fd)

    def lease(self, offset: int, size: int, key: Any, on_end: Callable[[Any], None]) -> Lease:
        """A part of it.

        Args:
            offset: Where it begins [B].
            size: Of the part [B].
            key: What `on_end` is told.
            on_end: As `Lease` says.
        """
        lease = self._bytes[offset : offset + size]
        lease.begin = offset
        lease.key = key
        lease.on_end = on_end
        return lease


class Slab:
    """One block of a pool; free again once nobody holds it."""

    __slots__ = ("holders", "offset", "order", "region", "size")

    def __init__(self, region: Region, offset: int, order: int) -> None:
        self.region = region
        self.offset = offset
        self.order = order
        self.size = PAGE << order
        """[B]."""
        self.holders = 0
        """Leases of this process, and readers that have not let go of it."""


class SlabPool:
    """Gives slabs of a region: a buddy allocator. Its methods are called under one lock, which its owner has."""

    def __init__(self, size: int) -> None:
        """Makes the memory.

        Args:
            size: Address space [B], a power of two of at least `PAGE`.

        Raises:
            ValueError: It is not.
            OSError: The system gives none.
        """
        if size < PAGE or size & (size - 1):
            raise ValueError(f"the memory of a topic must be a power of two of at least {PAGE} bytes, not {size}")
        self.fd, self.region = Region.create(size)
        self._orders = (size // PAGE).bit_length()
        self._free: list[list[int]] = [[] for _ in range(self._orders)]
        self._free[-1].append(0)
        self._used: list[int] = []
        self._slabs: dict[int, Slab] = {}
        self._ended: deque[Slab] = deque()

    def close(self) -> None:
        """Lets go of the descriptor; the memory lives on while anybody holds an array of it."""
        os.close(self.fd)

    @property
    def used(self) -> int:
        """How many slabs somebody holds; `collect` first, for what was let go of just now."""
        return len(self._slabs)

    def take(self, size: int) -> Slab | None:
        """A slab of at least `size` [B], held by nobody yet; None where there is no room."""
        self.collect()
        order = max(0, -(-size // PAGE) - 1).bit_length()
        found = next((one for one in range(order, self._orders) if self._free[one]), None)
        if found is None:
            return None
        offset = self._free[found].pop()
        while found > order:
            found -= 1
            self._free[found].append(offset + (PAGE << found))
        slab = Slab(self.region, offset, order)
        self._slabs[offset] = slab
        insort(self._used, offset)
        return slab

    def at(self, offset: int) -> Slab:
        """The slab that begins at an offset, which somebody holds."""
        return self._slabs[offset]

    def lease(self, slab: Slab) -> Lease:
        """Holds a slab for as long as an array of it lives in this process."""
        slab.holders += 1
        return self.region.lease(slab.offset, slab.size, slab, self._ended.append)

    def release(self, slab: Slab) -> None:
        """One who held it lets go."""
        slab.holders -= 1
        if slab.holders <= 0:
            self._give_back(slab)

    def collect(self) -> None:
        """Takes back what the arrays of this process have let go of."""
        while self._ended:
            self.release(self._ended.popleft())

    def _give_back(self, slab: Slab) -> None:
        offset, order = slab.offset, slab.order
        del self._slabs[offset]
        self._used.pop(bisect_right(self._used, offset) - 1)
        while order < self._orders - 1 and (buddy := offset ^ (PAGE << order)) in self._free[order]:
            self._free[order].remove(buddy)
            offset = min(offset, buddy)
            order += 1
        self._free[order].append(offset)

    def locate(self, array: np.ndarray) -> tuple[Slab, int] | None:
        """The slab in which an array lies, one piece in C order, and where; None where it lies elsewhere."""
        base = array.base
        if type(base) is Lease and type(slab := base.key) is Slab and slab.region is self.region:
            return slab, base.begin - slab.offset  # as it was made: to ask where an array lies takes long
        interface = array.__array_interface__
        if interface["strides"] is not None:
            return None
        offset = interface["data"][0] - self.region.address
        if not 0 <= offset < self.region.size:
            return None
        index = bisect_right(self._used, offset) - 1
        if index < 0:
            return None
        slab = self._slabs[self._used[index]]
        inside = offset - slab.offset
        return (slab, inside) if inside + array.nbytes <= slab.size else None


class Usage:
    """How much memory a change took, for the next one to know; it holds none of it."""

    __slots__ = ("size",)

    def __init__(self) -> None:
        self.size = 0
        """[B]."""


class SlabArena:
    """The memory of one change: its arrays lie one behind the other, in one slab where they fit."""

    def __init__(self, lease: Callable[[int], Lease | None], expected: int, on_full: Callable[[], None]) -> None:
        """Makes an empty one.

        Args:
            lease: Gives a slab of at least so many bytes, or None.
            expected: How much the arrays will take together [B], as far as that is known.
            on_full: Is called for an array for which there was no room, and which lies elsewhere.
        """
        self._lease = lease
        self._expected = expected
        self._on_full = on_full
        self._room: Lease | None = None
        self._begin = self._end = 0
        self.used = Usage()

    def array(self, shape: Any, dtype: Any) -> np.ndarray:
        """An array in the slab, not written yet; of the process's own memory where there is no room."""
        dtype = np.dtype(dtype)
        if dtype.hasobject:
            return np.empty(shape, dtype)
        shape = tuple(shape) if isinstance(shape, Iterable) else (shape,)
        if any(length < 0 for length in shape):
            raise ValueError(f"an array of shape {shape}")
        size = math.prod(shape) * dtype.itemsize
        taken = -(-size // _ALIGNMENT) * _ALIGNMENT
        if self._room is None or taken > self._end - self._begin:
            lease = self._lease(max(taken, self._expected - self.used.size))
            if lease is None:
                self._on_full()
                return np.empty(shape, dtype)
            self._room, self._begin, self._end = lease, 0, lease.size
        array = np.ndarray(shape, dtype, self._room.part(self._begin, size))
        self._begin += taken
        self.used.size += taken
        return array
