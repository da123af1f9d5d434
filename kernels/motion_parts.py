"""Motion compensation on a CPU: each part of a cloud by blocks, in vector instructions. `motion.py` has the plan.

A module of its own, so that no GPU waits for it: compilers for CUDA take long over what is written for a CPU.
"""

from __future__ import annotations

from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)
from .parts import part_start

__all__ = ["Segment", "move_part"]

wp.set_module_options({"fuse_fp": False})


@wp.struct
class Segment:
    """From one pose to the next, in the sensor's frame at the reference time."""

    rotation: wp.mat33
    position: wp.vec3
    step: wp.vec3
    axis: wp.vec3
    half_angle: float
    per_second: float


# What `_move_points` in `motion.py` does, operation by operation. Of a block's segments, which are one or two in a
# sweep as it was taken, each moves all its points and keeps its own: so there is no branch within a loop.
_MOVE = """
    constexpr int BLOCK = 256;
    const int poses = pose_count_in.data[0];
    const long long step_in = xyz_in.strides[0] / 4, step_out = xyz_out.strides[0] / 4;
    const long long step_t = t_in.strides[0] / sizeof(*t_in.data);
    const float* from = (const float*)xyz_in.data;  // may be where they go
    float* to = (float*)xyz_out.data;
    if (poses < 2) {
        if (from != to)
            for (long long i = first; i < last; ++i)
                for (int axis = 0; axis < 3; ++axis) to[i * step_out + axis] = from[i * step_in + axis];
        return;
    }
    const double* times = times_in.data;
    const double begin = times[0], end = times[poses - 1];
    const auto sine_of = [](const float angle) {
        const float s = angle * angle;
        return angle
            * (1.0f + s * (-0.16666666f + s * (8.3332423e-3f + s * (-1.9822762e-4f + s * 2.6348152e-6f))));
    };
    int all_outside = 0;
    for (int start = first; start < last; start += BLOCK) {
        const int length = last - start < BLOCK ? last - start : BLOCK;
        double t[BLOCK];
        float x[BLOCK], y[BLOCK], z[BLOCK], u[BLOCK], v[BLOCK], w[BLOCK];
        int on[BLOCK], outside = 0;
        if (row_in.data)
            for (int k = 0; k < length; ++k) t[k] = (double)t_in.data[row_in.data[start + k] * step_t];
        else
            for (int k = 0; k < length; ++k) t[k] = (double)t_in.data[(start + k) * step_t];
        for (int k = 0; k < length; ++k) {
            // Written so that NaN is outside, and of the first pose.
            const int within = (t[k] >= begin) & (t[k] <= end);
            outside += 1 - within;
            t[k] = within ? t[k] : (t[k] > end ? end : begin);
        }
        all_outside += outside;
        int least = poses - 2, most = 0;
        if (poses <= 16) {
            for (int k = 0; k < length; ++k) on[k] = 0;
            for (int pose = 1; pose < poses - 1; ++pose)
                for (int k = 0; k < length; ++k) on[k] += times[pose] <= t[k];
        } else {
            for (int k = 0; k < length; ++k) {
                int low = 0, high = poses - 1;
                while (high - low > 1) {
                    const int middle = (low + high) / 2;
                    if (times[middle] <= t[k]) low = middle;
                    else high = middle;
                }
                on[k] = low;
            }
        }
        for (int k = 0; k < length; ++k) {
            least = on[k] < least ? on[k] : least;
            most = on[k] > most ? on[k] : most;
        }
        for (int k = 0; k < length; ++k) {
            const float* p = from + (start + k) * step_in;
            x[k] = p[0];
            y[k] = p[1];
            z[k] = p[2];
        }
        for (int number = least; number <= most; ++number) {
            const auto& segment = segments_in.data[number];
            const double since = times[number];
            const float per_second = segment.per_second, half_angle = segment.half_angle;
            const float a = segment.axis[0], b = segment.axis[1], c = segment.axis[2];
            float m[3][3], at[3], step[3];
            for (int i = 0; i < 3; ++i) {
                for (int j = 0; j < 3; ++j) m[i][j] = segment.rotation.data[i][j];
                at[i] = segment.position[i];
                step[i] = segment.step[i];
            }
            for (int k = 0; k < length; ++k) {
                const float gone = (float)(t[k] - since) * per_second, share = gone < 1.0f ? gone : 1.0f;
                const float half = share * half_angle;
                const float sine = sine_of(half), cosine = sine_of(1.5707964f - half);
                const float e = 2.0f * sine * cosine, f = 2.0f * sine * sine;
                const float px = x[k], py = y[k], pz = z[k];
                const float cx = b * pz - c * py, cy = c * px - a * pz, cz = a * py - b * px;
                const float dx = b * cz - c * cy, dy = c * cx - a * cz, dz = a * cy - b * cx;
                const float tx = px + e * cx + f * dx, ty = py + e * cy + f * dy, tz = pz + e * cz + f * dz;
                const bool own = on[k] == number;
                const float nx = m[0][0] * tx + m[0][1] * ty + m[0][2] * tz + (at[0] + share * step[0]);
                const float ny = m[1][0] * tx + m[1][1] * ty + m[1][2] * tz + (at[1] + share * step[1]);
                const float nz = m[2][0] * tx + m[2][1] * ty + m[2][2] * tz + (at[2] + share * step[2]);
                u[k] = own ? nx : u[k];
                v[k] = own ? ny : v[k];
                w[k] = own ? nz : w[k];
            }
        }
        for (int k = 0; k < length; ++k) {
            float* p = to + (start + k) * step_out;
            p[0] = u[k];
            p[1] = v[k];
            p[2] = w[k];
        }
    }
    __atomic_fetch_add(&outside.data[0], all_outside, __ATOMIC_RELAXED);
"""


# Each turn adds an overload.
for _dtype in (wp.float32, wp.float64):

    @wp.func_native(_MOVE)
    def _move(
        # in
        first: int,
        last: int,
        xyz_in: wp.array(dtype=wp.vec3),
        t_in: wp.array(dtype=_dtype),
        row_in: wp.array(dtype=wp.int32),
        times_in: wp.array(dtype=wp.float64),
        segments_in: wp.array(dtype=Segment),
        pose_count_in: wp.array(dtype=wp.int32),
        # in out
        outside: wp.array(dtype=wp.int32),
        # out
        xyz_out: wp.array(dtype=wp.vec3),
    ):
        """Moves the points first … last − 1."""


@wp.kernel
def move_part(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    t_in: wp.array(dtype=Any),
    row_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    times_in: wp.array(dtype=wp.float64),
    segments_in: wp.array(dtype=Segment),
    pose_count_in: wp.array(dtype=wp.int32),
    # in out: zero
    outside: wp.array(dtype=wp.int32),
    # out
    xyz_out: wp.array(dtype=wp.vec3),
):
    """Moves one of the parts that the points are cut into."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    _move(first, last, xyz_in, t_in, row_in, times_in, segments_in, pose_count_in, outside, xyz_out)


for _dtype in (wp.float32, wp.float64):
    wp.overload(move_part, {"t_in": wp.array(dtype=_dtype)})
