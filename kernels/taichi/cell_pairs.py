"""Cells of a cloud and whether they touch, as `kernels.cell_pairs` has them for Warp, in Taichi.

A cell's side is radius / √3, so that any two of its points are within the radius. A radius that grows with the range
is cut into levels, eight to an octave, each with cells of its own; a cell's level is carried in its x. Where the device
has 64-bit numbers, float64 decides as in Warp; else float32 does.
"""

import math
from typing import Any

import numpy as np
import taichi as ti

__all__ = [
    "Integers",
    "Radius",
    "Rows",
    "Table",
    "cell_of",
    "cells_reached",
    "find",
    "growth_of",
    "level_in",
    "levels_reached",
    "point_of",
    "radius_of",
    "touch",
    "unite",
]

_LARGEST_CELL = 2.0**30
_LARGEST_FLOAT = 3.4028235e38
_LARGEST_SQUARE = 3.0e38
_BRUTE_FORCE = 4096.0  # pairs of points up to which nothing beats trying them all
_LEVEL_BITS = 19  # bits of x below its level
_HALF_LEVEL = 1 << 18
_LEVEL_OF_ONE_64, _BELOW_LEVEL_64 = 1023 << 3, 49  # of a float64: its exponent and three bits of fraction
_LEVEL_OF_ONE_32, _BELOW_LEVEL_32 = 127 << 3, 20
_INVERSE_SIDE, _SQUARED, _AT_ORIGIN, _PER_METRE = 0, 2, 4, 6  # where their words begin in `Radius.wide`
_REAL = (ti.f32, ti.f64)  # what a kernel reckons with, by whether the device has 64-bit numbers

Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Table = ti.types.ndarray(dtype=ti.i32, ndim=2)
Rows = ti.types.ndarray(dtype=ti.f32, ndim=2)
Radius = ti.types.struct(
    inverse_side=ti.f32,
    at_origin=ti.f32,
    per_metre=ti.f32,
    surely=ti.f32,  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not=ti.f32,  # and above here they are not
    wide=ti.types.vector(8, ti.i32),  # words of float64: inverse side, radius squared, radius at the origin, its growth
)


def radius_of(radius: float, per_metre: float, in_64_bits: bool) -> Any:
    """The numbers that kernels need of a radius [m] that grows with the range, by `per_metre` of 0 or 1e-5 … 1."""
    # A hair shorter, so that no rounding makes the diagonal longer than the radius.
    inverse_side = math.sqrt(3.0) / (radius * (1.0 - 1e-6))
    squared = radius * radius
    return Radius(
        inverse_side=math.sqrt(3.0) / (radius * (1.0 - 1e-3)),
        at_origin=radius,
        per_metre=per_metre,
        surely=squared * (1.0 - 1e-6) if in_64_bits or per_metre > 0 else squared,
        surely_not=squared * (1.0 + 1e-6),
        wide=np.array([inverse_side, squared, radius, per_metre]).view(np.int32).tolist(),
    )


@ti.func
def _number(radius: ti.template(), place: ti.template(), in_32_bits: ti.f32, in_64_bits: ti.template()):
    """One of the numbers of a radius, as wide as the device has them."""
    number = ti.cast(in_32_bits, _REAL[in_64_bits])
    if ti.static(in_64_bits):
        words = (ti.i64(radius.wide[place + 1]) << 32) | ti.i64(ti.u32(radius.wide[place]))
        number = ti.bit_cast(words, ti.f64)
    return number


@ti.func
def _inverse_side(radius: ti.template(), in_64_bits: ti.template()):
    return _number(radius, _INVERSE_SIDE, radius.inverse_side, in_64_bits)


@ti.func
def _at_origin(radius: ti.template(), in_64_bits: ti.template()):
    return _number(radius, _AT_ORIGIN, radius.at_origin, in_64_bits)


@ti.func
def _per_metre(radius: ti.template(), in_64_bits: ti.template()):
    return _number(radius, _PER_METRE, radius.per_metre, in_64_bits)


