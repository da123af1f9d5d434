"""Clustering on a CPU: columns of cells, joined with their neighbours. `cluster.py` has the plan.

Each part of the work joins the cells of its own columns, in a forest that no other part reads; one thread then joins
the columns at the borders between the parts, which are few.

Of most cells that touch the first points are near already. Those are therefore looked at beforehand, without a branch:
of cells on top of each other, and of the lowest of each run of cells side by side. That need not find all. Only where
components still differ are cells tried in earnest, first those that share a corner, then those that are two apart. The
heights of a column's cells are the bits of a mask, so that cells side by side are found in one step.
"""

from __future__ import annotations

import warp as wp

from .cell_columns import CellColumns, Layout
from .cell_pairs import TOUCH, Radius
from .column_neighbors import FORWARD, LIST_NEIGHBORS, map_places
from .device import DEFAULT_DEVICE
from .threads import PackedLaunch

__all__ = ["JoinedColumns", "label_points"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

# `a` and `b` are cells, `k` and `other` columns.
_JOIN = (
    TOUCH
    + """
    const vec4i* __restrict column = columns.data;
    const vec2i* __restrict stack = stacks.data;
    int* __restrict above = parent.data;
    const auto height = [&](const int cell) { return stack[cell][0]; };
    const auto find = [&](const int cell) {
        int root = cell;
        for (int next = above[root]; next != root; next = above[root]) {
            const int after = above[next];
            above[root] = after;
            root = after;
        }
        return root;
    };
    const auto cells_touch = [&](const int a, const int b) {
        return touch(stack[a][1], stack[a + 1][1], stack[b][1], stack[b + 1][1]);
    };
    const auto hang = [&](const int root, const int other) {
        const bool swapped = other < root;
        above[swapped ? root : other] = swapped ? other : root;
    };
    // All cells of two columns, or of one, that touch; of any height.
    const auto join_columns = [&](const int k, const int other) __attribute__((noinline)) {
        int low = column[other][2];
        const int end = column[other][3];
        for (int a = column[k][2]; a < column[k][3]; ++a) {
            if (k == other) low = a + 1;
            const long long z = height(a);
            while (low < end && height(low) < z - 2) ++low;
            for (int b = low; b < end && height(b) <= z + 2; ++b) {
                const int root = find(a), other_root = find(b);
                if (root != other_root && cells_touch(a, b)) hang(root, other_root);
            }
        }
    };
"""
)


@wp.func_native(
    _JOIN
    + LIST_NEIGHBORS
    + """
    typedef unsigned long long Mask;
    constexpr int MOST_HEIGHTS = 60;  // of a mask, which has two free on either side
    int* __restrict around = neighbors.data;
    int* __restrict root_of = column_root.data;
    const Mask* __restrict mask_of = (const Mask*)masks.data;
    const vec3* __restrict point = points.data;
    #ifdef __CUDA_ARCH__
    const auto popcount = [](const Mask mask) { return __popcll(mask); };
    #else
    const auto popcount = [](const Mask mask) { return (int)__builtin_popcountll(mask); };
    #endif
    const auto below = [](const Mask bit) { return bit - 1; };
    const auto lowest = [](const Mask mask) { return mask & (~mask + 1); };
    const auto bottom = [&](const int k) { return height(column[k][2]); };
    // A mask of one column as the other's, whose bottom is higher by so much.
    const auto moved = [](const Mask mask, const int by) {
        const Mask down = mask >> (by & 63), up = mask << (-by & 63);
        return by > 63 || by < -63 ? 0 : (by >= 0 ? down : up);
    };
    const auto spread = [](const Mask mask, const int reach) {
        const Mask by_one = mask | mask << 1 | mask >> 1;
        return reach == 1 ? by_one : by_one | mask << 2 | mask >> 2;
    };
    const auto first_points_touch = [&](const int a, const int b) {
        const vec3 &p = point[stack[a][1]], &q = point[stack[b][1]];
        const float x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
        return x * x + y * y + z * z <= radius.surely;
    };

    // Cells on top of each other.
    for (int k = begin; k < end; ++k) {
        const int first = column[k][2], last = column[k][3];
        const int base = height(first);
        int z = base;
        Mask mask = 4;
        above[first] = first;
        for (int a = first + 1; a < last; ++a) {
            const int here = height(a);
            const bool joined = (here == z + 1) & first_points_touch(a - 1, a);
            above[a] = joined ? above[a - 1] : a;
            z = here;
            mask |= (Mask)4 << ((z - base) & 63);
        }
        masks.data[k] = (long long)z - base < MOST_HEIGHTS ? mask : 0;
    }
    list_neighbors(begin, end, around);

    // Cells side by side.
    constexpr int BLOCK = 256;
    int pair[BLOCK + 32][2], pairs = 0;
    const auto unite_pairs = [&]() __attribute__((noinline)) {
        for (int i = 0; i < pairs; ++i) {
            const int a = find(pair[i][0]), b = find(pair[i][1]);
            above[a < b ? b : a] = a < b ? a : b;
        }
        pairs = 0;
    };
    for (int k = begin; k < end; ++k) {
        for (int o = 0; o < 2; ++o) {
            const int other = around[12ll * k + o];
            if (other < 0) continue;
            const Mask here = mask_of[k], there = mask_of[other];
            const int apart = bottom(k) - bottom(other);
            const Mask both = here & moved(there, apart);
            for (Mask left = both & ~(both << 1); left != 0; left &= left - 1) {
                const Mask bit = lowest(left);
                const int a = column[k][2] + popcount(here & below(bit));
                const int b = column[other][2] + popcount(there & below(moved(bit, -apart)));
                pair[pairs][0] = a;
                pair[pairs][1] = b;
                pairs += first_points_touch(a, b);
            }
            if (pairs >= BLOCK) unite_pairs();
        }
    }
    unite_pairs();

    // Stretches of a column's cells that are of one component; columns that are one whole.
    int* __restrict first_segment = first_segments.data + part;  // each part has one more than columns
    Mask* __restrict segment_mask = (Mask*)segment_masks.data;
    int* __restrict segment_root = segment_roots.data;
    const auto find_segments = [&]() {
        for (int c = first_cell; c < last_cell; ++c) above[c] = above[above[c]];  // a lower cell's is its root by now
        int segment = first_cell;
        for (int k = begin; k < end; ++k) {
            const int first = segment;
            first_segment[k] = first;
            Mask left = mask_of[k], mask = 0;
            int root = above[column[k][2]];
            for (int a = column[k][2]; a < column[k][3]; ++a) {
                if (above[a] != root) {
                    segment_mask[segment] = mask;
                    segment_root[segment++] = root;
                    root = above[a];
                    mask = 0;
                }
                mask |= lowest(left);
                left &= left - 1;
            }
            segment_mask[segment] = mask;
            segment_root[segment++] = root;
            root_of[k] = segment == first + 1 ? root : -1;
        }
        first_segment[end] = segment;
    };
    const auto join = [&](const int k, const int other, const int reach) __attribute__((noinline)) {
        const Mask here = mask_of[k], there = mask_of[other];
        if (here == 0 || there == 0) {
            join_columns(k, other);
            return;
        }
        const int apart = bottom(k) - bottom(other);
        if ((spread(here, reach) & moved(there, apart)) == 0) return;
        for (int s = first_segment[k]; s < first_segment[k + 1]; ++s) {
            const Mask own = segment_mask[s], near = spread(own, reach);
            for (int t = k == other ? s + 1 : first_segment[other]; t < first_segment[other + 1]; ++t) {
                if ((near & moved(segment_mask[t], apart)) == 0 || segment_root[s] == segment_root[t]) continue;
                const int root = find(segment_root[s]), other_root = find(segment_root[t]);
                if (root == other_root) continue;
                bool touched = false;
                for (int step = 0; step <= 2 * reach && !touched; ++step) {
                    // Heights that differ by 0, 1, −1, 2, −2.
                    const int by = apart + (step & 1 ? (step + 1) / 2 : -step / 2);
                    for (Mask left = own & moved(segment_mask[t], by); left != 0 && !touched; left &= left - 1) {
                        const Mask bit = lowest(left);
                        const int a = column[k][2] + popcount(here & below(bit));
                        const int b = column[other][2] + popcount(there & below(moved(bit, -by)));
                        touched = cells_touch(a, b);
                    }
                }
                if (touched) hang(root, other_root);
            }
        }
    };
    for (int reach = 1; reach < 3; ++reach) {
        find_segments();
        for (int k = begin; k < end; ++k) {
            const int own = root_of[k];
            if (own < 0 && reach == 1) join(k, k, 2);
            int differ = 0;
            for (int o = 0; o < (reach == 1 ? 4 : 12); ++o) {
                const int other = around[12ll * k + o];
                const int root = root_of[other < 0 ? k : other];
                differ |= (int)((other >= 0) & ((root != own) | (own < 0))) << o;
            }
            for (; differ != 0; differ &= differ - 1)
                join(k, around[12ll * k + popcount(below(differ & -differ))], reach);
        }
    }
"""
)
def _join_own(
    part: int,
    first_cell: int,
    last_cell: int,
    begin: int,
    end: int,
    layout: Layout,
    columns: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    column_map: wp.array(dtype=wp.int32),
    neighbors: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    column_root: wp.array(dtype=wp.int32),
    first_segments: wp.array(dtype=wp.int32),
    segment_masks: wp.array(dtype=wp.uint64),
    segment_roots: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of the columns begin … end − 1."""


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
    # in out: a map of columns, -1 where there is none, and left so
    column_map: wp.array(dtype=wp.int32),
    # out: of each column its neighbours, its cells' heights as a mask, 0 where it is not wide enough, and its root, or
    # -1; stretches of its cells of one root
    neighbors: wp.array(dtype=wp.int32),
    masks: wp.array(dtype=wp.uint64),
    column_root: wp.array(dtype=wp.int32),
    first_segments: wp.array(dtype=wp.int32),
    segment_masks: wp.array(dtype=wp.uint64),
    segment_roots: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
):
    """Unites the cells of a part that touch."""
    own = ranges[part]
    if own[2] < own[3]:
        _join_own(
            part,
            own[0],
            own[1],
            own[2],
            own[3],
            layout_in[0],
            columns,
            stacks,
            points,
            radius,
            column_map,
            neighbors,
            masks,
            column_root,
            first_segments,
            segment_masks,
            segment_roots,
            parent,
        )


@wp.func_native(
    _JOIN
    + """
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


@wp.func_native("""
    constexpr int UNNUMBERED = -2;
    int* __restrict root_of = parent.data;
    int* __restrict label_of = members.data;
    const wp::vec2i* __restrict stack = stacks.data;
    const int parts = ranges.shape[0];
    for (int p = 0; p < parts; ++p) {
        for (int c = ranges.data[p][0]; c < ranges.data[p][1]; ++c) {
            const int root = root_of[root_of[c]];  // a lower cell's parent is its root by now
            root_of[c] = root;
            label_of[root] = (root == c ? 0 : label_of[root]) + stack[c + 1][1] - stack[c][1];
        }
    }
    // Of a root nothing but its label is wanted from here on.
    for (int p = 0; p < parts; ++p)
        for (int c = ranges.data[p][0]; c < ranges.data[p][1]; ++c)
            if (root_of[c] == c) label_of[c] = label_of[c] >= min_size ? UNNUMBERED : -1;
    int clusters = 0;
    const int points = point_count.data[0];
    const int* __restrict cell_of = cell_of_point.data;
    int* __restrict label_out = labels_out.data;
    for (int i = 0; i < points; ++i) {
        const int cell = cell_of[i];
        int label = -1;
        if (cell >= 0) {
            label = label_of[root_of[cell]];
            if (label == UNNUMBERED) label = label_of[root_of[cell]] = clusters++;
        }
        label_out[i] = label;
    }
    cluster_count_out.data[0] = clusters;
""")
def _label(
    ranges: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    cell_of_point: wp.array(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    min_size: int,
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """The whole of `label_points`."""


@wp.kernel
def label_points(
    # in
    ranges: wp.array(dtype=wp.vec4i),
    stacks: wp.array(dtype=wp.vec2i),
    cell_of_point: wp.array(dtype=wp.int32),
    point_count: wp.array(dtype=wp.int32),
    min_size: int,
    # in out: members left as labels
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Counts each component's points, numbers those with enough in the order of their first, and labels the points."""
    _label(ranges, stacks, cell_of_point, point_count, min_size, parent, members, labels_out, cluster_count_out)


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
    ):
        """Makes it for columns such as `CellColumns` has; they may be those of some of its points."""
        capacity = by_cell.points.shape[0]
        cells = capacity + by_cell.parts

        def buffer(length: int, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=DEFAULT_DEVICE)

        self.parent = buffer(cells)
        """Of each cell one of its component, and of that itself."""
        given = [columns, stacks, points, radius]
        self._join = by_cell.packed(
            join_own_columns,
            [by_cell.layout, ranges, *given],
            [
                wp.full(map_places(capacity), -1, dtype=wp.int32, device=DEFAULT_DEVICE),
                *(buffer(FORWARD * capacity), buffer(capacity, wp.uint64), buffer(capacity)),
                *(buffer(cells), buffer(cells, wp.uint64), buffer(cells), self.parent),
            ],
        )
        self._join_borders = None
        if by_cell.parts > 1:
            self._join_borders = PackedLaunch(join_borders, None, [ranges, *given], [self.parent])

    def launch(self) -> None:
        """Joins the cells."""
        self._join.launch()
        if self._join_borders is not None:
            self._join_borders.launch()
