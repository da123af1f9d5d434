"""Points with too few others within a radius, found by a few CPU threads, in C++. See `outliers.py`."""

from __future__ import annotations

import warp as wp

from .leaf_lanes import Eight
from .point_tree import LEAF

__all__ = ["Reach", "find_lonely_in_parts"]

# Which points are within a radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(32)  # leaves that one part looks at before it leaves as many to the others


@wp.struct
class Reach:
    """A radius."""

    surely: wp.float32  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not: wp.float32  # and above here they are not
    squared: wp.float64


# The eight points of a leaf go up the tree together, each in a lane of its own: what a lane waits for, others of its
# radius, may be below a node, or in a leaf, of which one point after the other is held against all lanes.
# CUDA's compiler, which is shown this file too, knows no such vectors, and never runs it.
@wp.func_native("""
    const int members = wp::min(8, size - leaf * 8);
#ifdef __clang__
    typedef float Floats __attribute__((vector_size(32)));
    typedef int Ints __attribute__((vector_size(32)));
    typedef signed char Chars __attribute__((vector_size(8)));
    const float surely = reach.surely, surely_not = reach.surely_not;
    const float* const xs = (const float*)x.data;
    const float* const ys = (const float*)y.data;
    const float* const zs = (const float*)z.data;
    const auto lanes = [](const float* const from) {
        Floats eight;
        memcpy(&eight, from, 32);
        return eight;
    };
    const auto is_any = [](const Ints lanes) {
        const Chars narrow = __builtin_convertvector(lanes, Chars);
        long long bits;
        memcpy(&bits, &narrow, 8);
        return bits != 0;
    };
    const Floats px = lanes(xs + leaf * 8), py = lanes(ys + leaf * 8), pz = lanes(zs + leaf * 8);
    Ints found;
    for (int m = 0; m < 8; ++m) found[m] = m < members ? 0 : enough;
    Ints waits = found < enough;
    const auto gap = [](const Floats p, const float low, const float high) {
        const Floats below = low - p, above = p - high, off = below > above ? below : above;
        return off > 0.0f ? off : Floats{};
    };
    const auto is_near_some = [&](const int node) {
        const auto& l = low.data[node];
        const auto& h = high.data[node];
        const Floats gx = gap(px, l[0], h[0]), gy = gap(py, l[1], h[1]), gz = gap(pz, l[2], h[2]);
        return is_any((gx * gx + gy * gy + gz * gz <= surely_not) & waits);
    };
    const auto look_at = [&](const int other) {
        Ints near = {}, maybe = {};
        for (int k = other * 8; k < other * 8 + 8; ++k) {
            const Floats dx = px - xs[k], dy = py - ys[k], dz = pz - zs[k];
            const Floats squared = dx * dx + dy * dy + dz * dz;
            near -= squared <= surely;
            maybe -= squared <= surely_not;
        }
        if (is_any(maybe > near)) {
            near = Ints{};
            for (int m = 0; m < members; ++m) {
                for (int k = other * 8; k < other * 8 + 8; ++k) {
                    const double dx = (double)px[m] - xs[k], dy = (double)py[m] - ys[k], dz = (double)pz[m] - zs[k];
                    near[m] += dx * dx + dy * dy + dz * dz <= reach.squared;
                }
            }
        }
        found += other == leaf ? near - 1 : near;  // a point is near itself
        waits &= found < enough;
    };
    look_at(leaf);
    for (int node = leaves + leaf; node > 1 && is_any(waits); node >>= 1) {
        const int root = node ^ 1;
        for (int at = root;;) {
            if (is_near_some(at)) {
                if (at < leaves) {
                    at *= 2;
                    continue;
                }
                look_at(at - leaves);
            }
            while (at != root && (at & 1)) at >>= 1;
            if (at == root) break;
            ++at;
        }
    }
    for (int m = 0; m < members; ++m) outlier.data[index.data[leaf * 8 + m]] = found[m] < enough;
#endif
    return members;
""")
def _find_lonely_of(
    leaf: int,
    size: int,
    index: wp.array(dtype=wp.int32),
    x: wp.array(dtype=Eight),
    y: wp.array(dtype=Eight),
    z: wp.array(dtype=Eight),
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    leaves: int,
    reach: Reach,
    enough: int,
    outlier: wp.array(dtype=wp.bool),
) -> int:
    """Which of a leaf's points have fewer than `enough` others within the radius, as float64 decides."""


@wp.kernel
def find_lonely_in_parts(
    part: int,
    parts: int,
    # in
    index_in: wp.array(dtype=wp.int32),
    size_in: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=Eight),
    y_in: wp.array(dtype=Eight),
    z_in: wp.array(dtype=Eight),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    reach: Reach,
    min_neighbors: int,
    # out: true
    outlier_out: wp.array(dtype=wp.bool),
):
    """Every so many runs of leaves, so that crowded places are shared out."""
    size = size_in[0]
    used = (size + LEAF - 1) // LEAF
    for run in range(part, (used + _RUN - 1) // _RUN, parts):
        for leaf in range(run * _RUN, wp.min((run + 1) * _RUN, used)):
            _find_lonely_of(
                leaf, size, index_in, x_in, y_in, z_in, low_in, high_in, leaves, reach, min_neighbors, outlier_out
            )