@ti.func
def _reach_at(point: ti.math.vec3, radius: ti.template(), in_64_bits: ti.template()):
    """The radius at a point."""
    x = ti.cast(point[0], _REAL[in_64_bits])
    y = ti.cast(point[1], _REAL[in_64_bits])
    z = ti.cast(point[2], _REAL[in_64_bits])
    return _at_origin(radius, in_64_bits) + _per_metre(radius, in_64_bits) * ti.sqrt(x * x + y * y + z * z)


@ti.func
def _level_of(growth, in_64_bits: ti.template()) -> ti.i32:
    """The level of a radius, given as a multiple, ≥ 1, of that at the origin."""
    level = 0
    if ti.static(in_64_bits):
        level = ti.i32((ti.bit_cast(growth, ti.i64) >> _BELOW_LEVEL_64) - _LEVEL_OF_ONE_64)
    else:
        level = (ti.bit_cast(growth, ti.i32) >> _BELOW_LEVEL_32) - _LEVEL_OF_ONE_32
    return level


@ti.func
def growth_of(level: ti.i32, in_64_bits: ti.template()):
    """The least multiple of the radius at the origin that is of a level."""
    growth = ti.cast(1.0, _REAL[in_64_bits])
    if ti.static(in_64_bits):
        growth = ti.bit_cast((ti.i64(level) + _LEVEL_OF_ONE_64) << _BELOW_LEVEL_64, ti.f64)
    else:
        growth = ti.bit_cast((level + _LEVEL_OF_ONE_32) << _BELOW_LEVEL_32, ti.f32)
    return growth


@ti.func
def _cell_along(coordinate: ti.f32, radius: ti.template(), in_64_bits: ti.template()) -> ti.i32:
    """The cell's index along an axis; where float32 has no neighbours within a cell any more, the number's own bits."""
    cell = 0
    scaled = ti.cast(coordinate, _REAL[in_64_bits]) * _inverse_side(radius, in_64_bits)
    if ti.abs(scaled) < _LARGEST_CELL:
        cell = ti.i32(ti.floor(scaled))
    elif coordinate > 0.0:
        cell = ti.bit_cast(coordinate, ti.i32)
    else:
        cell = -ti.bit_cast(-coordinate, ti.i32)
    return cell


@ti.func
def cell_of(point: ti.math.vec3, radius: ti.template(), in_64_bits: ti.template(), grows: ti.template()):
    """The cell of a finite point, its level in x."""
    cell = ti.math.ivec3(0, 0, 0)
    if ti.static(grows):
        level = _level_of(_reach_at(point, radius, in_64_bits) / _at_origin(radius, in_64_bits), in_64_bits)
        inverse_side = _inverse_side(radius, in_64_bits) / growth_of(level, in_64_bits)
        for k in ti.static(range(3)):
            cell[k] = ti.i32(ti.floor(ti.cast(point[k], _REAL[in_64_bits]) * inverse_side))
        cell[0] += level << _LEVEL_BITS
    else:
        for k in ti.static(range(3)):
            cell[k] = _cell_along(point[k], radius, in_64_bits)
    return cell


@ti.func
def level_in(x: ti.i32) -> ti.i32:
    """The level that a cell's x carries."""
    return (x + _HALF_LEVEL) >> _LEVEL_BITS


@ti.func
def point_of(rows: Rows, i: ti.i32) -> ti.math.vec3:
    """A point's position."""
    return ti.math.vec3(rows[i, 0], rows[i, 1], rows[i, 2])


