"""Voxelization in Taichi: the same voxels as `kernels.voxel` makes in Warp, to the bit.

A voxel is named by its lowest point. A dense grid, or a hash table where a grid would be too large, keeps by atomic
minimum the lowest point of each cell; a scan over the points that are one numbers the voxels; and each voxel picks its
first points from a list of all it has. In the hash table, a lower point takes the place of a higher one, which is
carried on to the next place: so the first entry of a cell that a search meets is its lowest point, whatever the order
in which threads came.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti

from ..interop import Points
from ..plan import capacity_for, plan_for
from ..voxel import Voxels
from ..voxel_grid import grid_of
from .device import DEFAULT_TAICHI, check_count, give_back, launching, rows_of, start, workspace
from .parallel import NO_POINT, block_sums_for, hash_of, scan

__all__ = ["Voxelize", "voxelize"]

_DENSE_CELLS = 1 << 22  # of 4 bytes: larger grids miss the cache more than a hash table does
_VOXELS, _DROPPED_POINTS, _DROPPED_VOXELS, _OUTSIDE = range(4)
_BLOCK = 512  # points or voxels that one thread counts

_Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
_Rows = ti.types.ndarray(dtype=ti.f32, ndim=2)
_Grid = ti.types.struct(low=ti.math.vec3, high=ti.math.vec3, size=ti.math.vec3, cells=ti.math.ivec3, is_dense=ti.i32)


@ti.func
def _cell_of(points: _Rows, i: ti.i32, grid: ti.template()) -> ti.math.ivec3:
    """The cell of a point along x y z; x is -1 where there is none. Every comparison is false for a NaN."""
    cell = ti.math.ivec3(-1, 0, 0)
    x = points[i, 0]
    y = points[i, 1]
    z = points[i, 2]
    if (
        x >= grid.low[0]
        and y >= grid.low[1]
        and z >= grid.low[2]
        and x < grid.high[0]
        and y < grid.high[1]
        and z < grid.high[2]
    ):
        cell[0] = ti.i32((x - grid.low[0]) / grid.size[0])
        cell[1] = ti.i32((y - grid.low[1]) / grid.size[1])
        cell[2] = ti.i32((z - grid.low[2]) / grid.size[2])
        if cell[0] >= grid.cells[0] or cell[1] >= grid.cells[1] or cell[2] >= grid.cells[2]:
            cell[0] = -1
    return cell


@ti.func
def _slot_of(cell: ti.math.ivec3, grid: ti.template()) -> ti.i32:
    """The place of a cell in a dense grid."""
    return (cell[2] * grid.cells[1] + cell[1]) * grid.cells[0] + cell[0]


@ti.func
def _is_same(a: ti.math.ivec3, b: ti.math.ivec3) -> ti.i32:
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2]


@ti.func
def _claim(points: _Rows, i: ti.i32, own: ti.math.ivec3, grid: ti.template(), table: _Integers):
    """Enters a point for its cell in the hash table."""
    mask = table.shape[0] - 1
    carried = i
    cell = own
    slot = hash_of(cell) & mask
    while carried >= 0:
        there = table[slot]
        if there > carried:
            there = ti.atomic_min(table[slot], carried)
        if there == NO_POINT:
            carried = -1
        else:
            other = _cell_of(points, there, grid)
            if _is_same(other, cell):
                carried = -1
            else:
                slot = (slot + 1) & mask
                if there > carried:
                    carried = there
                    cell = other


@ti.func
def _lowest(points: _Rows, cell: ti.math.ivec3, grid: ti.template(), table: _Integers) -> ti.i32:
    """The lowest point of a cell that has points, from the hash table."""
    mask = table.shape[0] - 1
    slot = hash_of(cell) & mask
    point = table[slot]
    while not _is_same(_cell_of(points, point, grid), cell):
        slot = (slot + 1) & mask
        point = table[slot]
    return point


@ti.kernel
def _assign(
    # in
    points: _Rows,
    count: ti.i32,
    grid: _Grid,
    max_points: ti.i32,
    max_voxels: ti.i32,
    # in out: lowest points of cells, a dense grid (left free) or a hash table
    table: _Integers,
    # out: workspace
    lowest: _Integers,
    number: _Integers,
    voxel: _Integers,
    rank: _Integers,
    size: _Integers,
    begin: _Integers,
    listed: _Integers,
    sums: _Integers,
    # out
    totals: _Integers,
):
    """Numbers the voxels by their lowest point, and lists the points of each in any order."""
    for slot in range((1 - grid.is_dense) * table.shape[0]):
        table[slot] = NO_POINT
    for i in range(count):
        cell = _cell_of(points, i, grid)
        if cell[0] >= 0:
            if grid.is_dense != 0:
                slot = _slot_of(cell, grid)
                if table[slot] > i:
                    ti.atomic_min(table[slot], i)
            else:
                _claim(points, i, cell, grid, table)
    for i in range(count):
        cell = _cell_of(points, i, grid)
        first = -1
        if cell[0] >= 0:
            if grid.is_dense != 0:
                first = table[_slot_of(cell, grid)]
            else:
                first = _lowest(points, cell, grid, table)
        lowest[i] = first
        number[i] = ti.i32(first == i)
    scan(number, count, sums, totals, _VOXELS)
    for _ in range(1):
        found = totals[_VOXELS]
        totals[_VOXELS] = ti.min(found, max_voxels)
        totals[_DROPPED_VOXELS] = ti.max(found - max_voxels, 0)
        totals[_DROPPED_POINTS] = 0
        totals[_OUTSIDE] = 0
    for v in range(totals[_VOXELS]):
        size[v] = 0
    for block in range((count + _BLOCK - 1) // _BLOCK):
        outside = 0
        for i in range(block * _BLOCK, ti.min(count, (block + 1) * _BLOCK)):
            first = lowest[i]
            v = -1
            if first < 0:
                outside += 1
            else:
                v = number[first]
                if v >= max_voxels:
                    v = -1
                else:
                    rank[i] = ti.atomic_add(size[v], 1)
                if first == i and grid.is_dense != 0:
                    table[_slot_of(_cell_of(points, i, grid), grid)] = NO_POINT
            voxel[i] = v
        ti.atomic_add(totals[_OUTSIDE], outside)
    for block in range((totals[_VOXELS] + _BLOCK - 1) // _BLOCK):
        dropped = 0
        for v in range(block * _BLOCK, ti.min(totals[_VOXELS], (block + 1) * _BLOCK)):
            begin[v] = size[v]
            dropped += ti.max(size[v] - max_points, 0)
        ti.atomic_add(totals[_DROPPED_POINTS], dropped)
    scan(begin, totals[_VOXELS], sums, sums, sums.shape[0] - 1)
    for i in range(count):
        if voxel[i] >= 0:
            listed[begin[voxel[i]] + rank[i]] = i


@ti.kernel
def _fill(
    # in
    points: _Rows,
    grid: _Grid,
    totals: _Integers,
    size: _Integers,
    begin: _Integers,
    # in out: the first points of each voxel become the lowest, in order
    listed: _Integers,
    # out
    features: ti.types.ndarray(dtype=ti.f32, ndim=3),
    coords: ti.types.ndarray(dtype=ti.i32, ndim=2),
    counts: _Integers,
):
    """Copies the first points of each voxel."""
    for v in range(totals[_VOXELS]):
        first = begin[v]
        kept = 0
        for j in range(size[v]):
            point = listed[first + j]
            # An insertion sort that lets go what falls off its end; the points come nearly in order.
            place = kept
            while place > 0 and listed[first + ti.max(place - 1, 0)] > point:
                if place < features.shape[1]:
                    listed[first + place] = listed[first + place - 1]
                place -= 1
            if place < features.shape[1]:
                listed[first + place] = point
                kept = ti.min(kept + 1, features.shape[1])
        cell = _cell_of(points, listed[first], grid)
        coords[v, 0] = cell[2]
        coords[v, 1] = cell[1]
        coords[v, 2] = cell[0]
        counts[v] = kept
        for j in range(features.shape[1]):
            for column in range(features.shape[2]):
                value = 0.0
                if j < kept:
                    value = points[listed[first + ti.min(j, kept - 1)], column]
                features[v, j, column] = value


@ti.kernel
def _free(table: _Integers):
    for slot in range(table.shape[0]):
        table[slot] = NO_POINT


@dataclass(frozen=True, kw_only=True)
class Voxelize:
    """A plan: workspace on Taichi's device for clouds of up to `capacity` points; `launch` reads nothing back."""

    voxel_size: tuple[float, float, float]
    """Edges of a voxel along x y z [m], > 0."""
    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax [m], upper bounds open."""
    columns: int = 4
    """Columns of a point, ≥ 3: x y z and what else it carries."""
    max_points: int = 32
    """Points that a voxel keeps."""
    max_voxels: int = 40_000
    """Voxels that are kept."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_TAICHI
    """Taichi's device, as `start` takes it."""

    totals: Any = field(init=False, repr=False, compare=False)
    """Out: ti.Ndarray of four int32: voxels; points beyond max_points, voxels beyond max_voxels, points outside or not
    finite, which all were left out."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        grid = grid_of(self.voxel_size, self.point_range)
        for name, least in (("columns", 3), ("max_points", 1), ("max_voxels", 1), ("capacity", 1)):
            if not least <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least {least} and below 2³¹, not {getattr(self, name)}")
        size = self.max_voxels * self.max_points * self.columns
        if size >= 1 << 31:
            raise ValueError(
                f"max_voxels × max_points × columns must stay below 2³¹ numbers, not {size}; lower max_voxels"
            )
        start(self.device)
        is_dense = int(grid.total) <= _DENSE_CELLS
        slots = int(grid.total) if is_dense else 2 << (self.capacity - 1).bit_length()

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        with launching:
            keep(
                "_grid",
                _Grid(
                    low=list(grid.low),
                    high=list(grid.high),
                    size=list(grid.size),
                    cells=list(grid.cells),
                    is_dense=is_dense,
                ),
            )
            keep("_table", workspace(slots, ti.i32))
            _free(self._table)
            for name in ("lowest", "number", "voxel", "rank", "size", "begin", "listed"):
                keep(f"_{name}", workspace(self.capacity, ti.i32))
            keep("_sums", workspace(block_sums_for(self.capacity), ti.i32))
            keep("totals", workspace(4, ti.i32))

    def launch(self, points: Any, count: int, features: Any, coords: Any, counts: Any) -> None:
        """Fills the arrays given, and `totals`, from the first `count` points.

        Args:
            points: ti.Ndarray or contiguous NumPy array, float32, shape (n, columns), count ≤ n ≤ capacity.
            count: How many points there are.
            features: Out: ti.Ndarray or NumPy array, float32, shape (max_voxels, max_points, columns); rows of voxels
                there are none of are left alone.
            coords: Out: int32, shape (max_voxels, 3), cell indices z y x.
            counts: Out: int32, shape (max_voxels,), points kept in each voxel.
        """
        with launching:
            self._assign(points, count, self.totals)
            self._fill(points, self.totals, features, coords, counts)

    def _assign(self, points: Any, count: int, totals: Any) -> None:
        check_count(count, points, self.capacity)
        _assign(
            *(points, count, self._grid, self.max_points, self.max_voxels, self._table),
            *(self._lowest, self._number, self._voxel, self._rank, self._size, self._begin, self._listed, self._sums),
            totals,
        )

    def _fill(self, points: Any, totals: Any, features: Any, coords: Any, counts: Any) -> None:
        _fill(points, self._grid, totals, self._size, self._begin, self._listed, features, coords, counts)


def voxelize(
    points: Points,
    voxel_size: tuple[float, float, float],
    point_range: Sequence[float],
    max_points: int,
    max_voxels: int,
) -> Voxels:
    """As `kernels.voxel.voxelize`, for points that are borrowed already."""
    device = start()
    n, columns = points.table.shape
    plan = plan_for(
        Voxelize,
        voxel_size=voxel_size,
        point_range=point_range,
        columns=columns,
        max_points=max_points,
        max_voxels=max_voxels,
        capacity=capacity_for(n),
        device=device,
    )
    rows = rows_of(points)
    totals = np.zeros(4, np.int32)
    with launching:
        plan._assign(rows, n, totals)
        voxels, dropped_points, dropped_voxels, outside = (int(number) for number in totals)
        features = np.empty((voxels, max_points, columns), np.float32)
        coords, counts = np.empty((voxels, 3), np.int32), np.empty(voxels, np.int32)
        if voxels:
            plan._fill(rows, totals, features, coords, counts)
    return Voxels(
        *(give_back(part, points) for part in (features, coords, counts)),
        dropped_points,
        dropped_voxels,
        outside,
    )
