"""Clustering by a grid of voxels on a CPU: columns beside their neighbours. `grid_cluster.py` has the plan."""

from __future__ import annotations

import warp as wp

from .cell_columns import aligned, is_before
from .cell_pairs import find
from .unchecked import at, put

__all__ = ["join_border_voxels", "join_own_voxels"]

_LARGEST_CELL = wp.constant(1 << 30)


@wp.func
def _reach_of(dx: int, dy: int, axes: int) -> int:
    """By how much the heights of neighbours in two columns may differ; -1 where there are none."""
    return wp.min(axes - wp.abs(dx) - wp.abs(dy), 1)


@wp.func
def _are_apart(a: int, b: int) -> bool:
    """Whether indices differ where float32 has no neighbours any more."""
    return a != b and (wp.abs(a) >= _LARGEST_CELL or wp.abs(b) >= _LARGEST_CELL)


@wp.func
def _unite(a: int, b: int, parent: wp.array(dtype=wp.int32)):
    if at(parent, a) != at(parent, b):
        root_a = find(parent, a)
        root_b = find(parent, b)
        if root_a != root_b:
            put(parent, wp.max(root_a, root_b), wp.min(root_a, root_b))


@wp.func
def _unite_heights(
    here: wp.vec4i, there: wp.vec4i, reach: int, stacks: wp.array(dtype=wp.vec2i), parent: wp.array(dtype=wp.int32)
):
    """Unites the voxels of two columns whose z differ by no more than `reach`, of any height."""
    if _are_apart(here[0], there[0]) or _are_apart(here[1], there[1]):
        return
    low = int(there[2])
    for a in range(here[2], here[3]):
        z = at(stacks, a)[0]
        while low < there[3] and at(stacks, low)[0] < z - reach:
            low += 1
        b = int(low)
        while b < there[3] and at(stacks, b)[0] <= z + reach:
            if not _are_apart(z, at(stacks, b)[0]):
                _unite(a, b, parent)
            b += 1


@wp.func
def _unite_masks(
    here: wp.vec4i,
    there: wp.vec4i,
    here_mask: wp.uint64,
    there_mask: wp.uint64,
    reach: int,
    stacks: wp.array(dtype=wp.vec2i),
    parent: wp.array(dtype=wp.int32),
):
    """The same where both columns have masks. Of voxels on top of each other, which are united, one is enough."""
    one = wp.uint64(1)
    apart = at(stacks, here[2])[0] - at(stacks, there[2])[0]
    by = apart - reach
    while by <= apart + reach:
        left = here_mask & aligned(there_mask, by)
        left = left & ~(left << one)
        while left != wp.uint64(0):
            lower = (left & (~left + one)) - one  # ones below the lowest one
            height = int(wp.bit_count(lower))
            a = here[2] + int(wp.bit_count(here_mask & lower))
            b = there[2] + int(wp.bit_count(there_mask & ((one << wp.uint64(height + by)) - one)))
            left = left & (left - one)
            _unite(a, b, parent)
        by += 1


@wp.func
def _unite_rows(
    columns: wp.array(dtype=wp.vec4i),
    first: int,
    last: int,
    others: int,
    others_end: int,
    axes: int,
    stacks: wp.array(dtype=wp.vec2i),
    masks: wp.array(dtype=wp.uint64),
    parent: wp.array(dtype=wp.int32),
):
    """Unites the voxels of columns with those after them among others, which stand in the same order."""
    dx = int(0)
    while dx < 2:
        head = int(others)
        for k in range(first, last):
            here = at(columns, k)
            here_mask = at(masks, k)
            x = here[0] + dx
            while head < others_end and ((head <= k and dx == 0) or is_before(at(columns, head), x, here[1] - 1)):
                head += 1
            other = int(head)
            while other < others_end and at(columns, other)[0] == x and at(columns, other)[1] <= here[1] + 1:
                there = at(columns, other)
                there_mask = at(masks, other)
                reach = _reach_of(dx, there[1] - here[1], axes)
                far = wp.max(wp.abs(there[0]), wp.abs(there[1])) >= _LARGEST_CELL - 1
                if reach >= 0 and (far or here_mask == wp.uint64(0) or there_mask == wp.uint64(0)):
                    _unite_heights(here, there, reach, stacks, parent)
                elif reach >= 0:
                    _unite_masks(here, there, here_mask, there_mask, reach, stacks, parent)
                other += 1
        dx += 1


@wp.kernel
def join_own_voxels(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    axes: int,
    # out: the columns' voxels by height above the lowest as a mask, 0 where it is too short
    masks: wp.array(dtype=wp.uint64),
    parent: wp.array(dtype=wp.int32),
):
    """Unites the voxels of a part that are neighbours."""
    begin = ranges[part][2]
    end = ranges[part][3]
    k = int(begin)
    while k < end:
        column = at(columns, k)
        a = column[2]
        last = column[3]
        lowest = at(stacks, a)[0]
        z = lowest - 2
        mask = wp.uint64(0)
        while a < last:
            below = z
            z = at(stacks, a)[0]
            root = int(a)
            if z == below + 1 and not _are_apart(z, below):
                root = at(parent, a - 1)
            put(parent, a, root)
            mask = mask | (wp.uint64(1) << wp.uint64((z - lowest) & 63))
            a += 1
        if z - lowest > 63 or lowest <= 1 - _LARGEST_CELL or z >= _LARGEST_CELL - 1:
            mask = wp.uint64(0)
        put(masks, k, mask)
        k += 1
    _unite_rows(columns, begin, end, begin, end, axes, stacks, masks, parent)


@wp.kernel
def join_border_voxels(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    axes: int,
    masks: wp.array(dtype=wp.uint64),
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites voxels of different parts that are neighbours."""
    parts = ranges.shape[0]
    for p in range(parts):
        for q in range(p + 1, parts):
            begin = ranges[q][2]
            end = ranges[q][3]
            if begin < end:
                x = columns[begin][0] - 1
                y = columns[begin][1] - 1
                last = ranges[p][3]
                first = int(last)
                while first > ranges[p][2] and not is_before(columns[first - 1], x, y):
                    first -= 1
                _unite_rows(columns, first, last, begin, end, axes, stacks, masks, parent)
