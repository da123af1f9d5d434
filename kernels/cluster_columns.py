"""Clustering on a CPU: columns of cells, joined with their neighbours. `cluster.py` has the plan.

Cells on top of each other whose first points are near make a segment. Segments stand in order of x, y and z, so those
that may touch one lie in three stretches: of its own row of columns, of the next, and of the one after that. Their
boxes are compared with its own eight at a time, without a branch, and so are then the points of those that are of
another component still and near enough.

Each part of the work joins the cells of its own columns, in a forest that no other part reads; one thread then joins
the columns at the borders between the parts, which are few.
"""

from __future__ import annotations

from collections.abc import Sequence

import warp as wp

from .cell_columns import CellColumns
from .cell_pairs import TOUCH, Radius
from .column_neighbors import NEAR_COLUMNS
from .column_sort import FIND_COLUMNS
from .device import DEFAULT_DEVICE
from .threads import PackedLaunch

__all__ = ["JoinedColumns"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LANES = 8  # read beyond the end of what is compared eight at a time

# `s` and `t` are segments, `k` is a column.
_JOIN_OWN = (
    "#ifndef __CUDA_ARCH__  // for CPUs alone"
    + TOUCH
    + NEAR_COLUMNS
    + FIND_COLUMNS
    + """
    constexpr int LANES = 8, MOST_TESTS = 1024;  // of eight pairs, until crowds are narrowed to what lies between them
    typedef float Eight __attribute__((ext_vector_type(8)));
    typedef int EightOf __attribute__((ext_vector_type(8)));
    typedef bool EightBits __attribute__((ext_vector_type(8)));
    typedef const float* __restrict Lanes;
    const auto eight = [](const float* from) {
        Eight loaded;
        memcpy(&loaded, from, sizeof(loaded));
        return loaded;
    };
    const auto eight_of = [](const int* from) {
        EightOf loaded;
        memcpy(&loaded, from, sizeof(loaded));
        return loaded;
    };
    const auto bits_of = [](const EightOf answers) {
        return (unsigned)__builtin_bit_cast(unsigned char, __builtin_convertvector(answers, EightBits));
    };
    // Of finite numbers; the built-in functions for these also see to those that are not.
    const auto least_of = [](const auto a, const auto b) { return a < b ? a : b; };
    const auto most_of = [](const auto a, const auto b) { return a > b ? a : b; };
    const auto squared_gap = [&](const Eight over, const Eight under) {
        const Eight gap = most_of(most_of(over, under), (Eight)0.0f);
        return gap * gap;
    };
    const auto along_all = [](const Eight eight, const auto& pick) {
        const auto four = pick(eight.lo, eight.hi);
        const auto two = pick(four.lo, four.hi);
        return pick((float)two.x, (float)two.y);
    };
    const vec4i* __restrict column = columns.data;
    const vec2i* __restrict stack = stacks.data;
    const vec3* __restrict point = points.data;
    int* __restrict above = segment_parent.data;
    int* __restrict cell_of = segment_cell.data;
    int* __restrict start_of = segment_start.data;
    int* __restrict segment_of = first_segment.data + part;  // each part has one more than columns
    const auto lanes_of = [](const wp::array_t<float>& lanes, const int row) {
        return lanes.data + (long long)row * lanes.shape[1];
    };
    const Lanes low[3] = {lanes_of(boxes, 0), lanes_of(boxes, 1), lanes_of(boxes, 2)};
    const Lanes high[3] = {lanes_of(boxes, 3), lanes_of(boxes, 4), lanes_of(boxes, 5)};
    const Lanes along[3] = {lanes_of(coordinates, 0), lanes_of(coordinates, 1), lanes_of(coordinates, 2)};
    const auto first_bits = [](const int count) { return count >= LANES ? (1u << LANES) - 1 : (1u << count) - 1; };
    const auto lowest = [](const unsigned bits) { return __builtin_ctz(bits); };

    // Cells on top of each other make segments.
    int segments = first_cell - 1;
    for (int k = begin; k < end; ++k) {
        segment_of[k] = segments + 1;
        int z = stack[column[k][2]][0], before = stack[column[k][2]][1];
        cell_of[++segments] = column[k][2];
        for (int c = column[k][2] + 1; c < column[k][3]; ++c) {
            const int first = stack[c][1];
            const vec3 &p = point[first], &q = point[before];
            const float dx = p[0] - q[0], dy = p[1] - q[1], dz = p[2] - q[2];
            const bool linked = (stack[c][0] == z + 1) & (dx * dx + dy * dy + dz * dz <= radius.surely);
            segments += !linked;
            cell_of[segments] = linked ? cell_of[segments] : c;
            z = stack[c][0];
            before = first;
        }
    }
    segment_of[end] = ++segments;
    cell_of[segments] = last_cell;
    const float* __restrict rows = (const float*)point;
    float* __restrict lane[3] = {lanes_of(coordinates, 0), lanes_of(coordinates, 1), lanes_of(coordinates, 2)};
    for (int i = stack[first_cell][1]; i < stack[last_cell][1]; ++i) {
        lane[0][i] = rows[3ll * i];
        lane[1][i] = rows[3ll * i + 1];
        lane[2][i] = rows[3ll * i + 2];
    }
    const EightOf LANE = {0, 1, 2, 3, 4, 5, 6, 7};
    for (int s = first_cell; s < segments; ++s) {
        const int first = stack[cell_of[s]][1], last = stack[cell_of[s + 1]][1];
        start_of[s] = first;
        above[s] = s;
        for (int axis = 0; axis < 3; ++axis) {
            Eight least = point[first][axis], most = least;
            for (int i = first; i < last; i += LANES) {
                const EightOf own = LANE < last - i;
                const Eight here = own ? eight(along[axis] + i) : least;
                least = least_of(least, here);
                most = most_of(most, own ? here : most);
            }
            lanes_of(boxes, axis)[s] = along_all(least, least_of);
            lanes_of(boxes, axis + 3)[s] = along_all(most, most_of);
        }
    }
    start_of[segments] = stack[last_cell][1];

    float surely = radius.surely, surely_not = radius.surely_not;
    const auto set_level = [&](const int level) {
        const long long bits[2] = {(level + (1023ll << 3)) << 49, (level + 1 + (1023ll << 3)) << 49};
        double growth[2];
        memcpy(growth, bits, 16);
        const double least = growth[0] * radius.at_origin, most = growth[1] * radius.at_origin;
        surely = (float)wp::min(least * least * (1.0 - 1e-6), 3.0e38);
        surely_not = (float)(most * most * (1.0 + 1e-6));
    };
    const auto find = [&](const int s) {
        int root = s;
        for (int next = above[root]; next != root; next = above[root]) {
            const int after = above[next];
            above[root] = after;
            root = after;
        }
        return root;
    };
    // Of the eight segments from `t` which are near enough and not known to be of the same component.
    const auto near_segments = [&](const int s, const int t) {
        Eight sum = 0.0f;
        for (int axis = 0; axis < 3; ++axis)
            sum += squared_gap(eight(low[axis] + t) - high[axis][s], low[axis][s] - eight(high[axis] + t));
        return bits_of((sum <= surely_not) & (eight_of(above + t) != above[s]));
    };
    // Of the eight points from `i` which are near a segment's box.
    const auto near_box = [&](const int i, const int t) {
        Eight sum = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const Eight here = eight(along[axis] + i);
            sum += squared_gap(low[axis][t] - here, here - high[axis][t]);
        }
        return bits_of(sum <= surely_not);
    };
    const auto squared_distances = [&](const int i, const vec3& p) {
        const Eight x = p[0] - eight(along[0] + i), y = p[1] - eight(along[1] + i), z = p[2] - eight(along[2] + i);
        return x * x + y * y + z * z;
    };
    const auto segments_touch = [&](const int s, const int t) __attribute__((noinline)) {
        const int s_end = start_of[s + 1], t_begin = start_of[t], t_end = start_of[t + 1];
        int tests = 0;
        for (int i = start_of[s]; i < s_end; i += LANES) {
            for (unsigned near = near_box(i, t) & first_bits(s_end - i); near != 0; near &= near - 1) {
                const vec3& p = point[i + lowest(near)];
                for (int j = t_begin; j < t_end; j += LANES) {
                    const unsigned own = first_bits(t_end - j);
                    const Eight squared = squared_distances(j, p);
                    if ((bits_of(squared <= surely) & own) != 0) return true;
                    for (unsigned maybe = bits_of(squared <= surely_not) & own; maybe != 0; maybe &= maybe - 1)
                        if (are_near(p, point[j + lowest(maybe)], surely, surely_not)) return true;
                    if (++tests > MOST_TESTS) return touch(start_of[s], s_end, t_begin, t_end);
                }
            }
        }
        return false;
    };
    const auto join = [&](const int s, const int t) {
        const int root = find(s), other = find(t);
        if (root != other && segments_touch(s, t)) above[wp::max(root, other)] = wp::min(root, other);
    };

    // A segment and those after it: up to eight of each row at once.
    NearColumns rows_on[3] = {
        {column, end, 0, 2, begin, begin}, {column, end, 1, 2, begin, begin}, {column, end, 2, 2, begin, begin}};
    const long long bits_from = (long long)part * words.shape[1];
    const int* layout = layouts.data + part * layouts.shape[1];
    const bool by_bits = layouts.data != nullptr && layout[0] > 0;
    const ColumnsByBits bits{
        (const unsigned long long*)words.data + bits_from, ranks.data + bits_from,
        block_columns.data + (by_bits ? layout[6] : 0), layout};
    for (int k = begin; k < end; ++k) {
        const int level = grows ? (column[k][0] + (1 << 18)) >> 19 : 0;
        int near_from[3], near_to[3];
        if (by_bits) {
            for (int row = 0; row < 3; ++row)
                bits.find(column[k][0], column[k][1], level, row, near_from[row], near_to[row]);
        } else {
            for (int row = 0; row < 3; ++row) {
                rows_on[row].move_to(k);
                near_from[row] = rows_on[row].first;
                near_to[row] = rows_on[row].last;
            }
        }
        int from[3] = {0, segment_of[near_from[1]], segment_of[near_from[2]]};
        const int to[3] = {segment_of[near_to[0]], segment_of[near_to[1]], segment_of[near_to[2]]};
        if (grows) set_level(level);
        for (int s = segment_of[k]; s < segment_of[k + 1]; ++s) {
            from[0] = s + 1;
            unsigned near = 0;
            bool more = false;
            for (int row = 0; row < 3; ++row) {
                near |= (near_segments(s, from[row]) & first_bits(to[row] - from[row])) << LANES * row;
                more |= to[row] - from[row] > LANES;
            }
            for (; near != 0; near &= near - 1) {
                const int bit = lowest(near);
                join(s, from[bit / LANES] + bit % LANES);
            }
            if (!more) continue;
            for (int row = 0; row < 3; ++row) {
                for (int t = from[row] + LANES; t < to[row]; t += LANES)
                    for (near = near_segments(s, t) & first_bits(to[row] - t); near != 0; near &= near - 1)
                        join(s, t + lowest(near));
            }
        }
    }
    for (int s = first_cell; s < segments; ++s) {
        above[s] = above[above[s]];  // a lower segment's is its root by now
        for (int c = cell_of[s]; c < cell_of[s + 1]; ++c) parent.data[c] = cell_of[above[s]];
    }
    #endif
"""
)


@wp.func_native(_JOIN_OWN)
def _join_own(
    part: int,
    first_cell: int,
    last_cell: int,
    begin: int,
    end: int,
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    words: wp.array2d(dtype=wp.uint64),
    ranks: wp.array2d(dtype=wp.int32),
    block_columns: wp.array(dtype=wp.int32),
    layouts: wp.array2d(dtype=wp.int32),
    first_segment: wp.array(dtype=wp.int32),
    segment_cell: wp.array(dtype=wp.int32),
    segment_start: wp.array(dtype=wp.int32),
    segment_parent: wp.array(dtype=wp.int32),
    boxes: wp.array2d(dtype=wp.float32),
    coordinates: wp.array2d(dtype=wp.float32),
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of the columns begin … end − 1."""


@wp.kernel
def join_own_columns(
    part: int,
    parts: int,
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    words: wp.array2d(dtype=wp.uint64),
    ranks: wp.array2d(dtype=wp.int32),
    block_columns: wp.array(dtype=wp.int32),
    layouts: wp.array2d(dtype=wp.int32),
    # out: of each column its first segment; of each segment its first cell and point, one of its component, the lowest
    # x, y, z and the highest; the points' x, y and z
    first_segment: wp.array(dtype=wp.int32),
    segment_cell: wp.array(dtype=wp.int32),
    segment_start: wp.array(dtype=wp.int32),
    segment_parent: wp.array(dtype=wp.int32),
    boxes: wp.array2d(dtype=wp.float32),
    coordinates: wp.array2d(dtype=wp.float32),
    parent: wp.array(dtype=wp.int32),
):
    """Unites the cells of a part that touch."""
    own = ranges[part]
    if own[2] < own[3]:
        _join_own(
            part, own[0], own[1], own[2], own[3], columns, stacks, points, radius, words, ranks, block_columns, layouts,
            first_segment, segment_cell, segment_start, segment_parent, boxes, coordinates, parent,
        )  # fmt: skip


@wp.func_native(
    TOUCH
    + """
    const vec4i* __restrict column = columns.data;
    const vec2i* __restrict stack = stacks.data;
    int* __restrict above = parent.data;
    const auto find = [&](const int cell) {
        int root = cell;
        for (int next = above[root]; next != root; next = above[root]) {
            const int after = above[next];
            above[root] = after;
            root = after;
        }
        return root;
    };
    const auto join_columns = [&](const int k, const int other) {
        int low = column[other][2];
        const int end = column[other][3];
        for (int a = column[k][2]; a < column[k][3]; ++a) {
            const long long z = stack[a][0];
            while (low < end && stack[low][0] < z - 2) ++low;
            for (int b = low; b < end && stack[b][0] <= z + 2; ++b) {
                const int root = find(a), other_root = find(b);
                if (root != other_root && touch(stack[a][1], stack[a + 1][1], stack[b][1], stack[b + 1][1]))
                    above[wp::max(root, other_root)] = wp::min(root, other_root);
            }
        }
    };
    const int parts = ranges.shape[0];
    const auto is_before = [&](const int k, const int x, const int y) {
        return column[k][0] < x || (column[k][0] == x && column[k][1] < y);
    };
    for (int p = 0; p < parts; ++p) {
        for (int q = p + 1; q < parts; ++q) {
            const int others = ranges.data[q][2], others_end = ranges.data[q][3], last = ranges.data[p][3];
            if (others == others_end) continue;
            int first = last;
            while (first > ranges.data[p][2] && !is_before(first - 1, column[others][0] - 2, column[others][1] - 2))
                --first;
            for (int dx = 0; dx < 3; ++dx) {
                int head = others;
                for (int k = first; k < last; ++k) {
                    const int x = column[k][0] + dx, y = column[k][1];
                    while (head < others_end && is_before(head, x, y - 2)) ++head;
                    for (int o = head; o < others_end && column[o][0] == x && column[o][1] <= y + 2; ++o)
                        join_columns(k, o);
                }
            }
        }
    }
"""
)
def _join_parts(
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of different parts."""


@wp.kernel
def join_borders(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of different parts that touch."""
    _join_parts(ranges, columns, stacks, points, radius, parent)


class JoinedColumns:
    """Workspace to join the cells of columns that touch; `parent` tells the components."""

    def __init__(
        self,
        by_cell: CellColumns,
        ranges: wp.array,
        columns: wp.array,
        stacks: wp.array,
        points: wp.array,
        radius: Radius,
        bits: Sequence[wp.array | None] = (None,) * 4,
    ):
        """Makes it for columns such as `CellColumns` has, and their `bits`; or for those of some of its points."""
        capacity = by_cell.points.shape[0]
        cells = capacity + by_cell.parts

        def buffer(shape: int | tuple[int, int] = cells, dtype: type = wp.int32) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=DEFAULT_DEVICE)

        self.parent = buffer()
        """Of each cell one of its component, and of that itself."""
        given = [ranges, columns, stacks, points, radius]
        own = [buffer(), buffer(), buffer(), buffer(cells + _LANES)]
        lanes = [buffer((6, cells + _LANES), wp.float32), buffer((3, capacity + _LANES), wp.float32)]
        self.join = by_cell.packed(join_own_columns, [*given, *bits], [*own, *lanes, self.parent])
        """Joins the cells of each part; a part reads only what the sort of that part has written."""
        self._join_borders = None
        if by_cell.parts > 1:
            self._join_borders = PackedLaunch(join_borders, None, given, [self.parent])

    def launch(self) -> None:
        """Joins the cells."""
        self.join.launch()
        self.launch_borders()

    def launch_borders(self) -> None:
        """Joins the cells at the borders of the parts, after `join`."""
        if self._join_borders is not None:
            self._join_borders.launch()
