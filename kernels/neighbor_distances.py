"""How far each point's nearest neighbours are, on average; on a tree of boxes.

The points of a leaf look for their neighbours together. Each keeps a list of squared distances, cut to the least when
it is full. Distances are summed in a fixed order, so that the same cloud gives the same answer each time, whatever the
threads do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE
from .point_tree import LEAF, PointTree, next_node
from .threads import launch_parts, thread_count

__all__ = ["Eight", "NeighborDistances", "lay_out", "parts_for"]

# How far a point is must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(32)  # leaves that one part looks at before it leaves as many to the others
_SLOTS = wp.constant(32)  # numbers from one part to the next, in different lines of the cache
_MOST_NEIGHBORS = 1024
_LEAST_OF_PART = 512  # points for which a thread of their own is worth its while
_WINDOW = wp.constant(3)  # leaves on either side of one that tell how far neighbours may be
_LARGEST = wp.constant(3.0e38)
_FARTHEST = wp.constant(wp.float64(3.0e38))

Eight = wp.types.vector(length=int(LEAF), dtype=wp.float32)
"""One coordinate of the points of a leaf."""


def parts_for(points: int, most: int) -> int:
    """In how many parts a CPU looks at points: few are not worth a second thread."""
    return max(1, min(most, points // _LEAST_OF_PART))


@wp.kernel
def lay_out(
    # in
    points_in: wp.array(dtype=wp.vec3),
    size_in: wp.array(dtype=wp.int32),
    # out
    x_out: wp.array(dtype=Eight),
    y_out: wp.array(dtype=Eight),
    z_out: wp.array(dtype=Eight),
):
    """Coordinates of a leaf side by side, for vector instructions; where it has no point, infinitely far."""
    leaf = wp.tid()
    x = Eight(wp.inf)
    y = Eight(wp.inf)
    z = Eight(wp.inf)
    for k in range(LEAF):
        i = leaf * LEAF + k
        if i < size_in[0]:
            p = points_in[i]
            x[k] = p[0]
            y[k] = p[1]
            z[k] = p[2]
    x_out[leaf] = x
    y_out[leaf] = y
    z_out[leaf] = z


@wp.struct
class _Lists:
    """Where the lists of the points of a leaf lie."""

    room: int  # numbers that each list can hold
    pitch: int  # from the list of a point to that of the next
    step: int  # from a number to the next


# The next two in C++, where a compiler makes vector instructions of the loops: twice as fast as the same in Python.
@wp.func_native("""
    float square[8];
    for (int k = 0; k < 8; ++k) {
        const float dx = x[k] - p[0], dy = y[k] - p[1], dz = z[k] - p[2];
        square[k] = dx * dx + dy * dy + dz * dz;
    }
    float* to = nearest.data + first + count * step;
    for (int k = 0; k < 8; ++k) {
        const int is_near = square[k] < reach;
        *to = square[k];
        to += is_near ? step : 0;
        count += is_near;
    }
    return count;
""")
def _append(
    p: wp.vec3,
    x: Eight,
    y: Eight,
    z: Eight,
    reach: float,
    nearest: wp.array(dtype=wp.float32),
    first: int,
    step: int,
    count: int,
) -> int:
    """Notes which squared distances to eight points are within reach; gives how many the list has then."""


@wp.func_native("""
    // Who of the leaf is near enough to the other's box.
    const float* reach = within.data + slot;
    int is_near[8];
    for (int m = 0; m < 8; ++m) {
        float gap = 0.0f;
        const float from[3] = {own_x[m], own_y[m], own_z[m]};
        for (int axis = 0; axis < 3; ++axis) {
            const float below = low[axis] - from[axis], above = from[axis] - high[axis];
            float off = below > above ? below : above;
            off = off > 0.0f ? off : 0.0f;
            gap += off * off;
        }
        is_near[m] = gap < reach[m];
    }
    int longest = 0;
    for (int m = 0; m < members; ++m) {
        if (!is_near[m])
            continue;
        float square[8];
        for (int k = 0; k < 8; ++k) {
            const float dx = x[k] - own_x[m], dy = y[k] - own_y[m], dz = z[k] - own_z[m];
            square[k] = dx * dx + dy * dy + dz * dz;
        }
        if (is_own)
            square[m] = INFINITY;
        int count = filled.data[slot + m];
        const float most = reach[m];
        float* to = nearest.data + first + m * pitch + count * step;
        for (int k = 0; k < 8; ++k) {
            const int stays = square[k] < most;
            *to = square[k];
            to += stays ? step : 0;
            count += stays;
        }
        filled.data[slot + m] = count;
        longest = count > longest ? count : longest;
    }
    return longest;
