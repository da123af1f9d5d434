"""Euclidean clustering, exact: points are of one cluster where a chain of steps no longer than the radius joins them.

Space is cut into cells of side radius / √3, so that a cell is one component by itself and only pairs of cells are
left to join: those at most two cells apart, by the first pair of points found within the radius. A CPU walks through
columns of cells with their neighbours; a GPU tries all pairs of cells at once. The labels are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["EuclideanCluster", "cluster"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LARGEST_CELL = wp.constant(wp.float64(2.0**30))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_NO_POINT = wp.constant(wp.int32(2**31 - 1))
_BRUTE_FORCE = wp.constant(wp.int64(4096))  # pairs of points up to which nothing beats trying them all
_SMALLEST_RADIUS = 1e-8
_FEW = wp.constant(16)  # cells of a column that an insertion sort takes


@wp.struct
class _Radius:
    inverse_side: wp.float64  # of a cell
    surely: wp.float32  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not: wp.float32  # and above here they are not
    squared: wp.float64


# ---- cells


@wp.func
def _cell_along(coordinate: float, inverse_side: wp.float64) -> int:
    """The cell's index along an axis; where float32 has no neighbours within a cell any more, the number's own bits."""
    scaled = wp.float64(coordinate) * inverse_side
    cell = int(0)
    if wp.abs(scaled) < _LARGEST_CELL:
        cell = int(wp.floor(scaled))
    elif coordinate > 0.0:
        cell = wp.cast(coordinate, wp.int32)
    else:
        cell = -wp.cast(-coordinate, wp.int32)
    return cell


@wp.func
def _cell_of(point: wp.vec3, radius: _Radius) -> wp.vec3i:
    return wp.vec3i(
        _cell_along(point[0], radius.inverse_side),
        _cell_along(point[1], radius.inverse_side),
        _cell_along(point[2], radius.inverse_side),
    )


@wp.func
def _is_finite(point: wp.vec3) -> bool:
    return (point[0] - point[0]) + (point[1] - point[1]) + (point[2] - point[2]) == 0.0


@wp.func
def _differ(a: wp.vec3i, b: wp.vec3i) -> bool:
    return a[0] != b[0] or a[1] != b[1] or a[2] != b[2]


@wp.func
def _hash_cell(cell: wp.vec3i) -> int:
    """Blocks of 4 × 4 × 2 cells are spread over the table; within one, neighbours in space share cache lines."""
    block = (
        wp.uint32(cell[0] >> 2) * wp.uint32(73856093)
        ^ wp.uint32(cell[1] >> 2) * wp.uint32(19349669)
        ^ wp.uint32(cell[2] >> 1) * wp.uint32(83492791)
    )
    within = ((cell[0] & 3) << 3) | ((cell[1] & 3) << 1) | (cell[2] & 1)
    return int((((block * _SPREAD) >> wp.uint32(7)) << wp.uint32(5)) & wp.uint32(0x3FFFFFE0)) | within


@wp.func
def _hash_column(x: int, y: int) -> int:
    """Tiles of 512 × 512 columns are spread over the table; within one, neighbours in space share cache lines."""
    tile = wp.uint32(x >> 9) * wp.uint32(73856093) ^ wp.uint32(y >> 9) * wp.uint32(19349669)
    return int(((tile * _SPREAD) ^ wp.uint32((x & 511) * 512 + (y & 511))) & wp.uint32(0x3FFFFFFF))


# ---- pairs of cells


@wp.func
def _is_near(p: wp.vec3, q: wp.vec3, radius: _Radius) -> bool:
    """Whether the distance is within the radius, as float64 decides; float32 does where it is sure to agree."""
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    squared = x * x + y * y + z * z
    near = squared <= radius.surely
    if squared > radius.surely and squared <= radius.surely_not:
        dx = wp.float64(p[0]) - wp.float64(q[0])
        dy = wp.float64(p[1]) - wp.float64(q[1])
        dz = wp.float64(p[2]) - wp.float64(q[2])
        near = dx * dx + dy * dy + dz * dz <= radius.squared
    return near


@wp.func
def _gap_squared(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """The squared distance of a point to a box."""
    gap = wp.max(wp.max(low - p, p - high), wp.vec3(0.0))
    return gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2]


@wp.func
def _touch_large(
    points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: _Radius
) -> bool:
    """As `_touch`, for crowded cells: narrows both sides to what lies near the other's box before it tries pairs."""
    infinite = float(wp.inf)
    a_low = wp.vec3(-infinite)
    a_high = wp.vec3(infinite)
    b_low = wp.vec3(-infinite)
    b_high = wp.vec3(infinite)
    a_left = a_end - a_begin
    b_left = b_end - b_begin
    for _ in range(8):
        low = wp.vec3(infinite)
        high = wp.vec3(-infinite)
        left = int(0)
        for i in range(a_begin, a_end):
            p = points[i]
            if _gap_squared(p, b_low, b_high) <= radius.surely_not:
                low = wp.min(low, p)
                high = wp.max(high, p)
                left += 1
        narrowed = left < a_left
        a_low = low
        a_high = high
        a_left = left
        low = wp.vec3(infinite)
        high = wp.vec3(-infinite)
        left = int(0)
        for j in range(b_begin, b_end):
            q = points[j]
            if _gap_squared(q, a_low, a_high) <= radius.surely_not:
                low = wp.min(low, q)
                high = wp.max(high, q)
                left += 1
        narrowed = narrowed or left < b_left
        b_low = low
        b_high = high
        b_left = left
        if a_left == 0 or b_left == 0:
            return False
        if not narrowed and _ > 0:
            break
    for i in range(a_begin, a_end):
        p = points[i]
        if _gap_squared(p, b_low, b_high) <= radius.surely_not:
            for j in range(b_begin, b_end):
                if _is_near(p, points[j], radius):
                    return True
    return False


