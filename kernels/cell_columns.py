"""A cloud's points by cell, for a CPU: sorted by x, y and z, so that cells stand in columns and columns in rows.

Two passes of a counting sort do it, on all cores: each part of the work counts and moves a share of the points. The
digits are made to measure from the extent of the cloud. A cloud too wide for two digits, such as one with a point a
thousand kilometres away, is sorted along each axis by as many passes as it takes, on one core.

From there on each part has the cells of a range of columns to itself. See `cell_pairs.py` for what a cell is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from .cell_pairs import Radius, cell_of, is_finite, level_of_x, x_of_level
from .device import DEFAULT_DEVICE
from .threads import PackedLaunch, launch_parts, thread_count
from .unchecked import at, put

__all__ = ["CellColumns", "Layout", "aligned", "is_before", "parts_for", "row_of"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NOWHERE = wp.constant(wp.int32(-(2**31)))  # x of the cell of points that are left out
_LEAST = wp.constant(wp.int32(-(2**31)))
_MOST = wp.constant(wp.int32(2**31 - 1))
_MOST_CELLS = wp.constant(wp.int64(2**31 - 1))
_WIDE_BITS = wp.constant(11)  # of a digit of clouds too wide for two digits made to measure
_WIDE_DIGITS = wp.constant(1 << 11)
_POINTS_WORTH_A_THREAD = 6_000


@wp.struct
class Layout:
    """How the cells of a cloud are numbered: by column, and within a column by z."""

    least: wp.vec4i  # the lowest x, y, z and level
    has_levels: int
    levels: int
    width: int  # cells along x, in each level
    depth: int  # along y
    height: int  # along z
    shift: int  # bits of a column's number that are of the low digit
    low_digits: int
    high_digits: int  # 0 where the cloud is too wide for two digits


@wp.func
def aligned(mask: wp.uint64, by: int) -> wp.uint64:
    """A mask moved by a number of heights; up to 63 of them, beyond which nothing is left."""
    moved = wp.uint64(0)
    if by >= 0 and by < 64:
        moved = mask >> wp.uint64(by)
    elif by < 0 and by > -64:
        moved = mask << wp.uint64(-by)
    return moved


@wp.func
def is_before(column: wp.vec4i, x: int, y: int) -> bool:
    """Whether a column comes before x and y."""
    return column[0] < x or (column[0] == x and column[1] < y)


@wp.func
def row_of(x: int, layout: Layout, aside: int) -> int:
    """A column's row, of which each level has those of its cells and a number aside."""
    level = int(0)
    if layout.has_levels != 0:
        level = level_of_x(x)
    return (level - layout.least[3]) * (layout.width + aside) + x - x_of_level(level) - layout.least[0]


@wp.func
def _layout_of(bounds: wp.array(dtype=wp.vec4i), parts: int, has_levels: int, most_digits: int) -> Layout:
    least = bounds[0]
    most = bounds[1]
    for part in range(1, parts):
        least = wp.min(least, bounds[2 * part])
        most = wp.max(most, bounds[2 * part + 1])
    layout = Layout()
    layout.least = least
    layout.has_levels = has_levels
    layout.levels = 1
    layout.width = 1
    layout.depth = 1
    layout.height = 1
    layout.low_digits = 1
    layout.high_digits = 1
    if least[0] > most[0]:
        return layout
    cells = wp.int64(1)
    for axis in range(4):
        extent = wp.int64(most[axis]) - wp.int64(least[axis]) + wp.int64(1)
        if extent > _MOST_CELLS / cells:
            layout.high_digits = 0
            return layout
        cells *= extent
    layout.width = most[0] - least[0] + 1
    layout.depth = most[1] - least[1] + 1
    layout.height = most[2] - least[2] + 1
    layout.levels = most[3] - least[3] + 1
    columns = layout.levels * layout.width * layout.depth
    if layout.height > most_digits:
        layout.high_digits = 0
        return layout
    while (layout.height << (layout.shift + 1)) <= (columns >> (layout.shift + 1)):
        layout.shift += 1
    layout.low_digits = layout.height << layout.shift
    layout.high_digits = ((columns - 1) >> layout.shift) + 1
    if layout.low_digits > most_digits or layout.high_digits > most_digits:
        layout.high_digits = 0
    return layout


