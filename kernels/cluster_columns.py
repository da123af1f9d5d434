"""Clustering on a CPU: columns of cells, walked through beside their neighbours. `cluster.py` has the plan.

Each part of the work joins the cells of its own columns, in a forest that no other part reads; one thread then joins
the columns at the borders between the parts, which are few.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from .cell_columns import LEAST_MAP, MAP_PER_POINT, CellColumns, Layout, aligned, is_before, row_of
from .cell_pairs import Radius, find, touch
from .device import DEFAULT_DEVICE
from .unchecked import at, put

__all__ = ["JoinedColumns", "label_points"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_ADJACENT = wp.constant(0)  # which cells of two columns to unite: those that share a corner
_OTHERS = wp.constant(1)
_ALL = wp.constant(2)
_UNNUMBERED = wp.constant(-2)
_NO_COLUMN = wp.constant(-2)
_NO_ROOT = wp.constant(-3)
_HIGH_CELL = wp.constant(wp.uint64(1 << 60))


@wp.func
def _cells_touch(
    a: int,
    b: int,
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
) -> bool:
    return touch(points, at(stacks, a)[1], at(stacks, a + 1)[1], at(stacks, b)[1], at(stacks, b + 1)[1], radius)


@wp.func
def _join_cells(
    a: int,
    b: int,
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites two cells if they touch."""
    if at(parent, a) != at(parent, b):
        root_a = find(parent, a)
        root_b = find(parent, b)
        if root_a != root_b and _cells_touch(a, b, stacks, points, radius):
            put(parent, wp.max(root_a, root_b), wp.min(root_a, root_b))


