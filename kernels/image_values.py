"""What an image says at the pixels of points: the kernels of painting. See `projection.py`."""

from __future__ import annotations

from typing import Any

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["paint", "paint_in_parts"]

# What is read between pixels must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(1024)  # points that one part paints before it leaves as many to others


@wp.func
def _paint_point(
    i: int,
    pixel: wp.vec2,
    visible: bool,
    image: wp.array3d(dtype=Any),
    bilinear: int,
    values: wp.array2d(dtype=wp.float32),
):
    """What the image says at a point's pixel; beyond the outermost centres, what it says there."""
    if not visible:
        for channel in range(values.shape[1]):
            values[i, channel] = 0.0
        return
    height = image.shape[0]
    width = image.shape[1]
    if bilinear == 0:
        row = wp.min(int(pixel[1] + 0.5), height - 1)
        column = wp.min(int(pixel[0] + 0.5), width - 1)
        for channel in range(values.shape[1]):
            values[i, channel] = float(image[row, column, channel])
        return
    u = wp.clamp(pixel[0], 0.0, float(width - 1))
    v = wp.clamp(pixel[1], 0.0, float(height - 1))
    left = int(u)
    top = int(v)
    right = wp.min(left + 1, width - 1)
    bottom = wp.min(top + 1, height - 1)
    a = u - float(left)
    b = v - float(top)
    for channel in range(values.shape[1]):
        above = float(image[top, left, channel]) * (1.0 - a) + float(image[top, right, channel]) * a
        below = float(image[bottom, left, channel]) * (1.0 - a) + float(image[bottom, right, channel]) * a
        values[i, channel] = above * (1.0 - b) + below * b


@wp.kernel
def paint(
    # in
    pixels_in: wp.array(dtype=wp.vec2),
    visible_in: wp.array(dtype=wp.bool),
    count_in: wp.array(dtype=wp.int32),
    image_in: wp.array3d(dtype=Any),
    bilinear: int,
    # out
    values_out: wp.array2d(dtype=wp.float32),
):
    """One point a thread."""
    i = wp.tid()
    if i < count_in[0]:
        _paint_point(i, pixels_in[i], visible_in[i], image_in, bilinear, values_out)


@wp.kernel
def paint_in_parts(
    part: int,
    parts: int,
    # in
    pixels_in: wp.array(dtype=wp.vec2),
    visible_in: wp.array(dtype=wp.bool),
    count_in: wp.array(dtype=wp.int32),
    image_in: wp.array3d(dtype=Any),
    bilinear: int,
    points: int,
    # out
    values_out: wp.array2d(dtype=wp.float32),
):
    """Every so many runs of points, so that those in the image are shared out."""
    n = wp.min(count_in[0], points)
    for run in range(part, (n + _RUN - 1) / _RUN, parts):
        for i in range(run * _RUN, wp.min((run + 1) * _RUN, n)):
            _paint_point(i, pixels_in[i], visible_in[i], image_in, bilinear, values_out)


for _dtype in (wp.uint8, wp.float32):
    wp.overload(paint, {"image_in": wp.array3d(dtype=_dtype)})
    wp.overload(paint_in_parts, {"image_in": wp.array3d(dtype=_dtype)})
