"""The ground on a CPU: points and cells in parts, by loops that a compiler turns into vector instructions.

They give the bytes of the kernels for GPUs in `ground_plane` and `ground`, which say what is computed and why.
"""

from __future__ import annotations

import warp as wp

from .parts import part_start
from .polar_grid import FIRST_RING, RING_BITS, RINGS, SEGMENTS

__all__ = ["GroundLimits", "bin_part", "judge_cells_part", "judge_points_part"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_GRID = f"""
    constexpr int SEGMENTS = {int(SEGMENTS)}, RINGS = {int(RINGS)};
    constexpr int RING_BITS = {int(RING_BITS)}, FIRST_RING = {int(FIRST_RING)};
"""


@wp.struct
class GroundLimits:
    """What a verdict on cells and points goes by, as `ground` has it."""

    off_median: float
    gradient: float
    stands_from: float
    stands_levels: wp.uint64
    top_bare: float
    top_occupied: float
    bottom: float
    bottom_per_metre: float
    farthest: float


# The cells are found a block of points at a time, without a branch; only then are they written to, point by point.
@wp.func_native(
    _GRID
    + """
    constexpr int BLOCK = 256;
    const auto run = [&](const float* __restrict points, const long long step) {
        long long* __restrict table = tables.data + 2ll * SEGMENTS * RINGS * part;
        for (int start = first; start < last; start += BLOCK) {
            const int length = last - start < BLOCK ? last - start : BLOCK;
            const float* __restrict at = points + start * step;
            int* __restrict cells = cell_out.data + start;
            int depth[BLOCK], level[BLOCK];
            for (int k = 0; k < length; ++k) {
                float x = at[k * step], y = at[k * step + 1], z = at[k * step + 2];
                const float ax = x < 0.0f ? -x : x, ay = y < 0.0f ? -y : y, az = z < 0.0f ? -z : z;
                const bool finite = ax + ay + az < 3.0e38f;
                x = finite ? x : 0.0f;
                y = finite ? y : 0.0f;
                z = finite ? z : 0.0f;
                const float sine = x / ((finite ? ax : 0.0f) + (finite ? ay : 0.0f) + 1.0e-30f);
                const float angle = y < 0.0f ? 3.0f + sine : 1.0f - sine;
                const int segment = (int)(angle * (SEGMENTS * 0.25f)) & (SEGMENTS - 1);
                union { float number; int bits; } squared;
                squared.number = x * x + y * y;
                int ring = (squared.bits >> RING_BITS) - FIRST_RING;
                ring = ring > 0 ? ring : 0;
                ring = ring < RINGS - 1 ? ring : RINGS - 1;
                z = z < -999.0f ? -999.0f : z;
                z = z > 999.0f ? 999.0f : z;
                cells[k] = finite ? segment * RINGS + ring : -1;
                depth[k] = (int)((1000.0f - z) * 1000.0f);
                level[k] = (int)((1000.0f + z) * 4.0f) & 63;
            }
            for (int k = 0; k < length; ++k) {
                if (cells[k] < 0) continue;
                long long* __restrict cell = table + 2 * cells[k];
                const long long key = ((long long)depth[k] << 32) | (0x7FFFFFFF - (start + k));
                cell[0] = cell[0] > key ? cell[0] : key;
                cell[1] |= 1ll << level[k];
            }
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4);
    else if (xyz_in.strides[0] == 12) run(points, 3);
    else run(points, xyz_in.strides[0] / 4);
"""
)
def _bin(
    # in
    part: int,
    first: int,
    last: int,
    xyz_in: wp.array(dtype=wp.vec3),
    # in out
    tables: wp.array2d(dtype=wp.int64),
    # out
    cell_out: wp.array(dtype=wp.int32),
):
    """The cells of the points first … last − 1, and what they add to the table of the part."""


@wp.kernel
def bin_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    # in out: zero
    tables: wp.array2d(dtype=wp.int64),
    # out
    cell_out: wp.array(dtype=wp.int32),
):
    """Bins one part of the points, whose table is one of those that lie below each other."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    _bin(part, part_start(n, part, parts), part_start(n, part + 1, parts), xyz_in, tables, cell_out)


# Along a segment all cells are judged, those without points for nothing: that is less work than to ask.
@wp.func_native(
    _GRID
    + """
    const float a = plane[0], b = plane[1], c = plane[2];
    const float* __restrict radii = radius_in.data;
    float inner[RINGS], width[RINGS];
    for (int k = 0; k < RINGS; ++k) {
        const int before = k > 0 ? k - 1 : 0, after = k < RINGS - 1 ? k + 1 : RINGS - 1;
        width[k] = radii[after] - radii[before];
    }
    for (int segment = first; segment < last; ++segment) {
        const float* __restrict rises = rise_in.data;
        const float* __restrict far_left = rises + (segment - 2 & SEGMENTS - 1) * RINGS;
        const float* __restrict left = rises + (segment - 1 & SEGMENTS - 1) * RINGS;
        const float* __restrict own = rises + segment * RINGS;
        const float* __restrict right = rises + (segment + 1 & SEGMENTS - 1) * RINGS;
        const float* __restrict far_right = rises + (segment + 2 & SEGMENTS - 1) * RINGS;
        const float* __restrict centres = (const float*)centre_in.data + 2ll * segment * RINGS;
        const unsigned long long* __restrict cells = (const unsigned long long*)cells_in.data + 2ll * segment * RINGS;
        float* __restrict surfaces = (float*)surface_out.data + 4ll * segment * RINGS;
        for (int k = 0; k < RINGS; ++k)
            inner[k] = own[k < RINGS - 1 ? k + 1 : k] - own[k > 0 ? k - 1 : 0];
        for (int k = 0; k < RINGS; ++k) {
            const float p = far_left[k], q = left[k], s = right[k], t = far_right[k], r = radii[k];
            const float pq_low = p < q ? p : q, pq_high = p < q ? q : p;
            const float os_low = own[k] < s ? own[k] : s, os_high = own[k] < s ? s : own[k];
            const float low = pq_low > os_low ? pq_low : os_low, high = pq_high < os_high ? pq_high : os_high;
            const float less = low < high ? low : high, more = low < high ? high : low;
            const float below = more < t ? more : t, median = less > below ? less : below;
            const float floor = median - limits.off_median, ceiling = median + limits.off_median;
            const float raised = own[k] > floor ? own[k] : floor, rise = raised < ceiling ? raised : ceiling;
            const float steep = inner[k] / width[k];
            const float up = steep > -limits.gradient ? steep : -limits.gradient;
            const float half = 0.5f * (up < limits.gradient ? up : limits.gradient);
            const float z = rise + a * centres[2 * k] + b * centres[2 * k + 1] + c;
            const float bound = z > -900.0f ? (z < 900.0f ? z : 900.0f) : -900.0f;
            const float quarters = (1000.0f + bound + limits.stands_from) * 4.0f;
            const int whole = (int)quarters;
            const unsigned long long level = (whole + ((float)whole < quarters ? 1 : 0)) & 63;
            const unsigned long long turned = cells[2 * k + 1] >> level | cells[2 * k + 1] << (64 - level & 63);
            surfaces[4 * k] = rise - half * r;
            surfaces[4 * k + 1] = half / r;
            surfaces[4 * k + 2] = turned & limits.stands_levels ? limits.top_occupied : limits.top_bare;
            surfaces[4 * k + 3] = -limits.bottom - limits.bottom_per_metre * r;
        }
    }