# A block of points at a time, without a branch, which a compiler makes vector instructions of.
@wp.func_native("""
    constexpr int BLOCK = 256, NOWHERE = -2147483647 - 1;
    constexpr double FAR = 1073741824.0;
    const double inverse_side = radius.inverse_side;
    const unsigned char* __restrict include = has_include ? include_in.data : nullptr;
    int low[3] = {2147483647, 2147483647, 2147483647}, high[3] = {NOWHERE, NOWHERE, NOWHERE};
    const char* row = (const char*)xyz_in.data + (long long)first * xyz_in.strides[0];
    float along[3][BLOCK];
    int cell[3][BLOCK], usable[BLOCK];
    for (int start = first; start < last; start += BLOCK) {
        const int length = last - start < BLOCK ? last - start : BLOCK, left = used - start;
        for (int k = 0; k < length; ++k, row += xyz_in.strides[0])
            for (int axis = 0; axis < 3; ++axis) along[axis][k] = ((const float*)row)[axis];
        for (int k = 0; k < length; ++k) {
            const float x = along[0][k], y = along[1][k], z = along[2][k];
            usable[k] = ((x - x) + (y - y) + (z - z) == 0.0f) & (k < left);
        }
        if (include != nullptr)
            for (int k = 0; k < length; ++k) usable[k] &= include[start + k] != 0;
        int far = 0;
        for (int axis = 0; axis < 3; ++axis) {
            int least = low[axis], most = high[axis];
            for (int k = 0; k < length; ++k) {
                const double scaled = (double)(usable[k] ? along[axis][k] : 0.0f) * inverse_side;
                const bool is_far = (scaled >= FAR) | (scaled <= -FAR);
                far |= (int)is_far;
                const int whole = (int)(is_far ? 0.0 : scaled);
                const int index = whole - (scaled < (double)whole);
                cell[axis][k] = index;
                const int at_least = usable[k] ? index : 2147483647, at_most = usable[k] ? index : NOWHERE;
                least = at_least < least ? at_least : least;
                most = at_most > most ? at_most : most;
            }
            low[axis] = least;
            high[axis] = most;
        }
        if (far) return false;
        wp::vec3i* __restrict out = cells_out.data + start;
        int* __restrict number = cell_of_point.data + start;
        for (int k = 0; k < length; ++k) {
            out[k][0] = usable[k] ? cell[0][k] : NOWHERE;
            out[k][1] = cell[1][k];
            out[k][2] = cell[2][k];
            number[k] = -1;  // of points that take part it is set later
        }
    }
    const int level = low[0] <= high[0] ? 0 : low[0];
    bounds_out.data[2 * part] = wp::vec4i(low[0], low[1], low[2], level);
    bounds_out.data[2 * part + 1] = wp::vec4i(high[0], high[1], high[2], low[0] <= high[0] ? 0 : high[0]);
    return true;
""")
def _find_near_cells(
    part: int,
    first: int,
    last: int,
    used: int,
    xyz_in: wp.array(dtype=wp.vec3),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    cells_out: wp.array(dtype=wp.vec3i),
    cell_of_point: wp.array(dtype=wp.int32),
    bounds_out: wp.array(dtype=wp.vec4i),
) -> bool:
    """As `_find_cells` for the points first … last − 1 and one radius; False where a point is too far out for that."""
    return False


@wp.kernel
def _find_cells(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    # out: of each part the lowest and the highest x, y, z and level; how many points there are to label
    cells_out: wp.array(dtype=wp.vec3i),
    cell_of_point: wp.array(dtype=wp.int32),
    bounds_out: wp.array(dtype=wp.vec4i),
    point_count_out: wp.array(dtype=wp.int32),
):
    """Finds the cell of each point, and their extent."""
    n = xyz_in.shape[0]
    used = wp.min(count_in[0], n)
    i = n * part // parts
    end = n * (part + 1) // parts
    if part == 0:
        point_count_out[0] = n
    if radius.per_metre == wp.float64(0.0) and _find_near_cells(
        part, i, end, used, xyz_in, include_in, has_include, radius, cells_out, cell_of_point, bounds_out
    ):
        return
    low_x = int(_MOST)
    low_y = int(_MOST)
    low_z = int(_MOST)
    low_level = int(_MOST)
    high_x = int(_LEAST)
    high_y = int(_LEAST)
    high_z = int(_LEAST)
    high_level = int(_LEAST)
    while i < end:
        point = xyz_in[i]
        usable = i < used and is_finite(point)
        if usable and has_include != 0:
            usable = include_in[i] != wp.uint8(0)
        if usable:
            cell = cell_of(point, radius)
            put(cells_out, i, cell)
            x = cell[0]
            level = int(0)
            if radius.per_metre > wp.float64(0.0):
                level = level_of_x(x)
                x -= x_of_level(level)
            low_x = wp.min(low_x, x)
            low_y = wp.min(low_y, cell[1])
            low_z = wp.min(low_z, cell[2])
            low_level = wp.min(low_level, level)
            high_x = wp.max(high_x, x)
            high_y = wp.max(high_y, cell[1])
            high_z = wp.max(high_z, cell[2])
            high_level = wp.max(high_level, level)
        else:
            put(cells_out, i, wp.vec3i(_NOWHERE, 0, 0))
            put(cell_of_point, i, -1)
        i += 1
    bounds_out[2 * part] = wp.vec4i(low_x, low_y, low_z, low_level)
    bounds_out[2 * part + 1] = wp.vec4i(high_x, high_y, high_z, high_level)