@wp.func
def _touch(
    points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: _Radius
) -> bool:
    """Whether any point of one cell is within the radius of any point of another."""
    if wp.int64(a_end - a_begin) * wp.int64(b_end - b_begin) > _BRUTE_FORCE:
        return _touch_large(points, a_begin, a_end, b_begin, b_end, radius)
    for i in range(a_begin, a_end):
        p = points[i]
        for j in range(b_begin, b_end):
            if _is_near(p, points[j], radius):
                return True
    return False


@wp.func
def _find(parent: wp.array(dtype=wp.int32), cell: int) -> int:
    """The root of a cell. Halves the path; a write lost to another thread leaves an ancestor all the same."""
    root = int(cell)
    above = parent[root]
    while above != root:
        next = parent[above]
        parent[root] = next
        root = next
        above = parent[root]
    return root


@wp.func
def _unite(parent: wp.array(dtype=wp.int32), a: int, b: int):
    """Joins two components; the lower root stays, so that it is the lowest cell of its component in the end."""
    low = _find(parent, a)
    high = _find(parent, b)
    while low != high:
        if low > high:
            swap = low
            low = high
            high = swap
        found = wp.atomic_cas(parent, high, high, low)
        if found == high:
            high = low
        else:
            # Another thread was first: go on from where it hung the root.
            high = _find(parent, found)
            low = _find(parent, low)


# ---- one thread, in order


@wp.func
def _sort_by_height(stack: wp.array(dtype=wp.vec2i), begin: int, end: int):
    """Shell sort, which for the few cells of most columns is an insertion sort."""
    gap = int(1)
    if end - begin > _FEW:
        while gap < (end - begin) // 3:
            gap = gap * 3 + 1
    while gap > 0:
        for i in range(begin + gap, end):
            moving = stack[i]
            place = int(i)
            while place >= begin + gap and stack[place - gap][0] > moving[0]:
                stack[place] = stack[place - gap]
                place -= gap
            stack[place] = moving
        gap = gap // 3


