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

from .cell_pairs import Radius, cell_of, differ, find, hash_cell, is_finite, radius_of, touch, unite
from .cluster_columns import gather_cells_in_order, join_in_order, label_in_order
from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["EuclideanCluster", "cluster"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NO_POINT = wp.constant(wp.int32(2**31 - 1))
_SMALLEST_RADIUS = 1e-8


@wp.kernel
def _claim_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    # in out: a table of points that stand for their cells, -1 where free; lowest points and sizes
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    slot_of_point: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
):
    """Finds each point's slot in the table, which whichever point comes first claims for the cell."""
    i = wp.tid()
    slot_of_point[i] = -1
    cell_size[i] = 0
    if i >= count_in[0]:
        return
    point = xyz_in[i]
    if not is_finite(point):
        return
    if has_include != 0 and include_in[i] == wp.uint8(0):
        return
    cell = cell_of(point, radius)
    mask = table.shape[0] - 1
    slot = hash_cell(cell) & mask
    found = wp.atomic_cas(table, slot, -1, i)
    while found >= 0 and differ(cell_of(xyz_in[wp.max(found, 0)], radius), cell):
        slot = (slot + 1) & mask
        found = wp.atomic_cas(table, slot, -1, i)
    slot_of_point[i] = slot
    wp.atomic_min(lowest, slot, i)
    wp.atomic_add(size, slot, 1)


@wp.kernel
def _mark_lowest(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the lowest point of each cell."""
    i = wp.tid()
    head = int(0)
    slot = slot_of_point[i]
    if slot >= 0 and lowest[slot] == i:
        head = 1
    head_out[i] = head


@wp.kernel
def _number_cells(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    radius: Radius,
    # out
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_size: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
):
    """Numbers the cells by their lowest point."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cell_count[0] = rank_in[i]
    if head_in[i] == 0:
        return
    slot = slot_of_point[i]
    c = rank_in[i] - 1
    cell_of_slot[slot] = c
    cells[c] = cell_of(xyz_in[i], radius)
    cell_size[c] = size[slot]
    parent[c] = c
    members[c] = 0


@wp.kernel
def _scatter_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    # in out: where each cell ends, from last to first
    cell_end: wp.array(dtype=wp.int32),
    # out
    points: wp.array(dtype=wp.vec3),
):
    """Lists the points of each cell, in any order: whether two cells touch does not hang on it."""
    i = wp.tid()
    slot = slot_of_point[i]
    if slot >= 0:
        points[wp.atomic_sub(cell_end, cell_of_slot[slot], 1) - 1] = xyz_in[i]


