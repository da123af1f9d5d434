"""Voxelization, hard and with fixed capacities: the first points of each voxel, as networks for point clouds want them.

First come, first served: voxels are numbered by the lowest index of a point in them, and keep their first points in
the order of the input. A CPU does just that, in one pass over a dense grid, or a hash table where a grid would be too
large, and clears a voxel when it is met first, just before it is written. A GPU gets the same bytes from a stable sort
by cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .backend import uses_taichi
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .voxel_grid import VoxelGrid, cell_number, grid_of, slot_of, voxel_of, write_coords
from .voxel_sort import VoxelSort

__all__ = ["Voxelize", "Voxels", "voxelize"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LEAST_ROOM = 4096  # voxels
_DENSE_CELLS = 1 << 22  # of 4 bytes: larger grids miss the cache more than a hash table does
_LINE = wp.constant(16)  # floats of a cache line, which a CPU clears at once
_line = wp.types.vector(length=16, dtype=wp.float32)
_DROPPED_POINTS, _DROPPED_VOXELS, _OUTSIDE = (wp.constant(i) for i in range(3))


@wp.func
def _write_features(
    xyz: wp.array(dtype=wp.vec3),
    extra: wp.array2d(dtype=wp.float32),
    point: int,
    place: int,
    features: wp.array(dtype=wp.float32),
):
    """Copies a point's columns to a place, counted in points from the start of `features`."""
    columns = extra.shape[1]
    base = place * (columns + 3)
    position = xyz[point]
    features[base] = position[0]
    features[base + 1] = position[1]
    features[base + 2] = position[2]
    for column in range(columns):
        features[base + 3 + column] = extra[point, column]


@wp.func
def _clear(voxel: int, per_voxel: int, features: wp.array(dtype=wp.float32), lines: wp.array(dtype=_line)):
    """Zeroes the features of a voxel."""
    if lines:
        per_line = per_voxel / _LINE
        for k in range(voxel * per_line, (voxel + 1) * per_line):
            lines[k] = _line()
    else:
        for k in range(voxel * per_voxel, (voxel + 1) * per_voxel):
            features[k] = 0.0