@wp.kernel
def _gather_cells_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: _Radius,
    # in out: tables of cells and of columns, -1 where free
    cell_table: wp.array(dtype=wp.int32),
    column_table: wp.array(dtype=wp.int32),
    # out
    cell_of_point: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_slot: wp.array(dtype=wp.int32),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    cell_column: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.vec4i),
    column_slot: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    stack: wp.array(dtype=wp.vec2i),
    sizes: wp.array(dtype=wp.int32),
):
    """Numbers cells by their lowest point, lists the points of each cell, and by height the cells of each column."""
    cell_mask = cell_table.shape[0] - 1
    column_mask = column_table.shape[0] - 1
    cell_count = int(0)
    column_count = int(0)
    c = int(-1)
    before = wp.vec3i(0, 0, 0)
    n = wp.min(count_in[0], xyz_in.shape[0])
    for i in range(n):
        point = xyz_in[i]
        usable = _is_finite(point)
        if usable and has_include != 0:
            usable = include_in[i] != wp.uint8(0)
        if usable:
            cell = _cell_of(point, radius)
            # Neighbours in a scan are mostly neighbours in space: often it is the cell of the point before.
            if c < 0 or _differ(cell, before):
                before = cell
                slot = _hash_cell(cell) & cell_mask
                c = cell_table[slot]
                while c >= 0 and _differ(cells[c], cell):
                    slot = (slot + 1) & cell_mask
                    c = cell_table[slot]
                if c < 0:
                    c = cell_count
                    cell_count += 1
                    cell_table[slot] = c
                    cell_slot[c] = slot
                    cells[c] = cell
                    cell_end[c] = 0
                    parent[c] = c
                    slot = _hash_column(cell[0], cell[1]) & column_mask
                    k = column_table[slot]
                    while k >= 0 and (columns[k][0] != cell[0] or columns[k][1] != cell[1]):
                        slot = (slot + 1) & column_mask
                        k = column_table[slot]
                    if k < 0:
                        k = column_count
                        column_count += 1
                        column_table[slot] = k
                        column_slot[k] = slot
                        columns[k] = wp.vec4i(cell[0], cell[1], 0, 0)
                    cell_column[c] = k
                    columns[k] = columns[k] + wp.vec4i(0, 0, 0, 1)
            cell_of_point[i] = c
            cell_end[c] = cell_end[c] + 1
        else:
            cell_of_point[i] = -1
    # From sizes to where each begins; the end then moves as it is filled.
    begin = int(0)
    for k in range(column_count):
        column = columns[k]
        columns[k] = wp.vec4i(column[0], column[1], begin, begin)
        begin += column[3]
    begin = int(0)
    for v in range(cell_count):
        cell_begin[v] = begin
        begin += cell_end[v]
        cell_end[v] = cell_begin[v]
        k = cell_column[v]
        stack[columns[k][3]] = wp.vec2i(cells[v][2], v)
        columns[k] = columns[k] + wp.vec4i(0, 0, 0, 1)
    for i in range(n):
        v = cell_of_point[i]
        if v >= 0:
            end = cell_end[v]
            points[end] = xyz_in[i]
            cell_end[v] = end + 1
    for k in range(column_count):
        _sort_by_height(stack, columns[k][2], columns[k][3])
    sizes[0] = cell_count
    sizes[1] = column_count


