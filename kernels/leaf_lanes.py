"""Leaves and nodes of a tree in lanes, as vector instructions want them: x, y and z apart, eight in a row."""

from __future__ import annotations

import warp as wp

from .point_tree import LEAF

__all__ = ["Eight", "lay_out", "lay_out_boxes", "parts_for"]

_LEAST_OF_PART = 512  # points for which a thread of their own is worth its while

Eight = wp.types.vector(length=int(LEAF), dtype=wp.float32)
"""One coordinate of the points of a leaf."""


def parts_for(points: int, most: int) -> int:
    """In how many parts a CPU looks at points: few are not worth a second thread."""
    return max(1, min(most, points // _LEAST_OF_PART))


@wp.kernel
def lay_out(
    # in
    points_in: wp.array(dtype=wp.vec3),
    size_in: wp.array(dtype=wp.int32),
    # out
    x_out: wp.array(dtype=Eight),
    y_out: wp.array(dtype=Eight),
    z_out: wp.array(dtype=Eight),
):
    """Coordinates of a leaf side by side; where it has no point, infinitely far."""
    leaf = wp.tid()
    x = Eight(wp.inf)
    y = Eight(wp.inf)
    z = Eight(wp.inf)
    for k in range(LEAF):
        i = leaf * LEAF + k
        if i < size_in[0]:
            p = points_in[i]
            x[k] = p[0]
            y[k] = p[1]
            z[k] = p[2]
    x_out[leaf] = x
    y_out[leaf] = y
    z_out[leaf] = z


@wp.kernel
def lay_out_boxes(
    # in
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    # out: lowest x, y, z, highest x, y, z
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """Bounds of the nodes side by side."""
    node = wp.tid()
    low = low_in[node]
    high = high_in[node]
    for axis in range(3):
        boxes_out[axis, node] = low[axis]
        boxes_out[axis + 3, node] = high[axis]
