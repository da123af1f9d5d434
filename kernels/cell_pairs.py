"""Cells of a cloud and whether they touch: the ground that both ways of clustering stand on.

A cell's side is radius / √3, so that any two of its points are within the radius; all that is left to find out is
which cells, at most two apart along each axis, have a pair of points within it.

A radius that grows with the range is cut into levels, eight to an octave, each with cells of its own as large as its
least radius allows. Within a level two cells that touch are still at most two apart, as radii in it differ by no more
than an eighth; `join_levels` sees to the pairs of cells of different levels. A cell's level is carried in its x.
"""

from __future__ import annotations

import math

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)
from .unchecked import at

__all__ = [
    "TOUCH",
    "Radius",
    "cell_of",
    "differ",
    "find",
    "hash_cell",
    "is_finite",
    "is_near",
    "join_levels",
    "radius_of",
    "touch",
    "unite",
]

_LARGEST_CELL = wp.constant(wp.float64(2.0**30))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_SUB_LEVEL = wp.constant(wp.int64(49))  # bits of a float64 below its exponent and three bits of fraction: the level
_LEVEL_OF_ONE = wp.constant(wp.int64(1023 << 3))
_LEVEL_BITS = wp.constant(19)  # bits of x below its level
_HALF_LEVEL = wp.constant(1 << 18)


@wp.struct
class Radius:
    """What kernels need of a radius [m]; made by `radius_of`."""

    inverse_side: wp.float64  # of a cell
    surely: wp.float32  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not: wp.float32  # and above here they are not
    squared: wp.float64
    at_origin: wp.float64
    per_metre: wp.float64  # of range; 0 for one radius everywhere, whose cells have no levels


def radius_of(radius: float, per_metre: float = 0.0) -> Radius:
    """The numbers that kernels need of a radius [m] that grows with the range, by `per_metre` of 0 or 1e-5 … 1."""
    numbers = Radius()
    numbers.at_origin, numbers.per_metre = radius, per_metre
    # A hair shorter, so that no rounding makes the diagonal longer than the radius.
    numbers.inverse_side = math.sqrt(3.0) / (radius * (1.0 - 1e-6))
    numbers.squared = radius * radius
    numbers.surely, numbers.surely_not = numbers.squared * (1.0 - 1e-6), numbers.squared * (1.0 + 1e-6)
    return numbers


@wp.func
def _cell_along(coordinate: float, inverse_side: wp.float64) -> int:
    """The cell's index along an axis; where float32 has no neighbours within a cell any more, the number's own bits."""
    scaled = wp.float64(coordinate) * inverse_side
    cell = int(0)
    if wp.abs(scaled) < _LARGEST_CELL:
        cell = int(wp.floor(scaled))
    elif coordinate > 0.0:
        cell = wp.cast(coordinate, wp.int32)
    else:
        cell = -wp.cast(-coordinate, wp.int32)
    return cell


@wp.func
def _reach_at(point: wp.vec3, radius: Radius) -> wp.float64:
    """The radius at a point."""
    x = wp.float64(point[0])
    y = wp.float64(point[1])
    z = wp.float64(point[2])
    return radius.at_origin + radius.per_metre * wp.sqrt(x * x + y * y + z * z)


@wp.func
def _level_of(growth: wp.float64) -> int:
    """The level of a radius, given as a multiple, ≥ 1, of that at the origin."""
    return int((wp.cast(growth, wp.int64) >> _SUB_LEVEL) - _LEVEL_OF_ONE)


@wp.func
def _growth_of(level: int) -> wp.float64:
    """The least multiple of the radius at the origin that is of a level."""
    return wp.cast((wp.int64(level) + _LEVEL_OF_ONE) << _SUB_LEVEL, wp.float64)


@wp.func
def cell_of(point: wp.vec3, radius: Radius) -> wp.vec3i:
    """The cell of a finite point."""
    level = int(0)
    inverse_side = radius.inverse_side
    if radius.per_metre > wp.float64(0.0):
        level = _level_of(_reach_at(point, radius) / radius.at_origin)
        inverse_side = inverse_side / _growth_of(level)
    x = wp.float64(point[0]) * inverse_side
    y = wp.float64(point[1]) * inverse_side
    z = wp.float64(point[2]) * inverse_side
    a = int(wp.floor(x))
    b = int(wp.floor(y))
    c = int(wp.floor(z))
    if radius.per_metre > wp.float64(0.0):
        a += level << _LEVEL_BITS
    elif wp.max(wp.max(wp.abs(x), wp.abs(y)), wp.abs(z)) >= _LARGEST_CELL:
        a = _cell_along(point[0], inverse_side)
        b = _cell_along(point[1], inverse_side)
        c = _cell_along(point[2], inverse_side)
    return wp.vec3i(a, b, c)


