"""Points in the voxels of a hash table, for device code: where a voxel is, what it holds, which point is nearest.

A table has a row for each slot: the key of a cell, -1 where free, and its voxel << 8 | points. Points are kept against
the low corner of their voxel, so that a map is as exact a thousand kilometres from where it began as at its origin.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)

__all__ = [
    "FREE",
    "add_point",
    "cell_of",
    "cell_of_key",
    "content_of",
    "find_slot",
    "first_slot",
    "is_usable",
    "key_of",
    "look_up",
    "moved_by",
    "nearest_in_map",
    "next_slot",
    "offset_in",
]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

FREE = wp.constant(wp.int64(-1))
_CELL_LIMIT = wp.constant(wp.float64(2.0**20))
_CELL_BIAS = wp.constant(wp.int64(2**20))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))


@wp.func
def moved_by(pose: wp.mat44d, p: wp.vec3) -> wp.vec3d:
    """A point seen from a pose, in the world."""
    x = wp.float64(p[0])
    y = wp.float64(p[1])
    z = wp.float64(p[2])
    return wp.vec3d(
        pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3],
        pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3],
        pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3],
    )


@wp.func
def is_usable(p: wp.vec3d, inverse_size: wp.float64) -> bool:
    """Whether a point lies in a voxel that has a number; false for what is not finite."""
    total = wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2])  # a maximum may hide a NaN, a sum does not
    reach = wp.max(wp.abs(p[0]), wp.max(wp.abs(p[1]), wp.abs(p[2])))
    return wp.isfinite(total) and reach * inverse_size < _CELL_LIMIT


@wp.func
def cell_of(p: wp.vec3d, inverse_size: wp.float64) -> wp.vec3i:
    """The cell of a usable point."""
    return wp.vec3i(
        int(wp.floor(p[0] * inverse_size)), int(wp.floor(p[1] * inverse_size)), int(wp.floor(p[2] * inverse_size))
    )


@wp.func
def offset_in(p: wp.vec3d, cell: wp.vec3i, size: wp.float64) -> wp.vec3:
    """A point against the low corner of its cell."""
    return wp.vec3(
        float(p[0] - wp.float64(cell[0]) * size),
        float(p[1] - wp.float64(cell[1]) * size),
        float(p[2] - wp.float64(cell[2]) * size),
    )


@wp.func
def key_of(cell: wp.vec3i) -> wp.int64:
    """The number of a cell."""
    x = wp.int64(cell[0]) + _CELL_BIAS
    y = wp.int64(cell[1]) + _CELL_BIAS
    z = wp.int64(cell[2]) + _CELL_BIAS
    return (x << wp.int64(42)) | (y << wp.int64(21)) | z


@wp.func
def cell_of_key(key: wp.int64) -> wp.vec3i:
    """The inverse of `key_of`."""
    low = (_CELL_BIAS << wp.int64(1)) - wp.int64(1)
    return wp.vec3i(
        int((key >> wp.int64(42)) - _CELL_BIAS),
        int(((key >> wp.int64(21)) & low) - _CELL_BIAS),
        int((key & low) - _CELL_BIAS),
    )


@wp.func
def first_slot(cell: wp.vec3i, mask: int) -> int:
    """Where a cell is looked for first; the 64 cells of a cube of 4 lie together."""
    mixed = (
        wp.uint32(cell[0] >> 2) * wp.uint32(73856093)
        ^ wp.uint32(cell[1] >> 2) * wp.uint32(19349669)
        ^ wp.uint32(cell[2] >> 2) * wp.uint32(83492791)
    )
    block = int((mixed * _SPREAD) >> wp.uint32(7))
    return ((block << 6) | ((cell[2] & 3) << 4) | ((cell[1] & 3) << 2) | (cell[0] & 3)) & mask


@wp.func
def next_slot(slot: int, mask: int) -> int:
    """Where to look next: in the next cube of 64, and, the step being odd, at every slot in the end."""
    return (slot + 65) & mask


@wp.func
def find_slot(table: wp.array2d(dtype=wp.int64), cell: wp.vec3i) -> int:
    """The slot of a cell, or the free one where it would be put."""
    mask = table.shape[0] - 1
    key = key_of(cell)
    slot = first_slot(cell, mask)
    found = table[slot, 0]
    while found != key and found != FREE:
        slot = next_slot(slot, mask)
        found = table[slot, 0]
    return slot


@wp.func
def content_of(voxel: int, points: int) -> wp.int64:
    """What a table holds of a voxel."""
    return (wp.int64(voxel) << wp.int64(8)) | wp.int64(points)


@wp.func
def look_up(table: wp.array2d(dtype=wp.int64), cell: wp.vec3i) -> wp.int64:
    """The voxel of a cell and its points, as voxel << 8 | points; 0 points where there is none."""
    slot = find_slot(table, cell)
    content = wp.int64(0)
    if table[slot, 0] != FREE:
        content = table[slot, 1]
    return content


@wp.func
def add_point(
    points: wp.array(dtype=wp.vec3), voxel: int, count: int, max_points: int, offset: wp.vec3, spacing_sq: float
) -> int:
    """Adds a point to its voxel unless that is full or the point too close to another; how many it then has."""
    if count >= max_points:
        return count
    base = voxel * max_points
    for k in range(count):
        if wp.length_sq(points[base + k] - offset) < spacing_sq:
            return count
    points[base + count] = offset
    return count + 1


@wp.func
def _gap(which: int, near: float, edge: float) -> float:
    """The square of how far along an axis the own voxel is (0), the nearer neighbour (1), the other (2)."""
    gap = wp.where(which == 1, near, wp.where(which == 2, edge - near, 0.0))
    return gap * gap


@wp.func
def _side(which: int, nearer: int) -> int:
    """The cell, against the own, that is meant by the same number."""
    return wp.where(which == 2, -nearer, which * nearer)


@wp.func
def nearest_in_map(
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    max_points: int,
    p: wp.vec3d,
    size: wp.float64,
    limit_sq: float,
) -> tuple[wp.vec3, float, float]:
    """The point of the map nearest to `p`, among the 27 voxels around it.

    Returns:
        From `p` to it; its squared distance, `limit_sq` where none is nearer than that; and a lower bound of the
        squared distance of every other point of the map.
    """
    best = limit_sq
    vector = wp.vec3()
    inverse_size = wp.float64(1.0) / size
    if not is_usable(p, inverse_size):
        return vector, best, 0.0
    cell = cell_of(p, inverse_size)
    offset = offset_in(p, cell, size)
    edge = float(size)
    # The nearer neighbour along each axis comes first, and voxels beyond the best so far are left out.
    near = wp.vec3()
    side = wp.vec3i()
    for axis in range(3):
        near[axis] = wp.max(wp.min(offset[axis], edge - offset[axis]), 0.0)
        side[axis] = wp.where(offset[axis] < edge - offset[axis], -1, 1)
    border = edge + wp.min(near[0], wp.min(near[1], near[2]))
    other = border * border
    z = int(0)
    while z < 3:
        beyond_z = _gap(z, near[2], edge)
        if beyond_z < best:
            y = int(0)
            while y < 3:
                beyond_y = beyond_z + _gap(y, near[1], edge)
                if beyond_y < best:
                    x = int(0)
                    while x < 3:
                        beyond = beyond_y + _gap(x, near[0], edge)
                        if beyond < best:
                            shift = wp.vec3i(_side(x, side[0]), _side(y, side[1]), _side(z, side[2]))
                            content = look_up(table, cell + shift)
                            base = int(content >> wp.int64(8)) * max_points
                            corner = wp.vec3(float(shift[0]), float(shift[1]), float(shift[2])) * edge - offset
                            found = int(-1)
                            for k in range(base, base + int(content & wp.int64(255))):
                                distance_sq = wp.length_sq(corner + points[k])
                                other = wp.min(other, wp.max(distance_sq, best))
                                if distance_sq < best:
                                    best = distance_sq
                                    found = k
                            if found >= 0:
                                vector = corner + points[found]
                        else:
                            other = wp.min(other, beyond)
                        x += 1
                else:
                    other = wp.min(other, beyond_y)
                y += 1
        else:
            other = wp.min(other, beyond_z)
        z += 1
    return vector, best, other
