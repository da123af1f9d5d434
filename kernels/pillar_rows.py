"""Pillars on a CPU: points described eight at once, then each thread sums and draws rows of the grid of its own.

What a point adds to its cell is a few integers, found without a branch. The rows are dealt out so that each thread has
about as many points; a row is drawn 32 cells at a time, and only where it differs from the launch before.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)
from .parts import first_row_of, part_start

__all__ = ["PillarSpec", "describe_points", "draw_rows"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})


@wp.struct
class PillarSpec:
    """What kernels need of a grid of pillars."""

    low: wp.vec3
    high: wp.vec3
    inverse_cell: float
    inverse_slice: float
    rows: int
    columns: int
    words: int  # of 32 cells in a row, the last one possibly not full
    slices: int
    channels: int  # bit c: channel c is drawn; those that are follow each other


@wp.func_native("""
    const auto run = [&](const float* __restrict points, const long long step, int* __restrict place,
                         int* __restrict offset, int* __restrict above) {
        const float low[3] = {spec.low[0], spec.low[1], spec.low[2]};
        const float high[3] = {spec.high[0], spec.high[1], spec.high[2]};
        const float inverse_cell = spec.inverse_cell, inverse_slice = spec.inverse_slice;
        const int last_row = spec.rows - 1, last_column = spec.columns - 1, last_slice = spec.slices - 1;
        const int width = 32 * spec.words;
        for (long long i = first; i < last; ++i) {
            const float x = points[i * step], y = points[i * step + 1], z = points[i * step + 2] + sensor_height;
            const bool inside = (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
                & (z >= low[2]) & (z < high[2]);
            const float u = inside ? (x - low[0]) * inverse_cell : 0.0f;
            const float v = inside ? (y - low[1]) * inverse_cell : 0.0f;
            const float height = inside ? z : 0.0f;
            const int column_of = (int)u, row_of = (int)v, level_of = (int)(height * inverse_slice) + 1;
            const int column = column_of < last_column ? column_of : last_column;
            const int row = row_of < last_row ? row_of : last_row;
            const int level = height >= 0.0f ? (level_of < last_slice ? level_of : last_slice) : 0;
            const int dx = (int)((u - (float)column) * 4096.0f), dy = (int)((v - (float)row) * 4096.0f);
            place[i] = inside ? row * width + column : -1;
            offset[i] = dx | dy << 13 | level << 26;
            above[i] = (int)((height - low[2]) * 1000.0f);
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4, place_out.data, offset_out.data, above_out.data);
    else if (xyz_in.strides[0] == 12) run(points, 3, place_out.data, offset_out.data, above_out.data);
    else run(points, xyz_in.strides[0] / 4, place_out.data, offset_out.data, above_out.data);
""")
def _describe(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    spec: PillarSpec,
    sensor_height: float,
    first: int,
    last: int,
    # out
    place_out: wp.array(dtype=wp.int32),
    offset_out: wp.array(dtype=wp.int32),
    above_out: wp.array(dtype=wp.int32),
):
    """The cells of points, −1 outside; the offset in the cell along x and y, 13 bits each, and the slice; the height.

    Offsets are in 1/4096 cell, less than two cells, since the last cell of a row or column may be longer.
    """


@wp.kernel
def describe_points(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    spec: PillarSpec,
    # out
    place_out: wp.array(dtype=wp.int32),
    offset_out: wp.array(dtype=wp.int32),
    above_out: wp.array(dtype=wp.int32),
):
    """Of each point of a part its cell, −1 where it has none, and what it adds there."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    _describe(xyz_in, spec, sensor_height_in[0], first, last, place_out, offset_out, above_out)


@wp.func_native("""
    constexpr int POINTS = 0, Z = 1, DX = 2, DY = 3, HIGH = 4, LOW = 5, BITS = 6, ROW = 8, AHEAD = 16;
    const unsigned begin = (unsigned)first_row * 32 * spec.words;
    const unsigned length = (unsigned)(last_row - first_row) * 32 * spec.words;
    const int* __restrict place = place_in.data;
    long long* __restrict all_sums = sums.data;
    for (int i = 0; i < count; ++i) {
    #ifndef __CUDA_ARCH__
        if (i + AHEAD < count && (unsigned)place[i + AHEAD] - begin < length)
            __builtin_prefetch(all_sums + ROW * (long long)place[i + AHEAD], 1);
    #endif
        if ((unsigned)place[i] - begin >= length) continue;
        long long* __restrict cell = all_sums + ROW * (long long)place[i];
        const int z = above_in.data[i], offset = offset_in.data[i];
        const long long points = cell[POINTS], bit = 1 << (offset >> 26);
        const int dx = offset & 8191, dy = offset >> 13 & 8191;
        cell[POINTS] = points + 1;
        if (points == 0) {
            occupied.data[place[i] >> 5] |= 1u << (place[i] & 31);
            cell[Z] = cell[HIGH] = cell[LOW] = z;
            cell[DX] = dx;
            cell[DY] = dy;
            cell[BITS] = bit;
        } else {
            cell[Z] += z;
            cell[DX] += dx;
            cell[DY] += dy;
            cell[HIGH] = cell[HIGH] > z ? cell[HIGH] : z;
            cell[LOW] = cell[LOW] < z ? cell[LOW] : z;
            cell[BITS] |= bit;
        }
    }
""")
def _sum(
    # in
    place_in: wp.array(dtype=wp.int32),
    offset_in: wp.array(dtype=wp.int32),
    above_in: wp.array(dtype=wp.int32),
    count: int,
    spec: PillarSpec,
    first_row: int,
    last_row: int,
    # in out
    sums: wp.array(dtype=wp.int64),
    occupied: wp.array(dtype=wp.uint32),
):
    """Adds the points in the rows first_row … last_row − 1 to their cells."""


@wp.func_native("""
    constexpr int POINTS = 0, Z = 1, DX = 2, DY = 3, HIGH = 4, LOW = 5, BITS = 6, ROW = 8, MEANS = 5, MOST = 31;
    const auto lowest_bit = [](unsigned bits) {
    #ifdef __CUDA_ARCH__
        return __ffs(bits) - 1;
    #else
        return __builtin_ctz(bits);
    #endif
    };
    const int slices = spec.slices, columns = spec.columns;
    const long long plane = (long long)spec.rows * columns;
    const bool everything = !shown.data;
    for (int row = first_row; row < last_row; ++row)
        for (int in_row = 0; in_row < spec.words; ++in_row) {
            const long long word = (long long)row * spec.words + in_row;
            unsigned there = occupied.data[word];
            const unsigned changed = everything ? ~0u : there | shown.data[word];
            if (!changed) continue;
            occupied.data[word] = 0;
            unsigned in_slice[MOST + 1] = {};
            float sum[6][32] = {};
            float value[MEANS][32];
            if (!everything) shown.data[word] = there;
            for (; there; there &= there - 1) {
                const int k = lowest_bit(there);
                long long* __restrict cell = sums.data + ROW * (32 * word + k);
                for (unsigned bits = (unsigned)cell[BITS]; bits; bits &= bits - 1)
                    in_slice[lowest_bit(bits)] |= 1u << k;
                for (int n = 0; n < BITS; ++n) sum[n][k] = (float)cell[n];
                cell[POINTS] = 0;
            }
            for (int k = 0; k < 32; ++k) {
                const bool points = sum[POINTS][k] > 0.0f;
                const float share = 1.0f / (points ? sum[POINTS][k] : 1.0f);
                const float dx = sum[DX][k] * share / 4096.0f - 0.5f;
                const float dy = sum[DY][k] * share / 4096.0f - 0.5f;
                const float z = sum[Z][k] * share / 1000.0f + lowest;
                const float high = sum[HIGH][k] / 1000.0f + lowest;
                const float low = sum[LOW][k] / 1000.0f + lowest;
                value[0][k] = points ? dx : 0.0f;
                value[1][k] = points ? dy : 0.0f;
                value[2][k] = points ? z : 0.0f;
                value[3][k] = points ? high : 0.0f;
                value[4][k] = points ? low : 0.0f;
            }
            float* __restrict to = grid.data + (long long)row * columns + 32 * in_row;
            const int length = columns - 32 * in_row < 32 ? columns - 32 * in_row : 32;
            // By halves of a word, each a line of the cache.
            for (int slice = 0; slice < slices; ++slice) {
                if (!(spec.channels >> slice & 1)) continue;
                const unsigned bits = in_slice[slice];
                unsigned differ = ~0u;
                if (!everything) {
                    unsigned& before = shown_slices.data[word * (MOST + 1) + slice];
                    differ = before ^ bits;
                    before = bits;
                }
                for (int half = 0; half < 32; half += 16) {
                    if (!(differ >> half & 0xFFFF)) continue;
                    if (length == 32) for (int k = half; k < half + 16; ++k) to[k] = bits >> k & 1 ? 1.0f : 0.0f;
                    else for (int k = half; k < length; ++k) to[k] = bits >> k & 1 ? 1.0f : 0.0f;
                }
                to += plane;
            }
            for (int mean = 0; mean < MEANS; ++mean) {
                if (!(spec.channels >> (slices + mean) & 1)) continue;
                for (int half = 0; half < 32; half += 16) {
                    if (!(changed >> half & 0xFFFF)) continue;
                    if (length == 32) for (int k = half; k < half + 16; ++k) to[k] = value[mean][k];
                    else for (int k = half; k < length; ++k) to[k] = value[mean][k];
                }
                to += plane;
            }
        }
""")
def _draw(
    # in
    spec: PillarSpec,
    lowest: float,
    first_row: int,
    last_row: int,
    # in out
    sums: wp.array(dtype=wp.int64),
    occupied: wp.array(dtype=wp.uint32),
    shown: wp.array(dtype=wp.uint32),
    shown_slices: wp.array(dtype=wp.uint32),
    grid: wp.array(dtype=wp.float32),
):
    """Draws rows, and empties their cells; all of a row, or where `shown` is not null, what has changed."""


@wp.kernel
def draw_rows(
    # in
    part: int,
    parts: int,
    place_in: wp.array(dtype=wp.int32),
    offset_in: wp.array(dtype=wp.int32),
    above_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    points: int,
    spec: PillarSpec,
    # in out: zero, and left so; what the grid shows, or null where it is new
    sums: wp.array(dtype=wp.int64),
    occupied: wp.array(dtype=wp.uint32),
    shown: wp.array(dtype=wp.uint32),
    shown_slices: wp.array(dtype=wp.uint32),
    grid: wp.array(dtype=wp.float32),
):
    """Sums and draws one of the parts that the rows of the grid are cut into."""
    n = wp.min(count_in[0], points)
    first_row = first_row_of(part, parts, place_in, n, spec.rows, 32 * spec.words)
    last_row = first_row_of(part + 1, parts, place_in, n, spec.rows, 32 * spec.words)
    _sum(place_in, offset_in, above_in, n, spec, first_row, last_row, sums, occupied)
    _draw(spec, spec.low[2], first_row, last_row, sums, occupied, shown, shown_slices, grid)