@ti.func
def _is_near(
    p: ti.math.vec3,
    q: ti.math.vec3,
    surely: ti.f32,
    surely_not: ti.f32,
    radius: ti.template(),
    in_64_bits: ti.template(),
    grows: ti.template(),
) -> ti.i32:
    """Whether the distance is within the radius, as float64 decides; float32 does where it is sure to agree."""
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    squared = x * x + y * y + z * z
    near = ti.i32(squared <= surely)
    if ti.static(in_64_bits or grows):  # noqa: SIM102 (one of the two is compiled away)
        if squared > surely and squared <= surely_not:
            dx = ti.cast(p[0], _REAL[in_64_bits]) - ti.cast(q[0], _REAL[in_64_bits])
            dy = ti.cast(p[1], _REAL[in_64_bits]) - ti.cast(q[1], _REAL[in_64_bits])
            dz = ti.cast(p[2], _REAL[in_64_bits]) - ti.cast(q[2], _REAL[in_64_bits])
            limit = _number(radius, _SQUARED, surely, in_64_bits)
            if ti.static(grows):
                reach = ti.min(_reach_at(p, radius, in_64_bits), _reach_at(q, radius, in_64_bits))
                limit = reach * reach
            near = ti.i32(dx * dx + dy * dy + dz * dz <= limit)
    return near


@ti.func
def _is_by_box(p: ti.math.vec3, low: ti.math.vec3, high: ti.math.vec3, surely_not: ti.f32) -> ti.i32:
    """Whether a point may be within the radius of a point in a box."""
    x = ti.max(low[0] - p[0], p[0] - high[0], 0.0)
    y = ti.max(low[1] - p[1], p[1] - high[1], 0.0)
    z = ti.max(low[2] - p[2], p[2] - high[2], 0.0)
    return x * x + y * y + z * z <= surely_not


@ti.func
def touch(
    points: Rows,
    a_begin: ti.i32,
    a_end: ti.i32,
    b_begin: ti.i32,
    b_end: ti.i32,
    level: ti.i32,
    radius: ti.template(),
    in_64_bits: ti.template(),
    grows: ti.template(),
) -> ti.i32:
    """Whether any point of one cell is within the radius of any point of another; of two radii the smaller holds.

    Of crowded cells, only what lies near the box of what is left of the other is tried.

    Args:
        points: Sorted by cell.
        a_begin: The one's first point.
        a_end: And past its last.
        b_begin: The other's first point.
        b_end: And past its last.
        level: The lower of their levels.
        radius: The radius.
        in_64_bits: Whether the device has 64-bit numbers.
        grows: Whether the radius grows with the range.
    """
    surely = radius.surely
    surely_not = radius.surely_not
    if ti.static(grows):
        least = _at_origin(radius, in_64_bits) * growth_of(level, in_64_bits)
        most = _at_origin(radius, in_64_bits) * growth_of(level + 1, in_64_bits)
        surely = ti.min(ti.f32(least * least * (1.0 - 1e-6)), _LARGEST_SQUARE)
        surely_not = ti.f32(most * most * (1.0 + 1e-6))
    far = ti.math.vec3(_LARGEST_FLOAT, _LARGEST_FLOAT, _LARGEST_FLOAT)
    a_low = -far
    a_high = far
    b_low = -far
    b_high = far
    a_left = a_end - a_begin
    b_left = b_end - b_begin
    rounds = ti.select(ti.f32(a_left) * ti.f32(b_left) > _BRUTE_FORCE, 8, 0)
    while rounds > 0:
        rounds -= 1
        left = 0
        low = far
        high = -far
        for i in range(a_begin, a_end):
            p = point_of(points, i)
            if _is_by_box(p, b_low, b_high, surely_not):
                low = ti.min(low, p)
                high = ti.max(high, p)
                left += 1
        narrowed = left < a_left
        a_low = low
        a_high = high
        a_left = left
        left = 0
        low = far
        high = -far
        if a_left > 0:
            for j in range(b_begin, b_end):
                q = point_of(points, j)
                if _is_by_box(q, a_low, a_high, surely_not):
                    low = ti.min(low, q)
                    high = ti.max(high, q)
                    left += 1
        narrowed = narrowed or left < b_left
        b_low = low
        b_high = high
        b_left = left
        if a_left == 0 or b_left == 0 or (rounds < 7 and not narrowed):
            rounds = 0
    near = 0
    i = a_begin
    while i < a_end and near == 0 and a_left > 0 and b_left > 0:
        p = point_of(points, i)
        if _is_by_box(p, b_low, b_high, surely_not):
            j = b_begin
            while j < b_end and near == 0:
                near = _is_near(p, point_of(points, j), surely, surely_not, radius, in_64_bits, grows)
                j += 1
        i += 1
    return near