@wp.kernel
def _voxelize_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    dense: int,
    max_points: int,
    max_voxels: int,
    # in out: table of voxel numbers, -1 where free; what the launch before has put there, and how many voxels it has
    # filled, or null where the features are new
    table: wp.array(dtype=wp.int32),
    slot_of_voxel: wp.array(dtype=wp.int32),
    cell_of_voxel: wp.array(dtype=wp.int64),
    numbered: wp.array(dtype=wp.int32),
    filled: wp.array(dtype=wp.int32),
    # out: the features twice, the second time in lines, or null where a voxel is not a whole number of them
    features_out: wp.array(dtype=wp.float32),
    lines_out: wp.array(dtype=_line),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    voxel_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread, point after point. Clears a voxel when it is met first, when it is about to be written."""
    per_voxel = max_points * (extra_in.shape[1] + 3)
    room = features_out.shape[0] / per_voxel
    for old in range(numbered[0]):
        table[slot_of_voxel[old]] = -1
    mask = table.shape[0] - 1
    voxels = int(0)
    crowded = int(0)
    outside = int(0)
    row = int(-1)
    before = wp.vec3i(-1, -1, -1)
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        voxel = voxel_of(xyz_in[i], grid)
        if voxel[0] < 0:
            outside += 1
        else:
            # Neighbours in a scan are mostly neighbours in space: often it is the voxel of the point before.
            if ((voxel[0] ^ before[0]) | (voxel[1] ^ before[1]) | (voxel[2] ^ before[2])) != 0:
                before = voxel
                slot = int(0)
                cell = wp.int64(0)
                if dense != 0:
                    slot = (voxel[2] * grid.cells[1] + voxel[1]) * grid.cells[0] + voxel[0]
                    row = table[slot]
                else:
                    cell = cell_number(voxel, grid)
                    slot = slot_of(cell, mask)
                    row = table[slot]
                    while row >= 0 and cell_of_voxel[row] != cell:
                        slot = (slot + 1) & mask
                        row = table[slot]
                if row < 0:
                    row = voxels
                    voxels += 1
                    table[slot] = row
                    slot_of_voxel[row] = slot
                    if dense == 0:
                        cell_of_voxel[row] = cell
                    if row < max_voxels:
                        counts_out[row] = 0
                        write_coords(voxel, row, coords_out)
                        if row < room:
                            _clear(row, per_voxel, features_out, lines_out)
            if row < max_voxels:
                rank = counts_out[row]
                if rank < max_points:
                    counts_out[row] = rank + 1
                    if row < room:
                        _write_features(xyz_in, extra_in, i, row * max_points + rank, features_out)
                else:
                    crowded += 1
    numbered[0] = voxels
    voxels_kept = wp.min(voxels, max_voxels)
    if filled:
        for old in range(voxels_kept, filled[0]):
            _clear(old, per_voxel, features_out, lines_out)
        filled[0] = voxels_kept
    voxel_count_out[0] = voxels_kept
    dropped_out[_DROPPED_POINTS] = crowded
    dropped_out[_DROPPED_VOXELS] = wp.max(voxels - max_voxels, 0)
    dropped_out[_OUTSIDE] = outside


@wp.kernel
def _fill_sorted(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    max_points: int,
    max_voxels: int,
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    segment_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    number_in: wp.array(dtype=wp.int32),
    # out
    features_out: wp.array(dtype=wp.float32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    voxel_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Copies each sorted point to its place: its rank in the cell, in the voxel that the cell's first point numbers."""
    j = wp.tid()
    last = xyz_in.shape[0] - 1
    if j == last:
        voxels = number_in[last]
        voxel_count_out[0] = wp.min(voxels, max_voxels)
        dropped_out[_DROPPED_VOXELS] = wp.max(voxels - max_voxels, 0)
    key = key_in[j]
    if key == grid.total:
        return
    start = start_in[segment_in[j] - 1]
    voxel = number_in[point_in[start]] - 1
    if voxel >= max_voxels:
        return
    rank = j - start
    if rank < max_points:
        _write_features(xyz_in, extra_in, point_in[j], voxel * max_points + rank, features_out)
    else:
        wp.atomic_add(dropped_out, _DROPPED_POINTS, 1)
    if rank == 0:
        write_coords(voxel_of(xyz_in[point_in[j]], grid), voxel, coords_out)
    if j == last or key_in[j + 1] != key:
        counts_out[voxel] = wp.min(rank + 1, max_points)