@wp.kernel
def _count_digits(
    part: int,
    parts: int,
    # in
    cells: wp.array(dtype=wp.vec3i),
    bounds: wp.array(dtype=wp.vec4i),
    point_count: wp.array(dtype=wp.int32),
    has_levels: int,
    # out: a low and a high digit per point, of points that are left out -1; of each part how many have which digit
    digits_out: wp.array(dtype=wp.vec2i),
    low_counts: wp.array2d(dtype=wp.int32),
    high_counts: wp.array2d(dtype=wp.int32),
):
    """Makes the two digits of each point, and counts them."""
    layout = _layout_of(bounds, parts, has_levels, low_counts.shape[1])
    if layout.high_digits == 0:
        return
    n = point_count[0]
    low_count = low_counts[part]
    high_count = high_counts[part]
    for digit in range(layout.low_digits):
        put(low_count, digit, 0)
    for digit in range(layout.high_digits):
        put(high_count, digit, 0)
    mask = (1 << layout.shift) - 1
    least_y = layout.least[1]
    least_z = layout.least[2]
    i = n * part // parts
    end = n * (part + 1) // parts
    while i < end:
        cell = at(cells, i)
        low = int(-1)
        high = int(-1)
        if cell[0] != _NOWHERE:
            column = row_of(cell[0], layout, 0) * layout.depth + cell[1] - least_y
            low = (column & mask) * layout.height + cell[2] - least_z
            high = column >> layout.shift
            put(low_count, low, at(low_count, low) + 1)
            put(high_count, high, at(high_count, high) + 1)
        put(digits_out, i, wp.vec2i(low, high))
        i += 1


@wp.func
def _sort_wide(
    cells: wp.array(dtype=wp.vec3i),
    least: wp.vec4i,
    n: int,
    count: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    spare: wp.array(dtype=wp.vec2i),
) -> int:
    """Sorts by z, y, x with as many digits as there are; gives how many points take part."""
    used = int(0)
    low = wp.vec3i(_MOST, least[1], least[2])
    high = wp.vec3i(_LEAST, _LEAST, _LEAST)
    for i in range(n):
        if cells[i][0] != _NOWHERE:
            order[used] = i
            used += 1
            low[0] = wp.min(low[0], cells[i][0])
            high = wp.max(high, cells[i])
    axis = int(2)
    while axis >= 0:
        extent = wp.uint32(high[axis]) - wp.uint32(low[axis])
        shift = int(0)
        while shift < 32 and (extent >> wp.uint32(shift)) > wp.uint32(0):
            for digit in range(_WIDE_DIGITS):
                count[digit] = 0
            for k in range(used):
                i = order[k]
                spare[k] = wp.vec2i(
                    int((wp.uint32(cells[i][axis]) - wp.uint32(low[axis])) >> wp.uint32(shift)) & (_WIDE_DIGITS - 1), i
                )
                count[spare[k][0]] = count[spare[k][0]] + 1
            begin = int(0)
            for digit in range(_WIDE_DIGITS):
                size = count[digit]
                count[digit] = begin
                begin += size
            for k in range(used):
                digit = spare[k][0]
                order[count[digit]] = spare[k][1]
                count[digit] = count[digit] + 1
            shift += _WIDE_BITS
        axis -= 1
    return used


