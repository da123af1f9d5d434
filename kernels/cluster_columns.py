"""Clustering by one thread: columns of cells, walked through with their neighbours. `cluster.py` has the plan."""

from __future__ import annotations

import warp as wp

from .cell_pairs import Radius, cell_of, differ, find, hash_cell, hash_column, is_finite, join_levels, touch

__all__ = ["gather_cells_in_order", "join_in_order", "join_levels_in_order", "label_in_order"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_FEW = wp.constant(16)  # cells of a column that an insertion sort takes


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
def gather_cells_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
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
        usable = is_finite(point)
        if usable and has_include != 0:
            usable = include_in[i] != wp.uint8(0)
        if usable:
            cell = cell_of(point, radius)
            # Neighbours in a scan are mostly neighbours in space: often it is the cell of the point before.
            if c < 0 or differ(cell, before):
                before = cell
                slot = hash_cell(cell) & cell_mask
                c = cell_table[slot]
                while c >= 0 and differ(cells[c], cell):
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
                    slot = hash_column(cell[0], cell[1]) & column_mask
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
    radius: Radius,
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
                root_a = find(parent, a)
                root_b = find(parent, b)
                if root_a != root_b and touch(points, cell_begin[a], cell_end[a], cell_begin[b], cell_end[b], radius):
                    parent[wp.max(root_a, root_b)] = wp.min(root_a, root_b)
            t += 1


@wp.kernel
def join_in_order(
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
    radius: Radius,
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
                slot = hash_column(x, y) & mask
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
def join_levels_in_order(
    # in: of slots nothing, since the table has the cells themselves
    cell_table: wp.array(dtype=wp.int32),
    no_slots: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    sizes: wp.array(dtype=wp.int32),
    radius: Radius,
    # in out: roots
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of different levels that touch."""
    for a in range(sizes[0]):
        join_levels(a, cell_table, no_slots, cells, cell_begin, cell_end, points, radius, parent)
    for c in range(sizes[0]):
        parent[c] = parent[parent[c]]  # the parent of a lower cell is its root by now


@wp.kernel
def label_in_order(
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
