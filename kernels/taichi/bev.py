"""Bird's-eye-view maps in Taichi: the same maps as `kernels.bev` draws in Warp."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti

from ..interop import Points
from ..plan import capacity_for, plan_for
from .device import DEFAULT_TAICHI, check_count, give_back, launching, rows_of, start, workspace

__all__ = ["BevMaps", "bev"]

_FULL = 63  # points of a cell whose density is one
_HIGHEST, _FIRST = range(2)  # the columns of a cell
_LOWEST_BITS = -(2**31)
_NO_POINT = 2**31 - 1


@ti.func
def _in_order(z: ti.f32) -> ti.i32:
    """The bits of a float as an integer in the same order, −0 as 0."""
    bits = ti.bit_cast(z, ti.i32)
    if bits == _LOWEST_BITS:
        bits = 0
    return bits ^ ((bits >> 31) & 0x7FFFFFFF)


@ti.kernel
def _draw(
    # in
    points: ti.types.ndarray(dtype=ti.f32, ndim=2),
    count: ti.i32,
    low: ti.types.vector(3, ti.f32),
    high: ti.types.vector(3, ti.f32),
    cells_per_metre: ti.types.vector(2, ti.f32),
    density: ti.types.ndarray(dtype=ti.f32, ndim=1),
    rows: ti.i32,
    columns: ti.i32,
    maps_are_zero: ti.i32,
    # in out: as `_clear` leaves them
    counts: ti.types.ndarray(dtype=ti.i32, ndim=1),
    cells: ti.types.ndarray(dtype=ti.i32, ndim=2),
    # out
    cell_of_point: ti.types.ndarray(dtype=ti.i32, ndim=1),
    maps: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    # How many points each cell has, and the height of its highest.
    for i in range(count):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        cell = -1
        if x >= low[0] and x < high[0] and y >= low[1] and y < high[1] and z >= low[2] and z < high[2]:
            row = ti.min(ti.i32((x - low[0]) * cells_per_metre[0]), rows - 1)
            column = ti.min(ti.i32((y - low[1]) * cells_per_metre[1]), columns - 1)
            cell = row * columns + column
            ti.atomic_add(counts[cell], 1)
            if cells[cell, _HIGHEST] < _in_order(z):
                ti.atomic_max(cells[cell, _HIGHEST], _in_order(z))
        cell_of_point[i] = cell
    # The first of the points that are as high.
    for i in range(count):
        cell = cell_of_point[i]
        if cell >= 0 and cells[cell, _HIGHEST] == _in_order(points[i, 2]) and cells[cell, _FIRST] > i:
            ti.atomic_min(cells[cell, _FIRST], i)
    for cell in range(rows * columns):
        number = counts[cell]
        if number > 0:
            i = cells[cell, _FIRST]
            maps[0, cell] = points[i, 2]
            intensity = 0.0
            if points.shape[1] > 3:
                intensity = points[i, 3]
            maps[1, cell] = intensity
            maps[2, cell] = density[ti.min(number, _FULL)]
            counts[cell] = 0
            cells[cell, _HIGHEST] = _LOWEST_BITS
            cells[cell, _FIRST] = _NO_POINT
        elif maps_are_zero == 0:
            maps[0, cell] = 0.0
            maps[1, cell] = 0.0
            maps[2, cell] = 0.0


@ti.kernel
def _clear(cells: ti.types.ndarray(dtype=ti.i32, ndim=2)):
    for cell in range(cells.shape[0]):
        cells[cell, _HIGHEST] = _LOWEST_BITS
        cells[cell, _FIRST] = _NO_POINT


@dataclass(frozen=True, kw_only=True)
class BevMaps:
    """A plan: workspace on Taichi's device for clouds of up to `capacity` points; `launch` reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    point_range: tuple[float, ...]
    """xmin ymin zmin xmax ymax zmax [m] of the points drawn, upper bounds open."""
    shape: tuple[int, int]
    """Rows, along x, and columns, along y."""
    device: str = DEFAULT_TAICHI
    """Taichi's device, as `start` takes it."""

    maps: Any = field(init=False, repr=False, compare=False)
    """Height [m], intensity and density per cell, ti.Ndarray, shape (3, rows × columns), float32, row by row; zero
    where there is no point."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        low, high = self.point_range[:3], self.point_range[3:]
        if len(self.point_range) != 6 or not all(
            a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)
        ):
            raise ValueError(
                f"point_range must be xmin ymin zmin xmax ymax zmax, finite, with min < max, not {self.point_range}"
            )
        if len(self.shape) != 2 or min(self.shape) < 1:
            raise ValueError(f"shape must be rows and columns, at least 1 each, not {self.shape}")
        rows, columns = self.shape
        if 3 * rows * columns > 2**31 - 1:
            raise ValueError(f"shape {self.shape} has more cells than 2³¹ / 3")
        start(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_low", ti.Vector(low, dt=ti.f32))
        keep("_high", ti.Vector(high, dt=ti.f32))
        scale = (rows / (high[0] - low[0]), columns / (high[1] - low[1]))
        keep("_cells_per_metre", ti.Vector(scale, dt=ti.f32))
        with launching:
            keep("_counts", workspace(rows * columns, ti.i32))
            keep("_cells", workspace((rows * columns, 2), ti.i32))
            _clear(self._cells)
            density = workspace(_FULL + 1, ti.f32)
            density.from_numpy((np.log1p(np.arange(_FULL + 1)) / np.log(_FULL + 1)).astype(np.float32))
            keep("_density", density)
            keep("_cell_of_point", workspace(self.capacity, ti.i32))
            keep("maps", workspace((3, rows * columns), ti.f32))

    def launch(self, points: Any, count: int) -> None:
        """Fills `maps` from the first `count` points.

        Args:
            points: ti.Ndarray or contiguous NumPy array, float32, shape (n, 3 or more), count ≤ n ≤ capacity: x y z [m]
                and intensity, which is zero where there are only three columns.
            count: How many points there are.
        """
        self._draw_into(self.maps, points, count, maps_are_zero=False)

    def _draw_into(self, maps: Any, points: Any, count: int, maps_are_zero: bool) -> None:
        check_count(count, points, self.capacity)
        with launching:
            _draw(
                *(points, count, self._low, self._high, self._cells_per_metre, self._density),
                *(*self.shape, int(maps_are_zero), self._counts, self._cells, self._cell_of_point, maps),
            )


def bev(points: Points, point_range: Sequence[float], shape: Sequence[int]) -> Any:
    """As `kernels.bev.bev`, for points that are borrowed already."""
    device = start()
    plan = plan_for(
        BevMaps,
        capacity=capacity_for(len(points)),
        point_range=point_range,
        shape=shape,
        device=device,
    )
    maps = np.zeros((3, *plan.shape), np.float32)
    # On a CPU the kernel works on this very memory, and zeros that are never written cost nothing.
    plan._draw_into(maps.reshape(3, -1), rows_of(points), len(points), maps_are_zero=device == "taichi:cpu")
    return give_back(maps, points)
