"""How far each point's nearest neighbours are, on average; on a tree of boxes.

The points of a leaf look for their neighbours together. Each keeps a list of squared distances, cut to the least when
it is full. `neighbor_parts.py` does the same for a CPU, where the leaf has one list. The same cloud gives the same
answer each time, whatever the threads do.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE
from .leaf_lanes import Eight, lay_out, lay_out_boxes, parts_for
from .neighbor_parts import mean_distances_in_parts, rows_for
from .point_tree import LEAF, PointTree, next_node
from .threads import launch_parts, thread_count

__all__ = ["NeighborDistances"]

# How far a point is must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_MOST_NEIGHBORS = 1024
_WINDOW = wp.constant(3)  # leaves on either side of one that tell how far neighbours may be
_LARGEST = wp.constant(3.0e38)
_FARTHEST = wp.constant(wp.float64(3.0e38))


@wp.struct
class _Lists:
    """Where the lists of the points of a leaf lie."""

    room: int  # numbers that each list can hold
    step: int  # from a number to the next; those of other points lie between


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
        float* to = nearest.data + first + m + count * step;
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
    for (int k = 0; k < count; ++k) {
        const float value = values[k * step];
        values[kept * step] = value;
        kept += value < limit;
    }
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
    """The mean distances of a leaf's points to their nearest neighbours: all together, from the leaf on upwards."""
    leaf = wp.tid()
    size = size_in[0]
    begin = leaf * LEAF
    if begin >= size:
        return
    members = wp.min(LEAF, size - begin)
    wanted = wp.min(neighbors, size - 1)
    own_low = low_in[leaves + leaf]
    own_high = high_in[leaves + leaf]
    # How far the neighbours of the leaf's centre are, at most: by the points next in the order.
    centre = 0.5 * own_low + 0.5 * own_high
    found = int(0)
    for other in range(wp.max(leaf - _WINDOW, 0), wp.min(leaf + _WINDOW, leaves - 1) + 1):
        found = _append(centre, x_in[other], y_in[other], z_in[other], _LARGEST, nearest, begin, lists.step, found)
    reach = float(wp.inf)
    if found > wanted:
        reach = wp.sqrt(_keep_least(nearest, begin, lists.step, found, wanted + 1, wanted + 1, filled, begin))
    limit = float(0.0)
    for member in range(members):
        filled[begin + member] = 0
        way = reach + wp.length(points_in[begin + member] - centre)
        within[begin + member] = way * way * 1.00001 + 1.0e-37
        limit = wp.max(limit, within[begin + member])
    node = leaves + leaf
    root = int(node)
    while node > 0 and wanted > 0:
        at = int(root)
        while at > 0:
            low_at = low_in[at]
            high_at = high_in[at]
            if _gap_squared_between(own_low, own_high, low_at, high_at) >= limit:
                at = next_node(at, root)
            elif at < leaves:
                at = 2 * at
            else:
                other = at - leaves
                longest = _visit(
                    members, x_in[leaf], y_in[leaf], z_in[leaf], other == leaf, low_at, high_at,
                    x_in[other], y_in[other], z_in[other], nearest, begin, lists.step, begin, within, filled,
                )  # fmt: skip
                if longest > lists.room - LEAF:
                    most = (wanted + lists.room - LEAF) // 2
                    limit = float(0.0)
                    for member in range(members):
                        q = begin + member
                        count = filled[begin + member]
                        if count > lists.room - LEAF:
                            within[begin + member] = _keep_least(
                                nearest, q, lists.step, count, wanted, most, filled, begin + member
                            )
                        limit = wp.max(limit, within[begin + member])
                at = next_node(at, root)
        if root != node:
            node = node >> 1
        root = node ^ 1
        if node == 1:
            node = 0
    for member in range(members):
        q = begin + member
        count = filled[begin + member]
        if count > wanted and wanted > 0:
            _keep_least(nearest, q, lists.step, count, wanted, wanted, filled, begin + member)
        total = wp.float64(0.0)
        for k in range(wanted):
            if k < count:
                total += wp.float64(wp.sqrt(nearest[q + k * lists.step]))
            else:
                total += _FARTHEST  # whose square no float32 holds
        mean_out[begin + member] = float(total / wp.float64(wp.max(wanted, 1)))


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
        held = tree.leaves * int(LEAF)
        lists = _Lists()
        lists.room = max(2 * self.neighbors + 4 * int(LEAF), (2 * int(_WINDOW) + 2) * int(LEAF))
        lists.step = held
        keep("_lists", lists)
        keep("_eights", [wp.zeros(tree.leaves, dtype=Eight, device=device) for _ in range(3)])
        if device.is_cpu:
            keep("_parts", thread_count())
            keep("_boxes", wp.zeros((6, 2 * tree.leaves), dtype=wp.float32, device=device))
            keep("_rows", wp.zeros((self._parts, 8 * rows_for(self.neighbors)), dtype=wp.float32, device=device))
        else:
            if lists.room * held > 2**31 - 1:
                raise ValueError(
                    f"neighbors {self.neighbors} of capacity {self.capacity} points are too many for one plan"
                )
            keep("_nearest", wp.zeros(lists.room * held, dtype=wp.float32, device=device))
            keep("_filled", wp.zeros(held, dtype=wp.int32, device=device))
            keep("_within", wp.zeros(held, dtype=wp.float32, device=device))
        keep("mean", wp.zeros(self.capacity, dtype=wp.float32, device=device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `tree` and `mean` from the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        tree, device = self.tree, self.mean.device
        tree.build(xyz, count)
        wp.launch(lay_out, tree.leaves, inputs=[tree.points, tree.size], outputs=self._eights, device=device)
        boxes = [tree.low, tree.high]
        if device.is_cpu:
            wp.launch(lay_out_boxes, 2 * tree.leaves, inputs=boxes, outputs=[self._boxes], device=device)
            inputs = [tree.size, *self._eights, *boxes, self._boxes, tree.leaves, self.neighbors]
            outputs = [self._rows, self.mean]
            launch_parts(mean_distances_in_parts, parts_for(xyz.shape[0], self._parts), inputs, outputs)
        else:
            inputs = [tree.points, *self._eights, tree.size, *boxes, tree.leaves, self.neighbors, self._lists]
            outputs = [self._nearest, self._filled, self._within, self.mean]
            wp.launch(_mean_distances, tree.leaves, inputs=inputs, outputs=outputs, device=device)
