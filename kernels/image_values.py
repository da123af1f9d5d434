"""What an image says at the pixels of points: the kernels of painting. See `projection.py`."""

from __future__ import annotations

from typing import Any

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["PAINT", "paint"]

# What is read between pixels must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})


# In C++, as Warp's own indices are checked and strided anew for every channel of four pixels.
PAINT = """
    const int height = image.shape[0], width = image.shape[1], channels = values.shape[1];
    const long long down = image.strides[0] / sizeof(*image.data), across = image.strides[1] / sizeof(*image.data);
    const long long deep = image.strides[2] / sizeof(*image.data);
    const auto limited = [](const float along, const float most) { return along < 0.0f ? 0.0f : wp::min(along, most); };
    // Beyond the outermost centres, what the image says there.
    const auto paint_point = [&](const wp::vec2& pixel, float* value) {
        if (!bilinear) {
            const int row = wp::min((int)(pixel[1] + 0.5f), height - 1);
            const int column = wp::min((int)(pixel[0] + 0.5f), width - 1);
            const auto* from = image.data + row * down + column * across;
            for (int channel = 0; channel < channels; ++channel) value[channel] = (float)from[channel * deep];
            return;
        }
        const float u = limited(pixel[0], (float)(width - 1)), v = limited(pixel[1], (float)(height - 1));
        const int left = (int)u, top = (int)v;
        const long long right = left + 1 < width ? across : 0, bottom = top + 1 < height ? down : 0;
        const float a = u - (float)left, b = v - (float)top;
        const auto* from = image.data + top * down + left * across;
        for (int channel = 0; channel < channels; ++channel, from += deep) {
            const float above = (float)from[0] * (1.0f - a) + (float)from[right] * a;
            const float below = (float)from[bottom] * (1.0f - a) + (float)from[bottom + right] * a;
            value[channel] = above * (1.0f - b) + below * b;
        }
    };
"""

# Each turn adds an overload.
for _dtype in (wp.uint8, wp.float32):

    @wp.func_native(
        PAINT
        + """
        float* value = (float*)((char*)values.data + i * (long long)values.strides[0]);
        if (visible) paint_point(pixel, value);
        else
            for (int channel = 0; channel < channels; ++channel) value[channel] = 0.0f;
        """
    )
    def _paint_point(
        i: int,
        pixel: wp.vec2,
        visible: bool,
        image: wp.array3d(dtype=_dtype),
        bilinear: int,
        values: wp.array2d(dtype=wp.float32),
    ):
        """What the image says at a point's pixel."""


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


for _dtype in (wp.uint8, wp.float32):
    wp.overload(paint, {"image_in": wp.array3d(dtype=_dtype)})