@wp.kernel
def _sort_low(
    part: int,
    parts: int,
    # in
    cells: wp.array(dtype=wp.vec3i),
    bounds: wp.array(dtype=wp.vec4i),
    point_count: wp.array(dtype=wp.int32),
    has_levels: int,
    digits: wp.array(dtype=wp.vec2i),
    low_counts: wp.array2d(dtype=wp.int32),
    # out: where a part puts the next point of each digit; points by their low digit, each with its high one; of a
    # wide cloud the order
    next_place: wp.array2d(dtype=wp.int32),
    by_low: wp.array(dtype=wp.vec2i),
    order: wp.array(dtype=wp.int32),
    used_out: wp.array(dtype=wp.int32),
    layout_out: wp.array(dtype=Layout),
):
    """Sorts by the low digit. Of a cloud too wide for two digits the first part does the whole sort."""
    layout = _layout_of(bounds, parts, has_levels, low_counts.shape[1])
    n = point_count[0]
    if part == 0:
        layout_out[0] = layout
    if layout.high_digits == 0:
        if part == 0:
            used_out[0] = _sort_wide(cells, layout.least, n, next_place[0], order, by_low)
        return
    place = next_place[part]
    begin = int(0)
    for digit in range(layout.low_digits):
        for other in range(parts):
            if other == part:
                put(place, digit, begin)
            begin += low_counts[other, digit]
    if part == 0:
        used_out[0] = begin
    i = n * part // parts
    end = n * (part + 1) // parts
    while i < end:
        both = at(digits, i)
        if both[0] >= 0:
            place_of = at(place, both[0])
            put(place, both[0], place_of + 1)
            put(by_low, place_of, wp.vec2i(both[1], i))
        i += 1


@wp.func
def _column_begin(order: wp.array(dtype=wp.int32), cells: wp.array(dtype=wp.vec3i), used: int, near: int) -> int:
    """The first place at or after `near` where a column begins."""
    begin = int(near)
    while begin > 0 and begin < used:
        here = cells[order[begin]]
        before = cells[order[begin - 1]]
        if here[0] != before[0] or here[1] != before[1]:
            return begin
        begin += 1
    return begin