@wp.func
def is_finite(point: wp.vec3) -> bool:
    """Whether no coordinate is a NaN or infinite."""
    return (point[0] - point[0]) + (point[1] - point[1]) + (point[2] - point[2]) == 0.0


@wp.func
def differ(a: wp.vec3i, b: wp.vec3i) -> bool:
    """Whether two cells are not the same."""
    return ((a[0] ^ b[0]) | (a[1] ^ b[1]) | (a[2] ^ b[2])) != 0  # one branch, where `or` makes three


@wp.func
def hash_cell(cell: wp.vec3i) -> int:
    """Blocks of 4 × 4 × 2 cells are spread over the table; within one, neighbours in space share cache lines."""
    block = (
        wp.uint32(cell[0] >> 2) * wp.uint32(73856093)
        ^ wp.uint32(cell[1] >> 2) * wp.uint32(19349669)
        ^ wp.uint32(cell[2] >> 1) * wp.uint32(83492791)
    )
    within = ((cell[0] & 3) << 3) | ((cell[1] & 3) << 1) | (cell[2] & 1)
    return int((((block * _SPREAD) >> wp.uint32(7)) << wp.uint32(5)) & wp.uint32(0x3FFFFFE0)) | within


_NEAR = """
    using namespace wp;
    const bool grows = radius.per_metre > 0.0;
    const auto reach_at = [&](const vec3& p) {
        const double x = p[0], y = p[1], z = p[2];
        return radius.at_origin + radius.per_metre * wp::sqrt(x * x + y * y + z * z);
    };
    const auto reach_of = [&](const vec3& p, const vec3& q) { return wp::min(reach_at(p), reach_at(q)); };
    // float32 decides where it is sure to agree with float64: up to one square, or from another on.
    const auto are_near = [&](const vec3& p, const vec3& q, const float surely, const float surely_not) {
        const float x = p[0] - q[0], y = p[1] - q[1], z = p[2] - q[2];
        const float squared = x * x + y * y + z * z;
        if (squared <= surely) return true;
        if (squared > surely_not) return false;
        const double dx = (double)p[0] - (double)q[0];
        const double dy = (double)p[1] - (double)q[1];
        const double dz = (double)p[2] - (double)q[2];
        const double reach = grows ? reach_of(p, q) : 0.0;
        return dx * dx + dy * dy + dz * dz <= (grows ? reach * reach : radius.squared);
    };
"""
"""C++ with a `radius`: `are_near(p, q, radius.surely, radius.surely_not)`."""

TOUCH = (
    _NEAR
    + """
    const auto gap_squared = [](const vec3& p, const vec3& low, const vec3& high) {
        float sum = 0.0f;
        for (int axis = 0; axis < 3; ++axis) {
            const float gap = wp::max(wp::max(low[axis] - p[axis], p[axis] - high[axis]), 0.0f);
            sum += gap * gap;
        }
        return sum;
    };
    // Crowded cells: both sides are narrowed to what lies near the other's box before pairs are tried.
    const auto touch_large = [&](const vec3* a, const int a_size, const vec3* b, const int b_size,
                                 const float surely, const float surely_not) __attribute__((noinline)) {
        const float infinite = INFINITY;
        vec3 low[2], high[2];
        int left[2] = {a_size, b_size};
        for (int axis = 0; axis < 3; ++axis) low[1][axis] = -infinite, high[1][axis] = infinite;
        bool narrowed = true;
        for (int turn = 0; turn < 8 && (narrowed || turn == 1); ++turn) {
            narrowed = false;
            for (int side = 0; side < 2; ++side) {
                const vec3* points_of = side == 0 ? a : b;
                const int size = side == 0 ? a_size : b_size;
                vec3 own_low(infinite, infinite, infinite), own_high(-infinite, -infinite, -infinite);
                int near = 0;
                for (int i = 0; i < size; ++i) {
                    const vec3& p = points_of[i];
                    if (gap_squared(p, low[1 - side], high[1 - side]) > surely_not) continue;
                    for (int axis = 0; axis < 3; ++axis) {
                        own_low[axis] = wp::min(own_low[axis], p[axis]);
                        own_high[axis] = wp::max(own_high[axis], p[axis]);
                    }
                    ++near;
                }
                if (near == 0) return false;
                narrowed |= near < left[side];
                left[side] = near;
                low[side] = own_low;
                high[side] = own_high;
            }
        }
        for (int i = 0; i < a_size; ++i) {
            if (gap_squared(a[i], low[1], high[1]) > surely_not) continue;
            for (int j = 0; j < b_size; ++j)
                if (are_near(a[i], b[j], surely, surely_not)) return true;
        }
        return false;
    };
    const auto touch = [&](const int a_begin, const int a_end, const int b_begin,
                           const int b_end) __attribute__((noinline)) {
        const vec3 *a = points.data + a_begin, *b = points.data + b_begin;
        const int a_size = a_end - a_begin, b_size = b_end - b_begin;
        float surely = radius.surely, surely_not = radius.surely_not;
        if (grows) {
            // Cells of one level: theirs is the square between those at its ends.
            const double growth = reach_of(a[0], b[0]) / radius.at_origin;
            long long level;
            memcpy(&level, &growth, 8);
            level = level >> 49 << 49;
            const long long above = level + (1ll << 49);
            double least, most;
            memcpy(&least, &level, 8);
            memcpy(&most, &above, 8);
            least *= radius.at_origin;
            most *= radius.at_origin;
            surely = (float)wp::min(least * least * (1.0 - 1e-6), 3.0e38);
            surely_not = (float)(most * most * (1.0 + 1e-6));
        }
        // Up to some pairs nothing beats trying them all.
        if ((long long)a_size * b_size > 4096)
            return touch_large(a, a_size, b, b_size, surely, surely_not);
        for (int i = 0; i < a_size; ++i)
            for (int j = 0; j < b_size; ++j)
                if (are_near(a[i], b[j], surely, surely_not)) return true;
        return false;
    };
"""
)
"""C++ with a `radius` and an array of `points`: `touch(a_begin, a_end, b_begin, b_end)`."""


