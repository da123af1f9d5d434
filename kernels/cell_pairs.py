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
    "Radius",
    "cell_of",
    "differ",
    "find",
    "hash_cell",
    "hash_column",
    "is_finite",
    "is_near",
    "join_levels",
    "level_of_x",
    "radius_of",
    "touch",
    "unite",
    "x_of_level",
]

_LARGEST_CELL = wp.constant(wp.float64(2.0**30))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_BRUTE_FORCE = wp.constant(wp.int64(4096))  # pairs of points up to which nothing beats trying them all
_SUB_LEVEL = wp.constant(wp.int64(49))  # bits of a float64 below its exponent and three bits of fraction: the level
_LEVEL_OF_ONE = wp.constant(wp.int64(1023 << 3))
_LEVEL_BITS = wp.constant(19)  # bits of x below its level
_HALF_LEVEL = wp.constant(1 << 18)
_LARGEST_SQUARE = wp.constant(wp.float64(3.0e38))


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
def level_of_x(x: int) -> int:
    """The level that a cell's x carries."""
    return (x + _HALF_LEVEL) >> _LEVEL_BITS


@wp.func
def x_of_level(level: int) -> int:
    """What a cell's x is greater by for its level."""
    return level << _LEVEL_BITS


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


@wp.func
def hash_column(x: int, y: int) -> int:
    """Tiles of 512 × 512 columns are spread over the table; within one, neighbours in space share cache lines."""
    tile = wp.uint32(x >> 9) * wp.uint32(73856093) ^ wp.uint32(y >> 9) * wp.uint32(19349669)
    return int(((tile * _SPREAD) ^ wp.uint32((x & 511) * 512 + (y & 511))) & wp.uint32(0x3FFFFFFF))


@wp.func
def is_near(p: wp.vec3, q: wp.vec3, radius: Radius) -> bool:
    """Whether the distance is within the radius, as float64 decides; float32 does where it is sure to agree."""
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    squared = x * x + y * y + z * z
    near = squared <= radius.surely
    if squared > radius.surely and squared <= radius.surely_not:
        dx = wp.float64(p[0]) - wp.float64(q[0])
        dy = wp.float64(p[1]) - wp.float64(q[1])
        dz = wp.float64(p[2]) - wp.float64(q[2])
        limit = radius.squared
        if radius.per_metre > wp.float64(0.0):
            reach = wp.min(_reach_at(p, radius), _reach_at(q, radius))
            limit = reach * reach
        near = dx * dx + dy * dy + dz * dz <= limit
    return near


@wp.func
def _gap_squared(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> float:
    """The squared distance of a point to a box."""
    gap = wp.max(wp.max(low - p, p - high), wp.vec3(0.0))
    return gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2]


@wp.func
def _touch_large(
    points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: Radius
) -> bool:
    """As `touch`, for crowded cells: narrows both sides to what lies near the other's box before it tries pairs."""
    infinite = float(wp.inf)
    a_low = wp.vec3(-infinite)
    a_high = wp.vec3(infinite)
    b_low = wp.vec3(-infinite)
    b_high = wp.vec3(infinite)
    a_left = a_end - a_begin
    b_left = b_end - b_begin
    turn = int(0)
    while turn < 8:
        low = wp.vec3(infinite)
        high = wp.vec3(-infinite)
        left = int(0)
        for i in range(a_begin, a_end):
            p = points[i]
            if _gap_squared(p, b_low, b_high) <= radius.surely_not:
                low = wp.min(low, p)
                high = wp.max(high, p)
                left += 1
        narrowed = left < a_left
        a_low = low
        a_high = high
        a_left = left
        low = wp.vec3(infinite)
        high = wp.vec3(-infinite)
        left = int(0)
        for j in range(b_begin, b_end):
            q = points[j]
            if _gap_squared(q, a_low, a_high) <= radius.surely_not:
                low = wp.min(low, q)
                high = wp.max(high, q)
                left += 1
        narrowed = narrowed or left < b_left
        b_low = low
        b_high = high
        b_left = left
        if a_left == 0 or b_left == 0:
            return False
        turn += 1
        if not narrowed and turn > 1:
            turn = 8
    for i in range(a_begin, a_end):
        p = points[i]
        if _gap_squared(p, b_low, b_high) <= radius.surely_not:
            for j in range(b_begin, b_end):
                if is_near(p, points[j], radius):
                    return True
    return False


@wp.func
def _touch(points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: Radius) -> bool:
    if wp.int64(a_end - a_begin) * wp.int64(b_end - b_begin) > _BRUTE_FORCE:
        return _touch_large(points, a_begin, a_end, b_begin, b_end, radius)
    near = bool(False)
    i = int(a_begin)
    while i < a_end:
        p = at(points, i)
        j = int(b_begin)
        while j < b_end:
            if is_near(p, at(points, j), radius):
                near = True
                j = b_end
                i = a_end
            j += 1
        i += 1
    return near


@wp.func
def touch(points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: Radius) -> bool:
    """Whether any point of one cell is within the radius of any point of another; of two radii the smaller holds."""
    if radius.per_metre > wp.float64(0.0):
        reach = wp.min(_reach_at(points[a_begin], radius), _reach_at(points[b_begin], radius))
        level = _level_of(reach / radius.at_origin)
        least = radius.at_origin * _growth_of(level)
        most = radius.at_origin * _growth_of(level + 1)
        here = Radius()
        here.surely = float(wp.min(least * least * wp.float64(1.0 - 1e-6), _LARGEST_SQUARE))
        here.surely_not = float(most * most * wp.float64(1.0 + 1e-6))
        here.at_origin = radius.at_origin
        here.per_metre = radius.per_metre
        return _touch(points, a_begin, a_end, b_begin, b_end, here)
    return _touch(points, a_begin, a_end, b_begin, b_end, radius)


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