@wp.func_native("""
    const int* __restrict index = order.data;
    const wp::vec3i* __restrict cell_of = cells.data;
    const char* __restrict rows = (const char*)xyz_in.data;
    const long long stride = xyz_in.strides[0];
    wp::vec3* __restrict point = points.data;
    wp::vec2i* __restrict stack = stacks.data;
    wp::vec4i* __restrict column = columns.data;
    int* __restrict number = cell_of_point.data;
    // Each part leaves a place free after its cells, for where the last one ends.
    int c = begin + part - 1, k = begin - 1, first = 0;
    int x = -2147483647 - 1, y = 0, z = 0;
    if (begin < end) stack[c + 1][1] = begin;
    for (int place = begin; place < end; ++place) {
        const int i = index[place];
        const float* row = (const float*)(rows + i * stride);
        point[place][0] = row[0];
        point[place][1] = row[1];
        point[place][2] = row[2];
        const int here[3] = {cell_of[i][0], cell_of[i][1], cell_of[i][2]};
        // No branch: there is no telling, and the processor has many of these on their way at once.
        const bool new_column = (here[0] != x) | (here[1] != y);
        c += new_column | (here[2] != z);
        k += new_column;
        first = new_column ? c : first;
        x = here[0];
        y = here[1];
        z = here[2];
        stack[c][0] = z;
        stack[c + 1][1] = place + 1;
        column[k][0] = x;
        column[k][1] = y;
        column[k][2] = first;
        column[k][3] = c + 1;
        number[i] = c;
    }
    if (begin < end) stack[c + 1][0] = 0;
    ranges.data[part] = wp::vec4i(begin + part, c + 1, begin, k + 1);
""")
def _list_cells(
    part: int,
    begin: int,
    end: int,
    xyz_in: wp.array(dtype=wp.vec3),
    cells: wp.array(dtype=wp.vec3i),
    order: wp.array(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    stacks: wp.array(dtype=wp.vec2i),
    columns: wp.array(dtype=wp.vec4i),
    ranges: wp.array(dtype=wp.vec4i),
):
    """Lists the cells and columns of the sorted points begin … end − 1."""


@wp.kernel
def _sort_high(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    cells: wp.array(dtype=wp.vec3i),
    layout_in: wp.array(dtype=Layout),
    used_in: wp.array(dtype=wp.int32),
    high_counts: wp.array2d(dtype=wp.int32),
    by_low: wp.array(dtype=wp.vec2i),
    # out
    next_place: wp.array2d(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    stacks: wp.array(dtype=wp.vec2i),
    columns: wp.array(dtype=wp.vec4i),
    ranges: wp.array(dtype=wp.vec4i),
):
    """Sorts a range of high digits, which is a range of columns, and lists their cells."""
    layout = layout_in[0]
    used = used_in[0]
    begin = int(0)
    end = int(0)
    if layout.high_digits == 0:
        begin = _column_begin(order, cells, used, used * part // parts)
        end = _column_begin(order, cells, used, used * (part + 1) // parts)
    else:
        place = next_place[part]
        first = int(_MOST)
        last = int(-1)
        place_of = int(0)
        # A digit is of the part in whose share of the points it begins.
        least = used * part // parts
        most = used * (part + 1) // parts
        for digit in range(layout.high_digits):
            size = int(0)
            for other in range(parts):
                size += high_counts[other, digit]
            if place_of >= least and place_of < most and size > 0:
                if last < 0:
                    first = digit
                    begin = place_of
                last = digit
                end = place_of + size
                put(place, digit, place_of)
            place_of += size
        k = int(0)
        while k < used:
            entry = at(by_low, k)
            if entry[0] >= first and entry[0] <= last:
                place_of = at(place, entry[0])
                put(place, entry[0], place_of + 1)
                put(order, place_of, entry[1])
            k += 1
    _list_cells(part, begin, end, xyz_in, cells, order, cell_of_point, points, stacks, columns, ranges)


def parts_for(capacity: int) -> int:
    """Into how many parts the work on clouds of up to `capacity` points is cut."""
    return max(1, min(thread_count(), capacity // _POINTS_WORTH_A_THREAD))


class CellColumns:
    """Workspace to sort clouds of up to `capacity` points into columns of cells; what is in it is for kernels."""

    def __init__(self, radius: Radius, capacity: int, parts: int | None = None):
        """Makes it.

        Args:
            radius: What the side of the cells follows from.
            capacity: Points that one launch can take.
            parts: Into how many the work is cut; by default as `parts_for` says.
        """
        self.parts = parts_for(capacity) if parts is None else parts
        digits = 1 << min(16, max(13, capacity.bit_length()))

        def buffer(shape: int | tuple[int, int] = capacity, dtype: type = wp.int32) -> wp.array:
            return wp.empty(shape, dtype=dtype, device=DEFAULT_DEVICE)

        self.radius = radius
        self.point_count = wp.zeros(1, dtype=wp.int32, device=DEFAULT_DEVICE)
        """Rows of the cloud, whether they take part or not."""
        self.cells = buffer(dtype=wp.vec3i)
        """Of each point; x is the lowest int32 for points that are left out."""
        self.order = buffer()
        """The points' indices by cell, in each cell in their own order."""
        self.points = buffer(dtype=wp.vec3)
        """The points in this order."""
        self.cell_of_point = buffer()
        """The number of each point's cell, or -1 for points that are left out."""
        self.stacks = buffer(capacity + self.parts, wp.vec2i)
        """Of each cell its z, and where its points begin; they end where those of the next begin."""
        self.columns = buffer(dtype=wp.vec4i)
        """Of each column x, y, its first cell, and the one after its last."""
        self.ranges = wp.zeros(self.parts, dtype=wp.vec4i, device=DEFAULT_DEVICE)
        """Of each part its first cell, the one after its last, its first column, and the one after its last."""
        self.layout = wp.empty(1, dtype=Layout, device=DEFAULT_DEVICE)
        self._bounds = buffer(2 * self.parts, wp.vec4i)
        self._digits = buffer(dtype=wp.vec2i)
        self._by_low = buffer(dtype=wp.vec2i)
        self._low_counts, self._high_counts, self._next_place = (buffer((self.parts, digits)) for _ in range(3))
        self._used = wp.zeros(1, dtype=wp.int32, device=DEFAULT_DEVICE)

        has_levels = int(radius.per_metre > 0)
        given = [self.cells, self._bounds, self.point_count, has_levels]
        self._find_cells = self.packed(
            _find_cells,
            [None, None, None, 0, radius],
            [self.cells, self.cell_of_point, self._bounds, self.point_count],
        )
        self._count_digits = self.packed(_count_digits, given, [self._digits, self._low_counts, self._high_counts])
        self._sort_low = self.packed(
            _sort_low,
            [*given, self._digits, self._low_counts],
            [self._next_place, self._by_low, self.order, self._used, self.layout],
        )
        self._sort_high = self.packed(
            _sort_high,
            [None, self.cells, self.layout, self._used, self._high_counts, self._by_low],
            [self._next_place, self.order, self.cell_of_point, self.points, self.stacks, self.columns, self.ranges],
        )

    def packed(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any]) -> PackedLaunch:
        """The launch of a kernel once per part."""
        return PackedLaunch(kernel, self.parts, inputs, outputs)

    def run(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """Launches a kernel once per part."""
        launch_parts(kernel, self.parts, inputs, outputs)

    def launch(self, xyz: wp.array, count: wp.array, include: wp.array, has_include: int) -> None:
        """Fills everything."""
        self._find_cells.launch(xyz_in=xyz, count_in=count, include_in=include, has_include=has_include)
        self._count_digits.launch()
        self._sort_low.launch()
        self._sort_high.launch(xyz_in=xyz)
