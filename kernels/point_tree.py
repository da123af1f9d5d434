"""A tree of boxes over the points of a cloud, for questions about neighbours: of any scale, and fixed in size.

Points are sorted along a curve of Morton (Z order), so that neighbours in the order are neighbours in space; eight in
a row are a leaf, and every node of a complete binary tree holds the box of its two children (Lauterbach et al., "Fast
BVH construction on GPUs", 2009, with a tree that is implied by the order). Node 1 is the root, nodes 2 i and 2 i + 1
are the children of i. How well the curve keeps neighbours together is a matter of speed alone: boxes are exact.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .point_lanes import LOAD_POINTS

__all__ = ["LEAF", "PointTree", "gap_squared", "next_node"]

# Which points share a leaf must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

LEAF = wp.constant(8)
"""Points of a leaf."""

_CHUNK = wp.constant(256)
_AXIS_BITS = 16
_SAMPLE = 64  # points whose spread tells how wide the curve is
_HIGHEST = 2**31 - 1


@wp.func
def _is_finite(p: wp.vec3) -> bool:
    return (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]) == 0.0


@wp.func
def _ordered(value: float) -> int:
    """The bits of a float as an integer in the same order."""
    bits = wp.cast(value, wp.int32)
    return bits ^ ((bits >> 31) & 0x7FFFFFFF)


@wp.func
def _value(ordered: int) -> float:
    return wp.cast(ordered ^ ((ordered >> 31) & 0x7FFFFFFF), wp.float32)


@wp.kernel
def _reset(
    # out
    bounds_out: wp.array(dtype=wp.int32),
    size_out: wp.array(dtype=wp.int32),
):
    """Empty bounds: lowest and, negated, highest corner."""
    for axis in range(6):
        bounds_out[axis] = _HIGHEST
    size_out[0] = 0


@wp.kernel
def _bound_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    # in out
    bounds: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
):
    """A run of points a thread: their bounds, and how many are finite."""
    begin = wp.tid() * _CHUNK
    infinite = float(wp.inf)
    low = wp.vec3(infinite)
    high = wp.vec3(-infinite)
    found = int(0)
    for i in range(begin, wp.min(begin + _CHUNK, wp.min(count_in[0], xyz_in.shape[0]))):
        p = xyz_in[i]
        if _is_finite(p):
            low = wp.min(low, p)
            high = wp.max(high, p)
            found += 1
    if found > 0:
        for axis in range(3):
            wp.atomic_min(bounds, axis, _ordered(low[axis]))
            wp.atomic_min(bounds, axis + 3, -_ordered(high[axis]))
        wp.atomic_add(size, 0, found)


@wp.func_native(
    f"""
    constexpr int SAMPLE = {_SAMPLE};"""
    """
    float sample[SAMPLE];
    int size = 0;
    const char* const rows = (const char*)xyz.data;
    for (int k = 0; k < SAMPLE; ++k) {
        const float* const row = (const float*)(rows + (long long)k * n / SAMPLE * xyz.strides[0]);
        if ((row[0] - row[0]) + (row[1] - row[1]) + (row[2] - row[2]) != 0.0f) continue;
        int place = size++;
        for (; place > 0 && sample[place - 1] > row[axis]; --place) sample[place] = sample[place - 1];
        sample[place] = row[axis];
    }
    if (size == 0) return wp::vec2(low, high);
    const float first = sample[size / 8], last = sample[size - 1 - size / 8], room = 4.0f * (last - first);
    if (room == 0.0f) return wp::vec2(low, high);
    return wp::vec2(wp::max(low, first - room), wp::min(high, last + room));