@wp.func_native(_NEAR + "return are_near(p, q, radius.surely, radius.surely_not);")
def is_near(p: wp.vec3, q: wp.vec3, radius: Radius) -> bool:
    """Whether the distance is within the radius, as float64 decides."""
    return False


@wp.func_native(TOUCH + "return touch(a_begin, a_end, b_begin, b_end);")
def touch(points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: Radius) -> bool:
    """Whether any point of one cell is within the radius of any point of another; of two radii the smaller holds."""
    return False


@wp.func
def find(parent: wp.array(dtype=wp.int32), cell: int) -> int:
    """The root of a cell. Halves the path; a write lost to another thread leaves an ancestor all the same."""
    root = int(cell)
    above = at(parent, root)
    while above != root:
        next = at(parent, above)
        parent[root] = next
        root = next
        above = at(parent, root)
    return root


@wp.func
def unite(parent: wp.array(dtype=wp.int32), a: int, b: int):
    """Joins two components; the lower root stays, so that it is the lowest cell of its component in the end."""
    low = find(parent, a)
    high = find(parent, b)
    while low != high:
        if low > high:
            swap = low
            low = high
            high = swap
        found = wp.atomic_cas(parent, high, high, low)
        if found == high:
            high = low
        else:
            # Another thread was first: go on from where it hung the root.
            high = find(parent, found)
            low = find(parent, low)


@wp.func
def join_levels(
    a: int,
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    radius: Radius,
    parent: wp.array(dtype=wp.int32),
):
    """Unites a cell with those of higher levels that it touches; `cell_of_slot` is null where `table` has the cells."""
    cell = cells[a]
    level = (cell[0] + _HALF_LEVEL) >> _LEVEL_BITS
    side = _growth_of(level) / radius.inverse_side
    low = wp.vec3d(
        wp.float64(cell[0] - (level << _LEVEL_BITS)) * side, wp.float64(cell[1]) * side, wp.float64(cell[2]) * side
    )
    high = low + wp.vec3d(side, side, side)
    # The longest radius in the cell, and the longest at a point within it.
    farthest = radius.at_origin + radius.per_metre * wp.length(wp.max(-low, high))
    reach = wp.min(farthest, radius.at_origin * _growth_of(level + 1)) * wp.float64(1.0 + 1e-6)
    last = _level_of((farthest + radius.per_metre * reach) / radius.at_origin * wp.float64(1.0 + 1e-6))
    mask = table.shape[0] - 1
    for other in range(level + 1, last + 1):
        inverse_side = radius.inverse_side / _growth_of(other)
        for x in range(int(wp.floor((low[0] - reach) * inverse_side)), int((high[0] + reach) * inverse_side) + 1):
            for y in range(int(wp.floor((low[1] - reach) * inverse_side)), int((high[1] + reach) * inverse_side) + 1):
                first_z = int(wp.floor((low[2] - reach) * inverse_side))
                for z in range(first_z, int((high[2] + reach) * inverse_side) + 1):
                    wanted = wp.vec3i(x + (other << _LEVEL_BITS), y, z)
                    slot = hash_cell(wanted) & mask
                    b = table[slot]
                    if b >= 0 and cell_of_slot:
                        b = cell_of_slot[slot]
                    while b >= 0 and differ(cells[b], wanted):
                        slot = (slot + 1) & mask
                        b = table[slot]
                        if b >= 0 and cell_of_slot:
                            b = cell_of_slot[slot]
                    if (
                        b >= 0
                        and find(parent, a) != find(parent, b)
                        and touch(points, cell_begin[a], cell_end[a], cell_begin[b], cell_end[b], radius)
                    ):
                        unite(parent, a, b)
