"""Bird's-eye-view maps of a cloud: height, intensity and density per cell of a grid on the ground.

The maps of MV3D (Chen et al., CVPR 2017) and Complex-YOLO (Simony et al., 2018), as one picture of three channels.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .backend import uses_taichi
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["BevMaps", "bev"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_HEIGHT, _INTENSITY, _DENSITY = (wp.constant(i) for i in range(3))
_HIGHEST, _COUNT = (wp.constant(i) for i in range(2))  # the columns of a cell
_LOW_WORD = wp.constant(wp.int64(0x7FFFFFFF))
_SIGN_BIAS = wp.constant(wp.int64(1 << 31))
_FULL = wp.constant(63)  # points of a cell whose density is one


@wp.struct
class _Grid:
    low: wp.vec3
    high: wp.vec3
    cells_per_metre: wp.vec2
    rows: int
    columns: int


@wp.func
def _cell_of(p: wp.vec3, grid: _Grid) -> int:
    """The cell of a point, or -1. Written so that NaN is outside."""
    low = grid.low
    high = grid.high
    if not (
        p[0] >= low[0] and p[0] < high[0] and p[1] >= low[1] and p[1] < high[1] and p[2] >= low[2] and p[2] < high[2]
    ):
        return -1
    row = wp.min(int((p[0] - low[0]) * grid.cells_per_metre[0]), grid.rows - 1)
    column = wp.min(int((p[1] - low[1]) * grid.cells_per_metre[1]), grid.columns - 1)
    return row * grid.columns + column


@wp.kernel
def _draw_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    grid: _Grid,
    density_in: wp.array(dtype=wp.float32),
    # in out: the density map as integers, zero, for now one and the place among those seen of each cell
    place: wp.array(dtype=wp.int32),
    # out: of each cell seen its number, and its height, intensity and count
    seen: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.vec3),
    # in out: zero
    maps: wp.array2d(dtype=wp.float32),
):
    """One thread: collects the cells that are seen side by side, and draws them in the end."""
    cells_seen = int(0)
    before = int(-1)
    at = int(0)
    value = wp.vec3(0.0, 0.0, 0.0)
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        p = xyz_in[i]
        cell = _cell_of(p, grid)
        if cell >= 0:
            # Neighbours in a scan are mostly neighbours in space: often it is the cell of the point before.
            if cell != before:
                if before >= 0:
                    values[at] = value
                before = cell
                at = place[cell] - 1
                if at < 0:
                    at = cells_seen
                    cells_seen += 1
                    place[cell] = cells_seen
                    seen[at] = cell
                    value = wp.vec3(-wp.inf, 0.0, 0.0)
                else:
                    value = values[at]
            value[2] = value[2] + 1.0
            if p[2] > value[0]:
                value[0] = p[2]
                if intensity_in:
                    value[1] = intensity_in[i]
    if before >= 0:
        values[at] = value
    for k in range(cells_seen):
        cell = seen[k]
        value = values[k]
        maps[_HEIGHT, cell] = value[0]
        maps[_INTENSITY, cell] = value[1]
        maps[_DENSITY, cell] = density_in[int(wp.min(value[2], float(_FULL)))]


@wp.kernel
def _raise_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: _Grid,
    # in out: zero
    cells: wp.array2d(dtype=wp.int64),
    # out
    cell_out: wp.array(dtype=wp.int32),
):
    """Per cell its highest point, the first of equals, and how many it has; the cell of each point that may be one."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    p = xyz_in[i]
    cell = _cell_of(p, grid)
    cell_out[i] = cell
    if cell < 0:
        return
    # The bits of a float as an integer in the same order; adding zero makes −0 equal 0.
    bits = wp.cast(p[2] + 0.0, wp.int32)
    order = wp.int64(bits ^ ((bits >> 31) & 0x7FFFFFFF)) + _SIGN_BIAS
    key = (order << wp.int64(31)) | (_LOW_WORD - wp.int64(i))
    wp.atomic_add(cells, cell, _COUNT, wp.int64(1))
    higher = wp.atomic_max(cells, cell, _HIGHEST, key) < key
    cell_out[i] = wp.where(higher, cell, -1)