""")
def _visit(
    members: int,
    own_x: Eight,
    own_y: Eight,
    own_z: Eight,
    is_own: bool,
    low: wp.vec3,
    high: wp.vec3,
    x: Eight,
    y: Eight,
    z: Eight,
    nearest: wp.array(dtype=wp.float32),
    first: int,
    pitch: int,
    step: int,
    slot: int,
    within: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
) -> int:
    """Notes the squared distances of a leaf's points to those of another; gives the length of the longest list."""


@wp.func_native("""
    float gap = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
        const float below = low[axis] - other_high[axis], above = other_low[axis] - high[axis];
        float off = below > above ? below : above;
        off = off > 0.0f ? off : 0.0f;
        gap += off * off;
    }
    return gap;
""")
def _gap_squared_between(low: wp.vec3, high: wp.vec3, other_low: wp.vec3, other_high: wp.vec3) -> float:
    """The squared distance between two boxes."""


@wp.func_native("""
    float* const values = nearest.data + first;
    const auto below = [&](const float limit) {
        int found = 0;
        if (step == 1)
            for (int k = 0; k < count; ++k) found += values[k] < limit;
        else
            for (int k = 0; k < count; ++k) found += values[k * step] < limit;
        return found;
    };
    const auto bits_of = [](const float value) { union { float f; int i; } both; both.f = value; return both.i; };
    const auto value_of = [](const int bits) { union { float f; int i; } both; both.i = bits; return both.f; };
    // The bits of positive floats are in the order of their values.
    int most_bits = 0;
    for (int k = 0; k < count; ++k) {
        const int bits = bits_of(values[k * step]);
        most_bits = bits > most_bits ? bits : most_bits;
    }
    // Fewer than wanted are below `low`, more than most below `high`: what is looked for lies between.
    float low = 0.0f, high = value_of(most_bits + 1);
    int below_low = 0, below_high = count, limit_found = count;
    float limit = high;
    for (int round = 0; limit_found < wanted || limit_found > most; ++round) {
        const int low_bits = bits_of(low), high_bits = bits_of(high);
        if (high_bits - low_bits < 2)
            break;
        limit = low + (high - low) * (0.5f * (wanted + most + 1) - below_low) / (below_high - below_low);
        if (round > 3 || !(limit > low && limit < high))
            limit = value_of(low_bits + (high_bits - low_bits) / 2);
        limit_found = below(limit);
        if (limit_found < wanted) {
            low = limit;
            below_low = limit_found;
        } else if (limit_found > most) {
            high = limit;
            below_high = limit_found;
        }
    }
    // Equal numbers, all of which are `low`, may be what is between.
    int spare = 0;
    if (limit_found < wanted || limit_found > most) {
        limit = low;
        spare = wanted - below(limit);
    }
    int kept = 0;
    const auto keep = [&](const int stride) {
        for (int k = 0; k < count; ++k) {
            const float value = values[k * stride];
            values[kept * stride] = value;
            kept += value < limit;
        }
    };
    if (step == 1)
        keep(1);
    else
        keep(step);
    for (; spare > 0; --spare)
        values[kept++ * step] = limit;
    filled.data[slot] = kept;
    return limit;
""")
def _keep_least(
    nearest: wp.array(dtype=wp.float32),
    first: int,
    step: int,
    count: int,
    wanted: int,
    most: int,
    filled: wp.array(dtype=wp.int32),
    slot: int,
) -> float:
    """Cuts a list of `count` numbers, 0 or more, to its least, `wanted` of them or up to `most`.

    Gives a number that none that is left exceeds, and at which there is no need for another.
    """


