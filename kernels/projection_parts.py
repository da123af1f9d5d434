"""Points projected onto an image and painted by a few CPU threads, in C++. See `projection.py`."""

from __future__ import annotations

from typing import Any

import warp as wp

from .camera import Camera, image_point, is_in_image
from .image_values import PAINT

__all__ = ["paint_in_parts", "project_in_parts"]

# What a GPU computes too must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(1024)  # points that one part takes before it leaves as many to others


# In C++, where a compiler makes vector instructions of the loop; it computes what `image_point` and `is_in_image` do.
@wp.func_native("""
    const float* const r = (const float*)&camera.rotation;
    const float tx = camera.translation[0], ty = camera.translation[1], tz = camera.translation[2];
    const float fx = camera.focal[0], fy = camera.focal[1], cx = camera.centre[0], cy = camera.centre[1];
    const float r0 = r[0], r1 = r[1], r2 = r[2], r3 = r[3], r4 = r[4], r5 = r[5], r6 = r[6], r7 = r[7], r8 = r[8];
    const float skew = camera.skew, right = (float)width - 0.5f, bottom = (float)height - 0.5f;
    float* const depths = depth.data;
    float* const to = (float*)pixels.data;
    unsigned char* const seen = (unsigned char*)visible.data;
    const auto run = [&](const long long step) {
        const float* const from = (const float*)xyz.data;
        for (int i = first; i < last; ++i) {
            const float px = from[i * step], py = from[i * step + 1], pz = from[i * step + 2];
            const float z = r6 * px + r7 * py + r8 * pz + tz;
            const float x = (r0 * px + r1 * py + r2 * pz + tx) / z;
            const float y = (r3 * px + r4 * py + r5 * pz + ty) / z;
            const float u = z > 0.0f ? fx * x + skew * y + cx : NAN;
            const float v = z > 0.0f ? fy * y + cy : NAN;
            to[2 * i] = u;
            to[2 * i + 1] = v;
            depths[i] = z;
            seen[i] = (u >= -0.5f) & (v >= -0.5f) & (u < right) & (v < bottom);
        }
    };
    if (xyz.strides[0] == 16) run(4);
    else if (xyz.strides[0] == 12) run(3);
    else run(xyz.strides[0] / 4);
    return last;
""")
def _project_run(
    xyz: wp.array(dtype=wp.vec3),
    camera: Camera,
    width: int,
    height: int,
    first: int,
    last: int,
    pixels: wp.array(dtype=wp.vec2),
    depth: wp.array(dtype=wp.float32),
    visible: wp.array(dtype=wp.bool),
) -> int:
    """Projects the points first … last − 1 onto a camera without distortion."""


@wp.func
def _project_share(
    xyz: wp.array(dtype=wp.vec3),
    camera: Camera,
    width: int,
    height: int,
    first: int,
    last: int,
    end: int,
    pixels: wp.array(dtype=wp.vec2),
    depth: wp.array(dtype=wp.float32),
    visible: wp.array(dtype=wp.bool),
):
    """Projects the points first … last − 1; from there to the end, none is visible."""
    if camera.is_distorted == 0:
        _project_run(xyz, camera, width, height, first, last, pixels, depth, visible)
    else:
        for i in range(first, last):
            point = image_point(xyz[i], camera)
            pixels[i] = wp.vec2(point[0], point[1])
            depth[i] = point[2]
            visible[i] = is_in_image(point, width, height)
    for i in range(wp.max(first, last), end):
        visible[i] = False


@wp.kernel
def project_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    camera: Camera,
    width: int,
    height: int,
    # out
    pixels_out: wp.array(dtype=wp.vec2),
    depth_out: wp.array(dtype=wp.float32),
    visible_out: wp.array(dtype=wp.bool),
):
    """Pixel and depth of a share of the points; nothing hides anything."""
    rows = xyz_in.shape[0]
    share = (rows + parts - 1) / parts
    first = wp.min(part * share, rows)
    end = wp.min(first + share, rows)
    last = wp.min(end, count_in[0])
    _project_share(xyz_in, camera, width, height, first, last, end, pixels_out, depth_out, visible_out)


