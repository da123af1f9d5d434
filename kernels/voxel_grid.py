"""The grid that a range is cut into: which voxel a point falls into, to the bit as SECOND's and spconv's voxelizers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["VoxelGrid", "cell_number", "grid_of", "voxel_of", "write_coords"]

_OUTSIDE = wp.constant(wp.int32(-1))


@wp.struct
class VoxelGrid:
    """What kernels need of a grid; made by `grid_of`."""

    low: wp.vec3
    high: wp.vec3
    size: wp.vec3
    cells: wp.vec3i  # along x y z
    total: wp.int64


@wp.func
def voxel_of(point: wp.vec3, grid: VoxelGrid) -> wp.vec3i:
    """The voxel of a point along x y z, or -1 -1 -1. Every comparison is false for a NaN."""
    voxel = wp.vec3i(_OUTSIDE, _OUTSIDE, _OUTSIDE)
    if (
        point[0] >= grid.low[0]
        and point[1] >= grid.low[1]
        and point[2] >= grid.low[2]
        and point[0] < grid.high[0]
        and point[1] < grid.high[1]
        and point[2] < grid.high[2]
    ):
        x = int((point[0] - grid.low[0]) / grid.size[0])
        y = int((point[1] - grid.low[1]) / grid.size[1])
        z = int((point[2] - grid.low[2]) / grid.size[2])
        if x < grid.cells[0] and y < grid.cells[1] and z < grid.cells[2]:
            voxel = wp.vec3i(x, y, z)
    return voxel


@wp.func
def cell_number(voxel: wp.vec3i, grid: VoxelGrid) -> wp.int64:
    """The row-major number of a voxel, x fastest."""
    return (wp.int64(voxel[2]) * wp.int64(grid.cells[1]) + wp.int64(voxel[1])) * wp.int64(grid.cells[0]) + wp.int64(
        voxel[0]
    )


@wp.func
def write_coords(voxel: wp.vec3i, row: int, coords: wp.array2d(dtype=wp.int32)):
    """Writes a voxel as z y x."""
    coords[row, 0] = voxel[2]
    coords[row, 1] = voxel[1]
    coords[row, 2] = voxel[0]


def grid_of(voxel_size: Sequence[float], point_range: Sequence[float]) -> VoxelGrid:
    """The cells that `point_range` is cut into.

    Raises:
        ValueError: An edge that is not positive, a range that is empty or not finite, or far too many cells.
    """
    low, high = point_range[:3], point_range[3:]
    cells = []
    for axis, size, start, stop in zip("xyz", voxel_size, low, high, strict=True):
        if not (size > 0 and math.isfinite(size)):
            raise ValueError(f"voxel_size must be > 0 m and finite, not {size} along {axis}")
        if not (start < stop and math.isfinite(start) and math.isfinite(stop)):
            raise ValueError(
                f"point_range must be xmin ymin zmin xmax ymax zmax with min < max, not {start} … {stop} along {axis}"
            )
        ratio = (stop - start) / size
        # A range that is a whole number of voxels, but for the rounding of its decimals, has just that number.
        whole = round(ratio)
        cells.append(whole if whole > 0 and abs(ratio - whole) < 1e-3 else math.ceil(ratio))
        if cells[-1] > 1 << 20:
            raise ValueError(
                f"point_range has {cells[-1]} voxels along {axis}, more than 2²⁰; choose a larger voxel_size"
            )
    grid = VoxelGrid()
    grid.low, grid.high, grid.size = wp.vec3(*low), wp.vec3(*high), wp.vec3(*voxel_size)
    grid.cells = wp.vec3i(*cells)
    grid.total = math.prod(cells)
    return grid
