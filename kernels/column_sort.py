"""Points by cell on a CPU: columns of cells in order of x and y, in each the cells in order of z. C++ for a kernel.

What is occupied is marked by bits: one for each block of up to 64 cells on top of each other, in rows along y, and in
a mask for each block that has points, one for each of its cells. A cell's number is then how many bits are set before
its own. So no point is moved before its place is known; points one after the other in a scan lie beside each other,
and so do their bits. Where the cloud is too wide for a bit a block, such as one with a point a thousand kilometres
away, a radix sort along each axis does it instead.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp)

__all__ = ["FIND_COLUMNS", "LAYOUT", "LEFT_OUT", "bits_for", "sort_cells"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LEAST_WORDS, _WORDS_PER_POINT, _MOST_WORDS = 1 << 16, 2, 1 << 24
LEFT_OUT = wp.constant(wp.int32(-(2**31)))
"""x of the cell of points that are left out."""


def bits_for(capacity: int, parts: int) -> int:
    """How many words of bits each part of a plan for up to `capacity` points has."""
    return min(max(_LEAST_WORDS, _WORDS_PER_POINT * capacity) // parts, _MOST_WORDS)


LAYOUT = 7
"""Numbers that say how a part's bits are laid out: words a row, or 0 where the cloud was too wide for bits; blocks a
column, as a power of two; the lowest x, y and level; rows a level; and where the columns of its blocks are listed."""

FIND_COLUMNS = """
    // Columns by the bits that they were numbered by.
    struct ColumnsByBits {
        const unsigned long long* word;
        const int *rank, *column_of, *layout;
        // The first column of a part whose bit is not before `at`.
        int from(const int at) const {
            const unsigned long long before = word[at >> 6] & (((unsigned long long)1 << (at & 63)) - 1);
            return column_of[rank[at >> 6] + __builtin_popcountll(before)];
        }
        // Those of a row, `dx` rows on, with y from y - 2 to y + 2: first, and one after the last.
        void find(const int x, const int y, const int level, const int dx, int& first, int& last) const {
            const int along = x - level * (1 << 19) - layout[2] + dx;
            first = last = column_of[0];
            if (along >= layout[5]) return;
            const int row_bits = layout[0] * 64, shift = layout[1], near = y - layout[3];
            const int row = ((level - layout[4]) * layout[5] + along) * row_bits;
            const int low = near > 2 ? (near - 2) << shift : 0, high = (near + 3) << shift;
            first = from(row + low);
            last = from(row + (high < row_bits ? high : row_bits));
        }
    };