# A camera's three bytes a pixel are weighed together: eight bytes hold two neighbouring pixels. Where eight would reach
# past the image's end, and elsewhere, the channels are weighed one by one. What is computed is the same.
_PAINT_BYTES = """
#ifdef __clang__
    typedef unsigned char Bytes8 __attribute__((vector_size(8)));
    typedef unsigned char Bytes4 __attribute__((vector_size(4)));
    typedef float Floats4 __attribute__((vector_size(16)));
    const auto* const end = image.data + (height - 1) * down + width * across;
    const bool are_bytes = sizeof(*image.data) == 1 && bilinear && channels == 3 && across == 3 && deep == 1;
    const auto paint_bytes = [&](const wp::vec2& pixel, float* const value) {
        const float u = limited(pixel[0], (float)(width - 1)), v = limited(pixel[1], (float)(height - 1));
        const int left = (int)u, top = (int)v;
        const auto* const from = image.data + top * down + left * 3;
        if (top + 1 >= height || from + down + 8 > end) return false;
        const float a = u - (float)left, b = v - (float)top;
        const auto row = [&](const void* const at) {
            Bytes8 pair;
            memcpy(&pair, at, 8);
            const Bytes8 zero = {};
            const Bytes4 here = __builtin_shufflevector(pair, zero, 0, 1, 2, 8);
            const Bytes4 next = __builtin_shufflevector(pair, zero, 3, 4, 5, 8);
            return __builtin_convertvector(here, Floats4) * (1.0f - a) + __builtin_convertvector(next, Floats4) * a;
        };
        const Floats4 painted = row(from) * (1.0f - b) + row(from + down) * b;
        memcpy(value, &painted, 12);
        return true;
    };
#else
    const bool are_bytes = false;
    const auto paint_bytes = [](const wp::vec2&, float*) { return false; };
#endif
"""

# Each turn adds an overload.
for _dtype in (wp.uint8, wp.float32):

    @wp.func_native(
        PAINT
        + _PAINT_BYTES
        + """
        float* const value = values.data + (long long)first * channels;
        memset(value, 0, (long long)(last - first) * channels * 4);
        const auto* const seen = (const unsigned char*)visible.data;
        for (int i = first; i < last;) {
            unsigned long long eight = 1;
            if (i + 8 <= last) memcpy(&eight, seen + i, 8);
            const int stop = wp::min(i + 8, last);
            if (eight == 0) i = stop;
            for (; i < stop; ++i) {
                float* const to = value + (long long)(i - first) * channels;
                if (seen[i] && !(are_bytes && paint_bytes(pixels.data[i], to))) paint_point(pixels.data[i], to);
            }
        }
        """
    )
    def _paint_run(
        first: int,
        last: int,
        pixels: wp.array(dtype=wp.vec2),
        visible: wp.array(dtype=wp.bool),
        image: wp.array3d(dtype=_dtype),
        bilinear: int,
        values: wp.array2d(dtype=wp.float32),
    ):
        """What the image says at the pixels of the points first … last − 1; the arrays are contiguous."""


@wp.kernel
def paint_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    camera: Camera,
    width: int,
    height: int,
    is_projected: int,
    image_in: wp.array3d(dtype=Any),
    bilinear: int,
    # in out
    pixels: wp.array(dtype=wp.vec2),
    depth: wp.array(dtype=wp.float32),
    visible: wp.array(dtype=wp.bool),
    # out
    values_out: wp.array2d(dtype=wp.float32),
):
    """Paints every so many runs of points, so that those in the image are shared out; projects them before it."""
    rows = xyz_in.shape[0]
    count = wp.min(count_in[0], rows)
    for run in range(part, (rows + _RUN - 1) / _RUN, parts):
        first = run * _RUN
        end = wp.min(first + _RUN, rows)
        last = wp.max(wp.min(end, count), first)
        if is_projected == 0:
            _project_share(xyz_in, camera, width, height, first, last, end, pixels, depth, visible)
        _paint_run(first, last, pixels, visible, image_in, bilinear, values_out)


for _dtype in (wp.uint8, wp.float32):
    wp.overload(paint_in_parts, {"image_in": wp.array3d(dtype=_dtype)})
