"""The points of a cluster that a box's heading is searched with: up to 64, evenly or the outermost. See `boxes.py`."""

from __future__ import annotations

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["FAR", "SAMPLES", "sample_evenly", "sample_extremes", "sample_extremes_in_order"]

# Which of two like points is the outermost must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

SAMPLES = wp.constant(64)
FAR = wp.constant(1.0e30)
_vec16 = wp.types.vector(length=16, dtype=wp.float32)


@wp.kernel
def sample_evenly(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    # out
    sample_out: wp.array2d(dtype=wp.vec2),
):
    """Up to 64 points of a cluster, evenly in its order, relative to its first."""
    cluster, slot = wp.tid()  # pyright: ignore[reportAssignmentType]
    first = start_in[cluster]
    size = start_in[cluster + 1] - first
    if slot >= wp.min(size, SAMPLES):
        return
    at = slot
    if size > SAMPLES:
        at = slot * (size / SAMPLES) + slot * (size % SAMPLES) / SAMPLES
    p = xyz_in[order_in[first + at]] - xyz_in[order_in[first]]
    sample_out[cluster, slot] = wp.vec2(p[0], p[1])


@wp.kernel
def sample_extremes(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    # out
    sample_out: wp.array2d(dtype=wp.vec2),
):
    """The outermost points of a cluster, all of them where it is small, else those in 64 directions."""
    cluster, quarter = wp.tid()  # pyright: ignore[reportAssignmentType]
    first = start_in[cluster]
    size = start_in[cluster + 1] - first
    if size == 0:
        return
    origin = xyz_in[order_in[first]]
    if size <= SAMPLES:
        for k in range(4):
            if 4 * quarter + k < size:
                q = xyz_in[order_in[first + 4 * quarter + k]] - origin
                sample_out[cluster, 4 * quarter + k] = wp.vec2(q[0], q[1])
        return
    d = direction_in[quarter * direction_in.shape[0] / (SAMPLES / 4)]
    low = wp.vec2(FAR, FAR)
    high = wp.vec2(-FAR, -FAR)
    for k in range(size):
        p = xyz_in[order_in[first + k]] - origin
        along = d[0] * p[0] + d[1] * p[1]
        across = d[0] * p[1] - d[1] * p[0]
        if along < low[0]:
            low[0] = along
            sample_out[cluster, 4 * quarter] = wp.vec2(p[0], p[1])
        if along > high[0]:
            high[0] = along
            sample_out[cluster, 4 * quarter + 1] = wp.vec2(p[0], p[1])
        if across < low[1]:
            low[1] = across
            sample_out[cluster, 4 * quarter + 2] = wp.vec2(p[0], p[1])
        if across > high[1]:
            high[1] = across
            sample_out[cluster, 4 * quarter + 3] = wp.vec2(p[0], p[1])


@wp.kernel
def sample_extremes_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    # out
    sample_out: wp.array2d(dtype=wp.vec2),
):
    """As `sample_extremes`, for a CPU: all directions side by side, since few points are the outermost so far."""
    cluster = wp.tid()
    first = start_in[cluster]
    size = start_in[cluster + 1] - first
    if size == 0:
        return
    origin = xyz_in[order_in[first]]
    if size <= SAMPLES:
        for k in range(size):
            q = xyz_in[order_in[first + k]] - origin
            sample_out[cluster, k] = wp.vec2(q[0], q[1])
        return
    cos = _vec16()
    sin = _vec16()
    for lane in range(16):
        d = direction_in[lane * direction_in.shape[0] / (SAMPLES / 4)]
        cos[lane] = d[0]
        sin[lane] = d[1]
    low_along = _vec16(FAR)
    low_across = _vec16(FAR)
    high_along = _vec16(-FAR)
    high_across = _vec16(-FAR)
    for k in range(size):
        p = xyz_in[order_in[first + k]] - origin
        along = cos * p[0] + sin * p[1]
        across = cos * p[1] - sin * p[0]
        lower_along = wp.min(low_along, along)
        higher_along = wp.max(high_along, along)
        lower_across = wp.min(low_across, across)
        higher_across = wp.max(high_across, across)
        if not (
            lower_along == low_along
            and higher_along == high_along
            and lower_across == low_across
            and higher_across == high_across
        ):
            here = wp.vec2(p[0], p[1])
            for lane in range(16):
                if lower_along[lane] != low_along[lane]:
                    sample_out[cluster, 4 * lane] = here
                if higher_along[lane] != high_along[lane]:
                    sample_out[cluster, 4 * lane + 1] = here
                if lower_across[lane] != low_across[lane]:
                    sample_out[cluster, 4 * lane + 2] = here
                if higher_across[lane] != high_across[lane]:
                    sample_out[cluster, 4 * lane + 3] = here
            low_along = lower_along
            high_along = higher_along
            low_across = lower_across
            high_across = higher_across