@wp.func
def _mean_distances_of(
    leaf: int,
    size: int,
    points: wp.array(dtype=wp.vec3),
    x: wp.array(dtype=Eight),
    y: wp.array(dtype=Eight),
    z: wp.array(dtype=Eight),
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    leaves: int,
    neighbors: int,
    lists: _Lists,
    first: int,
    slot: int,
    nearest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    within: wp.array(dtype=wp.float32),
    mean: wp.array(dtype=wp.float32),
):
    """The mean distances of a leaf's points to their nearest neighbours: all together, from the leaf on upwards."""
    begin = leaf * LEAF
    members = wp.min(LEAF, size - begin)
    wanted = wp.min(neighbors, size - 1)
    own_low = low[leaves + leaf]
    own_high = high[leaves + leaf]
    # How far the neighbours of the leaf's centre are, at most: by the points next in the order.
    centre = 0.5 * own_low + 0.5 * own_high
    found = int(0)
    for other in range(wp.max(leaf - _WINDOW, 0), wp.min(leaf + _WINDOW, leaves - 1) + 1):
        found = _append(centre, x[other], y[other], z[other], _LARGEST, nearest, first, lists.step, found)
    reach = float(wp.inf)
    if found > wanted:
        reach = wp.sqrt(_keep_least(nearest, first, lists.step, found, wanted + 1, wanted + 1, filled, slot))
    limit = float(0.0)
    for member in range(members):
        filled[slot + member] = 0
        way = reach + wp.length(points[begin + member] - centre)
        within[slot + member] = way * way * 1.00001 + 1.0e-37
        limit = wp.max(limit, within[slot + member])
    node = leaves + leaf
    root = int(node)
    while node > 0 and wanted > 0:
        at = int(root)
        while at > 0:
            low_at = low[at]
            high_at = high[at]
            if _gap_squared_between(own_low, own_high, low_at, high_at) >= limit:
                at = next_node(at, root)
            elif at < leaves:
                at = 2 * at
            else:
                other = at - leaves
                longest = _visit(
                    members, x[leaf], y[leaf], z[leaf], other == leaf, low_at, high_at, x[other], y[other], z[other],
                    nearest, first, lists.pitch, lists.step, slot, within, filled,
                )  # fmt: skip
                if longest > lists.room - LEAF:
                    most = (wanted + lists.room - LEAF) // 2
                    limit = float(0.0)
                    for member in range(members):
                        q = first + member * lists.pitch
                        count = filled[slot + member]
                        if count > lists.room - LEAF:
                            within[slot + member] = _keep_least(
                                nearest, q, lists.step, count, wanted, most, filled, slot + member
                            )
                        limit = wp.max(limit, within[slot + member])
                at = next_node(at, root)
        if root != node:
            node = node >> 1
        root = node ^ 1
        if node == 1:
            node = 0
    for member in range(members):
        q = first + member * lists.pitch
        count = filled[slot + member]
        if count > wanted and wanted > 0:
            _keep_least(nearest, q, lists.step, count, wanted, wanted, filled, slot + member)
        total = wp.float64(0.0)
        for k in range(wanted):
            if k < count:
                total += wp.sqrt(wp.float64(nearest[q + k * lists.step]))
            else:
                total += _FARTHEST  # whose square no float32 holds
        mean[begin + member] = float(total / wp.float64(wp.max(wanted, 1)))


@wp.kernel
def _mean_distances(
    # in
    points_in: wp.array(dtype=wp.vec3),
    x_in: wp.array(dtype=Eight),
    y_in: wp.array(dtype=Eight),
    z_in: wp.array(dtype=Eight),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    neighbors: int,
    lists: _Lists,
    # in out: of each point its list, how many it has, and within what they are
    nearest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    within: wp.array(dtype=wp.float32),
    # out
    mean_out: wp.array(dtype=wp.float32),
):
    """One leaf a thread; the lists of many threads lie side by side."""
    leaf = wp.tid()
    size = size_in[0]
    first = leaf * LEAF
    if first < size:
        _mean_distances_of(
            leaf, size, points_in, x_in, y_in, z_in, low_in, high_in, leaves, neighbors,
            lists, first, first, nearest, filled, within, mean_out,
        )  # fmt: skip


