"""Clustering on a CPU with a radius that grows: what joins cells of different levels. `cluster.py` has the plan."""

from __future__ import annotations

import warp as wp

from .cell_pairs import Radius, hash_cell, join_levels
from .unchecked import at

__all__ = ["join_levels_in_order"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})


@wp.kernel
def join_levels_in_order(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    no_slots: wp.array(dtype=wp.int32),
    radius: Radius,
    # in out: a table of cells, -1 where free, and left so; components
    table: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    # out
    cells: wp.array(dtype=wp.vec3i),
    slots: wp.array(dtype=wp.int32),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
):
    """Unites cells of different levels that touch."""
    mask = table.shape[0] - 1
    for p in range(ranges.shape[0]):
        for k in range(ranges[p][2], ranges[p][3]):
            column = at(columns, k)
            for c in range(column[2], column[3]):
                cell = wp.vec3i(column[0], column[1], at(stacks, c)[0])
                slot = hash_cell(cell) & mask
                while table[slot] >= 0:
                    slot = (slot + 1) & mask
                table[slot] = c
                slots[c] = slot
                cells[c] = cell
                cell_begin[c] = at(stacks, c)[1]
                cell_end[c] = at(stacks, c + 1)[1]
    for p in range(ranges.shape[0]):
        for c in range(ranges[p][0], ranges[p][1]):
            join_levels(c, table, no_slots, cells, cell_begin, cell_end, points, radius, parent)
    for p in range(ranges.shape[0]):
        for c in range(ranges[p][0], ranges[p][1]):
            table[slots[c]] = -1
