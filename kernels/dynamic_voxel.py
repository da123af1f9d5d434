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

from .arguments import reals, table
from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .parts import packed_parts, part_start, parts_for
from .plan import capacity_for, plan_for
from .voxel_grid import VoxelGrid, grid_of, voxel_of, write_coords
from .voxel_order import VoxelOrder
from .voxel_sort import VoxelSort

__all__ = ["DynamicVoxelize", "DynamicVoxels", "dynamic_voxelize"]

# Which cell a point falls into, and a sum, must not hang on whether a compiler fuses multiplications and additions.
wp.set_module_options({"fuse_fp": False})

_LEAST_PART = 250_000  # points; fewer take less time than waking a second thread


@wp.func
def _column_of(
    xyz: wp.array(dtype=wp.vec3), extra: wp.array2d(dtype=wp.float32), point: int, column: int
) -> wp.float64:
    if column < 3:
        return wp.float64(xyz[point][column])
    return wp.float64(extra[point, column - 3])


@wp.func_native("""
    const int others = extra_in.shape[1], columns = 3 + others;
    const long long nx = grid.cells[0], ny = grid.cells[1];
    const long long step = xyz_in.strides[0] / 4, step_other = extra_in.strides[0] / 4;
    const float* __restrict xyz = (const float*)xyz_in.data;
    const float* __restrict extra = extra_in.data;
    const bool four_together = columns == 4 && step == step_other && extra == xyz + 3;
    const int* __restrict first_of = first_in.data;
    const auto each_point = [&](const int row, const auto& add) {
        int left = counts_in.data[row];
        for (int run = head_in.data[row]; left > 0; run = next_in.data[run]) {
            for (int point = first_of[run]; point < first_of[run + 1]; ++point) add((long long)point);
            left -= first_of[run + 1] - first_of[run];
        }
    };
    for (int row = first; row < last; ++row) {
        const int all = counts_in.data[row];
        float* __restrict to = means_out.data + (long long)row * columns;
        const double n = (double)all;
        if (four_together) {
            double total[4] = {};
            each_point(row, [&](const long long point) {
                for (int column = 0; column < 4; ++column) total[column] += (double)xyz[step * point + column];
            });
            for (int column = 0; column < 4; ++column) to[column] = (float)(total[column] / n);
        } else
            for (int column = 0; column < columns; ++column) {
                const float* __restrict from = column < 3 ? xyz + column : extra + column - 3;
                const long long stride = column < 3 ? step : step_other;
                double total = 0.0;
                each_point(row, [&](const long long point) { total += (double)from[stride * point]; });
                to[column] = (float)(total / n);
            }
        const long long cell = cell_of_row_in.data[row], rest = cell / nx;
        coords_out.data[3 * row] = (int)(rest / ny);
        coords_out.data[3 * row + 1] = (int)(rest % ny);
        coords_out.data[3 * row + 2] = (int)(cell % nx);
    }
""")
def _average_rows(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    counts_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    next_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    cell_of_row_in: wp.array(dtype=wp.int64),
    first: int,
    last: int,
    # out
    coords_out: wp.array2d(dtype=wp.int32),
    means_out: wp.array2d(dtype=wp.float32),
):
    """Means and coordinates of the voxels first … last − 1."""


@wp.kernel
def _average_in_order(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    counts_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    next_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    cell_of_row_in: wp.array(dtype=wp.int64),
    voxels_in: wp.array(dtype=wp.int32),
    # out
    coords_out: wp.array2d(dtype=wp.int32),
    means_out: wp.array2d(dtype=wp.float32),
):
    """Means and coordinates of one of the parts that the voxels are cut into."""
    _average_rows(
        xyz_in, extra_in, grid, counts_in, head_in, next_in, first_in, cell_of_row_in,
        part_start(voxels_in[0], part, parts), part_start(voxels_in[0], part + 1, parts), coords_out, means_out,
    )  # fmt: skip


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
    """`in_order` (in parts), `sort` (parallel), or `auto`: `in_order` on a CPU, else `sort`. Results are equal."""
    parts: int | None = None
    """How many parts are averaged at once, by the method `in_order`; by default as the threads are worth it."""

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
            if not least <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least {least} and below 2³¹, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "sort"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'sort', not {self.method!r}")
        if self.parts is not None and self.parts < 1:
            raise ValueError(f"parts must be at least 1, not {self.parts}")
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
        buffer("means", (self.capacity, self.columns), wp.float32)
        keep("outside", wp.zeros(1, dtype=wp.int32, device=device))
        if sequential:
            by_voxel = VoxelOrder(grid, self.capacity, self.outside, self.voxel_of_point, device, self.parts)
            keep("_ordered", by_voxel)
            keep("counts", by_voxel.counts)
            keep("voxel_count", by_voxel.voxels[:1])
            given = [by_voxel.counts, by_voxel.head, by_voxel.next, by_voxel.first, by_voxel.cell_of_row]
            parts = self.parts or parts_for(self.capacity, _LEAST_PART)
            average = packed_parts(
                _average_in_order, parts, device, [None, None, grid, *given, by_voxel.voxels], [self.coords, self.means]
            )
            keep("_average", average)
        else:
            keep("_sorted", VoxelSort(grid, self.capacity, device))
            buffer("counts", self.capacity, wp.int32)
            keep("voxel_count", wp.zeros(1, dtype=wp.int32, device=device))

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
            self._ordered.launch(xyz, count)
            self._average(xyz_in=xyz, extra_in=extra)
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
    edges = table(voxel_size, "voxel_size").ravel()
    if edges.size not in (1, 3):
        raise ValueError(f"voxel_size must be one number or three, not {edges.size}")
    limits = reals(point_range, "point_range")
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
