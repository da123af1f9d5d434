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

from .cell_pairs import Radius, cell_of, differ, find, hash_cell, is_finite, unite
from .cell_table import CellTable, cell_at
from .device import DEFAULT_DEVICE, resolve_device
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
def _cluster_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: Radius,
    offsets: wp.array(dtype=wp.vec3i),
    min_size: int,
    # in out: table of voxels, -1 where free, and left so
    table: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_slot: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """One thread: numbers the voxels, joins them, and hands the numbers of their clusters to the points."""
    mask = table.shape[0] - 1
    voxels = int(0)
    c = int(-1)
    before = wp.vec3i(0, 0, 0)
    n = labels_out.shape[0]
    for i in range(n):
        voxel = int(-1)
        if i < count_in[0] and is_finite(xyz_in[i]):
            cell = cell_of(xyz_in[i], grid)
            # Neighbours in a scan are mostly neighbours in space: often it is the voxel of the point before.
            if c < 0 or differ(cell, before):
                before = cell
                slot = hash_cell(cell) & mask
                c = table[slot]
                while c >= 0 and differ(cells[c], cell):
                    slot = (slot + 1) & mask
                    c = table[slot]
                if c < 0:
                    c = voxels
                    voxels += 1
                    table[slot] = c
                    cells[c] = cell
                    cell_slot[c] = slot
                    parent[c] = c
                    members[c] = 0
            members[c] = members[c] + 1
            voxel = c
        labels_out[i] = voxel
    for a in range(voxels):
        cell = cells[a]
        for o in range(offsets.shape[0]):
            wanted = _neighbour(cell, offsets[o])
            slot = hash_cell(wanted) & mask
            b = table[slot]
            while b >= 0 and differ(cells[b], wanted):
                slot = (slot + 1) & mask
                b = table[slot]
            if b >= 0:
                root_a = find(parent, a)
                root_b = find(parent, b)
                if root_a != root_b:
                    parent[wp.max(root_a, root_b)] = wp.min(root_a, root_b)
    for a in range(voxels):
        table[cell_slot[a]] = -1
        root = parent[parent[a]]  # the parent of a lower voxel is its root by now
        parent[a] = root
        if root != a:
            members[root] = members[root] + members[a]
    clusters = int(0)
    for a in range(voxels):
        root = parent[a]
        if root == a:
            # Of a root nothing but its label is wanted from here on.
            label = int(-1)
            if members[a] >= min_size:
                label = clusters
                clusters += 1
            members[a] = label
        else:
            members[a] = members[root]
    for i in range(n):
        if labels_out[i] >= 0:
            labels_out[i] = members[labels_out[i]]
    cluster_count_out[0] = clusters


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
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""
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
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
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
        keep("_offsets", wp.array(offsets, dtype=wp.vec3i, device=device))
        buffers(wp.int32, "labels")
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        if sequential:
            keep("_table", wp.full(2 << (self.capacity - 1).bit_length(), -1, dtype=wp.int32, device=device))
            buffers(wp.vec3i, "_cells")
            buffers(wp.int32, "_cell_slot", "_parent", "_members")
        else:
            keep("_by_cell", CellTable(grid, self.capacity, device))
            keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))

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
            wp.launch(
                _cluster_in_order,
                1,
                inputs=[xyz, count, self._grid, self._offsets, self.min_size],
                outputs=[
                    *(self._table, self._cells, self._cell_slot, self._parent, self._members),
                    *(self.labels[:n], self.cluster_count),
                ],
                device=self.device,
            )
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
        cell=float(cell),
        min_size=int(min_size),
        connectivity=int(connectivity),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.labels[:n], borrowed.family)
