"""Filters on a CPU: each part of a cloud is packed behind what the parts before it keep. `filters.py` has the plan.

A module of its own, so that no GPU waits for it: compilers for CUDA take twenty seconds over what is written for a CPU.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)
from .parts import part_start

__all__ = ["EGO", "KEPT", "NON_FINITE", "OUT_OF_RANGE", "Limits", "pack_part"]

NON_FINITE, OUT_OF_RANGE, EGO, KEPT = (wp.constant(i) for i in range(4))


@wp.struct
class Limits:
    """What stays, and of that the own vehicle, which goes; upper bounds open."""

    low: wp.vec3
    high: wp.vec3
    ego_low: wp.vec3
    ego_high: wp.vec3


# In C++, where a compiler sees loops that it can turn into vector instructions: four times as fast as the same in
# Python. Points are judged in blocks without a branch, then those that stay are copied; their place is known by then.
@wp.func_native("""
    constexpr int BLOCK = 256;
    const auto run = [&](const float* __restrict points, const long long step) {
        const float low[3] = {limits.low[0], limits.low[1], limits.low[2]};
        const float high[3] = {limits.high[0], limits.high[1], limits.high[2]};
        const float ego_low[3] = {limits.ego_low[0], limits.ego_low[1], limits.ego_low[2]};
        const float ego_high[3] = {limits.ego_high[0], limits.ego_high[1], limits.ego_high[2]};
        int all_finite = 0, all_inside = 0, all_kept = 0;
        for (int start = first; start < last; start += BLOCK) {
            const int length = last - start < BLOCK ? last - start : BLOCK;
            const float* __restrict at = points + start * step;
            int stays[BLOCK], chosen[BLOCK];
            int finite = 0, inside = 0;
            for (int k = 0; k < length; ++k) {
                const float x = at[k * step], y = at[k * step + 1], z = at[k * step + 2];
                const int is_finite = (x - x) + (y - y) + (z - z) == 0.0f;
                const int is_inside = is_finite & (x >= low[0]) & (y >= low[1]) & (z >= low[2])
                    & (x < high[0]) & (y < high[1]) & (z < high[2]);
                const int is_ego = (x >= ego_low[0]) & (y >= ego_low[1]) & (z >= ego_low[2])
                    & (x < ego_high[0]) & (y < ego_high[1]) & (z < ego_high[2]);
                finite += is_finite;
                inside += is_inside;
                stays[k] = is_inside & (1 - is_ego);
            }
            int kept = 0;
            for (int k = 0; k < length; ++k) {
                chosen[kept] = k;
                kept += stays[k];
            }
            if (index_out.data) {
                const long long to = place + all_kept, width = xyz_out.strides[0] / 4;
                float* xyz_to = (float*)xyz_out.data + to * width;
                int* index_to = index_out.data + to;
                for (int k = 0; k < kept; ++k) {
                    const float* from = at + chosen[k] * step;
                    const float x = from[0], y = from[1], z = from[2];
                    xyz_to[k * width] = x;
                    xyz_to[k * width + 1] = y;
                    xyz_to[k * width + 2] = z;
                    index_to[k] = start + chosen[k];
                }
                if (intensity_out.data) {
                    const long long step_in = intensity_in.strides[0] / 4, step_out = intensity_out.strides[0] / 4;
                    const float* intensity_from = intensity_in.data + start * step_in;
                    float* intensity_to = intensity_out.data + to * step_out;
                    for (int k = 0; k < kept; ++k)
                        intensity_to[k * step_out] = intensity_in.data ? intensity_from[chosen[k] * step_in] : 0.0f;
                }
            }
            all_finite += finite;
            all_inside += inside;
            all_kept += kept;
        }
        if (!tallied) {
            tally.data[3 * part] = all_finite;
            tally.data[3 * part + 1] = all_inside;
            tally.data[3 * part + 2] = all_kept;
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4);
    else if (xyz_in.strides[0] == 12) run(points, 3);
    else run(points, xyz_in.strides[0] / 4);
""")
def _pack(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    limits: Limits,
    first: int,
    last: int,
    part: int,
    place: int,
    tallied: int,
    # in out
    tally: wp.array2d(dtype=wp.int32),
    # out: the last null where points are only to be counted
    xyz_out: wp.array(dtype=wp.vec3),
    intensity_out: wp.array(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
):
    """Packs those of the points first … last − 1 that stay, from `place` on; tallies the finite, inside and kept."""


@wp.kernel
def pack_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    limits: Limits,
    tallied: int,
    # in out: of each part its points that are finite, inside the range as well, and kept
    tally: wp.array2d(dtype=wp.int32),
    # out: null where points are only to be counted
    xyz_out: wp.array(dtype=wp.vec3),
    intensity_out: wp.array(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Packs one of the parts that the points are cut into, behind what the parts before it keep."""
    n = wp.max(wp.min(count_in[0], xyz_in.shape[0]), 0)
    place = int(0)
    if tallied != 0:
        for before in range(part):
            place += tally[before, 2]
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    _pack(xyz_in, intensity_in, limits, first, last, part, place, tallied, tally, xyz_out, intensity_out, index_out)
    if part == 0 and count_out:
        finite = int(0)
        inside = int(0)
        kept = int(0)
        for each in range(parts):
            finite += tally[each, 0]
            inside += tally[each, 1]
            kept += tally[each, 2]
        count_out[0] = kept
        dropped_out[NON_FINITE] = n - finite
        dropped_out[OUT_OF_RANGE] = finite - inside
        dropped_out[EGO] = inside - kept