@wp.func
def _join_heights(
    here: wp.vec4i,
    there: wp.vec4i,
    least: int,
    most: int,
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites those cells of two columns that touch, of those whose z differ by `least` … `most`."""
    low = int(there[2])
    for a in range(here[2], here[3]):
        z = at(stacks, a)[0]
        while low < there[3] and at(stacks, low)[0] < z - most:
            low += 1
        b = int(low)
        while b < there[3] and at(stacks, b)[0] <= z + most:
            if wp.abs(at(stacks, b)[0] - z) >= least:
                _join_cells(a, b, stacks, points, radius, parent)
            b += 1


@wp.func
def _join_second_next(
    column: wp.vec4i,
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites those cells of a column that touch, of those whose z differ by two."""
    for a in range(column[2], column[3] - 1):
        for b in range(a + 1, wp.min(a + 3, column[3])):
            if at(stacks, b)[0] == at(stacks, a)[0] + 2:
                _join_cells(a, b, stacks, points, radius, parent)


@wp.func
def _join_rows(
    columns: wp.array(dtype=wp.vec4i),
    first: int,
    last: int,
    others: int,
    others_end: int,
    dx: int,
    least_dy: int,
    most_dy: int,
    which: int,
    column_root: wp.array(dtype=wp.int32),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of columns with those of others that are `dx` rows on and `least_dy` … `most_dy` aside."""
    head = int(others)
    for k in range(first, last):
        here = at(columns, k)
        x = here[0] + dx
        while head < others_end and is_before(at(columns, head), x, here[1] + least_dy):
            head += 1
        other = int(head)
        if others == first and other <= k:
            other = k + 1
        while other < others_end and at(columns, other)[0] == x and at(columns, other)[1] <= here[1] + most_dy:
            there = at(columns, other)
            if which != _OTHERS or column_root[k] < 0 or column_root[k] != column_root[other]:
                least = int(0)
                most = int(2)
                if which == _ADJACENT:
                    most = 1
                elif which == _OTHERS and dx < 2 and wp.abs(there[1] - here[1]) < 2:
                    least = 2
                _join_heights(here, there, least, most, stacks, points, radius, parent)
            other += 1


@wp.func
def _join_two_columns(
    here: wp.vec4i,
    there: wp.vec4i,
    here_mask: wp.uint64,
    there_mask: wp.uint64,
    first_step: int,
    last_step: int,
    whole: bool,
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites those cells of two columns that touch, of those whose z differ by 0, 1, -1, 2, -2: the steps.

    If both columns are `whole`, of one component each, the first two cells that touch are enough.
    """
    a_begin = here[2]
    b_begin = there[2]
    apart = at(stacks, a_begin)[0] - at(stacks, b_begin)[0]
    one = wp.uint64(1)
    step = int(first_step)
    # Where no cell is within two of another there is nothing to try.
    spread = here_mask | (here_mask << one)
    spread = spread | (spread << wp.uint64(2)) | (here_mask << wp.uint64(4))
    if here_mask < _HIGH_CELL and (spread & aligned(there_mask, apart - 2)) == wp.uint64(0):
        step = 5
    while step <= last_step:
        by = (step + 1) >> 1
        if (step & 1) == 0:
            by = -by
        by += apart
        left = here_mask & aligned(there_mask, by)
        while left != wp.uint64(0):
            lower = (left & (~left + one)) - one  # ones below the lowest one
            height = int(wp.bit_count(lower))
            a = a_begin + int(wp.bit_count(here_mask & lower))
            b = b_begin + int(wp.bit_count(there_mask & ((one << wp.uint64(height + by)) - one)))
            left = left & (left - one)
            _join_cells(a, b, stacks, points, radius, parent)
            if whole and at(parent, a) == at(parent, b):
                left = wp.uint64(0)
                step = last_step
        step += 1


@wp.func
def _bit_if_other(root: int, own: int, bit: int) -> int:
    """A one at a bit, if there is a column at all and it is not of the same component."""
    bits = int(0)
    if root != _NO_COLUMN and root != own:
        bits = 1 << bit
    return bits


@wp.func
def _bit_if_any(column: int, bit: int) -> int:
    bits = int(0)
    if column >= 0:
        bits = 1 << bit
    return bits


@wp.func
def _join_neighbours(
    k: int,
    neighbours: int,
    ring: int,
    begin: int,
    end: int,
    row_length: int,
    offsets: wp.array(dtype=wp.vec2i),
    column_map: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.vec4i),
    column_root: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of a column with those of its neighbours, a bit each, that touch, of ring 0 or 1."""
    here = at(columns, k)
    here_mask = at(masks, k)
    root = at(column_root, k)
    left = int(neighbours)
    while left != 0:
        o = wp.bit_count((left & -left) - 1)
        left = left & (left - 1)
        other = at(column_map, at(places, k) + offsets[o][0] * row_length + offsets[o][1])
        if other >= begin and other < end:
            there_root = at(column_root, other)
            whole = root >= 0 and there_root >= 0
            if not whole or find(parent, root) != find(parent, there_root):
                there = at(columns, other)
                there_mask = at(masks, other)
                first_step = int(0)
                last_step = int(2)
                if ring == 1:
                    last_step = 4
                    if o < 4:
                        first_step = 3
                if here_mask == wp.uint64(0) or there_mask == wp.uint64(0):
                    _join_heights(here, there, first_step >> 1, last_step >> 1, stacks, points, radius, parent)
                else:
                    _join_two_columns(
                        here,
                        there,
                        here_mask,
                        there_mask,
                        first_step,
                        last_step,
                        whole,
                        stacks,
                        points,
                        radius,
                        parent,
                    )


@wp.kernel
def join_own_columns(
    part: int,
    parts: int,
    # in
    layout_in: wp.array(dtype=Layout),
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    offsets: wp.array(dtype=wp.vec2i),
    # in out: a map of columns and one of their roots, no column where there is none, and left so
    column_map: wp.array(dtype=wp.int32),
    root_map: wp.array(dtype=wp.int32),
    # out: roots of columns that are of one component, else -1; their places on the map; their cells' heights above
    # the lowest as a mask, 0 where it is not wide enough
    column_root: wp.array(dtype=wp.int32),
    places: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    parent: wp.array(dtype=wp.int32),
):
    """Unites the cells of a part that touch, the adjacent first: they leave little to the others."""
    layout = layout_in[0]
    begin = ranges[part][2]
    end = ranges[part][3]
    # Two columns free on either side, so that no neighbour is in the next row.
    row_length = layout.depth + 4
    rows = layout.levels * (layout.width + 2)
    mapped = layout.high_digits > 0 and rows <= column_map.shape[0] // row_length
    # Adjacent cells of a column.
    k = begin
    while k < end:
        column = at(columns, k)
        a = column[2]
        last = column[3] - 1
        put(parent, a, a)
        z = at(stacks, a)[0]
        lowest = z
        mask = wp.uint64(1)
        root = a
        while a < last:
            above = at(stacks, a + 1)[0]
            a += 1
            if above == z + 1 and _cells_touch(a - 1, a, stacks, points, radius):
                put(parent, a, at(parent, a - 1))
            else:
                put(parent, a, a)
                root = -1
            z = above
            mask = mask | (wp.uint64(1) << wp.uint64((z - lowest) & 63))
        if z - lowest > 63:
            mask = wp.uint64(0)
        masks[k] = mask
        put(column_root, k, root)
        if mapped:
            place = row_of(column[0], layout, 2) * row_length + column[1] - layout.least[1] + 2
            put(places, k, place)
            put(column_map, place, k)
        k += 1
    # Adjacent cells of adjacent columns, then all others. One loop for both, so that what it calls is compiled in once.
    ring = int(0)
    while ring < 2:
        if ring == 1:
            c = ranges[part][0]
            while c < ranges[part][1]:
                put(parent, c, at(parent, at(parent, c)))  # the parent of a lower cell is its root by now
                c += 1
            k = begin
            while k < end:
                a = at(columns, k)[2]
                last = at(columns, k)[3] - 1
                root = at(parent, a)
                while a < last:
                    a += 1
                    if at(parent, a) != root:
                        root = -1
                put(column_root, k, root)
                if mapped:
                    put(root_map, at(places, k), root)
                if root < 0:
                    _join_second_next(at(columns, k), stacks, points, radius, parent)
                k += 1
        k = begin
        while mapped and k < end:
            place = at(places, k)
            next = place + row_length
            neighbours = int(0)
            if ring == 0:
                neighbours = _bit_if_any(at(column_map, place + 1), 0) | _bit_if_any(at(column_map, next), 1)
                neighbours = neighbours | _bit_if_any(at(column_map, next - 1), 2)
                neighbours = neighbours | _bit_if_any(at(column_map, next + 1), 3)
            else:
                own = at(column_root, k)
                if own < 0:
                    own = _NO_ROOT
                second = next + row_length
                neighbours = _bit_if_other(at(root_map, place + 1), own, 0) | _bit_if_other(at(root_map, next), own, 1)
                neighbours = neighbours | _bit_if_other(at(root_map, next - 1), own, 2)
                neighbours = neighbours | _bit_if_other(at(root_map, next + 1), own, 3)
                neighbours = neighbours | _bit_if_other(at(root_map, place + 2), own, 4)
                neighbours = neighbours | _bit_if_other(at(root_map, second), own, 5)
                neighbours = neighbours | _bit_if_other(at(root_map, next - 2), own, 6)
                neighbours = neighbours | _bit_if_other(at(root_map, next + 2), own, 7)
                neighbours = neighbours | _bit_if_other(at(root_map, second - 1), own, 8)
                neighbours = neighbours | _bit_if_other(at(root_map, second + 1), own, 9)
                neighbours = neighbours | _bit_if_other(at(root_map, second - 2), own, 10)
                neighbours = neighbours | _bit_if_other(at(root_map, second + 2), own, 11)
            if neighbours != 0:
                _join_neighbours(
                    k,
                    neighbours,
                    ring,
                    begin,
                    end,
                    row_length,
                    offsets,
                    column_map,
                    places,
                    columns,
                    column_root,
                    masks,
                    stacks,
                    points,
                    radius,
                    parent,
                )
            k += 1
        if not mapped:
            dx = int(0)
            while dx < 2 + ring:
                _join_rows(
                    columns,
                    begin,
                    end,
                    begin,
                    end,
                    dx,
                    -1 - ring,
                    1 + ring,
                    ring,
                    column_root,
                    stacks,
                    points,
                    radius,
                    parent,
                )
                dx += 1
        ring += 1
    k = begin
    while mapped and k < end:
        put(column_map, at(places, k), -1)
        put(root_map, at(places, k), _NO_COLUMN)
        k += 1


@wp.kernel
def join_borders(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    column_root: wp.array(dtype=wp.int32),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of different parts that touch."""
    parts = ranges.shape[0]
    for p in range(parts):
        for q in range(p + 1, parts):
            begin = ranges[q][2]
            end = ranges[q][3]
            if begin < end:
                x = at(columns, begin)[0] - 2
                y = at(columns, begin)[1] - 2
                last = ranges[p][3]
                first = int(last)
                while first > ranges[p][2] and not is_before(at(columns, first - 1), x, y):
                    first -= 1
                dx = int(0)
                while dx < 3:
                    _join_rows(
                        columns, first, last, begin, end, dx, -2, 2, _ALL, column_root, stacks, points, radius, parent
                    )
                    dx += 1


@wp.kernel
def label_points(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    cell_of_point: wp.array(dtype=wp.int32),
    min_size: int,
    # in out: members left as labels
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Counts each component's points, numbers those with enough in the order of their first, and labels the points."""
    for p in range(ranges.shape[0]):
        c = ranges[p][0]
        end = ranges[p][1]
        while c < end:
            root = at(parent, at(parent, c))  # the parent of a lower cell is its root by now
            put(parent, c, root)
            before = int(0)
            if root != c:
                before = at(members, root)
            put(members, root, before + at(stacks, c + 1)[1] - at(stacks, c)[1])
            c += 1
    for p in range(ranges.shape[0]):
        c = ranges[p][0]
        end = ranges[p][1]
        while c < end:
            if at(parent, c) == c:
                # Of a root nothing but its label is wanted from here on.
                label = int(-1)
                if at(members, c) >= min_size:
                    label = _UNNUMBERED
                put(members, c, label)
            c += 1
    clusters = int(0)
    n = labels_out.shape[0]
    i = int(0)
    while i < n:
        label = int(-1)
        c = at(cell_of_point, i)
        if c >= 0:
            root = at(parent, c)
            label = at(members, root)
            if label == _UNNUMBERED:
                label = clusters
                put(members, root, label)
                clusters += 1
        put(labels_out, i, label)
        i += 1
    cluster_count_out[0] = clusters


class JoinedColumns:
    """Workspace to join the cells of columns that touch; `parent` tells the components."""

    def __init__(self, by_cell: CellColumns):
        """Makes it for whatever columns these can be."""
        capacity = by_cell.points.shape[0]
        places = max(LEAST_MAP, MAP_PER_POINT * capacity)
        # The adjacent columns first, and of them those that share a side.
        offsets = sorted(
            [d for d in np.ndindex(5, 5) if d > (2, 2)], key=lambda d: ((d[0] - 2) ** 2 + (d[1] - 2) ** 2, d)
        )

        def buffer(length: int, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=DEFAULT_DEVICE)

        self.by_cell = by_cell
        self.parent = buffer(capacity + by_cell.parts)
        """Of each cell one of its component, and of that itself."""
        self.column_map = wp.full(places, -1, dtype=wp.int32, device=DEFAULT_DEVICE)
        """Free between launches, with -1 everywhere."""
        self._root_map = wp.full(places, int(_NO_COLUMN), dtype=wp.int32, device=DEFAULT_DEVICE)
        self._offsets = wp.array(np.array(offsets, np.int32) - 2, dtype=wp.vec2i, device=DEFAULT_DEVICE)
        self._column_root, self._places = buffer(capacity), buffer(capacity)
        self._masks = buffer(capacity, wp.uint64)

    def launch(
        self, layout: wp.array, ranges: wp.array, columns: wp.array, stacks: wp.array, points: wp.array, radius: Radius
    ) -> None:
        """Joins the cells of columns such as `CellColumns` has; they may be those of some of its points."""
        self.by_cell.run(
            join_own_columns,
            [layout, ranges, columns, stacks, points, radius, self._offsets],
            [self.column_map, self._root_map, self._column_root, self._places, self._masks, self.parent],
        )
        if self.by_cell.parts > 1:
            wp.launch(
                join_borders,
                1,
                inputs=[ranges, columns, self._column_root, stacks, points, radius],
                outputs=[self.parent],
                device=DEFAULT_DEVICE,
            )