@ti.func
def _farthest_in(cell: ti.math.ivec3, radius: ti.template(), in_64_bits: ti.template()):
    """The lowest corner of a cell, its side, and the longest radius at any point in it."""
    level = level_in(cell[0])
    side = growth_of(level, in_64_bits) / _inverse_side(radius, in_64_bits)
    squared = ti.cast(0.0, _REAL[in_64_bits])
    low = ti.Vector([ti.cast(0.0, _REAL[in_64_bits]) for _ in range(3)])
    for k in ti.static(range(3)):
        along = cell[k]
        if ti.static(k == 0):
            along -= level << _LEVEL_BITS
        low[k] = ti.cast(along, _REAL[in_64_bits]) * side
        away = ti.max(-low[k], low[k] + side)
        squared += away * away
    return low, side, _at_origin(radius, in_64_bits) + _per_metre(radius, in_64_bits) * ti.sqrt(squared)


@ti.func
def levels_reached(cell: ti.math.ivec3, radius: ti.template(), in_64_bits: ti.template()) -> ti.i32:
    """The highest level of which a cell's points may reach others."""
    _, _, farthest = _farthest_in(cell, radius, in_64_bits)
    reach = _longest(cell, farthest, radius, in_64_bits)
    beyond = farthest + _per_metre(radius, in_64_bits) * reach
    return _level_of(beyond / _at_origin(radius, in_64_bits) * (1.0 + 1e-6), in_64_bits)


@ti.func
def _longest(cell: ti.math.ivec3, farthest, radius: ti.template(), in_64_bits: ti.template()):
    """The longest radius of a cell's points, and a hair."""
    most = _at_origin(radius, in_64_bits) * growth_of(level_in(cell[0]) + 1, in_64_bits)
    return ti.min(farthest, most) * (1.0 + 1e-6)


@ti.func
def cells_reached(cell: ti.math.ivec3, level: ti.i32, radius: ti.template(), in_64_bits: ti.template()):
    """The lowest and the highest cell of a level that the points of a cell may reach."""
    low, side, farthest = _farthest_in(cell, radius, in_64_bits)
    reach = _longest(cell, farthest, radius, in_64_bits)
    inverse_side = _inverse_side(radius, in_64_bits) / growth_of(level, in_64_bits)
    first = ti.math.ivec3(0, 0, 0)
    last = ti.math.ivec3(0, 0, 0)
    for k in ti.static(range(3)):
        first[k] = ti.i32(ti.floor((low[k] - reach) * inverse_side))
        last[k] = ti.i32(ti.floor((low[k] + side + reach) * inverse_side))
    first[0] += level << _LEVEL_BITS
    last[0] += level << _LEVEL_BITS
    return first, last


@ti.func
def find(parent: Integers, cell: ti.i32) -> ti.i32:
    """The root of a cell. Halves the path; a write lost to another thread leaves an ancestor all the same."""
    root = cell
    above = parent[root]
    while above != root:
        after = parent[above]
        parent[root] = after
        root = after
        above = parent[root]
    return root


@ti.func
def unite(parent: Integers, a: ti.i32, b: ti.i32):
    """Joins two components; the lower root stays."""
    low = find(parent, a)
    high = find(parent, b)
    while low != high:
        if low > high:
            swap = low
            low = high
            high = swap
        there = ti.atomic_min(parent[high], low)
        if there == high:
            high = low
        else:
            # Another thread was first: what it had hung the root to belongs to us too.
            high = find(parent, there)
            low = find(parent, low)
