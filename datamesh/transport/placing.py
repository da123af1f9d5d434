"""Where the arrays of a payload lie in shared memory, and the copies of those that do not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .slabs import Lease, Slab, SlabArena, SlabPool

__all__ = ["NoRoom", "Placing"]

_SMALL = 1024
"""Arrays up to so many bytes go with the message, unless they are in a slab already."""


class NoRoom(Exception):  # noqa: N818  (it is no error: the datum is dropped and counted)
    """The memory of the topic is full."""


class Placing:
    """Says for each array of a payload in which slab it lies, and copies to one what lies in none."""

    copies: SlabArena | None = None
    copied_bytes = 0
    leases: tuple[Lease, ...] = ()
    """Of those that were taken for copies."""

    def __init__(self, pool: SlabPool, lease: Callable[[int], Lease | None], expected: int) -> None:
        self._pool = pool
        self._lease = lease
        self._expected = expected
        self.slabs: list[Slab] = []
        """In the order of their numbers."""

    def take(self, size: int) -> Lease:
        """A slab. Raises `NoRoom`."""
        found = self._lease(size)
        if found is None:
            raise NoRoom
        self.leases += (found,)
        return found

    def __call__(self, array: np.ndarray) -> tuple[int, int] | None:
        """Number of the slab and offset in it; None for an array that goes with the message."""
        found = self._pool.locate(array)
        if found is None:
            if array.nbytes <= _SMALL:
                return None
            found = self._pool.locate(self._copy(array))
            assert found is not None
        slab, offset = found
        slabs = self.slabs
        if slab in slabs:
            return slabs.index(slab), offset
        slabs.append(slab)
        return len(slabs) - 1, offset

    def _copy(self, array: np.ndarray) -> np.ndarray:
        if self.copies is None:
            self.copies = SlabArena(self.take, self._expected, lambda: None)
        copy = self.copies.array(array.shape, array.dtype)
        np.copyto(copy, array)
        self.copied_bytes += array.nbytes
        return copy