"""
)
def _judge_segments(
    # in
    first: int,
    last: int,
    cells_in: wp.array2d(dtype=wp.int64),
    rise_in: wp.array(dtype=wp.float32),
    radius_in: wp.array(dtype=wp.float32),
    centre_in: wp.array(dtype=wp.vec2),
    plane: wp.vec3,
    limits: GroundLimits,
    # out
    surface_out: wp.array(dtype=wp.vec4),
):
    """The surfaces of the cells of the segments first … last − 1, and the heights between which points are ground."""


@wp.kernel
def judge_cells_part(
    # in
    part: int,
    parts: int,
    cells_in: wp.array2d(dtype=wp.int64),
    rise_in: wp.array(dtype=wp.float32),
    radius_in: wp.array(dtype=wp.float32),
    centre_in: wp.array(dtype=wp.vec2),
    plane_in: wp.array(dtype=wp.vec3),
    limits: GroundLimits,
    # out
    surface_out: wp.array(dtype=wp.vec4),
):
    """Judges the cells of some segments."""
    first = part_start(SEGMENTS, part, parts)
    last = part_start(SEGMENTS, part + 1, parts)
    _judge_segments(first, last, cells_in, rise_in, radius_in, centre_in, plane_in[0], limits, surface_out)


@wp.func_native("""
    const float a = plane[0], b = plane[1], c = plane[2], farthest = limits.farthest;
    const auto run = [&](const float* __restrict points, const long long step) {
        const int* __restrict cells = cell_in.data;
        const float* __restrict surfaces = (const float*)surface_in.data;
        float* __restrict heights = height_out.data;
        bool* __restrict mask = (bool*)mask_out.data;
        for (long long i = first; i < last; ++i) {
            const bool finite = cells[i] >= 0;
            const float* __restrict surface = surfaces + 4ll * (finite ? cells[i] : 0);
            const float x = points[i * step], y = points[i * step + 1], z = points[i * step + 2];
            const float squared = x * x + y * y;
            const float r2 = squared < farthest ? squared : farthest;
            const float height = z - a * x - b * y - c - surface[0] - surface[1] * r2;
            heights[i] = finite ? height : NAN;
            mask[i] = finite & (height < surface[2]) & (height > surface[3]);
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4);
    else if (xyz_in.strides[0] == 12) run(points, 3);
    else run(points, xyz_in.strides[0] / 4);
""")
def _judge(
    # in
    first: int,
    last: int,
    xyz_in: wp.array(dtype=wp.vec3),
    cell_in: wp.array(dtype=wp.int32),
    plane: wp.vec3,
    surface_in: wp.array(dtype=wp.vec4),
    limits: GroundLimits,
    # out
    mask_out: wp.array(dtype=wp.bool),
    height_out: wp.array(dtype=wp.float32),
):
    """The heights of the points first … last − 1 above the surfaces of their cells, and whether those are ground."""


@wp.kernel
def judge_points_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    cell_in: wp.array(dtype=wp.int32),
    plane_in: wp.array(dtype=wp.vec3),
    surface_in: wp.array(dtype=wp.vec4),
    limits: GroundLimits,
    # out
    mask_out: wp.array(dtype=wp.bool),
    height_out: wp.array(dtype=wp.float32),
):
    """Judges some of the points."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    _judge(first, last, xyz_in, cell_in, plane_in[0], surface_in, limits, mask_out, height_out)
