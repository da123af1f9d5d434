"""Euclidean clustering, exact: points are of one cluster where a chain of steps no longer than the radius joins them.

Space is cut into cells of side radius / √3, so that a cell is one component by itself and only pairs of cells are
left to join: those at most two cells apart, by the first pair of points found within the radius. A CPU walks through
columns of cells with their neighbours; a GPU tries all pairs of cells at once. The labels are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, whole
from .backend import uses_taichi
from .cell_columns import CellColumns
from .cell_pairs import Radius, find, join_levels, radius_of, touch, unite
from .cell_table import CellTable, cell_at
from .cluster_columns import JoinedColumns
from .cluster_labels import label_points
from .cluster_levels import join_levels_in_order
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .parts import parts_for
from .plan import capacity_for, plan_for
from .threads import PackedLaunch

__all__ = ["EuclideanCluster", "cluster"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_SMALLEST_RADIUS = 1e-8
_LEAST_GROWTH = 1e-5
_LEAST_PART = 30_000  # points for which a thread of their own is worth its while


@wp.kernel
def _join_cells(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    cell_count: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3i),
    radius: Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites a cell with one of its neighbours, if they touch."""
    o, a = wp.tid()  # pyright: ignore[reportAssignmentType]
    if a >= cell_count[0]:
        return
    wanted = cells[a] + offsets[o]
    b = cell_at(wanted, table, cell_of_slot, cells)
    if b >= 0 and find(parent, a) != find(parent, b):
        a_begin = cell_begin[a]
        b_begin = cell_begin[b]
        if touch(points, a_begin, a_begin + cell_size[a], b_begin, b_begin + cell_size[b], radius):
            unite(parent, a, b)