"""
)
def _width_along(xyz: wp.array(dtype=wp.vec3), n: int, axis: int, low: float, high: float) -> wp.vec2:
    """From where to where most of the points are, and some more; of all that they reach at most."""
    return wp.vec2(low, high)


@wp.kernel
def _find_width(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.int32),
    # out: lowest corner, highest corner
    width_out: wp.array(dtype=wp.float32),
):
    """How wide the curve is, an axis a thread: a few points far away do not make its cells too large for the rest."""
    axis = wp.tid()
    n = wp.min(count_in[0], xyz_in.shape[0])
    low = _value(bounds[axis])
    high = _value(-bounds[axis + 3])
    if n > 0:
        width = _width_along(xyz_in, n, axis, low, high)
        low = width[0]
        high = width[1]
    width_out[axis] = low
    width_out[axis + 3] = high


# A block of points at a time, without a branch, which a compiler makes vector instructions of.
@wp.func_native(
    f"""
    constexpr int AXIS_BITS = {_AXIS_BITS}, CHUNK = {_CHUNK};
    #ifdef __CUDA_ARCH__
    constexpr int BLOCK = 1;
    #else
    constexpr int BLOCK = CHUNK;
    #endif"""
    + LOAD_POINTS
    + """
    const float* const low = width.data;
    // Halved, so that the extent of any finite points is finite.
    float extent = 0.0f;
    for (int axis = 0; axis < 3; ++axis) {
        const float along = 0.5f * low[axis + 3] - 0.5f * low[axis];
        extent = along > extent ? along : extent;
    }
    const float whole = extent > 0.0f ? extent : 1.0f, last_cell = (1 << AXIS_BITS) - 1;
    float along[3][BLOCK];
    const long long step = xyz.strides[0] / 4;
    const int length = end - begin, used = wp::max(wp::min(n, end) - begin, 0);
    load_points((const float*)xyz.data + step * begin, step, used, along);
    long long* const keys = key.data + begin;
    int* const order = index.data + begin;
    for (int k = 0; k < length; ++k) order[k] = begin + k;
    for (int k = 0; k < used; ++k) {
        const float x = along[0][k], y = along[1][k], z = along[2][k];
        const bool is_finite = (x - x) + (y - y) + (z - z) == 0.0f;
        unsigned long long place = 0;
        for (int axis = 0; axis < 3; ++axis) {
            float share = (0.5f * (is_finite ? along[axis][k] : 0.0f) - 0.5f * low[axis]) / whole;
            share = share > 0.0f ? share : 0.0f;
            share = share < 1.0f ? share : 1.0f;
            // Sixteen bits, two zeros between each.
            unsigned long long spread = (unsigned)(int)(share * last_cell);
            spread = (spread | spread << 16) & 0x0000FF0000FFull;
            spread = (spread | spread << 8) & 0x00F00F00F00Full;
            spread = (spread | spread << 4) & 0x0C30C30C30C3ull;
            spread = (spread | spread << 2) & 0x249249249249ull;
            place |= spread << (2 - axis);
        }
        keys[k] = is_finite ? place : 1ull << (3 * AXIS_BITS);
    }
    for (int k = used; k < length; ++k) keys[k] = 1ll << (3 * AXIS_BITS);
    return length;
"""
)
def _key_block(
    begin: int,
    end: int,
    xyz: wp.array(dtype=wp.vec3),
    n: int,
    width: wp.array(dtype=wp.float32),
    key: wp.array(dtype=wp.int64),
    index: wp.array(dtype=wp.int32),
) -> int:
    """The places of the points begin … end − 1 along the curve; behind all if there is no finite one."""
    return 0


@wp.kernel
def _key_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    width: wp.array(dtype=wp.float32),
    capacity: int,
    block: int,
    # out
    key_out: wp.array(dtype=wp.int64),
    index_out: wp.array(dtype=wp.int32),
):
    """The place of each point along the curve, for the whole capacity, so that the sort finds no leftovers."""
    begin = wp.tid() * block
    n = wp.max(wp.min(count_in[0], xyz_in.shape[0]), 0)
    _key_block(begin, wp.min(begin + block, capacity), xyz_in, n, width, key_out, index_out)


@wp.kernel
def _bound_leaves(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    index_in: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    leaves: int,
    # out
    points_out: wp.array(dtype=wp.vec3),
    low_out: wp.array(dtype=wp.vec3),
    high_out: wp.array(dtype=wp.vec3),
):
    """Copies the points in their order, and bounds each leaf; an empty one is nowhere near anything."""
    leaf = wp.tid()
    infinite = float(wp.inf)
    low = wp.vec3(infinite)
    high = wp.vec3(-infinite)
    for i in range(leaf * LEAF, wp.min((leaf + 1) * LEAF, size[0])):
        p = xyz_in[index_in[i]]
        points_out[i] = p
        low = wp.min(low, p)
        high = wp.max(high, p)
    low_out[leaves + leaf] = low
    high_out[leaves + leaf] = high


