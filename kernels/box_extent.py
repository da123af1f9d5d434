"""How far the points of a cluster reach along a heading, and the box of that. See `boxes.py`."""

from __future__ import annotations

from typing import Any

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["Extent", "extent_of", "write_box"]

# What bounds a cluster must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

Extent: Any = wp.types.vector(length=6, dtype=wp.float32)
"""How far points reach from an origin: ahead, behind, to the left, to the right, up and down [m]."""


# In C++, where a compiler makes vector instructions of the loops.
@wp.func_native("""
    constexpr int LANES = 16;
    const float* const at = (const float*)points.data + 3 * first;
    const float x0 = origin[0], y0 = origin[1], z0 = origin[2];
    float low[3][LANES], high[3][LANES];
    for (int axis = 0; axis < 3; ++axis)
        for (int lane = 0; lane < LANES; ++lane) {
            low[axis][lane] = 0.0f;  // the origin is one of the points
            high[axis][lane] = 0.0f;
        }
    const auto widen = [&](const float* p, const int lane) {
        const float x = p[0] - x0, y = p[1] - y0, z = p[2] - z0;
        const float place[3] = {c * x + s * y, c * y - s * x, z};
        for (int axis = 0; axis < 3; ++axis) {
            low[axis][lane] = place[axis] < low[axis][lane] ? place[axis] : low[axis][lane];
            high[axis][lane] = place[axis] > high[axis][lane] ? place[axis] : high[axis][lane];
        }
    };
    int k = 0;
    for (; k + LANES <= size; k += LANES)
        for (int lane = 0; lane < LANES; ++lane) widen(at + 3 * (k + lane), lane);
    for (; k < size; ++k) widen(at + 3 * k, 0);
    wp::vec_t<6, wp::float32> reach;
    for (int axis = 0; axis < 3; ++axis) {
        reach[2 * axis] = high[axis][0];
        reach[2 * axis + 1] = -low[axis][0];
        for (int lane = 1; lane < LANES; ++lane) {
            reach[2 * axis] = high[axis][lane] > reach[2 * axis] ? high[axis][lane] : reach[2 * axis];
            reach[2 * axis + 1] = -low[axis][lane] > reach[2 * axis + 1] ? -low[axis][lane] : reach[2 * axis + 1];
        }
    }
    return reach;
""")
def extent_of(points: wp.array(dtype=wp.vec3), first: int, size: int, origin: wp.vec3, c: float, s: float) -> Extent:
    """How far points reach from one of them, in the frame of a heading's cosine and sine."""


@wp.func
def write_box(
    cluster: int,
    origin: wp.vec3,
    c: float,
    s: float,
    yaw: float,
    reach: Extent,
    min_size: float,
    boxes: wp.array2d(dtype=wp.float32),
):
    """Centre, sizes and yaw of a cluster, the longer side along the yaw; `yaw` is from 0 to less than π/2."""
    middle = wp.vec3()
    size = wp.vec3()
    for axis in range(3):
        ahead = reach[2 * axis]
        behind = reach[2 * axis + 1]
        middle[axis] = 0.5 * (ahead - behind)
        size[axis] = wp.max(ahead + behind, min_size)
    boxes[cluster, 0] = origin[0] + c * middle[0] - s * middle[1]
    boxes[cluster, 1] = origin[1] + s * middle[0] + c * middle[1]
    boxes[cluster, 2] = origin[2] + middle[2]
    heading = float(yaw)
    if size[1] > size[0]:  # the length lies across
        heading = wp.where(yaw == 0.0, 0.5 * wp.pi, yaw - 0.5 * wp.pi)
    boxes[cluster, 3] = wp.max(size[0], size[1])
    boxes[cluster, 4] = wp.min(size[0], size[1])
    boxes[cluster, 5] = size[2]
    boxes[cluster, 6] = heading
