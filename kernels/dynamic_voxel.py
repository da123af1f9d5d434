"""Dynamic voxelization: every point keeps its voxel, and every voxel the mean of its points; no capacities.

As in Zhou et al., End-to-end multi-view fusion for 3D object detection in LiDAR point clouds (CoRL 2019): nothing is
dropped for lack of room. Means are summed in float64 in the order of the input, on every device, so their bytes do not
hang on the order in which threads run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .voxel_grid import VoxelGrid, cell_number, grid_of, slot_of, voxel_of, write_coords
from .voxel_sort import VoxelSort

__all__ = ["DynamicVoxelize", "DynamicVoxels", "dynamic_voxelize"]

# Which cell a point falls into, and a sum, must not hang on whether a compiler fuses multiplications and additions.
wp.set_module_options({"fuse_fp": False})


@wp.func
def _column_of(
    xyz: wp.array(dtype=wp.vec3), extra: wp.array2d(dtype=wp.float32), point: int, column: int
) -> wp.float64:
    if column < 3:
        return wp.float64(xyz[point][column])
    return wp.float64(extra[point, column - 3])


@wp.kernel
def _gather_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    # in out: table of voxels, -1 where free, and left so
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    cell_of_row: wp.array(dtype=wp.int64),
    sums: wp.array2d(dtype=wp.float64),
    # out
    voxel_of_point_out: wp.array(dtype=wp.int32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    means_out: wp.array2d(dtype=wp.float32),
    voxel_count_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """One thread, point after point: adds each to its voxel; then the means, voxel after voxel."""
    mask = table.shape[0] - 1
    columns = sums.shape[1]
    voxels = int(0)
    outside = int(0)
    row = int(-1)
    before = wp.vec3i(-1, -1, -1)
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        voxel = voxel_of(xyz_in[i], grid)
        if voxel[0] < 0:
            outside += 1
            voxel_of_point_out[i] = -1
        else:
            # Neighbours in a scan are mostly neighbours in space: often it is the voxel of the point before.
            if ((voxel[0] ^ before[0]) | (voxel[1] ^ before[1]) | (voxel[2] ^ before[2])) != 0:
                before = voxel
                cell = cell_number(voxel, grid)
                slot = slot_of(cell, mask)
                row = table[slot]
                while row >= 0 and cell_of_row[row] != cell:
                    slot = (slot + 1) & mask
                    row = table[slot]
                if row < 0:
                    row = voxels
                    voxels += 1
                    table[slot] = row
                    slot_of_row[row] = slot
                    cell_of_row[row] = cell
                    counts_out[row] = 0
                    write_coords(voxel, row, coords_out)
                    for column in range(columns):
                        sums[row, column] = wp.float64(0.0)
            voxel_of_point_out[i] = row
            counts_out[row] = counts_out[row] + 1
            for column in range(columns):
                sums[row, column] = sums[row, column] + _column_of(xyz_in, extra_in, i, column)
    for v in range(voxels):
        table[slot_of_row[v]] = -1
        for column in range(columns):
            means_out[v, column] = float(sums[v, column] / wp.float64(counts_out[v]))
    voxel_count_out[0] = voxels
    outside_out[0] = outside


@wp.kernel
def _number_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    grid: VoxelGrid,
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    segment_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    number_in: wp.array(dtype=wp.int32),
    # out
    voxel_of_point_out: wp.array(dtype=wp.int32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    voxel_count_out: wp.array(dtype=wp.int32),
):
    """Hands each sorted point the number of its voxel; the last of a voxel tells how many there are."""
    j = wp.tid()
    last = xyz_in.shape[0] - 1
    if j == last:
        voxel_count_out[0] = number_in[last]
    i = point_in[j]
    key = key_in[j]
    if key == grid.total:
        voxel_of_point_out[i] = -1
        return
    start = start_in[segment_in[j] - 1]
    row = number_in[point_in[start]] - 1
    voxel_of_point_out[i] = row
    if j == start:
        write_coords(voxel_of(xyz_in[i], grid), row, coords_out)
    if j == last or key_in[j + 1] != key:
        counts_out[row] = j + 1 - start


@wp.kernel
def _average(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    segment_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    number_in: wp.array(dtype=wp.int32),
    counts_in: wp.array(dtype=wp.int32),
    # out
    means_out: wp.array2d(dtype=wp.float32),
):
    """The mean of one column of a voxel, by the thread of its first point."""
    j, column = wp.tid()  # pyright: ignore[reportAssignmentType]
    if key_in[j] == grid.total or start_in[segment_in[j] - 1] != j:
        return
    row = number_in[point_in[j]] - 1
    total = wp.float64(0.0)
    for k in range(j, j + counts_in[row]):
        total += _column_of(xyz_in, extra_in, point_in[k], column)
    means_out[row, column] = float(total / wp.float64(counts_in[row]))


@dataclass(frozen=True, kw_only=True)
class DynamicVoxelize:
    """A plan: workspace to voxelize clouds of up to `capacity` points; there is room for as many voxels."""

    voxel_size: tuple[float, float, float]
    """Edges of a voxel along x y z [m], > 0."""
    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax [m], upper bounds open."""
    columns: int = 4
    """Columns of a point, ≥ 3: x y z and what else it carries."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `sort` (parallel), or `auto`: `in_order` on a CPU, else `sort`. Results are equal."""

    voxel_of_point: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), int32: the row of each point's voxel, or -1; as many set as points were given."""
    coords: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity, 3), int32, cell indices z y x."""
    counts: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), int32, points of each voxel."""
    means: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity, columns), float32, the mean of each column over the points of a voxel."""
    voxel_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many voxels there are."""
    outside: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32: points outside of the range or not finite."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        grid = grid_of(self.voxel_size, self.point_range)
        for name, least in (("columns", 3), ("capacity", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} must be at least {least}, not {getattr(self, name)}")
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
        buffer("voxel_of_point", self.capacity, wp.int32)
        buffer("coords", (self.capacity, 3), wp.int32)
        buffer("counts", self.capacity, wp.int32)
        buffer("means", (self.capacity, self.columns), wp.float32)
        keep("voxel_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("outside", wp.zeros(1, dtype=wp.int32, device=device))
        if sequential:
            keep("_table", wp.full(2 << (self.capacity - 1).bit_length(), -1, dtype=wp.int32, device=device))
            buffer("_slot_of_row", self.capacity, wp.int32)
            buffer("_cell_of_row", self.capacity, wp.int64)
            buffer("_sums", (self.capacity, self.columns), wp.float64)
        else:
            keep("_sorted", VoxelSort(grid, self.capacity, device))

    def launch(self, xyz: wp.array, count: wp.array, extra: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            extra: The columns after the third, float32, shape (n, columns - 3), possibly of no columns.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if extra.shape != (n, self.columns - 3):
            raise ValueError(f"extra must have shape ({n}, {self.columns - 3}), not {extra.shape}")

        def run(kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        if self._sequential:
            run(
                _gather_in_order,
                1,
                [xyz, extra, count, self._grid],
                [
                    *(self._table, self._slot_of_row, self._cell_of_row, self._sums),
                    *(self.voxel_of_point, self.coords, self.counts, self.means, self.voxel_count, self.outside),
                ],
            )
            return
        self.outside.zero_()
        if n == 0:
            self.voxel_count.zero_()
            return
        by_voxel = self._sorted
        by_voxel.launch(xyz, count, self.outside)
        order = [by_voxel.key, by_voxel.point, by_voxel.segment, by_voxel.start, by_voxel.number]
        run(
            _number_points,
            n,
            [xyz, self._grid, *order],
            [self.voxel_of_point, self.coords, self.counts, self.voxel_count],
        )
        run(_average, (n, self.columns), [xyz, extra, self._grid, *order, self.counts], [self.means])


@dataclass(frozen=True, eq=False)
class DynamicVoxels:
    """The occupied voxels, in order of the lowest index of a point in them; arrays of the input's family."""

    voxel_of_point: Any
    """The row of each point's voxel, shape (n,), int32; -1 for points that are not finite or not in `point_range`."""
    coords: Any
    """Cell indices z y x, shape (V, 3), int32."""
    counts: Any
    """Points of each voxel, shape (V,), int32."""
    means: Any
    """The mean of each column over the points of a voxel, shape (V, C), float32, as float64 sums in order make it."""
    outside: int
    """Points that have no voxel."""

    def __len__(self) -> int:
        return self.counts.shape[0]


def dynamic_voxelize(points: Any, voxel_size: float | Sequence[float], point_range: Sequence[float]) -> DynamicVoxels:
    """Tells the voxel of every point, and the mean of every voxel.

    A point's cell is floor((position - minimum) / size) in float32, as for `voxelize`.

    Args:
        points: Positions [m] and other columns, shape (n, C), C ≥ 3, floating; NumPy, torch, Warp or DLPack.
        voxel_size: Edge of a voxel [m], one for all axes or three along x y z.
        point_range: xmin ymin zmin xmax ymax zmax [m]; upper bounds open.

    Returns:
        The voxel of each point, and coordinates, counts and means of the occupied voxels, on the device of `points`.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    edges = np.asarray(voxel_size, np.float64).ravel()
    if edges.size not in (1, 3):
        raise ValueError(f"voxel_size must be one number or three, not {edges.size}")
    limits = tuple(float(limit) for limit in point_range)
    if len(limits) != 6:
        raise ValueError(f"point_range must have six numbers, xmin ymin zmin xmax ymax zmax, not {len(limits)}")
    n, columns = borrowed.table.shape
    plan = plan_for(
        DynamicVoxelize,
        voxel_size=tuple(float(edge) for edge in np.broadcast_to(edges, 3)),
        point_range=limits,
        columns=columns,
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device), borrowed.extra)
    voxels = int(plan.voxel_count.numpy()[0])
    return DynamicVoxels(
        give(plan.voxel_of_point[:n], borrowed.family),
        give(plan.coords[:voxels], borrowed.family),
        give(plan.counts[:voxels], borrowed.family),
        give(plan.means[:voxels], borrowed.family),
        int(plan.outside.numpy()[0]),
    )