@wp.func
def _join_stacks(
    stack: wp.array(dtype=wp.vec2i),
    begin: int,
    end: int,
    other_begin: int,
    other_end: int,
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    radius: _Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites the cells of two columns that touch; of a column and itself, where the two begin alike."""
    low = int(other_begin)
    for s in range(begin, end):
        z = stack[s][0]
        a = stack[s][1]
        if begin == other_begin:
            low = s + 1
        while low < other_end and stack[low][0] < z - 2:
            low += 1
        t = int(low)
        while t < other_end and stack[t][0] <= z + 2:
            b = stack[t][1]
            if parent[a] != parent[b]:
                root_a = _find(parent, a)
                root_b = _find(parent, b)
                if root_a != root_b and _touch(points, cell_begin[a], cell_end[a], cell_begin[b], cell_end[b], radius):
                    parent[wp.max(root_a, root_b)] = wp.min(root_a, root_b)
            t += 1


@wp.kernel
def _join_in_order(
    # in
    column_table: wp.array(dtype=wp.int32),
    columns: wp.array(dtype=wp.vec4i),
    stack: wp.array(dtype=wp.vec2i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    sizes: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec2i),
    near_offsets: int,
    radius: _Radius,
    # in out: roots of columns that are of one component, else -1
    parent: wp.array(dtype=wp.int32),
    column_root: wp.array(dtype=wp.int32),
):
    """Unites cells of a column and of neighbouring columns, the adjacent first: they leave little to the others."""
    mask = column_table.shape[0] - 1
    for k in range(sizes[1]):
        column_root[k] = -1
        begin = columns[k][2]
        end = columns[k][3]
        _join_stacks(stack, begin, end, begin, end, cell_begin, cell_end, points, radius, parent)
    for ring in range(2):
        first = int(0)
        last = int(near_offsets)
        if ring == 1:
            first = near_offsets
            last = offsets.shape[0]
        for k in range(sizes[1]):
            here = columns[k]
            root = column_root[k]
            for o in range(first, last):
                x = here[0] + offsets[o][0]
                y = here[1] + offsets[o][1]
                slot = _hash_column(x, y) & mask
                other = column_table[slot]
                while other >= 0:
                    there = columns[other]
                    if there[0] == x and there[1] == y:
                        if root < 0 or column_root[other] != root:
                            _join_stacks(
                                stack,
                                here[2],
                                here[3],
                                there[2],
                                there[3],
                                cell_begin,
                                cell_end,
                                points,
                                radius,
                                parent,
                            )
                        other = -1
                    else:
                        slot = (slot + 1) & mask
                        other = column_table[slot]
        for c in range(sizes[0]):
            parent[c] = parent[parent[c]]  # the parent of a lower cell is its root by now
        if ring == 0:
            for k in range(sizes[1]):
                begin = columns[k][2]
                root = parent[stack[begin][1]]
                for s in range(begin + 1, columns[k][3]):
                    if parent[stack[s][1]] != root:
                        root = -1
                column_root[k] = root


@wp.kernel
def _label_in_order(
    # in
    count_in: wp.array(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    cell_slot: wp.array(dtype=wp.int32),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    column_slot: wp.array(dtype=wp.int32),
    sizes: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    min_size: int,
    # in out: tables left free; members left as labels
    cell_table: wp.array(dtype=wp.int32),
    column_table: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Counts each component's points, numbers those with enough, and hands the numbers to the points."""
    for c in range(sizes[0]):
        cell_table[cell_slot[c]] = -1
        root = parent[c]
        if root == c:
            members[c] = 0
        members[root] = members[root] + cell_end[c] - cell_begin[c]
    for k in range(sizes[1]):
        column_table[column_slot[k]] = -1
    clusters = int(0)
    for c in range(sizes[0]):
        root = parent[c]
        if root == c:
            # Of a root nothing but its label is wanted from here on.
            label = int(-1)
            if members[c] >= min_size:
                label = clusters
                clusters += 1
            members[c] = label
        else:
            members[c] = members[root]
    for i in range(labels_out.shape[0]):
        label = int(-1)
        if i < count_in[0] and cell_of_point[i] >= 0:
            label = members[cell_of_point[i]]
        labels_out[i] = label
    cluster_count_out[0] = clusters


# ---- many threads


@wp.kernel
def _claim_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: _Radius,
    # in out: a table of points that stand for their cells, -1 where free; lowest points and sizes
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    slot_of_point: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
):
    """Finds each point's slot in the table, which whichever point comes first claims for the cell."""
    i = wp.tid()
    slot_of_point[i] = -1
    cell_size[i] = 0
    if i >= count_in[0]:
        return
    point = xyz_in[i]
    if not _is_finite(point):
        return
    if has_include != 0 and include_in[i] == wp.uint8(0):
        return
    cell = _cell_of(point, radius)
    mask = table.shape[0] - 1
    slot = _hash_cell(cell) & mask
    found = wp.atomic_cas(table, slot, -1, i)
    while found >= 0 and _differ(_cell_of(xyz_in[wp.max(found, 0)], radius), cell):
        slot = (slot + 1) & mask
        found = wp.atomic_cas(table, slot, -1, i)
    slot_of_point[i] = slot
    wp.atomic_min(lowest, slot, i)
    wp.atomic_add(size, slot, 1)


@wp.kernel
def _mark_lowest(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the lowest point of each cell."""
    i = wp.tid()
    head = int(0)
    slot = slot_of_point[i]
    if slot >= 0 and lowest[slot] == i:
        head = 1
    head_out[i] = head


@wp.kernel
def _number_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    radius: _Radius,
    # out
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_size: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
):
    """Numbers the cells by their lowest point."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cell_count[0] = rank_in[i]
    if head_in[i] == 0:
        return
    slot = slot_of_point[i]
    c = rank_in[i] - 1
    cell_of_slot[slot] = c
    cells[c] = _cell_of(xyz_in[i], radius)
    cell_size[c] = size[slot]
    parent[c] = c
    members[c] = 0


@wp.kernel
def _scatter_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    # in out: where each cell ends, from last to first
    cell_end: wp.array(dtype=wp.int32),
    # out
    points: wp.array(dtype=wp.vec3),
):
    """Lists the points of each cell, in any order: whether two cells touch does not hang on it."""
    i = wp.tid()
    slot = slot_of_point[i]
    if slot >= 0:
        points[wp.atomic_sub(cell_end, cell_of_slot[slot], 1) - 1] = xyz_in[i]


