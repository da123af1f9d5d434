"""The detection head's input: a grid of pillars seen from above, a few hand-made channels for each.

A pillar is described by what transfers between sensors: which height slices hold points, where in the cell they
lie and how high they reach. Intensity, the number of points and the position in the grid are left out on purpose.
All sums are integers, so the bytes do not depend on the order of the points or of the threads: on a CPU each thread
sums and draws rows of its own, on a GPU all share all cells.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, reals
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .parts import parts_for, run_parts
from .pillar_rows import PillarSpec, describe_points, draw_rows
from .plan import capacity_for, plan_for

__all__ = ["PILLAR_SLICES", "SLICE_HEIGHT", "PillarGrid", "pillar_channels", "pillarize"]

PILLAR_SLICES = 15
"""Binary channels: below the ground, thirteen slices of `SLICE_HEIGHT` from the ground up, all above them."""

SLICE_HEIGHT = 0.25
"""Height of a slice [m]."""

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LEAST_PART = 30_000  # points; fewer are drawn sooner than a second thread is woken
# A cell's sums are one row, one cache line, of 64-bit numbers: points, sums of z above the range [mm] and of dx, dy
# from the cell's corner [1/4096 cell], slice bits, highest and lowest of these z, and the slice bits that the grid
# shows now.
_POINTS, _Z, _DX, _DY, _BITS, _HIGH, _LOW, _SHOWN, _ROW = (wp.constant(i) for i in (0, 1, 2, 3, 4, 5, 6, 7, 8))
_CEILING = wp.constant(wp.int64(2**31 - 1))
_SLICES = wp.constant(PILLAR_SLICES)
_LAST_SLICE = wp.constant(PILLAR_SLICES - 1)


def pillar_channels() -> tuple[str, ...]:
    """The names of the channels in order: the slices, then means of dx, dy, z, then highest and lowest z."""
    slices = [f"z{(i - 1) * SLICE_HEIGHT:.2f}" for i in range(1, PILLAR_SLICES)]
    return ("below", *slices, "mean_dx", "mean_dy", "mean_z", "z_max", "z_min")


@wp.kernel
def _clear_pillars(
    # in
    shown_in: wp.array(dtype=wp.uint32),
    sums_in: wp.array2d(dtype=wp.int64),
    places_in: wp.array(dtype=wp.int32),
    # in out
    grid: wp.array3d(dtype=wp.float32),
):
    """Zeroes what the launch before wrote, and nothing else; 32 neighbouring cells a thread."""
    i = wp.tid()
    occupied = shown_in[i]
    if occupied == wp.uint32(0):
        return
    for k in range(32):
        if (occupied >> wp.uint32(k)) & wp.uint32(1) != wp.uint32(0):
            cell = i * 32 + k
            row = cell // grid.shape[2]
            column = cell - row * grid.shape[2]
            bits = sums_in[cell, _SHOWN]
            for s in range(_SLICES):
                if (int(bits) >> s) & 1 != 0 and places_in[s] >= 0:
                    grid[places_in[s], row, column] = 0.0
            for channel in range(_SLICES, _SLICES + 5):
                if places_in[channel] >= 0:
                    grid[places_in[channel], row, column] = 0.0


@wp.kernel
def _sum_pillars(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    low: wp.vec3,
    high: wp.vec3,
    inverse_cell: float,
    inverse_slice: float,
    columns: int,
    # in out
    sums: wp.array2d(dtype=wp.int64),
    occupied: wp.array(dtype=wp.uint32),
):
    """Adds each point to its cell; the first in a cell marks the cell as occupied."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    point = xyz_in[i]
    x = point[0]
    y = point[1]
    z = point[2] + sensor_height_in[0]
    # NaN fails every comparison, so it is outside too.
    inside = x >= low[0] and x < high[0] and y >= low[1] and y < high[1] and z >= low[2] and z < high[2]
    if not inside:
        return
    u = (x - low[0]) * inverse_cell
    v = (y - low[1]) * inverse_cell
    column = wp.min(int(u), columns - 1)
    row = wp.min(int(v), sums.shape[0] // columns - 1)
    cell = row * columns + column
    above = wp.int64(int((z - low[2]) * 1000.0))
    level = wp.where(z >= 0.0, wp.min(int(z * inverse_slice) + 1, _LAST_SLICE), 0)
    if wp.atomic_add(sums, cell, _POINTS, wp.int64(1)) == wp.int64(0):
        wp.atomic_or(occupied, cell >> 5, wp.uint32(1) << wp.uint32(cell & 31))
    wp.atomic_add(sums, cell, _Z, above)
    wp.atomic_add(sums, cell, _DX, wp.int64(int((u - float(column)) * 4096.0)))
    wp.atomic_add(sums, cell, _DY, wp.int64(int((v - float(row)) * 4096.0)))
    # These only ever grow, or fall: most points change nothing, and a plain read shows it.
    bit = wp.int64(1 << level)
    if sums[cell, _BITS] & bit == wp.int64(0):
        wp.atomic_or(sums, cell, _BITS, bit)
    if sums[cell, _HIGH] < above:
        wp.atomic_max(sums, cell, _HIGH, above)
    if sums[cell, _LOW] > above:
        wp.atomic_min(sums, cell, _LOW, above)


@wp.func
def _put(grid: wp.array3d(dtype=wp.float32), channel: int, row: int, column: int, value: float):
    if channel >= 0:
        grid[channel, row, column] = value


@wp.kernel
def _write_pillars(
    # in
    lowest: float,
    places_in: wp.array(dtype=wp.int32),
    # in out
    occupied: wp.array(dtype=wp.uint32),
    sums: wp.array2d(dtype=wp.int64),
    grid: wp.array3d(dtype=wp.float32),
    # out
    shown_out: wp.array(dtype=wp.uint32),
):
    """Writes the channels of the occupied cells, and frees their rows of sums for the next launch.

    A thread takes 32 neighbouring cells, so that it writes along the rows of the grid, not across its channels.
    """
    i = wp.tid()
    there = occupied[i]
    shown_out[i] = there
    occupied[i] = wp.uint32(0)
    if there == wp.uint32(0):
        return
    for k in range(32):
        if (there >> wp.uint32(k)) & wp.uint32(1) != wp.uint32(0):
            cell = i * 32 + k
            row = cell // grid.shape[2]
            column = cell - row * grid.shape[2]
            bits = sums[cell, _BITS]
            for s in range(_SLICES):
                if (int(bits) >> s) & 1 != 0 and places_in[s] >= 0:
                    grid[places_in[s], row, column] = 1.0
            share = 1.0 / float(sums[cell, _POINTS])
            _put(grid, places_in[_SLICES], row, column, float(sums[cell, _DX]) * share / 4096.0 - 0.5)
            _put(grid, places_in[_SLICES + 1], row, column, float(sums[cell, _DY]) * share / 4096.0 - 0.5)
            _put(grid, places_in[_SLICES + 2], row, column, float(sums[cell, _Z]) * share / 1000.0 + lowest)
            _put(grid, places_in[_SLICES + 3], row, column, float(sums[cell, _HIGH]) / 1000.0 + lowest)
            _put(grid, places_in[_SLICES + 4], row, column, float(sums[cell, _LOW]) / 1000.0 + lowest)
            for field in range(_HIGH + 1):
                sums[cell, field] = wp.int64(0)
            sums[cell, _LOW] = _CEILING
            sums[cell, _SHOWN] = bits


@dataclass(frozen=True, kw_only=True)
class PillarGrid:
    """A plan: the grid of one cloud of up to `capacity` points; only the cells that held points are cleared.

    Attributes:
        grid: The network's input, shape (1, C, H, W), float32: `channels`, rows along y, columns along x. Offsets in
            cells from the cell's centre, heights [m] above the ground.
    """

    point_range: tuple[float, float, float, float, float, float] = (-60.0, -60.0, -2.0, 60.0, 60.0, 6.0)
    """xmin ymin zmin xmax ymax zmax [m], upper bounds open; z is the height above the ground."""
    cell: float = 0.25
    """Edge of a cell [m]."""
    channels: tuple[str, ...] = pillar_channels()
    """Which of `pillar_channels` are drawn, in their order; the others cost nothing."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`rows` (by parts of the grid), `shared` (parallel), or `auto`: `rows` on a CPU, else `shared`: equal results."""
    parts: int | None = None
    """How many parts of the grid are drawn at once, by the method `rows`; by default as the threads are worth it."""

    def __post_init__(self):
        if len(self.point_range) != 6:
            raise ValueError(f"point_range must be xmin ymin zmin xmax ymax zmax, not {self.point_range}")
        low, high = self.point_range[:3], self.point_range[3:]
        if not (self.cell > 0 and math.isfinite(self.cell)):
            raise ValueError(f"cell must be > 0 m and finite, not {self.cell}")
        if not all(a < b and math.isfinite(b - a) for a, b in zip(low, high, strict=True)):
            raise ValueError(
                f"point_range must be xmin ymin zmin xmax ymax zmax, finite, with min < max, not {self.point_range}"
            )
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if (high[2] - low[2]) * 1000.0 >= 2**31:
            raise ValueError(f"point_range must be less than 2³¹ mm high, not {low[2]} … {high[2]} m")
        every = pillar_channels()
        if not self.channels or self.channels != tuple(name for name in every if name in self.channels):
            raise ValueError(f"channels must be some of {', '.join(every)}, in that order, not {self.channels}")
        if self.method not in ("auto", "rows", "shared"):
            raise ValueError(f"method must be 'auto', 'rows' or 'shared', not {self.method!r}")
        if self.parts is not None and self.parts < 1:
            raise ValueError(f"parts must be at least 1, not {self.parts}")
        columns, rows = (round((high[axis] - low[axis]) / self.cell) for axis in (0, 1))
        words = (columns + 31) // 32
        if min(columns, rows) < 1 or rows * words * 32 >= 2**31:
            raise ValueError(
                f"point_range must be 1 to 2³¹ cells of {self.cell} m, not {rows} rows of {columns}; change cell"
            )
        device = resolve_device(self.device)
        by_rows = self.method == "rows" or (self.method == "auto" and device == DEFAULT_DEVICE)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        keep("_by_rows", by_rows)
        buffer("grid", (1, len(self.channels), rows, columns), wp.float32)
        keep("_grid", self.grid[0])
        buffer("_height", 1, wp.float32)
        if by_rows:
            spec = PillarSpec()
            spec.low, spec.high = wp.vec3(*low), wp.vec3(*high)
            spec.inverse_cell, spec.inverse_slice = 1.0 / self.cell, 1.0 / SLICE_HEIGHT
            spec.rows, spec.columns, spec.words, spec.slices = rows, columns, words, PILLAR_SLICES
            spec.channels = sum(1 << k for k, name in enumerate(every) if name in self.channels)
            keep("_spec", spec)
            keep("_parts", self.parts or parts_for(self.capacity, _LEAST_PART))
            keep("_described", [wp.empty(self.capacity, dtype=wp.int32, device=device) for _ in range(3)])
            buffer("_sums", rows * words * 32 * int(_ROW), wp.int64)
            buffer("_occupied", rows * words, wp.uint32)
            buffer("_shown", rows * words, wp.uint32)
            buffer("_shown_slices", rows * words * 32, wp.uint32)
            return
        place = {name: k for k, name in enumerate(self.channels)}
        keep("_places", wp.array([place.get(name, -1) for name in every], dtype=wp.int32, device=device))
        cells = columns * rows
        buffer("_sums", (cells, int(_ROW)), wp.int64)
        self._sums[:, int(_LOW)].fill_(2**31 - 1)
        buffer("_occupied", (cells + 31) // 32, wp.uint32)
        buffer("_shown", (cells + 31) // 32, wp.uint32)

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """The shape of `grid`: (1, C, H, W)."""
        return self.grid.shape

    def launch(self, xyz: wp.array, count: wp.array, sensor_height: float | wp.array) -> None:
        """Fills `grid` from the first `count[0]` of the points; points outside the range or not finite are left out.

        Args:
            xyz: Positions in the sensor's frame [m], z up, shape (n,), n ≤ capacity, dtype vec3, possibly strided.
            count: Number of points, shape (1,), int32, on the device.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
        """
        if xyz.shape[0] > self.capacity:
            raise ValueError(f"xyz has {xyz.shape[0]} points, more than the plan's capacity of {self.capacity}")
        height = sensor_height
        if not isinstance(height, wp.array):
            height = self._height
            height.fill_(float(sensor_height))
        if self._by_rows:
            self._draw(xyz, count, height, self.grid, [self._shown, self._shown_slices])
            return
        words = self._occupied.shape[0]
        device = self.grid.device
        wp.launch(
            _clear_pillars, words, inputs=[self._shown, self._sums, self._places], outputs=[self._grid], device=device
        )
        wp.launch(
            _sum_pillars,
            xyz.shape[0],
            inputs=[
                xyz,
                count,
                height,
                wp.vec3(*self.point_range[:3]),
                wp.vec3(*self.point_range[3:]),
                1.0 / self.cell,
                1.0 / SLICE_HEIGHT,
                self.grid.shape[3],
            ],
            outputs=[self._sums, self._occupied],
            device=device,
        )
        wp.launch(
            _write_pillars,
            words,
            inputs=[self.point_range[2], self._places],
            outputs=[self._occupied, self._sums, self._grid, self._shown],
            device=device,
        )

    def _draw(
        self, xyz: wp.array, count: wp.array, height: wp.array, grid: wp.array, shown: list[wp.array | None]
    ) -> None:
        """Draws rows by parts: on all of `grid`, or where it differs from what is `shown`."""
        run_parts(describe_points, self._parts, self.device, [xyz, count, height, self._spec], self._described)
        run_parts(
            draw_rows,
            self._parts,
            self.device,
            [*self._described, count, xyz.shape[0], self._spec],
            [self._sums, self._occupied, *shown, grid.flatten()],
        )


def pillarize(
    points: Any,
    *,
    sensor_height: float,
    point_range: tuple[float, float, float, float, float, float] = (-60.0, -60.0, -2.0, 60.0, 60.0, 6.0),
    cell: float = 0.25,
) -> Any:
    """The pillar channels of a cloud.

    Args:
        points: Positions in the sensor's frame [m], shape (n, 3 or more), any array family.
        sensor_height: Height of the sensor above the ground [m].
        point_range: xmin ymin zmin xmax ymax zmax [m], upper bounds open; z is the height above the ground.
        cell: Edge of a cell [m].

    Returns:
        Shape (C, H, W), float32, of the family of `points`: channels of `pillar_channels`, rows along y, columns
        along x.
    """
    height = real(sensor_height, "sensor_height")
    if not math.isfinite(height):
        raise ValueError(f"sensor_height must be a finite number of metres, not {sensor_height}")
    borrowed = borrow_points(points)
    plan = plan_for(
        PillarGrid,
        point_range=reals(point_range, "point_range"),
        cell=real(cell, "cell"),
        capacity=capacity_for(len(borrowed)),
        device=borrowed.device,
    )
    count = count_on(len(borrowed), borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count, height)
        return give(plan._grid, borrowed.family)
    # Straight onto an array of its own: the grid is far larger than the cloud.
    host = np.empty(plan.shape[1:], np.float32)
    plan._height.fill_(height)
    grid = wp.array(host, dtype=wp.float32, copy=False, device=DEFAULT_DEVICE)
    plan._draw(borrowed.xyz, count, plan._height, grid, [None, None])
    return adopt(host, borrowed.family)
