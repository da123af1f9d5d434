"""DBSCAN on a CPU: columns of cells beside their neighbours. `dbscan.py` has the plan.

The components of cores are those of Euclidean clustering of the cores alone, so that `cluster_columns.py` finds them;
here cores are told from other points before, and the others labelled after.
"""

from __future__ import annotations

import warp as wp

from .cell_pairs import Radius, is_near
from .column_neighbors import NEAR_COLUMNS
from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp)
from .parts import part_start
from .unchecked import at, put

__all__ = ["MOST_NEAR", "ROWS", "find_cores", "label_others", "list_rows", "pick_cores"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NO_LABEL = wp.constant(wp.int32(2**31 - 1))
ROWS = 5
"""Rows of columns that have some near one: its own, and two on either side."""
MOST_NEAR = 25
"""Columns near one, itself among them."""
_ROWS = wp.constant(ROWS)


# Its own row first, then those beside it.
@wp.func_native(
    "#ifndef __CUDA_ARCH__  // for CPUs alone"
    + NEAR_COLUMNS
    + """
    const int parts = ranges.shape[0], begin = ranges.data[part][2], end = ranges.data[part][3];
    for (int row = 0; row < 5; ++row) {
        const int dx = row % 2 == 0 ? row / 2 : -(row + 1) / 2;
        for (int k = begin; k < end; ++k) rows_out.data[5ll * k + row] = wp::vec2i(0, 0);
        // A row is all of one part.
        for (int other = 0; other < parts; ++other) {
            const int first = ranges.data[other][2], last = ranges.data[other][3];
            NearColumns near{columns.data, last, dx, 2, first, first};
            for (int k = begin; k < end; ++k) {
                near.move_to(k);
                if (near.first < near.last) rows_out.data[5ll * k + row] = wp::vec2i(near.first, near.last);
            }
        }
    }
    #endif
"""
)
def _list_rows(
    part: int, ranges: wp.array(dtype=wp.vec4i), columns: wp.array(dtype=wp.vec4i), rows_out: wp.array(dtype=wp.vec2i)
):
    """The stretches of columns near each of a part's."""


@wp.kernel
def list_rows(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    cell_of_point: wp.array(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    # out: of each column those near it, row by row; of points that are left out
    rows_out: wp.array(dtype=wp.vec2i),
    core_cell_of_point: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
):
    """Lists what is near each column, and marks the points that take no part."""
    _list_rows(part, ranges, columns, rows_out)
    n = point_count[0]
    for i in range(part_start(n, part, parts), part_start(n, part + 1, parts)):
        if at(cell_of_point, i) < 0:
            core_cell_of_point[i] = -1
            core_out[i] = False


@wp.func
def _list_neighbours(
    k: int, rows: wp.array(dtype=wp.vec2i), columns: wp.array(dtype=wp.vec4i), neighbours: wp.array(dtype=wp.vec2i)
) -> int:
    """Lists the column and those around it, by their first and last cells, and gives how many they are."""
    listed = int(0)
    row = int(0)
    while row < _ROWS:
        near = at(rows, k * _ROWS + row)
        other = near[0]
        while other < near[1]:
            put(neighbours, listed, wp.vec2i(at(columns, other)[2], at(columns, other)[3]))
            listed += 1
            other += 1
        row += 1
    return listed


@wp.kernel
def find_cores(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    rows: wp.array(dtype=wp.vec2i),
    radius: Radius,
    min_points: int,
    # out: of each part the columns around one; how many points are near each, up to `min_points`
    neighbours_out: wp.array2d(dtype=wp.vec2i),
    near_out: wp.array(dtype=wp.int32),
):
    """Counts what is near each point; a cell with as many as make a core needs no count."""
    neighbours = neighbours_out[part]
    k = ranges[part][2]
    while k < ranges[part][3]:
        listed = int(-1)
        a = at(columns, k)[2]
        last = at(columns, k)[3]
        while a < last:
            begin = at(stacks, a)[1]
            end = at(stacks, a + 1)[1]
            size = end - begin
            i = int(begin)
            while i < end:
                put(near_out, i, size)
                i += 1
            undecided = int(0)
            if size < min_points:
                undecided = size
                if listed < 0:
                    listed = _list_neighbours(k, rows, columns, neighbours)
            z = at(stacks, a)[0]
            n = int(0)
            while undecided > 0 and n < listed:
                b = at(neighbours, n)[0]
                b_last = at(neighbours, n)[1]
                while b < b_last and at(stacks, b)[0] < z - 2:
                    b += 1
                put(neighbours, n, wp.vec2i(b, b_last))
                while undecided > 0 and b < b_last and at(stacks, b)[0] <= z + 2:
                    if b != a:
                        others = at(stacks, b)[1]
                        others_end = at(stacks, b + 1)[1]
                        i = begin
                        while i < end:
                            near = at(near_out, i)
                            if near < min_points:
                                point = at(points, i)
                                j = int(others)
                                while j < others_end and near < min_points:
                                    if is_near(point, at(points, j), radius):
                                        near += 1
                                    j += 1
                                put(near_out, i, near)
                                if near >= min_points:
                                    undecided -= 1
                            i += 1
                    b += 1
                n += 1
            a += 1
        k += 1


@wp.kernel
def pick_cores(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=wp.int32),
    near: wp.array(dtype=wp.int32),
    min_points: int,
    # out: columns, cells and points as they are without those that are no cores; of each cell and point its cell there
    core_ranges: wp.array(dtype=wp.vec4i),
    core_columns: wp.array(dtype=wp.vec4i),
    core_stacks: wp.array(dtype=wp.vec2i),
    core_points: wp.array(dtype=wp.vec3),
    core_cell: wp.array(dtype=wp.int32),
    core_cell_of_point: wp.array(dtype=wp.int32),
):
    """Picks out the cores."""
    own = ranges[part]
    begin = own[2]
    place = int(begin)  # of the next core; parts begin at the same places as they do with all points
    next_cell = own[0]
    next_column = int(begin)
    k = int(begin)
    while k < own[3]:
        column = at(columns, k)
        first_cell = int(next_cell)
        a = column[2]
        while a < column[3]:
            cell_begin = int(place)
            i = at(stacks, a)[1]
            end = at(stacks, a + 1)[1]
            while i < end:
                cell = int(-1)
                if at(near, i) >= min_points:
                    cell = next_cell
                    put(core_points, place, at(points, i))
                    place += 1
                put(core_cell_of_point, at(order, i), cell)
                i += 1
            cell = int(-1)
            if place > cell_begin:
                cell = next_cell
                put(core_stacks, next_cell, wp.vec2i(at(stacks, a)[0], cell_begin))
                next_cell += 1
            put(core_cell, a, cell)
            a += 1
        if next_cell > first_cell:
            core_columns[next_column] = wp.vec4i(column[0], column[1], first_cell, next_cell)
            next_column += 1
        k += 1
    if next_cell > own[0]:
        put(core_stacks, next_cell, wp.vec2i(0, place))
    core_ranges[part] = wp.vec4i(own[0], next_cell, begin, next_column)


@wp.kernel
def label_others(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    order: wp.array(dtype=wp.int32),
    near: wp.array(dtype=wp.int32),
    core_stacks: wp.array(dtype=wp.vec2i),
    core_points: wp.array(dtype=wp.vec3),
    core_cell: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    label_of_root: wp.array(dtype=wp.int32),
    rows: wp.array(dtype=wp.vec2i),
    radius: Radius,
    min_points: int,
    # out
    neighbours_out: wp.array2d(dtype=wp.vec2i),
    labels_out: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
):
    """Gives points that are no cores the lowest label of a core near them, if there is one."""
    neighbours = neighbours_out[part]
    k = ranges[part][2]
    while k < ranges[part][3]:
        listed = int(-1)
        a = at(columns, k)[2]
        last = at(columns, k)[3]
        while a < last:
            z = at(stacks, a)[0]
            i = at(stacks, a)[1]
            end = at(stacks, a + 1)[1]
            own = _NO_LABEL
            if at(core_cell, a) >= 0:
                own = at(label_of_root, at(parent, at(core_cell, a)))
            while i < end:
                is_core = at(near, i) >= min_points
                core_out[at(order, i)] = is_core
                if not is_core:
                    if listed < 0:
                        listed = _list_neighbours(k, rows, columns, neighbours)
                    point = at(points, i)
                    label = int(own)
                    n = int(0)
                    while n < listed:
                        b = at(neighbours, n)[0]
                        b_last = at(neighbours, n)[1]
                        while b < b_last and at(stacks, b)[0] < z - 2:
                            b += 1
                        put(neighbours, n, wp.vec2i(b, b_last))
                        while b < b_last and at(stacks, b)[0] <= z + 2:
                            cell = at(core_cell, b)
                            if cell >= 0:
                                other = at(label_of_root, at(parent, cell))
                                j = at(core_stacks, cell)[1]
                                others_end = at(core_stacks, cell + 1)[1]
                                while other < label and j < others_end:
                                    if is_near(point, at(core_points, j), radius):
                                        label = other
                                    j += 1
                            b += 1
                        n += 1
                    if label == _NO_LABEL:
                        label = -1
                    put(labels_out, at(order, i), label)
                i += 1
            a += 1
        k += 1
