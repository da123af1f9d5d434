"""The kernels of range images: which pixel a point falls into, and which point a pixel shows. See `range_image.py`.

Float32 tells the pixel of almost every point; the few near the edge of one are told by float64 products, so that the
pixels are those of exact angles, alike on every device.
"""

from __future__ import annotations

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = [
    "EMPTY",
    "SEARCH_FROM",
    "View",
    "draw_pixels",
    "draw_pixels_in_parts",
    "find_nearest",
    "find_nearest_in_parts",
    "find_rows",
]

# Which pixel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RANGE, _X, _Y, _Z, _INTENSITY = (wp.constant(i) for i in range(5))
EMPTY = wp.constant(wp.int64(2**63 - 1))
"""A pixel without a point."""

_INDEX_BITS = wp.constant(wp.int64(32))
_INDEX_MASK = wp.constant(wp.int64(0x7FFFFFFF))
_OUTSIDE = wp.constant(-1)  # the row above the image; bins that hold less have an edge in them,
SEARCH_FROM = wp.constant(-3)  # and the row above it is this less what they hold


@wp.struct
class View:
    """Numbers of the image, and of the table of rows."""

    rows: int
    columns: int
    top_sine: float
    bins_per_sine: float
    place_slack: float


@wp.func
def _share_of_turn(ratio: float) -> float:
    """The arc tangent of 0 … 1 over 2π, within 6e-7."""
    square = ratio * ratio
    fourth = square * square
    low = 0.15915423 - 0.052996794 * square
    middle = 0.031129001 - 0.019275236 * square
    high = 0.0091244903 - 0.0021362182 * square
    return ratio * (low + fourth * (middle + fourth * high))


@wp.func
def _column_of(x: float, y: float, edges: wp.array(dtype=wp.vec2d), view: View) -> int:
    """The column of a direction, counted clockwise from straight behind."""
    wide = wp.max(wp.abs(x), wp.abs(y))
    turn = _share_of_turn(wp.where(wide > 0.0, wp.min(wp.abs(x), wp.abs(y)) / wide, 0.0))
    turn = wp.where(wp.abs(y) > wp.abs(x), 0.25 - turn, turn)
    turn = wp.where(x < 0.0, 0.5 - turn, turn)
    place = wp.where(y < 0.0, 0.5 + turn, 0.5 - turn) * float(view.columns)
    column = int(place)
    edge = int(place + 0.5)
    if wp.abs(place - float(edge)) < view.place_slack:
        ray = edges[edge]
        column = edge
        if ray[0] * wp.float64(y) > ray[1] * wp.float64(x):  # counter-clockwise of the edge
            column = edge - 1
        column = (column + view.columns) % view.columns
    return column


@wp.func
def _row_of(
    p: wp.vec3,
    distance: float,
    sines: wp.array(dtype=wp.float64),
    row_of_bin: wp.array(dtype=wp.int32),
    view: View,
) -> int:
    """The row whose upper edge is at or above a point and whose lower edge is below it; -1 and `rows` are outside."""
    bin = int((view.top_sine - p[2] / distance) * view.bins_per_sine)
    row = row_of_bin[wp.clamp(bin, 0, row_of_bin.shape[0] - 1)]
    if row < _OUTSIDE:
        row = SEARCH_FROM - row
        x = wp.float64(p[0])
        y = wp.float64(p[1])
        z = wp.float64(p[2])
        exact = wp.sqrt(x * x + y * y + z * z)
        while row < view.rows and z <= sines[row + 1] * exact:
            row += 1
    return row