@wp.kernel
def _join_levels(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_end: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    cell_count: wp.array(dtype=wp.int32),
    radius: Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells of different levels that touch."""
    a = wp.tid()
    if a < cell_count[0]:
        join_levels(a, table, cell_of_slot, cells, cell_begin, cell_end, points, radius, parent)


@dataclass(frozen=True, kw_only=True)
class EuclideanCluster:
    """A plan: workspace to cluster clouds of up to `capacity` points, of which it keeps the `labels`."""

    radius: float
    """Longest step [m] that joins two points."""
    radius_per_metre: float = 0.0
    """By how much it grows per metre of range, 0 or 1e-5 … 1: two points then go by the one nearer to the origin."""
    min_size: int = 1
    """Points that make a cluster; smaller ones get the label -1."""
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
        if not (self.radius >= _SMALLEST_RADIUS and math.isfinite(self.radius)):
            raise ValueError(
                f"radius must be a positive number of metres (at least {_SMALLEST_RADIUS}), not {self.radius}"
            )
        if self.radius_per_metre != 0 and not _LEAST_GROWTH <= self.radius_per_metre <= 1:
            raise ValueError(
                f"radius_per_metre must be 0, or from {_LEAST_GROWTH} to 1 metre per metre of range, "
                f"not {self.radius_per_metre}"
            )
        for name in ("min_size", "capacity"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        if self.method == "in_order" and device != DEFAULT_DEVICE:
            raise ValueError(f"method 'in_order' needs the device {DEFAULT_DEVICE!r}, not {device!r}")
        sequential = self.method != "shared" and device == DEFAULT_DEVICE

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffers(dtype: type, *names: str) -> None:
            for name in names:
                keep(name, wp.empty(self.capacity, dtype=dtype, device=device))

        keep("_radius", radius_of(self.radius, self.radius_per_metre))
        keep("_sequential", sequential)
        keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))
        buffers(wp.int32, "labels")
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        forward = [d for d in np.ndindex(5, 5, 5) if d > (2, 2, 2)]
        offsets = np.array(sorted(forward, key=lambda d: sum((i - 2) ** 2 for i in d)), np.int32) - 2
        if sequential:
            parts = parts_for(self.capacity, _LEAST_PART)
            by_cell = CellColumns(self._radius, self.capacity, parts, ordered=False)
            keep("_by_cell", by_cell)
            columns = [by_cell.ranges, by_cell.columns, by_cell.stacks, by_cell.points]
            joined = JoinedColumns(by_cell, *columns, self._radius, by_cell.bits)
            keep("_joined", joined)
            cells = self.capacity + by_cell.parts
            members = wp.empty(cells, dtype=wp.int32, device=device)
            given = [by_cell.ranges, by_cell.stacks, by_cell.cell_of_point, by_cell.point_count, self.min_size]
            labelled = [joined.parent, members, None, self.cluster_count]
            keep("_label", PackedLaunch(label_points, None, given, labelled))
            if self.radius_per_metre > 0:
                slots = 2 << (self.capacity - 1).bit_length()
                keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
                keep("_cells", wp.empty(cells, dtype=wp.vec3i, device=device))
                for name in ("_slots", "_cell_begin", "_cell_end"):
                    keep(name, wp.empty(cells, dtype=wp.int32, device=device))
        else:
            buffers(wp.int32, "_cell_end")
            keep("_offsets", wp.array(offsets, dtype=wp.vec3i, device=device))
            keep("_by_cell", CellTable(self._radius, self.capacity, device))

    def launch(self, xyz: wp.array, count: wp.array, include: wp.array | None = None) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            include: Shape (n or more,), bool or uint8: where it is zero, a point takes no part and gets the label -1.
        """
        self._launch(xyz, count, include, self.labels)

    def _launch(self, xyz: wp.array, count: wp.array, include: wp.array | None, labels: wp.array) -> None:
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if include is None:
            mask, has_include = self._no_include, 0
        else:
            if include.shape[0] < n or include.dtype not in (wp.bool, wp.uint8):
                raise ValueError(f"include must be bool or uint8 with at least {n} rows, as there are points")
            mask, has_include = include.view(wp.uint8) if include.dtype == wp.bool else include, 1
        if self._sequential:
            self._launch_in_order([xyz, count, mask, has_include], labels)
        elif n == 0:
            self.cluster_count.zero_()
        else:
            self._by_cell.launch(xyz, count, mask, has_include)
            self._launch_shared(n, labels)

    def _launch_in_order(self, given: list, labels: wp.array) -> None:
        by_cell, joined = self._by_cell, self._joined
        by_cell.launch(*given, then=joined.join)
        joined.launch_borders()
        if self.radius_per_metre > 0:
            columns = [by_cell.ranges, by_cell.columns, by_cell.stacks, by_cell.points]
            wp.launch(
                join_levels_in_order,
                1,
                inputs=[*columns, None, self._radius],
                outputs=[
                    *(self._table, joined.parent, self._cells, self._slots),
                    *(self._cell_begin, self._cell_end),
                ],
                device=self.device,
            )
        self._label.launch(labels_out=labels)

    def _launch_shared(self, n: int, labels: wp.array) -> None:
        by_cell, radius = self._by_cell, self._radius
        parent, cell_count = by_cell.parent, by_cell.cell_count
        cell_size, cell_begin = by_cell.cell_size[:n], by_cell.cell_begin
        found = [by_cell.table, by_cell.cell_of_slot]

        def run(kernel: wp.Kernel, inputs: list, outputs: list, dim: int | tuple[int, int] = n) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        # Components of cells.
        inputs = [*found, by_cell.cells, cell_begin, cell_size, by_cell.points, cell_count, self._offsets, radius]
        run(_join_cells, inputs, [parent], (self._offsets.shape[0], n))
        if self.radius_per_metre > 0:
            wp.utils.array_scan(cell_size, self._cell_end[:n], inclusive=True)
            inputs = [*found, by_cell.cells, cell_begin, self._cell_end, by_cell.points, cell_count, radius]
            run(_join_levels, inputs, [parent])
        by_cell.label(n, self.min_size, labels, self.cluster_count)


def cluster(
    points: Any, radius: float, min_size: int = 1, *, radius_per_metre: float = 0.0, backend: str = "warp"
) -> Any:
    """Groups points that a chain of steps no longer than `radius` joins.

    The connected components of the graph of all pairs with distance ≤ radius, as float64 decides on the float32
    positions: the partition of a KD-tree's pairs and a graph search, or of DBSCAN with a single point as a core.

    The points of a LiDAR lie the farther apart the farther they are. With `radius_per_metre` the radius at a point is
    radius + radius_per_metre × its distance from the origin, and a pair is joined where its distance is at most the
    smaller of the two radii, that of the point nearer to the origin: both points must reach each other.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        radius: Longest step [m], > 0.
        min_size: Points that make a cluster.
        radius_per_metre: By how much the radius grows per metre of range: 0, or from 1e-5 to 1; often 0.01.
        backend: `warp`, or `taichi`, whose labels are the same.

    Returns:
        Labels, shape (n,), int32, of the same family and on the same device as `points`: clusters are numbered
        from 0 by the lowest index of a point in them; -1 marks points of smaller components and those that are not
        finite.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `radius` is not positive, `min_size` is below 1, or
            `radius_per_metre` is not from 0 to 1; or there is no such backend.
        ImportError: The backend is Taichi, which is not installed.
    """
    radius, radius_per_metre = real(radius, "radius"), real(radius_per_metre, "radius_per_metre")
    min_size = whole(min_size, "min_size")
    borrowed = borrow_points(points)
    n = len(borrowed)
    if uses_taichi(backend):
        from .taichi import cluster as in_taichi

        return in_taichi.cluster(borrowed, radius, min_size, radius_per_metre)
    plan = plan_for(
        EuclideanCluster,
        radius=radius,
        radius_per_metre=radius_per_metre,
        min_size=min_size,
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    count = count_on(n, borrowed.device)
    if n == 0 or borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count)
        return give(plan.labels[:n], borrowed.family)
    host = np.empty(n, np.int32)  # the caller's own: to copy them would take as long again as to write them
    plan._launch(borrowed.xyz, count, None, wp.array(host, copy=False, device=DEFAULT_DEVICE))
    return adopt(host, borrowed.family)