@wp.kernel
def _join_cells(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
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
    mask = table.shape[0] - 1
    slot = hash_cell(wanted) & mask
    while table[slot] >= 0:
        b = cell_of_slot[slot]
        if differ(cells[b], wanted):
            slot = (slot + 1) & mask
        else:
            if find(parent, a) != find(parent, b):
                a_begin = cell_begin[a]
                b_begin = cell_begin[b]
                if touch(points, a_begin, a_begin + cell_size[a], b_begin, b_begin + cell_size[b], radius):
                    unite(parent, a, b)
            return


@wp.kernel
def _count_members(
    # in
    cell_size: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    # in out
    parent: wp.array(dtype=wp.int32),
    members: wp.array(dtype=wp.int32),
):
    c = wp.tid()
    if c < cell_count[0]:
        wp.atomic_add(members, find(parent, c), cell_size[c])


@wp.kernel
def _mark_clusters(
    # in
    members: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    min_size: int,
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the root cells of components with enough points."""
    c = wp.tid()
    head = int(0)
    if c < cell_count[0] and parent[c] == c and members[c] >= min_size:
        head = 1
    head_out[c] = head


@wp.kernel
def _label_points(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    # in out: paths may be halved; the table is left free
    parent: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Hands each point the number of its component."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        cluster_count_out[0] = rank_in[i]
    label = int(-1)
    slot = slot_of_point[i]
    if slot >= 0:
        root = find(parent, cell_of_slot[slot])
        if head_in[root] == 1:
            label = rank_in[root] - 1
        table[slot] = -1
        lowest[slot] = _NO_POINT
        size[slot] = 0
    labels_out[i] = label


@dataclass(frozen=True, kw_only=True)
class EuclideanCluster:
    """A plan: workspace to cluster clouds of up to `capacity` points, of which it keeps the `labels`."""

    radius: float
    """Longest step [m] that joins two points."""
    min_size: int = 1
    """Points that make a cluster; smaller ones get the label -1."""
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
        if not (self.radius >= _SMALLEST_RADIUS and math.isfinite(self.radius)):
            raise ValueError(
                f"radius must be a positive number of metres (at least {_SMALLEST_RADIUS}), not {self.radius}"
            )
        for name in ("min_size", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
        slots = 2 << (self.capacity - 1).bit_length()

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffers(dtype: type, *names: str) -> None:
            for name in names:
                keep(name, wp.empty(self.capacity, dtype=dtype, device=device))

        keep("_radius", radius_of(self.radius))
        keep("_sequential", sequential)
        keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))
        keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
        buffers(wp.vec3, "_points")
        buffers(wp.vec3i, "_cells")
        buffers(wp.int32, "labels", "_cell_begin", "_cell_end", "_parent", "_members")
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        forward = [d for d in np.ndindex(5, 5, 5) if d > (2, 2, 2)]
        offsets = np.array(sorted(forward, key=lambda d: sum((i - 2) ** 2 for i in d)), np.int32) - 2
        if sequential:
            flat = np.unique(offsets[:, :2], axis=0)
            flat = flat[np.argsort((flat**2).sum(1), kind="stable")][1:]
            keep("_near_offsets", int((np.abs(flat).max(1) == 1).sum()))
            keep("_offsets", wp.array(flat, dtype=wp.vec2i, device=device))
            keep("_column_table", wp.full(slots, -1, dtype=wp.int32, device=device))
            buffers(wp.vec4i, "_columns")
            buffers(wp.vec2i, "_stack")
            buffers(wp.int32, "_cell_of_point", "_cell_slot", "_cell_column")
            buffers(wp.int32, "_column_slot", "_column_root")
            keep("_sizes", wp.zeros(2, dtype=wp.int32, device=device))
        else:
            keep("_offsets", wp.array(offsets, dtype=wp.vec3i, device=device))
            keep("_lowest", wp.full(slots, 2**31 - 1, dtype=wp.int32, device=device))
            keep("_size", wp.zeros(slots, dtype=wp.int32, device=device))
            keep("_cell_of_slot", wp.empty(slots, dtype=wp.int32, device=device))
            keep("_cell_count", wp.zeros(1, dtype=wp.int32, device=device))
            buffers(wp.int32, "_slot_of_point", "_head", "_rank", "_cell_size")

    def launch(self, xyz: wp.array, count: wp.array, include: wp.array | None = None) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            include: Shape (n or more,), bool or uint8: where it is zero, a point takes no part and gets the label -1.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if include is None:
            mask, has_include = self._no_include, 0
        else:
            if include.shape[0] < n or include.dtype not in (wp.bool, wp.uint8):
                raise ValueError(f"include must be bool or uint8 with at least {n} rows, as there are points")
            mask, has_include = include.view(wp.uint8) if include.dtype == wp.bool else include, 1
        given = [xyz, count, mask, has_include, self._radius]
        if self._sequential:
            self._launch_in_order(n, given)
        elif n == 0:
            self.cluster_count.zero_()
        else:
            self._launch_shared(n, given)

    def _launch_in_order(self, n: int, given: list) -> None:
        tables = [self._table, self._column_table]
        cell_ends = [self._cell_begin, self._cell_end]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, 1, inputs=inputs, outputs=outputs, device=self.device)

        run(
            gather_cells_in_order,
            given,
            [
                *(*tables, self._cell_of_point, self._cells, self._cell_slot, *cell_ends, self._cell_column),
                *(self._columns, self._column_slot, self._parent, self._points, self._stack, self._sizes),
            ],
        )
        run(
            join_in_order,
            [
                *(self._column_table, self._columns, self._stack, *cell_ends, self._points, self._sizes),
                *(self._offsets, self._near_offsets, self._radius),
            ],
            [self._parent, self._column_root],
        )
        run(
            label_in_order,
            [
                *(given[1], self._cell_of_point, self._cell_slot, *cell_ends, self._column_slot),
                *(self._sizes, self._parent, self.min_size),
            ],
            [*tables, self._members, self.labels[:n], self.cluster_count],
        )

    def _launch_shared(self, n: int, given: list) -> None:
        xyz, radius = given[0], self._radius
        slot_of_point, head, rank = self._slot_of_point[:n], self._head[:n], self._rank[:n]
        cell_size, cell_begin, cell_end = self._cell_size[:n], self._cell_begin[:n], self._cell_end[:n]
        slots = [self._table, self._lowest, self._size]

        def run(kernel: wp.Kernel, inputs: list, outputs: list, dim: int | tuple[int, int] = n) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        # Cells, numbered by their lowest point.
        run(_claim_cells, given, [*slots, slot_of_point, cell_size])
        run(_mark_lowest, [slot_of_point, self._lowest], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _number_cells,
            [xyz, slot_of_point, head, rank, self._size, radius],
            [self._cell_of_slot, self._cells, cell_size, self._parent, self._members, self._cell_count],
        )
        # Points by cell.
        wp.utils.array_scan(cell_size, cell_begin, inclusive=False)
        wp.utils.array_scan(cell_size, cell_end, inclusive=True)
        run(_scatter_points, [xyz, slot_of_point, self._cell_of_slot], [cell_end, self._points])
        # Components of cells.
        run(
            _join_cells,
            [
                *(self._table, self._cell_of_slot, self._lowest, self._cells, cell_begin, cell_size, self._points),
                *(self._cell_count, self._offsets, radius),
            ],
            [self._parent],
            (self._offsets.shape[0], n),
        )
        run(_count_members, [cell_size, self._cell_count], [self._parent, self._members])
        # Labels.
        run(_mark_clusters, [self._members, self._cell_count, self._parent, self.min_size], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(
            _label_points,
            [slot_of_point, self._cell_of_slot, head, rank],
            [self._parent, *slots, self.labels, self.cluster_count],
        )


def cluster(points: Any, radius: float, min_size: int = 1) -> Any:
    """Groups points that a chain of steps no longer than `radius` joins.

    The connected components of the graph of all pairs with distance ≤ radius, as float64 decides on the float32
    positions: the partition of a KD-tree's pairs and a graph search, or of DBSCAN with a single point as a core.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        radius: Longest step [m], > 0.
        min_size: Points that make a cluster.

    Returns:
        Labels, shape (n,), int32, of the same family and on the same device as `points`: clusters are numbered
        from 0 by the lowest index of a point in them; -1 marks points of smaller components and those that are not
        finite.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `radius` is not positive, or `min_size` is below 1.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(
        EuclideanCluster,
        radius=float(radius),
        min_size=int(min_size),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.labels[:n], borrowed.family)