@dataclass(frozen=True, kw_only=True)
class Voxelize:
    """A plan: workspace to voxelize clouds of up to `capacity` points, of which it keeps `features` and the rest."""

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
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `sort` (parallel), or `auto`: `in_order` on a CPU, else `sort`. Results are equal."""

    features: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels, max_points, columns), float32; zero where a voxel has no point."""
    coords: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels, 3), int32, cell indices z y x."""
    counts: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels,), int32, points kept in each voxel."""
    voxel_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many voxels there are; from there on `features` are zero, and other rows old."""
    dropped: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (3,), int32: points beyond max_points, voxels beyond max_voxels, points outside or not finite."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        grid = grid_of(self.voxel_size, self.point_range)
        for name, least in (("columns", 3), ("max_points", 1), ("max_voxels", 1), ("capacity", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
        size = self.max_voxels * self.max_points * self.columns
        if size >= 1 << 31:
            raise ValueError(
                f"max_voxels × max_points × columns must stay below 2³¹ numbers, not {size}; lower max_voxels"
            )
        if self.method not in ("auto", "in_order", "sort"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'sort', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.empty(shape, dtype=dtype, device=device))

        keep("_grid", grid)
        keep("_sequential", sequential)
        keep("_features", wp.zeros(size, dtype=wp.float32, device=device))
        keep("features", self._features.reshape((self.max_voxels, self.max_points, self.columns)))
        buffer("coords", (self.max_voxels, 3), wp.int32)
        buffer("counts", self.max_voxels, wp.int32)
        keep("voxel_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("dropped", wp.zeros(3, dtype=wp.int32, device=device))
        if sequential:
            dense = grid.total <= _DENSE_CELLS
            slots = int(grid.total) if dense else 2 << (self.capacity - 1).bit_length()
            keep("_dense", int(dense))
            keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
            buffer("_slot_of_voxel", self.capacity, wp.int32)
            buffer("_cell_of_voxel", self.capacity, wp.int64)
            keep("_numbered", wp.zeros(1, dtype=wp.int32, device=device))
            keep("_filled", wp.zeros(1, dtype=wp.int32, device=device))
            keep("_room", [min(self.max_voxels, _LEAST_ROOM)])  # voxels that the function face expects
        else:
            keep("_sorted", VoxelSort(grid, self.capacity, device))
            keep("_outside", self.dropped[int(_OUTSIDE) :])

    def launch(self, xyz: wp.array, count: wp.array, extra: wp.array | None = None) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            extra: The columns after the third, float32, shape (n, columns - 3), or (n,) where it is one column.
        """
        extra = self._checked(xyz, extra)
        if self._sequential:
            self._launch_in_order(xyz, count, extra, self._features, self._filled)
        else:
            self._launch_sort(xyz, count, extra)

    def _checked(self, xyz: wp.array, extra: wp.array | None) -> wp.array:
        """`extra` with two dimensions, after a look at the shapes."""
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if extra is None:
            extra = wp.array(ptr=None, dtype=wp.float32, shape=(n, 0), device=self.device)
        elif extra.ndim == 1:
            extra = wp.array(
                ptr=extra.ptr, dtype=wp.float32, shape=(n, 1), strides=(extra.strides[0], 4), device=extra.device
            )
        if extra.shape != (n, self.columns - 3):
            raise ValueError(f"extra must have shape ({n}, {self.columns - 3}), not {extra.shape}")
        return extra

    def _launch_in_order(
        self, xyz: wp.array, count: wp.array, extra: wp.array, features: wp.array, filled: wp.array | None = None
    ) -> None:
        """Fills `features`, flat, as far as it reaches, and all other outputs."""
        lines = None
        if self.max_points * self.columns % int(_LINE) == 0:
            lines = wp.array(ptr=features.ptr, dtype=_line, shape=features.shape[0] // int(_LINE), device=self.device)
        wp.launch(
            _voxelize_in_order,
            1,
            inputs=[xyz, extra, count, self._grid, self._dense, self.max_points, self.max_voxels],
            outputs=[
                *(self._table, self._slot_of_voxel, self._cell_of_voxel, self._numbered, filled, features, lines),
                *(self.coords, self.counts, self.voxel_count, self.dropped),
            ],
            device=self.device,
        )

    def _launch_into_new(self, xyz: wp.array, count: wp.array, extra: wp.array) -> np.ndarray:
        """In order: as `launch`, but the features are an array of their own, since they are too many to copy."""
        room = min(self._room[0], max(xyz.shape[0], 1))
        while True:
            host = np.empty((room, self.max_points, self.columns), np.float32)
            self._launch_in_order(xyz, count, extra, wp.array(host.reshape(-1), copy=False, device=DEFAULT_DEVICE))
            voxels = int(self.voxel_count.numpy()[0])
            if voxels <= room:
                break
            room = voxels
        # A cloud like this one shall find room enough at the first try.
        self._room[0] = min(self.max_voxels, max(_LEAST_ROOM, voxels + voxels // 8))
        return host[:voxels]

    def _launch_sort(self, xyz: wp.array, count: wp.array, extra: wp.array) -> None:
        n = xyz.shape[0]
        self._features.zero_()
        self.dropped.zero_()
        if n == 0:
            self.voxel_count.zero_()
            return
        by_voxel = self._sorted
        by_voxel.launch(xyz, count, self._outside)
        wp.launch(
            _fill_sorted,
            n,
            inputs=[
                *(xyz, extra, self._grid, self.max_points, self.max_voxels),
                *(by_voxel.key, by_voxel.point, by_voxel.segment[:n], by_voxel.start, by_voxel.number[:n]),
            ],
            outputs=[self._features, self.coords, self.counts, self.voxel_count, self.dropped],
            device=self.device,
        )


@dataclass(frozen=True, eq=False)
class Voxels:
    """The occupied voxels, in order of the lowest index of a point in them; arrays of the input's family."""

    features: Any
    """The columns of the points, shape (V, max_points, C), float32, in the order of the input, then zeros."""
    coords: Any
    """Cell indices z y x, shape (V, 3), int32."""
    counts: Any
    """Points kept in each voxel, shape (V,), int32."""
    dropped_points: int
    """Points left out since their voxel already had `max_points`."""
    dropped_voxels: int
    """Voxels left out, with all their points, since there were already `max_voxels`."""
    outside: int
    """Points left out since they are not finite or not in `point_range`."""

    def __len__(self) -> int:
        return self.counts.shape[0]


def voxelize(
    points: Any,
    voxel_size: float | Sequence[float],
    point_range: Sequence[float],
    max_points: int = 32,
    max_voxels: int = 40_000,
    *,
    backend: str = "warp",
) -> Voxels:
    """Sorts points into voxels, or pillars where a voxel is as high as the range; first come, first served.

    A point's cell is floor((position - minimum) / size) in float32, as in SECOND's and spconv's voxelizers, whose
    results these are, to the bit, as long as the range is a whole number of voxels; else the last voxel is cut short.

    Args:
        points: Positions [m] and other columns, shape (n, C), C ≥ 3, floating; NumPy, torch, Warp or DLPack.
        voxel_size: Edge of a voxel [m], one for all axes or three along x y z.
        point_range: xmin ymin zmin xmax ymax zmax [m]; upper bounds open.
        max_points: Points that a voxel keeps; later ones are dropped and counted.
        max_voxels: Voxels kept; later ones are dropped with their points and counted.
        backend: `warp`, or `taichi`, whose voxels are the same.

    Returns:
        Features, coordinates and counts of the occupied voxels, on the device of `points`.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit, or there is no such backend; the message says which.
        ImportError: The backend is Taichi, which is not installed.
    """
    borrowed = borrow_points(points)
    edges = np.asarray(voxel_size, np.float64).ravel()
    if edges.size not in (1, 3):
        raise ValueError(f"voxel_size must be one number or three, not {edges.size}")
    size = tuple(float(edge) for edge in np.broadcast_to(edges, 3))
    limits = tuple(float(limit) for limit in point_range)
    if len(limits) != 6:
        raise ValueError(f"point_range must have six numbers, xmin ymin zmin xmax ymax zmax, not {len(limits)}")
    if uses_taichi(backend):
        from .taichi import voxel as in_taichi

        return in_taichi.voxelize(borrowed, size, limits, int(max_points), int(max_voxels))
    n, columns = borrowed.table.shape
    plan = plan_for(
        Voxelize,
        voxel_size=size,
        point_range=limits,
        columns=columns,
        max_points=int(max_points),
        max_voxels=int(max_voxels),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count, borrowed.extra)
        voxels = int(plan.voxel_count.numpy()[0])
        features = give(plan.features[:voxels], borrowed.family)
    else:
        host = plan._launch_into_new(borrowed.xyz, count, plan._checked(borrowed.xyz, borrowed.extra))
        voxels = len(host)
        features = adopt(host, borrowed.family)
    dropped_points, dropped_voxels, outside = (int(number) for number in plan.dropped.numpy())
    return Voxels(
        features,
        give(plan.coords[:voxels], borrowed.family),
        give(plan.counts[:voxels], borrowed.family),
        dropped_points,
        dropped_voxels,
        outside,
    )
