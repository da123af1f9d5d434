"""Labels of points on a CPU from the components of their cells: for every way of clustering by columns of cells."""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp)

__all__ = ["label_points"]


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
