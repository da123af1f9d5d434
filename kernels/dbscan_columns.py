"""DBSCAN on a CPU: columns of cells beside their neighbours. `dbscan.py` has the plan.

The components of cores are those of Euclidean clustering of the cores alone, so that `cluster_columns.py` finds them;
here cores are told from other points before, and the others labelled after.
"""

from __future__ import annotations

import warp as wp

from .cell_columns import Layout, is_before, row_of
from .cell_pairs import Radius, is_near
from .unchecked import at, put

__all__ = ["find_cores", "label_others", "map_columns", "pick_cores", "unmap_columns"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NO_LABEL = wp.constant(wp.int32(2**31 - 1))
_MARGIN = wp.constant(2)  # columns free on either side of the map, so that no neighbour is in another row


@wp.func
def _is_mapped(layout: Layout, size: int) -> bool:
    rows = layout.levels * (layout.width + 2 * _MARGIN)
    return layout.high_digits > 0 and rows <= size // (layout.depth + 2 * _MARGIN)


@wp.func
def _place_of(x: int, y: int, layout: Layout) -> int:
    row = row_of(x, layout, 2 * _MARGIN) + _MARGIN
    return row * (layout.depth + 2 * _MARGIN) + y - layout.least[1] + _MARGIN


@wp.func
def _search_column(x: int, y: int, ranges: wp.array(dtype=wp.vec4i), columns: wp.array(dtype=wp.vec4i)) -> int:
    """The column at x and y, by bisection, or -1."""
    found = int(-1)
    for p in range(ranges.shape[0]):
        low = ranges[p][2]
        high = ranges[p][3]
        end = high
        while low < high:
            middle = low + (high - low) // 2
            if is_before(at(columns, middle), x, y):
                low = middle + 1
            else:
                high = middle
        if low < end and at(columns, low)[0] == x and at(columns, low)[1] == y:
            found = low
    return found


@wp.func
def _list_neighbours(
    k: int,
    layout: Layout,
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    offsets: wp.array(dtype=wp.vec2i),
    column_map: wp.array(dtype=wp.int32),
    neighbours: wp.array(dtype=wp.vec2i),
) -> int:
    """Lists the column and those around it, by their first and last cells, and gives how many they are."""
    x = at(columns, k)[0]
    y = at(columns, k)[1]
    mapped = _is_mapped(layout, column_map.shape[0])
    row_length = layout.depth + 2 * _MARGIN
    place = int(0)
    if mapped:
        place = _place_of(x, y, layout)
    listed = int(0)
    o = int(0)
    while o < offsets.shape[0]:
        offset = at(offsets, o)
        other = int(-1)
        if mapped:
            other = at(column_map, place + offset[0] * row_length + offset[1])
        else:
            other = _search_column(x + offset[0], y + offset[1], ranges, columns)
        if other >= 0:
            put(neighbours, listed, wp.vec2i(at(columns, other)[2], at(columns, other)[3]))
            listed += 1
        o += 1
    return listed


@wp.kernel
def map_columns(
    part: int,
    parts: int,
    # in
    layout_in: wp.array(dtype=Layout),
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    cell_of_point: wp.array(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    # in out: -1 where there is no column
    column_map: wp.array(dtype=wp.int32),
    # out, of points that are left out
    core_cell_of_point: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
):
    """Puts the columns on the map, and marks the points that take no part."""
    layout = layout_in[0]
    if _is_mapped(layout, column_map.shape[0]):
        for k in range(ranges[part][2], ranges[part][3]):
            put(column_map, _place_of(at(columns, k)[0], at(columns, k)[1], layout), k)
    n = point_count[0]
    for i in range(n * part // parts, n * (part + 1) // parts):
        if at(cell_of_point, i) < 0:
            core_cell_of_point[i] = -1
            core_out[i] = False


@wp.kernel
def unmap_columns(
    part: int,
    parts: int,
    # in
    layout_in: wp.array(dtype=Layout),
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    # in out
    column_map: wp.array(dtype=wp.int32),
):
    """Takes the columns off the map."""
    layout = layout_in[0]
    if _is_mapped(layout, column_map.shape[0]):
        for k in range(ranges[part][2], ranges[part][3]):
            put(column_map, _place_of(at(columns, k)[0], at(columns, k)[1], layout), -1)


@wp.kernel
def find_cores(
    part: int,
    parts: int,
    # in
    layout_in: wp.array(dtype=Layout),
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    offsets: wp.array(dtype=wp.vec2i),
    column_map: wp.array(dtype=wp.int32),
    radius: Radius,
    min_points: int,
    # out: of each part the columns around one; how many points are near each, up to `min_points`
    neighbours_out: wp.array2d(dtype=wp.vec2i),
    near_out: wp.array(dtype=wp.int32),
):
    """Counts what is near each point; a cell with as many as make a core needs no count."""
    layout = layout_in[0]
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
                    listed = _list_neighbours(k, layout, ranges, columns, offsets, column_map, neighbours)
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
    layout_in: wp.array(dtype=Layout),
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
    offsets: wp.array(dtype=wp.vec2i),
    column_map: wp.array(dtype=wp.int32),
    radius: Radius,
    min_points: int,
    # out
    neighbours_out: wp.array2d(dtype=wp.vec2i),
    labels_out: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
):
    """Gives points that are no cores the lowest label of a core near them, if there is one."""
    layout = layout_in[0]
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
                        listed = _list_neighbours(k, layout, ranges, columns, offsets, column_map, neighbours)
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