@wp.kernel
def _draw_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    cell_in: wp.array(dtype=wp.int32),
    density_in: wp.array(dtype=wp.float32),
    # in out: left zero
    cells: wp.array2d(dtype=wp.int64),
    # in out: zero
    maps: wp.array2d(dtype=wp.float32),
):
    """The highest point of each cell writes it, and clears the workspace."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    cell = cell_in[i]
    if cell < 0:
        return
    if (cells[cell, _HIGHEST] & _LOW_WORD) != _LOW_WORD - wp.int64(i):
        return
    maps[_HEIGHT, cell] = xyz_in[i][2]
    if intensity_in:
        maps[_INTENSITY, cell] = intensity_in[i]
    maps[_DENSITY, cell] = density_in[wp.min(int(cells[cell, _COUNT]), _FULL)]
    cells[cell, _HIGHEST] = wp.int64(0)
    cells[cell, _COUNT] = wp.int64(0)


@dataclass(frozen=True, kw_only=True)
class BevMaps:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    point_range: tuple[float, ...]
    """xmin ymin zmin xmax ymax zmax [m] of the points drawn, upper bounds open."""
    shape: tuple[int, int]
    """Rows, along x, and columns, along y."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""

    maps: wp.array = field(init=False, repr=False)
    """Height [m], intensity and density per cell, shape (3, rows, columns), float32; zero where there is no point."""

    def __post_init__(self):
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1 point, not {self.capacity}")
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
        if rows * columns > 2**31 - 1:
            raise ValueError(f"shape {self.shape} has more cells than 2³¹ − 1")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
        grid = _Grid()
        grid.low, grid.high = wp.vec3(*low), wp.vec3(*high)
        grid.cells_per_metre = wp.vec2(rows / (high[0] - low[0]), columns / (high[1] - low[1]))
        grid.rows, grid.columns = rows, columns

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_grid", grid)
        keep("_sequential", sequential)
        density = np.log1p(np.arange(_FULL + 1)) / np.log(_FULL + 1)
        keep("_density", wp.array(density, dtype=wp.float32, device=device))
        if sequential:
            most = min(self.capacity, rows * columns)
            keep("_seen", wp.empty(most, dtype=wp.int32, device=device))
            keep("_values", wp.empty(most, dtype=wp.vec3, device=device))
        else:
            keep("_cells", wp.zeros((rows * columns, 2), dtype=wp.int64, device=device))
            keep("_cell", wp.zeros(self.capacity, dtype=wp.int32, device=device))
        keep("maps", wp.zeros((3, rows, columns), dtype=wp.float32, device=device))
        keep("_flat", self.maps.reshape((3, rows * columns)))

    def launch(self, xyz: wp.array, intensity: wp.array | None, count: wp.array) -> None:
        """Fills `maps` from the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            intensity: Shape (n,), float32; None where there are none, which gives zeros.
            count: Shape (1,), int32.
        """
        self.maps.zero_()
        self._draw_into(self._flat, xyz, intensity, count)

    def _draw_into(self, maps: wp.array, xyz: wp.array, intensity: wp.array | None, count: wp.array) -> None:
        """Draws on maps that are zero, shape (3, cells)."""
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if self._sequential:
            cells = maps.shape[1]
            place = wp.array(ptr=maps.ptr + 8 * cells, dtype=wp.int32, shape=cells, device=self.device)
            wp.launch(
                _draw_in_order,
                1,
                inputs=[xyz, intensity, count, self._grid, self._density],
                outputs=[place, self._seen, self._values, maps],
                device=self.device,
            )
            return
        wp.launch(
            _raise_cells,
            n,
            inputs=[xyz, count, self._grid, self._cells],
            outputs=[self._cell],
            device=self.device,
        )
        wp.launch(
            _draw_cells,
            n,
            inputs=[xyz, intensity, count, self._cell, self._density, self._cells, maps],
            device=self.device,
        )


def bev(points: Any, point_range: Sequence[float], shape: Sequence[int], *, backend: str = "warp") -> Any:
    """Draws a cloud from above.

    Row 0 is at xmin and rows rise with x; column 0 is at ymin and columns rise with y. In a vehicle's frame, `maps[:,
    ::-1, ::-1]` looks as a map does, forward up and left on the left.

    Args:
        points: x y z [m] and intensity in the fourth column, shape (n, 3 or more), floating; without a fourth column
            the intensity is zero.
        point_range: xmin ymin zmin xmax ymax zmax [m] of the points drawn, upper bounds open.
        shape: Rows and columns.
        backend: `warp`, or `taichi`, whose maps are the same.

    Returns:
        Three maps, shape (3, rows, columns), float32, of the family and on the device of `points`: z of the highest
        point of each cell [m]; that point's intensity, of the first where several are as high; and the density
        min(1, log(1 + n) / log(64)) of n points. Empty cells are zero in all three: the density tells them.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit, or there is no such backend; the message says which.
        ImportError: The backend is Taichi, which is not installed.
    """
    borrowed = borrow_points(points)
    if uses_taichi(backend):
        from .taichi import bev as in_taichi

        return in_taichi.bev(borrowed, point_range, shape)
    plan = plan_for(
        BevMaps,
        capacity=capacity_for(len(borrowed)),
        point_range=tuple(float(limit) for limit in point_range),
        shape=tuple(int(length) for length in shape),
        device=borrowed.device,
    )
    count = count_on(len(borrowed), borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, borrowed.intensity, count)
        return give(plan.maps, borrowed.family)
    # Straight onto an array of its own: zeros that are never written cost nothing.
    host = np.zeros((3, *plan.shape), np.float32)
    flat = wp.array(host.reshape(3, -1), dtype=wp.float32, copy=False, device=DEFAULT_DEVICE)
    plan._draw_into(flat, borrowed.xyz, borrowed.intensity, count)
    return adopt(host, borrowed.family)
