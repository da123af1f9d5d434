"""Clustering by a grid of voxels: occupied voxels that are neighbours are of one cluster, with all their points.

The cheap kin of `cluster.py`: no distance is computed, so that points up to two voxels apart may be joined, and points
a hair apart may not be if `connectivity` leaves out diagonal neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, whole
from .cell_columns import CellColumns
from .cell_pairs import Radius, unite
from .cell_table import CellTable, cell_at
from .cluster_labels import label_points
from .device import DEFAULT_DEVICE, resolve_device
from .grid_columns import join_border_voxels, join_own_voxels
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["GridCluster", "grid_cluster"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LARGEST_CELL = wp.constant(1 << 30)
_SMALLEST_SIZE = 1e-8
_AXES = {6: 1, 18: 2, 26: 3}  # by connectivity along how many axes a neighbour may be off


@wp.func
def _neighbour(cell: wp.vec3i, offset: wp.vec3i) -> wp.vec3i:
    """The voxel at an offset; where float32 has no such neighbours any more, the voxel itself."""
    neighbour = cell + offset
    for axis in range(3):
        if offset[axis] != 0 and (wp.abs(cell[axis]) >= _LARGEST_CELL or wp.abs(neighbour[axis]) >= _LARGEST_CELL):
            return cell
    return neighbour


@wp.kernel
def _join_neighbours(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_count: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3i),
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites a voxel with one of its neighbours."""
    o, a = wp.tid()  # pyright: ignore[reportAssignmentType]
    if a >= cell_count[0]:
        return
    b = cell_at(_neighbour(cells[a], offsets[o]), table, cell_of_slot, cells)
    if b >= 0 and b != a:
        unite(parent, a, b)


@dataclass(frozen=True, kw_only=True)
class GridCluster:
    """A plan: workspace to cluster clouds of up to `capacity` points, of which it keeps the `labels`."""

    cell: float
    """Edge of a voxel [m]."""
    min_size: int = 1
    """Points that make a cluster; smaller ones get the label -1."""
    connectivity: int = 26
    """Neighbours of a voxel: 6 that share a face with it, 18 with those that share an edge, 26 with all corners."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (for a CPU, by columns of cells), `shared` (a thread per cell), or `auto`: `in_order` on a CPU, else
    `shared`: equal results."""
    labels: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), int32: clusters numbered by their lowest point from 0, or -1; as many set as points
    were given."""
    cluster_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many clusters there are."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not (self.cell >= _SMALLEST_SIZE and math.isfinite(self.cell)):
            raise ValueError(f"cell must be a positive number of metres (at least {_SMALLEST_SIZE}), not {self.cell}")
        if self.connectivity not in _AXES:
            raise ValueError(f"connectivity must be 6, 18 or 26, not {self.connectivity}")
        for name in ("min_size", "capacity"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        if self.method == "in_order" and device != DEFAULT_DEVICE:
            raise ValueError(f"method 'in_order' needs the device {DEFAULT_DEVICE!r}, not {device!r}")
        sequential = self.method != "shared" and device == DEFAULT_DEVICE
        axes = _AXES[self.connectivity]
        offsets = np.array([d for d in np.ndindex(3, 3, 3) if d > (1, 1, 1)], np.int32) - 1
        offsets = offsets[np.abs(offsets).sum(axis=1) <= axes]
        grid = Radius()
        grid.inverse_side = 1.0 / self.cell

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffers(dtype: type, *names: str) -> None:
            for name in names:
                keep(name, wp.empty(self.capacity, dtype=dtype, device=device))

        keep("_grid", grid)
        keep("_sequential", sequential)
        keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))
        keep("_offsets", wp.array(offsets, dtype=wp.vec3i, device=device))
        buffers(wp.int32, "labels")
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        if sequential:
            by_cell = CellColumns(grid, self.capacity, ordered=False)
            keep("_by_cell", by_cell)
            for name in ("_parent", "_members"):
                keep(name, wp.empty(self.capacity + by_cell.parts, dtype=wp.int32, device=device))
            keep("_masks", wp.empty(self.capacity, dtype=wp.uint64, device=device))
        else:
            keep("_by_cell", CellTable(grid, self.capacity, device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if self._sequential:
            self._launch_in_order(xyz, count)
        elif n == 0:
            self.cluster_count.zero_()
        else:
            by_cell = self._by_cell
            by_cell.launch(xyz, count, self._no_include, 0)
            wp.launch(
                _join_neighbours,
                (self._offsets.shape[0], n),
                inputs=[by_cell.table, by_cell.cell_of_slot, by_cell.cells, by_cell.cell_count, self._offsets],
                outputs=[by_cell.parent],
                device=self.device,
            )
            by_cell.label(n, self.min_size, self.labels, self.cluster_count)

    def _launch_in_order(self, xyz: wp.array, count: wp.array) -> None:
        by_cell, axes = self._by_cell, _AXES[self.connectivity]
        by_cell.launch(xyz, count, self._no_include, 0)
        voxels = [by_cell.ranges, by_cell.columns, by_cell.stacks, axes]
        by_cell.run(join_own_voxels, voxels, [self._masks, self._parent])

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, 1, inputs=inputs, outputs=outputs, device=self.device)

        if by_cell.parts > 1:
            run(join_border_voxels, [*voxels, self._masks], [self._parent])
        run(
            label_points,
            [by_cell.ranges, by_cell.stacks, by_cell.cell_of_point, by_cell.point_count, self.min_size],
            [self._parent, self._members, self.labels, self.cluster_count],
        )


def grid_cluster(points: Any, cell: float, min_size: int = 1, connectivity: int = 26) -> Any:
    """Groups points whose voxels are neighbours.

    A point's voxel is floor(position × (1 / cell)) in float64. The clusters are the connected components of the
    occupied voxels, as of `scipy.ndimage.label`: points up to one voxel apart along each axis are always of one
    cluster with a connectivity of 26, and points two voxels and more apart are joined only by others between them.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        cell: Edge of a voxel [m], > 0.
        min_size: Points that make a cluster.
        connectivity: Neighbours of a voxel: 6 that share a face with it, 18 with those that share an edge, 26 with
            those that share a corner.

    Returns:
        Labels, shape (n,), int32, of the same family and on the same device as `points`: clusters are numbered
        from 0 by the lowest index of a point in them; -1 marks points of smaller components and those that are not
        finite.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `cell` is not positive, `min_size` is below 1, or
            `connectivity` is not 6, 18 or 26.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(
        GridCluster,
        cell=real(cell, "cell"),
        min_size=whole(min_size, "min_size"),
        connectivity=whole(connectivity, "connectivity"),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.labels[:n], borrowed.family)