"""
"""C++: `ColumnsByBits near{words, ranks, columns, layout}` of a part, and `near.find(x, y, level, dx, first, last)`."""

# Parts are cut by rows of columns, at the quantiles of a sample of the points.
_SORT = """
    typedef unsigned long long Bits;
    constexpr int NOWHERE = -2147483647 - 1, SAMPLE = 512;
    #ifdef __CUDA_ARCH__
    const auto popcount = [](const Bits bits) { return __popcll(bits); };
    #else
    const auto popcount = [](const Bits bits) { return (int)__builtin_popcountll(bits); };
    #endif
    const auto below = [](const int bit) { return ((Bits)1 << bit) - 1; };
    const int n = point_count.data[0];
    const int stride = cells.shape[1];
    const int* __restrict cell_x = cells.data;
    const int* __restrict cell_y = cell_x + stride;
    const int* __restrict cell_z = cell_y + stride;

    // The points of this part, and how far they reach.
    long long first_x = NOWHERE + 1ll, end_x = 1ll << 31;
    if (parts > 1) {
        int sample[SAMPLE], samples = 0;
        for (int i = 0; i < n; i += n / SAMPLE + 1) {
            const int x = cell_x[i];
            if (x == NOWHERE) continue;
            int place = samples++;
            for (; place > 0 && sample[place - 1] > x; --place) sample[place] = sample[place - 1];
            sample[place] = x;
        }
        if (samples == 0) end_x = part == 0 ? end_x : first_x;
        else {
            if (part > 0) first_x = sample[samples * part / parts];
            if (part + 1 < parts) end_x = sample[samples * (part + 1) / parts];
        }
    }
    int begin = 0, own = 0;
    if (parts > 1)
        for (int i = 0; i < n; ++i) begin += (cell_x[i] != NOWHERE) & (cell_x[i] < first_x);
    int* __restrict list = list_of.data + begin;
    int least[4] = {2147483647, 2147483647, 2147483647, 0}, most[4] = {NOWHERE, NOWHERE, NOWHERE, 0};
    const auto level_of = [&](const int x) { return has_levels ? (x + (1 << 18)) >> 19 : 0; };
    // Without a branch, which a compiler makes vector instructions of.
    const int first_own = (int)first_x, last_own = (int)(end_x - 1);
    for (int axis = has_levels ? 1 : 0; axis < 3; ++axis) {
        const int* __restrict along = cells.data + (long long)axis * stride;
        int lowest = least[axis], highest = most[axis];
        for (int i = 0; i < n; ++i) {
            const bool is_own = (cell_x[i] >= first_own) & (cell_x[i] <= last_own);
            const int at_least = is_own ? along[i] : 2147483647, at_most = is_own ? along[i] : NOWHERE;
            lowest = at_least < lowest ? at_least : lowest;
            highest = at_most > highest ? at_most : highest;
        }
        least[axis] = lowest;
        most[axis] = highest;
    }
    for (int i = 0; parts == 1 && i < n; ++i) {
        list[own] = i;
        own += cell_x[i] != NOWHERE;
    }
    for (int i = 0; parts > 1 && i < n; ++i)
        if ((cell_x[i] >= first_own) & (cell_x[i] <= last_own)) list[own++] = i;
    if (has_levels) {
        least[3] = 2147483647;
        most[3] = NOWHERE;
        for (int m = 0; m < own; ++m) {
            const int level = level_of(cell_x[list[m]]), x = cell_x[list[m]] - level * (1 << 19);
            least[0] = x < least[0] ? x : least[0];
            most[0] = x > most[0] ? x : most[0];
            least[3] = level < least[3] ? level : least[3];
            most[3] = level > most[3] ? level : most[3];
        }
    }
    // A place is left free after a part's cells, for where the last one ends.
    const int first_cell = begin + part, end = begin + own;
    int* __restrict layout = layouts.data + part * layouts.shape[1];
    layout[0] = 0;
    if (own == 0) {
        ranges.data[part] = wp::vec4i(first_cell, first_cell, begin, begin);
        return;
    }
    const char* __restrict rows = (const char*)xyz_in.data;
    wp::vec3* __restrict point = points.data;
    wp::vec2i* __restrict stack = stacks.data;
    wp::vec4i* __restrict column = columns.data;
    int* __restrict number = cell_of_point.data;
    int* __restrict index = order.data;
    const auto put_point = [&](const int place, const int i) {
        const float* row = (const float*)(rows + (long long)i * xyz_in.strides[0]);
        if (index != nullptr) index[place] = i;
        point[place] = wp::vec3(row[0], row[1], row[2]);
    };
    int c = first_cell - 1, k = begin - 1;
    const auto add_column = [&](const int x, const int y) {
        column[++k] = wp::vec4i(x, y, c + 1, c + 1);
    };

    // Blocks of 64 heights: a power of two of them to a column, a whole number of words to a row.
    int shift = 0;
    while (((long long)most[2] - least[2]) >> 6 >> shift > 0) ++shift;
    const double wide = (double)most[0] - least[0] + 1, deep = (double)most[1] - least[1] + 1;
    if (wide * ((double)most[3] - least[3] + 1) * (deep * (1 << shift) / 64 + 1) >= words_of.shape[1]) {
        // Too wide for bits. The order is found by as many digits of 11 bits as there are.
        int* from = list;
        int* to = blocks.data + begin;
        int count[2048];
        for (int axis = 2; axis >= 0; --axis) {
            const int* __restrict along = cells.data + (long long)axis * stride;
            unsigned low = ~0u, high = 0;
            for (int m = 0; m < own; ++m) {
                const unsigned key = (unsigned)along[from[m]] ^ 0x80000000u;
                low = key < low ? key : low;
                high = key > high ? key : high;
            }
            for (int shift = 0; shift < 32 && (high - low) >> shift > 0; shift += 11) {
                const auto digit = [&](const int i) {
                    return (((unsigned)along[i] ^ 0x80000000u) - low) >> shift & 2047;
                };
                for (int d = 0; d < 2048; ++d) count[d] = 0;
                for (int m = 0; m < own; ++m) ++count[digit(from[m])];
                for (int d = 0, before = 0; d < 2048; ++d) {
                    const int size = count[d];
                    count[d] = before;
                    before += size;
                }
                for (int m = 0; m < own; ++m) to[count[digit(from[m])]++] = from[m];
                int* swapped = from;
                from = to;
                to = swapped;
            }
        }
        for (int m = 0; m < own; ++m) list[m] = from[m];
        for (int m = 0; m < own; ++m) {
            const int i = list[m];
            const int x = cell_x[i], y = cell_y[i], z = cell_z[i];
            const bool new_column = m == 0 || column[k][0] != x || column[k][1] != y;
            if (new_column) add_column(x, y);
            if (new_column || stack[c][0] != z) {
                stack[++c] = wp::vec2i(z, begin + m);
                column[k][3] = c + 1;
            }
            number[i] = c;
            put_point(begin + m, i);
        }
        stack[c + 1] = wp::vec2i(0, end);
        ranges.data[part] = wp::vec4i(first_cell, c + 1, begin, k + 1);
        return;
    }

    const int words_a_row = (((most[1] - least[1] + 1) << shift) + 63) / 64;
    const int width = most[0] - least[0] + 1, row_count = width * (most[3] - least[3] + 1);
    const int words = row_count * words_a_row;
    Bits* __restrict word = (Bits*)words_of.data + (long long)part * words_of.shape[1];
    int* __restrict rank = ranks.data + (long long)part * ranks.shape[1];
    int* __restrict block_of = blocks.data + begin;
    Bits* __restrict mask = (Bits*)masks.data + begin;
    int* __restrict block_cell = block_cells.data + begin;
    int* __restrict next = next_places.data + first_cell;
    for (int w = 0; w < words; ++w) word[w] = 0;
    for (int m = 0; m < own; ++m) {
        const int i = list[m], x = cell_x[i];
        const int level = level_of(x);
        const int row = (level - least[3]) * width + x - level * (1 << 19) - least[0];
        const int block = row * words_a_row * 64 + ((cell_y[i] - least[1]) << shift) + ((cell_z[i] - least[2]) >> 6);
        block_of[m] = block;
        word[block >> 6] |= (Bits)1 << (block & 63);
    }
    int occupied = 0;
    for (int w = 0; w < words; ++w) {
        rank[w] = occupied;
        occupied += popcount(word[w]);
    }
    rank[words] = occupied;
    word[words] = 0;
    const int described[7] = {words_a_row, shift, least[0], least[1], least[3], width, begin + part};
    for (int number = 0; number < 7; ++number) layout[number] = described[number];
    int* __restrict column_of = block_columns.data + begin + part;
    for (int b = 0; b < occupied; ++b) mask[b] = 0;
    for (int m = 0; m < own; ++m) {
        const int at = block_of[m];
        const int block = rank[at >> 6] + popcount(word[at >> 6] & below(at & 63));
        block_of[m] = block;
        mask[block] |= (Bits)1 << ((cell_z[list[m]] - least[2]) & 63);
    }
    int found = 0;
    for (int b = 0; b < occupied; ++b) {
        block_cell[b] = found;
        found += popcount(mask[b]);
    }
    for (int a = 0; a < found; ++a) next[a] = 0;
    for (int m = 0; m < own; ++m) {
        const int i = list[m], block = block_of[m];
        const int cell = block_cell[block] + popcount(mask[block] & below((cell_z[i] - least[2]) & 63));
        block_of[m] = cell;
        number[i] = first_cell + cell;
        ++next[cell];
    }
    for (int row = 0, w = 0, b = 0, place = begin; row < row_count; ++row) {
        const int level = row / width + least[3];
        const int x = (row % width) + least[0] + level * (has_levels ? 1 << 19 : 0);
        long long last_y = 1ll << 40;
        for (int start = 0; start < words_a_row; ++start, ++w) {
            for (Bits left = word[w]; left != 0; left &= left - 1, ++b) {
                const int at = start * 64 + popcount((left & (~left + 1)) - 1);
                const int y = (at >> shift) + least[1];
                if (y != last_y) add_column(x, y);
                last_y = y;
                column_of[b] = k;
                const int base = ((at & ((1 << shift) - 1)) << 6) + least[2];
                for (Bits heights = mask[b]; heights != 0; heights &= heights - 1) {
                    stack[++c] = wp::vec2i(base + popcount((heights & (~heights + 1)) - 1), place);
                    const int size = next[c - first_cell];
                    next[c - first_cell] = place;
                    place += size;
                }
                column[k][3] = c + 1;
            }
        }
    }
    column_of[occupied] = k + 1;
    for (int m = 0; m < own; ++m) put_point(next[block_of[m]]++, list[m]);
    stack[c + 1] = wp::vec2i(0, end);
    ranges.data[part] = wp::vec4i(first_cell, c + 1, begin, k + 1);