@wp.kernel
def _bound_nodes(
    first: int,
    # in out
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
):
    """Bounds a level of nodes by their children."""
    node = first + wp.tid()
    low[node] = wp.min(low[2 * node], low[2 * node + 1])
    high[node] = wp.max(high[2 * node], high[2 * node + 1])


@wp.kernel
def _bound_all_nodes(
    leaves: int,
    # in out
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
):
    """All levels by one thread, children before their parents."""
    for k in range(1, leaves):
        node = leaves - k
        low[node] = wp.min(low[2 * node], low[2 * node + 1])
        high[node] = wp.max(high[2 * node], high[2 * node + 1])


@wp.func
def gap_squared(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """The squared distance of a point to a box; never more than float32 says of any point in it."""
    gap = wp.max(wp.max(low - p, p - high), wp.vec3(0.0))
    return gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2]


@wp.func
def next_node(node: int, root: int) -> int:
    """The node after `node` and all below it, in the order of the leaves within the subtree of `root`; 0 at its end."""
    at = int(node)
    while at != root and (at & 1) == 1:
        at = at >> 1
    if at == root:
        return 0
    return at + 1


@dataclass(frozen=True, kw_only=True)
class PointTree:
    """A plan: the tree of a cloud of up to `capacity` points; `build` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one build can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    leaves: int = field(init=False, repr=False, compare=False)
    """How many leaves there are, a power of two; leaf i is node `leaves` + i."""
    points: wp.array = field(init=False, repr=False, compare=False)
    """The finite points in the order of the leaves [m], shape (capacity,), vec3."""
    index: wp.array = field(init=False, repr=False, compare=False)
    """Their places in the cloud, shape (capacity,), int32."""
    size: wp.array = field(init=False, repr=False, compare=False)
    """How many are finite, shape (1,), int32."""
    low: wp.array = field(init=False, repr=False, compare=False)
    """Lowest corner of each node [m], shape (2 leaves,), vec3."""
    high: wp.array = field(init=False, repr=False, compare=False)
    """Highest corner of each node [m], shape (2 leaves,), vec3; an empty node has its corners at infinity."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**30:
            raise ValueError(f"capacity must be 1 to 2³⁰ points, not {self.capacity}")
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, length: int, dtype: type) -> wp.array:
            keep(name, wp.zeros(length, dtype=dtype, device=device))
            return getattr(self, name)

        keep("leaves", 1 << (-(-self.capacity // LEAF) - 1).bit_length())
        buffer("_bounds", 6, wp.int32)
        buffer("_width", 6, wp.float32)
        buffer("_keys", 2 * self.capacity, wp.int64)  # a sort needs twice the room
        keep("index", buffer("_indices", 2 * self.capacity, wp.int32)[: self.capacity])
        buffer("size", 1, wp.int32)
        buffer("points", self.capacity, wp.vec3)
        buffer("low", 2 * self.leaves, wp.vec3)
        buffer("high", 2 * self.leaves, wp.vec3)

    def build(self, xyz: wp.array, count: wp.array) -> None:
        """Builds the tree of the first `count[0]` points, less those that are not finite.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")

        def run(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        run(_reset, 1, [], [self._bounds, self.size])
        run(_bound_points, -(-n // _CHUNK), [xyz, count], [self._bounds, self.size])
        run(_find_width, 3, [xyz, count, self._bounds], [self._width])
        block = int(_CHUNK) if self.size.device.is_cpu else 1
        given = [xyz, count, self._width, self.capacity, block]
        run(_key_points, -(-self.capacity // block), given, [self._keys, self._indices])
        # Less the lowest bit it takes a CPU a pass less.
        wp.utils.radix_sort_pairs(self._keys, self._indices, self.capacity, begin_bit=1, end_bit=3 * _AXIS_BITS + 1)
        run(
            _bound_leaves,
            self.leaves,
            [xyz, self.index, self.size, self.leaves],
            [self.points, self.low, self.high],
        )
        if self.size.device.is_cpu:
            run(_bound_all_nodes, 1, [self.leaves], [self.low, self.high])
            return
        first = self.leaves // 2
        while first:
            run(_bound_nodes, first, [first], [self.low, self.high])
            first //= 2
