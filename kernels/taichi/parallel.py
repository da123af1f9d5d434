"""What Taichi lacks and its kernels here share: a scan, a table of cells filled by many threads, and bits counted.

All of it is made of 32-bit integers and of atomics that every device has: there is no compare-and-swap.
"""

import taichi as ti

__all__ = ["NO_POINT", "bits_of", "block_sums_for", "hash_of", "scan"]

NO_POINT = 2**31 - 1
_BLOCK = 512  # numbers that one thread adds up

_Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)


def block_sums_for(count: int) -> int:
    """The length of the workspace that a scan of up to `count` numbers needs."""
    return count // _BLOCK + 2


@ti.func
def scan(values: _Integers, count: ti.i32, sums: _Integers, total: _Integers, place: ti.i32):
    """Replaces each of the first `count` values by the sum of those before it; writes their sum to `total[place]`.

    To be called from the outermost level of a kernel, where its loops run in parallel.
    """
    blocks = (count + _BLOCK - 1) // _BLOCK
    for block in range(blocks):
        added = 0
        for j in range(block * _BLOCK, ti.min(count, (block + 1) * _BLOCK)):
            added += values[j]
        sums[block] = added
    for _ in range(1):
        added = 0
        for block in range(blocks):
            own = sums[block]
            sums[block] = added
            added += own
        total[place] = added
    for block in range(blocks):
        added = sums[block]
        for j in range(block * _BLOCK, ti.min(count, (block + 1) * _BLOCK)):
            own = values[j]
            values[j] = added
            added += own


@ti.func
def hash_of(cell: ti.math.ivec3) -> ti.i32:
    """Blocks of 4 × 4 × 2 cells are spread over a table; within one, neighbours in space share cache lines."""
    block = ((cell[0] >> 2) * 73856093) ^ ((cell[1] >> 2) * 19349669) ^ ((cell[2] >> 1) * 83492791)
    within = ((cell[0] & 3) << 3) | ((cell[1] & 3) << 1) | (cell[2] & 1)
    return ((((block * -1640531535) >> 7) << 5) & 0x3FFFFFE0) | within


@ti.func
def bits_of(word: ti.i32) -> ti.i32:
    """How many bits are set."""
    pairs = word - ((word >> 1) & 0x55555555)
    fours = (pairs & 0x33333333) + ((pairs >> 2) & 0x33333333)
    return ((((fours + (fours >> 4)) & 0x0F0F0F0F) * 0x01010101) >> 24) & 0xFF