"""


@wp.func_native(_SORT)
def _sort(
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    cells: wp.array2d(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    has_levels: int,
    list_of: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    block_cells: wp.array(dtype=wp.int32),
    next_places: wp.array(dtype=wp.int32),
    words_of: wp.array2d(dtype=wp.uint64),
    ranks: wp.array2d(dtype=wp.int32),
    block_columns: wp.array(dtype=wp.int32),
    layouts: wp.array2d(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    stacks: wp.array(dtype=wp.vec2i),
    columns: wp.array(dtype=wp.vec4i),
    ranges: wp.array(dtype=wp.vec4i),
):
    """The whole of `sort_cells`."""


@wp.kernel
def sort_cells(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    cells: wp.array2d(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    has_levels: int,
    # out: for the sort's own use, by point, block of cells, cell and word of bits; where columns are, as `FIND_COLUMNS`
    # reads it
    list_of: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    block_cells: wp.array(dtype=wp.int32),
    next_places: wp.array(dtype=wp.int32),
    words_of: wp.array2d(dtype=wp.uint64),
    ranks: wp.array2d(dtype=wp.int32),
    block_columns: wp.array(dtype=wp.int32),
    layouts: wp.array2d(dtype=wp.int32),
    # out: see `CellColumns`
    order: wp.array(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    stacks: wp.array(dtype=wp.vec2i),
    columns: wp.array(dtype=wp.vec4i),
    ranges: wp.array(dtype=wp.vec4i),
):
    """Sorts the points of a range of rows, and lists their cells and columns."""
    _sort(
        part, parts, xyz_in, cells, point_count, has_levels, list_of, blocks, masks, block_cells, next_places,
        words_of, ranks, block_columns, layouts, order, cell_of_point, points, stacks, columns, ranges,
    )  # fmt: skip