@wp.kernel
def _mean_distances_in_parts(
    part: int,
    parts: int,
    # in
    points_in: wp.array(dtype=wp.vec3),
    x_in: wp.array(dtype=Eight),
    y_in: wp.array(dtype=Eight),
    z_in: wp.array(dtype=Eight),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    neighbors: int,
    lists: _Lists,
    # in out: of each point of a leaf its list, how many it has, and within what they are
    nearest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    within: wp.array(dtype=wp.float32),
    # out
    mean_out: wp.array(dtype=wp.float32),
):
    """Every so many runs of leaves, so that crowded places are shared out; a part's lists stay in its cache."""
    size = size_in[0]
    first = part * lists.room * LEAF
    slot = part * _SLOTS
    used = (size + LEAF - 1) // LEAF
    for run in range(part, (used + _RUN - 1) // _RUN, parts):
        for leaf in range(run * _RUN, wp.min((run + 1) * _RUN, used)):
            _mean_distances_of(
                leaf, size, points_in, x_in, y_in, z_in, low_in, high_in, leaves, neighbors,
                lists, first, slot, nearest, filled, within, mean_out,
            )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class NeighborDistances:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    neighbors: int
    """Nearest others of a point whose distances are averaged; of a cloud of fewer points, all the others."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    tree: PointTree = field(init=False, repr=False, compare=False)
    """Out: the finite points in the order in which `mean` is."""
    mean: wp.array = field(init=False, repr=False, compare=False)
    """Out: the mean distance [m] of each point of `tree` to its nearest others, shape (capacity,), float32."""

    def __post_init__(self):
        if not 1 <= self.neighbors <= _MOST_NEIGHBORS:
            raise ValueError(f"neighbors must be 1 to {_MOST_NEIGHBORS}, not {self.neighbors}")
        tree = PointTree(capacity=self.capacity, device=self.device)
        device = tree.points.device

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("tree", tree)
        lists = _Lists()
        lists.room = max(2 * self.neighbors + 4 * int(LEAF), (2 * int(_WINDOW) + 2) * int(LEAF))
        if device.is_cpu:
            keep("_parts", thread_count())
            lists.pitch, lists.step = lists.room, 1
            held, slots = self._parts * int(LEAF), self._parts * int(_SLOTS)
        else:
            held = slots = tree.leaves * int(LEAF)
            lists.pitch, lists.step = 1, held
        if lists.room * held > 2**31 - 1:
            raise ValueError(f"neighbors {self.neighbors} of capacity {self.capacity} points are too many for one plan")
        keep("_lists", lists)
        keep("_nearest", wp.zeros(lists.room * held, dtype=wp.float32, device=device))
        keep("_filled", wp.zeros(slots, dtype=wp.int32, device=device))
        keep("_within", wp.zeros(slots, dtype=wp.float32, device=device))
        keep("_eights", [wp.zeros(tree.leaves, dtype=Eight, device=device) for _ in range(3)])
        keep("mean", wp.zeros(self.capacity, dtype=wp.float32, device=device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `tree` and `mean` from the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        tree = self.tree
        tree.build(xyz, count)
        wp.launch(lay_out, tree.leaves, inputs=[tree.points, tree.size], outputs=self._eights, device=self.mean.device)
        inputs = [tree.points, *self._eights, tree.size, tree.low, tree.high, tree.leaves, self.neighbors, self._lists]
        outputs = [self._nearest, self._filled, self._within, self.mean]
        if self.mean.device.is_cpu:
            launch_parts(_mean_distances_in_parts, parts_for(xyz.shape[0], self._parts), inputs, outputs)
        else:
            wp.launch(_mean_distances, tree.leaves, inputs=inputs, outputs=outputs, device=self.mean.device)