@wp.kernel
def find_rows(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    ring_in: wp.array(dtype=wp.uint16),
    count_in: wp.array(dtype=wp.int32),
    sines_in: wp.array(dtype=wp.float64),
    row_of_bin_in: wp.array(dtype=wp.int32),
    view: View,
    # out
    row_out: wp.array(dtype=wp.int32),
    distance_out: wp.array(dtype=wp.float32),
):
    """The row of each point, -1 outside the image, and its range."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    p = xyz_in[i]
    distance = wp.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    row = int(_OUTSIDE)
    # Written so that NaN is nowhere.
    if distance > 0.0 and distance < float(wp.inf):
        if ring_in:
            row = view.rows - 1 - int(ring_in[i])
        else:
            row = _row_of(p, distance, sines_in, row_of_bin_in, view)
    row_out[i] = wp.where(row < view.rows, row, _OUTSIDE)
    distance_out[i] = distance


@wp.kernel
def find_nearest(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    row_in: wp.array(dtype=wp.int32),
    distance_in: wp.array(dtype=wp.float32),
    edges_in: wp.array(dtype=wp.vec2d),
    view: View,
    # in out: `EMPTY` where there is none
    nearest: wp.array(dtype=wp.int64),
):
    """Per pixel the nearest point, the first of equals."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    row = row_in[i]
    if row <= _OUTSIDE:
        return
    p = xyz_in[i]
    pixel = row * view.columns + _column_of(p[0], p[1], edges_in, view)
    # The bits of a positive float are in the order of its value.
    wp.atomic_min(nearest, pixel, (wp.int64(wp.cast(distance_in[i], wp.int32)) << _INDEX_BITS) | wp.int64(i))


@wp.func
def _draw_pixel(
    pixel: int,
    key: wp.int64,
    xyz: wp.array(dtype=wp.vec3),
    intensities: wp.array(dtype=wp.float32),
    channels: wp.array2d(dtype=wp.float32),
    indices: wp.array(dtype=wp.int32),
):
    """A pixel takes its point."""
    index = int(-1)
    distance = float(0.0)
    p = wp.vec3(0.0)
    intensity = float(0.0)
    if key != EMPTY:
        index = int(key & _INDEX_MASK)
        distance = wp.cast(int(key >> _INDEX_BITS), wp.float32)
        p = xyz[index]
        if intensities:
            intensity = intensities[index]
    channels[_RANGE, pixel] = distance
    channels[_X, pixel] = p[0]
    channels[_Y, pixel] = p[1]
    channels[_Z, pixel] = p[2]
    channels[_INTENSITY, pixel] = intensity
    indices[pixel] = index