@wp.kernel
def _join_cells(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    cell_count: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3i),
    radius: _Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites a cell with one of its neighbours, if they touch."""
    o, a = wp.tid()
    if a >= cell_count[0]:
        return
    wanted = cells[a] + offsets[o]
    mask = table.shape[0] - 1
    slot = _hash_cell(wanted) & mask
    while table[slot] >= 0:
        b = cell_of_slot[slot]
        if _differ(cells[b], wanted):
            slot = (slot + 1) & mask
        else:
            if _find(parent, a) != _find(parent, b):
                a_begin = cell_begin[a]
                b_begin = cell_begin[b]
                if _touch(points, a_begin, a_begin + cell_size[a], b_begin, b_begin + cell_size[b], radius):
                    _unite(parent, a, b)
            return


@wp.kernel
def _count_members(
    # in
    cell_size: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    # in out
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
):
    c = wp.tid()
    if c < cell_count[0]:
        wp.atomic_add(members, _find(parent, c), cell_size[c])


@wp.kernel
def _mark_clusters(
    # in
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    min_size: int,
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the root cells of components with enough points."""
    c = wp.tid()
    head = int(0)
    if c < cell_count[0] and parent[c] == c and members[c] >= min_size:
        head = 1
    head_out[c] = head


@wp.kernel
def _label_points(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    # in out: paths may be halved; the table is left free
    parent: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Hands each point the number of its component."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cluster_count_out[0] = rank_in[i]
    label = int(-1)
    slot = slot_of_point[i]
    if slot >= 0:
        root = _find(parent, cell_of_slot[slot])
        if head_in[root] == 1:
            label = rank_in[root] - 1
        table[slot] = -1
        lowest[slot] = _NO_POINT
        size[slot] = 0
    labels_out[i] = label


# ---- the public faces


@dataclass(frozen=True, kw_only=True)
class EuclideanCluster:
    """A plan: workspace to cluster clouds of up to `capacity` points, of which it keeps the `labels`."""

    radius: float
    """Longest step [m] that joins two points."""
    min_size: int = 1
    """Points that make a cluster; smaller ones get the label -1."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""
    labels: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), int32: clusters numbered by their lowest point from 0, or -1; as many set as points
    were given."""
    cluster_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many clusters there are."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not (self.radius >= _SMALLEST_RADIUS and math.isfinite(self.radius)):
            raise ValueError(
                f"radius must be a positive number of metres (at least {_SMALLEST_RADIUS}), not {self.radius}"
            )
        for name in ("min_size", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
        slots = 2 << (self.capacity - 1).bit_length()

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffers(dtype: type, *names: str) -> None:
            for name in names:
                keep(name, wp.empty(self.capacity, dtype=dtype, device=device))

        radius = _Radius()
        # A hair shorter, so that no rounding makes the diagonal longer than the radius.
        radius.inverse_side = math.sqrt(3.0) / (self.radius * (1.0 - 1e-6))
        radius.squared = self.radius * self.radius
        radius.surely, radius.surely_not = radius.squared * (1.0 - 1e-6), radius.squared * (1.0 + 1e-6)
        keep("_radius", radius)
        keep("_sequential", sequential)
        keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))
        keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
        buffers(wp.vec3, "_points")
        buffers(wp.vec3i, "_cells")
        buffers(wp.int32, "labels", "_cell_begin", "_cell_end", "_parent", "_members")
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        forward = [d for d in np.ndindex(5, 5, 5) if d > (2, 2, 2)]
        offsets = np.array(sorted(forward, key=lambda d: sum((i - 2) ** 2 for i in d)), np.int32) - 2
        if sequential:
            flat = np.unique(offsets[:, :2], axis=0)
            flat = flat[np.argsort((flat**2).sum(1), kind="stable")][1:]
            keep("_near_offsets", int((np.abs(flat).max(1) == 1).sum()))
            keep("_offsets", wp.array(flat, dtype=wp.vec2i, device=device))
            keep("_column_table", wp.full(slots, -1, dtype=wp.int32, device=device))
            buffers(wp.vec4i, "_columns")
            buffers(wp.vec2i, "_stack")
            buffers(wp.int32, "_cell_of_point", "_cell_slot", "_cell_column")
            buffers(wp.int32, "_column_slot", "_column_root")
            keep("_sizes", wp.zeros(2, dtype=wp.int32, device=device))
        else:
            keep("_offsets", wp.array(offsets, dtype=wp.vec3i, device=device))
            keep("_lowest", wp.full(slots, 2**31 - 1, dtype=wp.int32, device=device))
            keep("_size", wp.zeros(slots, dtype=wp.int32, device=device))
            keep("_cell_of_slot", wp.empty(slots, dtype=wp.int32, device=device))
            keep("_cell_count", wp.zeros(1, dtype=wp.int32, device=device))
            buffers(wp.int32, "_slot_of_point", "_head", "_rank", "_cell_size")

    def launch(self, xyz: wp.array, count: wp.array, include: wp.array | None = None) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            include: Shape (n or more,), bool or uint8: where it is zero, a point takes no part and gets the label -1.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if include is None:
            mask, has_include = self._no_include, 0
        else:
            if include.shape[0] < n or include.dtype not in (wp.bool, wp.uint8):
                raise ValueError(f"include must be bool or uint8 with at least {n} rows, as there are points")
            mask, has_include = include.view(wp.uint8) if include.dtype == wp.bool else include, 1
        given = [xyz, count, mask, has_include, self._radius]
        if self._sequential:
            self._launch_in_order(n, given)
        elif n == 0:
            self.cluster_count.zero_()
        else:
            self._launch_shared(n, given)

    def _launch_in_order(self, n: int, given: list) -> None:
        tables = [self._table, self._column_table]
        cell_ends = [self._cell_begin, self._cell_end]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, 1, inputs=inputs, outputs=outputs, device=self.device)

        run(
            _gather_cells_in_order,
            given,
            [
                *(*tables, self._cell_of_point, self._cells, self._cell_slot, *cell_ends, self._cell_column),
                *(self._columns, self._column_slot, self._parent, self._points, self._stack, self._sizes),
            ],
        )
        run(
            _join_in_order,
            [
                *(self._column_table, self._columns, self._stack, *cell_ends, self._points, self._sizes),
                *(self._offsets, self._near_offsets, self._radius),
            ],
            [self._parent, self._column_root],
        )
        run(
            _label_in_order,
            [
                *(given[1], self._cell_of_point, self._cell_slot, *cell_ends, self._column_slot),
                *(self._sizes, self._parent, self.min_size),
            ],
            [*tables, self._members, self.labels[:n], self.cluster_count],
        )

    def _launch_shared(self, n: int, given: list) -> None:
        xyz, radius = given[0], self._radius
        slot_of_point, head, rank = self._slot_of_point[:n], self._head[:n], self._rank[:n]
        cell_size, cell_begin, cell_end = self._cell_size[:n], self._cell_begin[:n], self._cell_end[:n]
        slots = [self._table, self._lowest, self._size]

        def run(kernel: wp.Kernel, inputs: list, outputs: list, dim: int | tuple[int, int] = n) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        # Cells, numbered by their lowest point.
        run(_claim_cells, given, [*slots, slot_of_point, cell_size])
        run(_mark_lowest, [slot_of_point, self._lowest], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _number_cells,
            [xyz, slot_of_point, head, rank, self._size, radius],
            [self._cell_of_slot, self._cells, cell_size, self._parent, self._members, self._cell_count],
        )
        # Points by cell.
        wp.utils.array_scan(cell_size, cell_begin, inclusive=False)
        wp.utils.array_scan(cell_size, cell_end, inclusive=True)
        run(_scatter_points, [xyz, slot_of_point, self._cell_of_slot], [cell_end, self._points])
        # Components of cells.
        run(
            _join_cells,
            [
                *(self._table, self._cell_of_slot, self._lowest, self._cells, cell_begin, cell_size, self._points),
                *(self._cell_count, self._offsets, radius),
            ],
            [self._parent],
            (self._offsets.shape[0], n),
        )
        run(_count_members, [cell_size, self._cell_count], [self._parent, self._members])
        # Labels.
        run(_mark_clusters, [self._members, self._cell_count, self._parent, self.min_size], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _label_points,
            [slot_of_point, self._cell_of_slot, head, rank],
            [self._parent, *slots, self.labels, self.cluster_count],
        )


def cluster(points: Any, radius: float, min_size: int = 1) -> Any:
    """Groups points that a chain of steps no longer than `radius` joins.

    The connected components of the graph of all pairs with distance ≤ radius, as float64 decides on the float32
    positions: the partition of a KD-tree's pairs and a graph search, or of DBSCAN with a single point as a core.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        radius: Longest step [m], > 0.
        min_size: Points that make a cluster.

    Returns:
        Labels, shape (n,), int32, of the same family and on the same device as `points`: clusters are numbered
        from 0 by the lowest index of a point in them; -1 marks points of smaller components and those that are not
        finite.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `radius` is not positive, or `min_size` is below 1.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(
        EuclideanCluster,
        radius=float(radius),
        min_size=int(min_size),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.labels[:n], borrowed.family)
