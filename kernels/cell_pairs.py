"""Cells of a cloud and whether they touch: the ground that both ways of clustering stand on.

A cell's side is radius / √3, so that any two of its points are within the radius; all that is left to find out is
which cells, at most two apart along each axis, have a pair of points within it.
"""

from __future__ import annotations

import math

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = [
    "Radius",
    "cell_of",
    "differ",
    "find",
    "hash_cell",
    "hash_column",
    "is_finite",
    "radius_of",
    "touch",
    "unite",
]

_LARGEST_CELL = wp.constant(wp.float64(2.0**30))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_BRUTE_FORCE = wp.constant(wp.int64(4096))  # pairs of points up to which nothing beats trying them all


@wp.struct
class Radius:
    """What kernels need of a radius [m]; made by `radius_of`."""

    inverse_side: wp.float64  # of a cell
    surely: wp.float32  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not: wp.float32  # and above here they are not
    squared: wp.float64


def radius_of(radius: float) -> Radius:
    """The numbers that kernels need of a radius [m]."""
    numbers = Radius()
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
def cell_of(point: wp.vec3, radius: Radius) -> wp.vec3i:
    """The cell of a finite point."""
    return wp.vec3i(
        _cell_along(point[0], radius.inverse_side),
        _cell_along(point[1], radius.inverse_side),
        _cell_along(point[2], radius.inverse_side),
    )


@wp.func
def is_finite(point: wp.vec3) -> bool:
    """Whether no coordinate is a NaN or infinite."""
    return (point[0] - point[0]) + (point[1] - point[1]) + (point[2] - point[2]) == 0.0


@wp.func
def differ(a: wp.vec3i, b: wp.vec3i) -> bool:
    """Whether two cells are not the same."""
    return a[0] != b[0] or a[1] != b[1] or a[2] != b[2]


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
def _is_near(p: wp.vec3, q: wp.vec3, radius: Radius) -> bool:
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
        near = dx * dx + dy * dy + dz * dz <= radius.squared
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
    for _ in range(8):
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
        if not narrowed and _ > 0:
            break
    for i in range(a_begin, a_end):
        p = points[i]
        if _gap_squared(p, b_low, b_high) <= radius.surely_not:
            for j in range(b_begin, b_end):
                if _is_near(p, points[j], radius):
                    return True
    return False


@wp.func
def touch(points: wp.array(dtype=wp.vec3), a_begin: int, a_end: int, b_begin: int, b_end: int, radius: Radius) -> bool:
    """Whether any point of one cell is within the radius of any point of another."""
    if wp.int64(a_end - a_begin) * wp.int64(b_end - b_begin) > _BRUTE_FORCE:
        return _touch_large(points, a_begin, a_end, b_begin, b_end, radius)
    for i in range(a_begin, a_end):
        p = points[i]
        for j in range(b_begin, b_end):
            if _is_near(p, points[j], radius):
                return True
    return False


@wp.func
def find(parent: wp.array(dtype=wp.int32), cell: int) -> int:
    """The root of a cell. Halves the path; a write lost to another thread leaves an ancestor all the same."""
    root = int(cell)
    above = parent[root]
    while above != root:
        next = parent[above]
        parent[root] = next
        root = next
        above = parent[root]
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