@wp.kernel
def draw_pixels(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    # in out: left empty
    nearest: wp.array(dtype=wp.int64),
    # out
    channels_out: wp.array2d(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
):
    """Each pixel takes its point, and clears the workspace."""
    pixel = wp.tid()
    key = nearest[pixel]
    nearest[pixel] = EMPTY
    _draw_pixel(pixel, key, xyz_in, intensity_in, channels_out, index_out)


# ---- the same in parts, for a CPU


# In C++, where a compiler makes vector instructions of the loops; they compute what `_row_of` and `_column_of` do.
@wp.func_native("""
    constexpr int BLOCK = 256;
    const auto bits_of = [](const float value) { union { float f; int i; } both; both.f = value; return both.i; };
    long long* const image = (long long*)nearest.data + part * (nearest.strides[0] / 8);
    int unsure_count = 0;
    const int bins = row_of_bin.shape[0], rows = view.rows, columns = view.columns;
    const float top_sine = view.top_sine, bins_per_sine = view.bins_per_sine, slack = view.place_slack;
    const auto run = [&](const long long step) {
        for (int start = first; start < last; start += BLOCK) {
            const int length = last - start < BLOCK ? last - start : BLOCK;
            const float* const points = (const float*)xyz.data + start * step;
            float ranges[BLOCK];
            int bin_of[BLOCK], column_of[BLOCK];
            for (int i = 0; i < length; ++i) {
                const float x = points[i * step], y = points[i * step + 1], z = points[i * step + 2];
                ranges[i] = sqrtf(x * x + y * y + z * z);
                int bin = (int)((top_sine - z / ranges[i]) * bins_per_sine);
                bin = bin > 0 ? bin : 0;
                bin_of[i] = bin < bins - 1 ? bin : bins - 1;
            }
            for (int i = 0; i < length; ++i) {
                const float x = points[i * step], y = points[i * step + 1];
                const float flat_x = x < 0.0f ? -x : x, flat_y = y < 0.0f ? -y : y;
                const float wide = flat_y > flat_x ? flat_y : flat_x, narrow = flat_y > flat_x ? flat_x : flat_y;
                const float ratio = narrow / (wide > 0.0f ? wide : 1.0f);
                const float square = ratio * ratio, fourth = square * square;
                const float low = 0.15915423f - 0.052996794f * square;
                const float middle = 0.031129001f - 0.019275236f * square;
                const float high = 0.0091244903f - 0.0021362182f * square;
                const float eighth = ratio * (low + fourth * (middle + fourth * high));
                const float quarter = flat_y > flat_x ? 0.25f - eighth : eighth;
                const float half = x < 0.0f ? 0.5f - quarter : quarter;
                const float at = (y < 0.0f ? 0.5f + half : 0.5f - half) * (float)columns;
                const float off = at - (float)(int)(at + 0.5f);
                column_of[i] = (off < 0.0f ? -off : off) < slack ? -1 : (int)at;
            }
            for (int i = 0; i < length; ++i) {
                const int row = row_of_bin.data[bin_of[i]], column = column_of[i];
                if (!(ranges[i] > 0.0f && ranges[i] < INFINITY) || row == -1 || row >= rows)
                    continue;
                if (row < -1 || column < 0) {
                    unsure.data[first + unsure_count++] = start + i;
                    continue;
                }
                const long long key = (long long)bits_of(ranges[i]) << 32 | (start + i);
                long long* const at = image + row * columns + column;
                if (key < *at)
                    *at = key;
            }
        }
    };
    if (xyz.strides[0] == 16) run(4);
    else if (xyz.strides[0] == 12) run(3);
    else run(xyz.strides[0] / 4);
    return unsure_count;
""")
def _draw_sure_points(
    xyz: wp.array(dtype=wp.vec3),
    row_of_bin: wp.array(dtype=wp.int32),
    view: View,
    first: int,
    last: int,
    part: int,
    nearest: wp.array2d(dtype=wp.int64),
    unsure: wp.array(dtype=wp.int32),
) -> int:
    """Draws those of the points first … last − 1 of which float32 can tell the pixel, and lists the others."""


@wp.func
def _draw_point(
    i: int,
    row: int,
    p: wp.vec3,
    distance: float,
    edges: wp.array(dtype=wp.vec2d),
    view: View,
    part: int,
    nearest: wp.array2d(dtype=wp.int64),
):
    if row >= 0 and row < view.rows:
        pixel = row * view.columns + _column_of(p[0], p[1], edges, view)
        key = (wp.int64(wp.cast(distance, wp.int32)) << _INDEX_BITS) | wp.int64(i)
        nearest[part, pixel] = wp.min(nearest[part, pixel], key)


@wp.kernel
def find_nearest_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    ring_in: wp.array(dtype=wp.uint16),
    count_in: wp.array(dtype=wp.int32),
    sines_in: wp.array(dtype=wp.float64),
    row_of_bin_in: wp.array(dtype=wp.int32),
    edges_in: wp.array(dtype=wp.vec2d),
    view: View,
    # in out: workspace; an image for each part, `EMPTY` where there is none
    unsure: wp.array(dtype=wp.int32),
    nearest: wp.array2d(dtype=wp.int64),
):
    """Per pixel the nearest point of a part, the first of equals."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    share = (n + parts - 1) / parts
    first = part * share
    last = wp.min(first + share, n)
    if ring_in:
        for i in range(first, last):
            p = xyz_in[i]
            distance = wp.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
            if distance > 0.0 and distance < float(wp.inf):
                _draw_point(i, view.rows - 1 - int(ring_in[i]), p, distance, edges_in, view, part, nearest)
        return
    for k in range(_draw_sure_points(xyz_in, row_of_bin_in, view, first, last, part, nearest, unsure)):
        i = unsure[first + k]
        p = xyz_in[i]
        distance = wp.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        row = _row_of(p, distance, sines_in, row_of_bin_in, view)
        _draw_point(i, row, p, distance, edges_in, view, part, nearest)


@wp.kernel
def draw_pixels_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    images: int,
    # in out: left empty
    nearest: wp.array2d(dtype=wp.int64),
    # out
    channels_out: wp.array2d(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
):
    """Each pixel of a share of the image takes the nearest of the parts' points, and clears the workspace."""
    pixels = index_out.shape[0]
    share = (pixels + parts - 1) / parts
    for pixel in range(part * share, wp.min((part + 1) * share, pixels)):
        key = EMPTY
        for image in range(images):
            if nearest[image, pixel] != EMPTY:
                key = wp.min(key, nearest[image, pixel])
                nearest[image, pixel] = EMPTY
        _draw_pixel(pixel, key, xyz_in, intensity_in, channels_out, index_out)
