"""How far each point's nearest neighbours are, by a few CPU threads, in C++. See `neighbor_distances.py`.

The eight points of a leaf look for their neighbours together, each in a lane of its own: a row has the squared
distances of all eight to one other point, and all eight limits are looked for at once.
"""

from __future__ import annotations

import warp as wp

from .leaf_lanes import Eight
from .point_tree import LEAF

__all__ = ["mean_distances_in_parts", "rows_for"]

# How far a point is must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(32)  # leaves that one part looks at before it leaves as many to the others
_SPARE = 8  # more than are wanted that a limit may let through while there are others to come
_GROWTH = 64  # rows that are added, at least, before they are looked through again


def rows_for(neighbors: int) -> int:
    """Rows that the list of a leaf has room for: half as many again as remain when it is looked through."""
    return 12 * (neighbors + _SPARE) + _GROWTH + 2 * int(LEAF)


# First the points next in the order tell each lane how far its neighbours are at most. Then the tree is gone through
# from the top, the boxes of eight nodes at a time, and the leaves that are near enough are visited from this one
# outwards.
# CUDA's compiler, which is shown this file too, knows no such vectors, and never runs it.
@wp.func_native(
    f"""
    constexpr int SPARE = {_SPARE}, GROWTH = {_GROWTH};"""
    """
    const int members = wp::min(8, size - leaf * 8);
#ifdef __clang__
    typedef float Floats __attribute__((vector_size(32)));
    typedef int Ints __attribute__((vector_size(32)));
    typedef double Doubles __attribute__((vector_size(64)));
    typedef signed char Chars __attribute__((vector_size(8)));
    typedef unsigned long long Mask;  // a byte for each lane
    constexpr int MOST_LEAVES = 64, MOST_LEVELS = 12;
    const int wanted = wp::min(neighbors, size - 1);
    const float* const xs = (const float*)x.data;
    const float* const ys = (const float*)y.data;
    const float* const zs = (const float*)z.data;
    const float* const bounds = boxes.data;
    const long long pitch = boxes.shape[1];
    float* const rows = rows_of.data + (long long)part * rows_of.shape[1];
    const int room = rows_of.shape[1] / 8;
    const auto lanes = [](const float* const from) {
        Floats eight;
        memcpy(&eight, from, 32);
        return eight;
    };
    const auto bits_of = [](const Floats values) {
        Ints bits;
        memcpy(&bits, &values, 32);
        return bits;
    };
    const auto values_of = [](const Ints bits) {
        Floats values;
        memcpy(&values, &bits, 32);
        return values;
    };
    const auto floats = [](const Ints numbers) { return __builtin_convertvector(numbers, Floats); };
    const auto mask_of = [](const Ints lanes) {
        const Chars narrow = __builtin_convertvector(lanes, Chars);
        Mask mask;
        memcpy(&mask, &narrow, 8);
        return mask;
    };
    const Floats px = lanes(xs + leaf * 8), py = lanes(ys + leaf * 8), pz = lanes(zs + leaf * 8);

    // What a lane's distance to its last neighbour is at most; rows at or above it need not be in the list.
    Floats within;
    for (int m = 0; m < 8; ++m) within[m] = m < members && wanted > 0 ? INFINITY : 0.0f;
    int count = 0;
    const auto put = [&](const int other, const int k) {
        const Floats dx = px - xs[other * 8 + k], dy = py - ys[other * 8 + k], dz = pz - zs[other * 8 + k];
        const Floats squared = dx * dx + dy * dy + dz * dz;
        memcpy(rows + count * 8, &squared, 32);
        return squared;
    };

    // Brings each limit down to where `wanted` to `most` rows are below it; where several are equal, to these.
    const auto narrow = [&](const int most) {
        Ints found = {};
        Floats top = {};
        for (int k = 0; k < count; ++k) {
            const Floats squared = lanes(rows + k * 8);
            const Ints is_in = squared < within;
            found -= is_in;
            top = (is_in & (squared > top)) ? squared : top;
        }
        // The bits of positive floats are in the order of their values. Fewer than wanted are below `low`, more than
        // most below `high`: what is looked for lies between.
        Ints low = {}, high = bits_of(top) + 1, below_low = {}, below_high = found;
        within = found >= wanted ? values_of(high) : within;
        Ints is_open = found > most;
        // How many are below a limit grows as a power of it: a line in logarithms, of which bits are almost that.
        const Ints target = bits_of(Floats{} + 0.5f * (wanted + most + 1));
        for (int round = 0; mask_of(is_open) != 0; ++round) {
            const Ints width = high - low, half = low + (width >> 1);
            const Ints above = bits_of(floats(below_high)), across = above - bits_of(floats(below_low));
            const Floats share = below_low > 0 ? floats(width) / floats(across) : Floats{} + 1.5f;
            Ints limit = high - __builtin_convertvector(floats(is_open & (above - target)) * share, Ints);
            const Ints is_between = (limit > low) & (limit < high);
            limit = is_between ? limit : half;
            if (round > 40 || (round > 3 && round % 2 == 1)) limit = half;
            const Ints is_tie = width < 2;
            limit = is_tie ? low : limit;
            found = Ints{};
            for (int k = 0; k < count; ++k) found -= lanes(rows + k * 8) < values_of(limit);
            const Ints is_few = found < wanted, is_many = found > most;
            within = (is_open & (is_tie | ~(is_few | is_many))) ? values_of(limit) : within;
            is_open &= ~is_tie & (is_few | is_many);
            low = (is_open & is_few) ? limit : low;
            below_low = (is_open & is_few) ? found : below_low;
            high = (is_open & is_many) ? limit : high;
            below_high = (is_open & is_many) ? found : below_high;
        }
    };
    float farthest;
    int full;
    const auto look_through = [&]() {
        narrow(wanted + SPARE);
        int kept = 0;
        for (int k = 0; k < count; ++k) {
            const Floats squared = lanes(rows + k * 8);
            memcpy(rows + kept * 8, &squared, 32);
            kept += mask_of(squared < within) != 0;
        }
        count = kept;
        full = wp::min(count + wp::max(count / 2, GROWTH), room - 8);
        farthest = 0.0f;
        for (int m = 0; m < 8; ++m) farthest = within[m] > farthest ? within[m] : farthest;
    };

    // The points next in the order.
    const int window = wp::max(3, 3 * neighbors / 16 + 1);
    const int begin = wp::max(leaf - window, 0), end = wp::min(leaf + window + 1, (size + 7) / 8);
    for (int other = begin; other < end; ++other) {
        for (int k = 0; k < 8; ++k) {
            put(other, k);
            if (other == leaf) rows[count * 8 + k] = INFINITY;  // a point is not its own neighbour
            ++count;
        }
    }
    look_through();

    // Other leaves.
    const auto gap = [](const Floats below, const Floats above) {
        const Floats off = below > above ? below : above;
        return off > 0.0f ? off : Floats{};
    };
    const auto visit = [&](const int other) {
        const auto& l = low_in.data[leaves + other];
        const auto& h = high_in.data[leaves + other];
        const Floats gx = gap(l[0] - px, px - h[0]), gy = gap(l[1] - py, py - h[1]), gz = gap(l[2] - pz, pz - h[2]);
        if (mask_of(gx * gx + gy * gy + gz * gz < within) == 0) return;
        for (int k = 0; k < 8; ++k) count += mask_of(put(other, k) < within) != 0;
        if (count > full) look_through();
    };
    int near_leaves[MOST_LEAVES], near_count = 0;
    const auto visit_near = [&]() {
        int above = 0;
        while (above < near_count && near_leaves[above] < leaf) ++above;
        for (int below = above - 1; below >= 0 || above < near_count;) {
            if (below >= 0) visit(near_leaves[below--]);
            if (above < near_count) visit(near_leaves[above++]);
        }
        near_count = 0;
    };
    const auto own_low = low_in.data[leaves + leaf], own_high = high_in.data[leaves + leaf];
    const auto near_of = [&](const int first) {
        Floats squared = {};
        for (int axis = 0; axis < 3; ++axis) {
            const Floats low = lanes(bounds + axis * pitch + first), high = lanes(bounds + (axis + 3) * pitch + first);
            const Floats off = gap(low - own_high[axis], own_low[axis] - high);
            squared += off * off;
        }
        return mask_of(squared < farthest);
    };
    int top = leaves;
    while (top > 4) top >>= 3;
    if (begin > 0 || end * 8 < size) {
        for (int root = top; root < 2 * top; ++root) {
            int first[MOST_LEVELS];
            Mask left[MOST_LEVELS];
            first[0] = 8 * root;
            left[0] = near_of(first[0]);
            for (int depth = 0; depth >= 0;) {
                if (left[depth] == 0) {
                    --depth;
                    continue;
                }
                const int lane = __builtin_ctzll(left[depth]) / 8;
                left[depth] &= ~((Mask)255 << (8 * lane));
                const int node = first[depth] + lane;
                if (node < leaves) {
                    ++depth;
                    first[depth] = 8 * node;
                    left[depth] = near_of(first[depth]);
                } else if (node - leaves < begin || node - leaves >= end) {
                    near_leaves[near_count++] = node - leaves;
                    if (near_count == MOST_LEAVES) visit_near();
                }
            }
        }
        visit_near();
    }

    // Sums in double precision of so few numbers of single precision are exact, whatever their order.
    narrow(wanted);
    Doubles total = {};
    Ints summed = {};
    for (int k = 0; k < count; ++k) {
        const Floats squared = lanes(rows + k * 8);
        const Ints is_in = squared < within;
        total += __builtin_convertvector(__builtin_elementwise_sqrt(is_in ? squared : Floats{}), Doubles);
        summed -= is_in;
    }
    for (int m = 0; m < members; ++m) {
        // Neighbours that are not below a limit are at it; or so far that no float32 holds their square.
        const double rest = within[m] < INFINITY ? (double)wp::sqrt(within[m]) : 3.0e38;
        mean.data[leaf * 8 + m] = (float)((total[m] + (wanted - summed[m]) * rest) / wp::max(wanted, 1));
    }
#endif
    return members;
"""
)
def _mean_distances_of(
    part: int,
    leaf: int,
    size: int,
    x: wp.array(dtype=Eight),
    y: wp.array(dtype=Eight),
    z: wp.array(dtype=Eight),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    boxes: wp.array2d(dtype=wp.float32),
    leaves: int,
    neighbors: int,
    rows_of: wp.array2d(dtype=wp.float32),
    mean: wp.array(dtype=wp.float32),
) -> int:
    """The mean distances of a leaf's points to their nearest neighbours."""


@wp.kernel
def mean_distances_in_parts(
    part: int,
    parts: int,
    # in
    size_in: wp.array(dtype=wp.int32),
    x_in: wp.array(dtype=Eight),
    y_in: wp.array(dtype=Eight),
    z_in: wp.array(dtype=Eight),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    boxes: wp.array2d(dtype=wp.float32),
    leaves: int,
    neighbors: int,
    # in out: of each part squared distances, eight a row
    rows: wp.array2d(dtype=wp.float32),
    # out
    mean_out: wp.array(dtype=wp.float32),
):
    """Every so many runs of leaves, so that crowded places are shared out; a part's rows stay in its cache."""
    size = size_in[0]
    used = (size + LEAF - 1) // LEAF
    for run in range(part, (used + _RUN - 1) // _RUN, parts):
        for leaf in range(run * _RUN, wp.min((run + 1) * _RUN, used)):
            _mean_distances_of(
                part, leaf, size, x_in, y_in, z_in, low_in, high_in, boxes, leaves, neighbors, rows, mean_out
            )
