"""DBSCAN: clusters of points that have many others near them, and the points at their borders.

A point with at least `min_points` within `eps`, itself among them, is a core; cores within `eps` of each other are of
one cluster; other points within `eps` of a core belong to its cluster, and the rest is noise (Ester, Kriegel, Sander,
Xu: A density-based algorithm for discovering clusters in large spatial databases with noise, KDD 1996). Cells of side
eps / √3 make it quick: all points of a cell with enough of them are cores, and the cores of a cell are of one cluster.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, whole
from .cell_columns import CellColumns
from .cell_pairs import Radius, find, is_near, radius_of, touch, unite
from .cell_table import CellTable, cell_at, free_slot
from .cluster_columns import JoinedColumns
from .cluster_labels import label_points
from .dbscan_columns import MOST_NEAR, ROWS, find_cores, label_others, list_rows, pick_cores
from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["Dbscan", "dbscan"]

# Whether a pair is within the radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_NO_POINT = wp.constant(wp.int32(2**31 - 1))
_SMALLEST_EPS = 1e-8


@wp.kernel
def _count_near(
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
    min_points: int,
    # out
    near_out: wp.array(dtype=wp.int32),
):
    """Counts what is near each point of a cell, up to `min_points`; a cell with as many needs no count."""
    a = wp.tid()
    if a >= cell_count[0] or cell_size[a] >= min_points:
        return
    begin = cell_begin[a]
    end = begin + cell_size[a]
    for i in range(begin, end):
        near_out[i] = cell_size[a]
    undecided = cell_size[a]
    o = int(0)
    while o < offsets.shape[0] and undecided > 0:
        b = cell_at(cells[a] + offsets[o], table, cell_of_slot, cells)
        if b >= 0:
            for i in range(begin, end):
                near = near_out[i]
                if near < min_points:
                    j = cell_begin[b]
                    last = j + cell_size[b]
                    while j < last and near < min_points:
                        if is_near(points[i], points[j], radius):
                            near += 1
                        j += 1
                    near_out[i] = near
                    if near >= min_points:
                        undecided -= 1
        o += 1


@wp.kernel
def _put_cores_first(
    # in
    cell_begin: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    min_points: int,
    # in out
    near: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    # out
    core_size: wp.array(dtype=wp.int32),
    lowest_core: wp.array(dtype=wp.int32),
):
    """Puts the cores of a cell before its other points."""
    a = wp.tid()
    if a >= cell_count[0]:
        return
    lowest_core[a] = _NO_POINT
    core_size[a] = cell_size[a]
    if cell_size[a] >= min_points:
        return
    core = cell_begin[a]
    for i in range(cell_begin[a], cell_begin[a] + cell_size[a]):
        if near[i] >= min_points:
            point = points[i]
            number = index[i]
            points[i] = points[core]
            index[i] = index[core]
            near[i] = near[core]
            points[core] = point
            index[core] = number
            core += 1
    core_size[a] = core - cell_begin[a]


@wp.kernel
def _join_cores(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    core_size: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    cell_count: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3i),
    radius: Radius,
    # in out
    parent: wp.array(dtype=wp.int32),
):
    """Unites cells whose cores touch. Of each pair of offsets one is left to the other cell."""
    a = wp.tid()
    if a >= cell_count[0] or core_size[a] == 0:
        return
    begin = cell_begin[a]
    for k in range(offsets.shape[0] / 2):
        b = cell_at(cells[a] + offsets[2 * k], table, cell_of_slot, cells)
        if b >= 0 and core_size[b] > 0 and find(parent, a) != find(parent, b):
            other = cell_begin[b]
            if touch(points, begin, begin + core_size[a], other, other + core_size[b], radius):
                unite(parent, a, b)


@wp.kernel
def _find_lowest_cores(
    # in
    cell_begin: wp.array(dtype=wp.int32),
    core_size: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    # in out
    parent: wp.array(dtype=wp.int32),
    lowest_core: wp.array(dtype=wp.int32),
):
    """The lowest core of each component, at its root."""
    a = wp.tid()
    if a >= cell_count[0] or core_size[a] == 0:
        return
    lowest = _NO_POINT
    for i in range(cell_begin[a], cell_begin[a] + core_size[a]):
        lowest = wp.min(lowest, index[i])
    wp.atomic_min(lowest_core, find(parent, a), lowest)


@wp.kernel
def _mark_lowest_cores(
    # in
    lowest_core: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    # in out: zero
    head: wp.array(dtype=wp.int32),
):
    a = wp.tid()
    if a < cell_count[0] and parent[a] == a and lowest_core[a] != _NO_POINT:
        head[lowest_core[a]] = 1


@wp.func
def _label_of(
    cell: int,
    lowest_core: wp.array(dtype=wp.int32),
    rank: wp.array(dtype=wp.int32),
    parent: wp.array(dtype=wp.int32),
) -> int:
    return rank[lowest_core[find(parent, cell)]] - 1


@wp.kernel
def _label_cells(
    # in
    table: wp.array(dtype=wp.int32),
    cell_of_slot: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    cell_begin: wp.array(dtype=wp.int32),
    cell_size: wp.array(dtype=wp.int32),
    core_size: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    cell_count: wp.array(dtype=wp.int32),
    offsets: wp.array(dtype=wp.vec3i),
    radius: Radius,
    lowest_core: wp.array(dtype=wp.int32),
    rank: wp.array(dtype=wp.int32),
    # in out: paths may be halved
    parent: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
):
    """Labels the points of a cell: cores by their component, others by the lowest label of a core near them."""
    a = wp.tid()
    if a >= cell_count[0]:
        return
    begin = cell_begin[a]
    end = begin + cell_size[a]
    cores_end = begin + core_size[a]
    own = _NO_POINT
    if core_size[a] > 0:
        own = _label_of(a, lowest_core, rank, parent)
    for i in range(begin, end):
        labels_out[index[i]] = own
        core_out[index[i]] = i < cores_end
    if cores_end == end:
        return
    for o in range(offsets.shape[0]):
        b = cell_at(cells[a] + offsets[o], table, cell_of_slot, cells)
        if b >= 0 and core_size[b] > 0:
            label = _label_of(b, lowest_core, rank, parent)
            for i in range(cores_end, end):
                if label < labels_out[index[i]]:
                    other = cell_begin[b]
                    if touch(points, i, i + 1, other, other + core_size[b], radius):
                        labels_out[index[i]] = label
    for i in range(cores_end, end):
        if labels_out[index[i]] == _NO_POINT:
            labels_out[index[i]] = -1


@wp.kernel
def _leave_out(
    # in
    slot_of_point: wp.array(dtype=wp.int32),
    rank: wp.array(dtype=wp.int32),
    # in out: left free
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    size: wp.array(dtype=wp.int32),
    # out
    labels_out: wp.array(dtype=wp.int32),
    core_out: wp.array(dtype=wp.bool),
    cluster_count_out: wp.array(dtype=wp.int32),
):
    """Labels the points that are in no cell, and frees the slots of the others."""
    i = wp.tid()
    if i == rank.shape[0] - 1:
        cluster_count_out[0] = rank[i]
    slot = slot_of_point[i]
    if slot >= 0:
        free_slot(slot, table, lowest, size)
    else:
        labels_out[i] = -1
        core_out[i] = False


@dataclass(frozen=True, kw_only=True)
class Dbscan:
    """A plan: workspace for clouds of up to `capacity` points, of which it keeps `labels` and which are cores."""

    eps: float
    """Distance [m] up to which two points are near each other."""
    min_points: int
    """Points near a point, itself among them, that make it a core."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (for a CPU, by columns of cells), `shared` (one thread per cell), or `auto`: `in_order` on a CPU, else
    `shared`: equal results."""
    labels: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), int32: clusters numbered by their lowest core from 0; -1 for noise."""
    core: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), bool, whether each point is a core."""
    cluster_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many clusters there are."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not (self.eps >= _SMALLEST_EPS and math.isfinite(self.eps)):
            raise ValueError(f"eps must be a positive number of metres (at least {_SMALLEST_EPS}), not {self.eps}")
        for name in ("min_points", "capacity"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        if self.method == "in_order" and device != DEFAULT_DEVICE:
            raise ValueError(f"method 'in_order' needs the device {DEFAULT_DEVICE!r}, not {device!r}")

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_sequential", self.method != "shared" and device == DEFAULT_DEVICE)
        keep("_radius", radius_of(self.eps))
        keep("_no_include", wp.zeros(1, dtype=wp.uint8, device=device))
        keep("labels", wp.empty(self.capacity, dtype=wp.int32, device=device))
        keep("core", wp.empty(self.capacity, dtype=wp.bool, device=device))
        keep("cluster_count", wp.zeros(1, dtype=wp.int32, device=device))
        if self._sequential:
            self._make_columns(keep)
            return
        keep("_by_cell", CellTable(self._radius, self.capacity, device, indexed=True))
        # The nearest cells first, and each beside the one opposite.
        forward = [d for d in np.ndindex(5, 5, 5) if d > (2, 2, 2)]
        offsets = np.array(sorted(forward, key=lambda d: sum((i - 2) ** 2 for i in d)), np.int32) - 2
        keep("_offsets", wp.array(np.stack([offsets, -offsets], 1).reshape(-1, 3), dtype=wp.vec3i, device=device))
        for name in ("_near", "_core_size", "_lowest_core"):
            keep(name, wp.empty(self.capacity, dtype=wp.int32, device=device))

    def _make_columns(self, keep: Callable[[str, Any], None]) -> None:
        by_cell = CellColumns(self._radius, self.capacity)
        cells = self.capacity + by_cell.parts

        def buffer(name: str, dtype: type = wp.int32, shape: int | tuple[int, int] = cells) -> None:
            keep(name, wp.empty(shape, dtype=dtype, device=DEFAULT_DEVICE))

        keep("_by_cell", by_cell)
        keep("_core_ranges", wp.zeros(by_cell.parts, dtype=wp.vec4i, device=DEFAULT_DEVICE))
        buffer("_rows", wp.vec2i, ROWS * self.capacity)
        buffer("_neighbours", wp.vec2i, (by_cell.parts, MOST_NEAR))
        buffer("_core_columns", wp.vec4i, self.capacity + 1)
        buffer("_core_stacks", wp.vec2i)
        buffer("_core_points", wp.vec3)
        for name in ("_near", "_core_cell", "_core_cell_of_point", "_members"):
            buffer(name)
        cores = [self._core_ranges, self._core_columns, self._core_stacks, self._core_points]
        keep("_of_cores", JoinedColumns(by_cell, *cores, self._radius))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if n == 0:
            self.cluster_count.zero_()
            return
        if self._sequential:
            self._launch_in_order(xyz, count)
            return
        by_cell, radius, offsets, least = self._by_cell, self._radius, self._offsets, self.min_points
        begin, size, core_size, count_of_cells = (
            by_cell.cell_begin,
            by_cell.cell_size,
            self._core_size,
            by_cell.cell_count,
        )
        parent, lowest_core, head, rank = by_cell.parent, self._lowest_core, by_cell.head[:n], by_cell.rank[:n]
        found = [by_cell.table, by_cell.cell_of_slot, by_cell.cells, begin]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=self.device)

        by_cell.launch(xyz, count, self._no_include, 0)
        # Cores.
        run(_count_near, [*found, size, by_cell.points, count_of_cells, offsets, radius, least], [self._near])
        run(
            _put_cores_first,
            [begin, size, count_of_cells, least],
            [self._near, by_cell.points, by_cell.index, core_size, lowest_core],
        )
        # Components of cores, numbered by the lowest.
        run(_join_cores, [*found, core_size, by_cell.points, count_of_cells, offsets, radius], [parent])
        run(_find_lowest_cores, [begin, core_size, by_cell.index, count_of_cells], [parent, lowest_core])
        head.zero_()
        run(_mark_lowest_cores, [lowest_core, parent, count_of_cells], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        # Labels.
        run(
            _label_cells,
            [
                *(*found, size, core_size, by_cell.points, by_cell.index, count_of_cells, offsets, radius),
                *(lowest_core, rank),
            ],
            [parent, self.labels, self.core],
        )
        run(
            _leave_out,
            [by_cell.slot_of_point[:n], rank],
            [*by_cell.slots, self.labels, self.core, self.cluster_count],
        )

    def _launch_in_order(self, xyz: wp.array, count: wp.array) -> None:
        by_cell, of_cores, least = self._by_cell, self._of_cores, self.min_points
        by_cell.launch(xyz, count, self._no_include, 0)
        columns = [by_cell.ranges, by_cell.columns]
        cells = [by_cell.stacks, by_cell.points]
        around = [self._rows, self._radius, least]
        # Cores.
        by_cell.run(
            list_rows,
            [*columns, by_cell.cell_of_point, by_cell.point_count],
            [self._rows, self._core_cell_of_point, self.core],
        )
        by_cell.run(find_cores, [*columns, *cells, *around], [self._neighbours, self._near])
        # Their components, numbered by the lowest.
        cores = [self._core_ranges, self._core_columns, self._core_stacks, self._core_points]
        by_cell.run(
            pick_cores,
            [*columns, *cells, by_cell.order, self._near, least],
            [*cores, self._core_cell, self._core_cell_of_point],
        )
        of_cores.launch()
        wp.launch(
            label_points,
            1,
            inputs=[self._core_ranges, self._core_stacks, self._core_cell_of_point, by_cell.point_count, 1],
            outputs=[of_cores.parent, self._members, self.labels, self.cluster_count],
            device=self.device,
        )
        # The other points.
        by_cell.run(
            label_others,
            [
                *(*columns, *cells, by_cell.order, self._near, self._core_stacks, self._core_points, self._core_cell),
                *(of_cores.parent, self._members, *around),
            ],
            [self._neighbours, self.labels, self.core],
        )


def dbscan(points: Any, eps: float, min_points: int) -> Any:
    """Clusters points by density.

    The labels are scikit-learn's: two points are near where their distance is ≤ `eps`, as float64 decides on the
    float32 positions; a point that is no core and near cores of several clusters gets the lowest of their labels.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        eps: Distance [m] up to which two points are near each other, > 0.
        min_points: Points near a point, itself among them, that make it a core.

    Returns:
        Labels, shape (n,), int32, of the same family and on the same device as `points`: clusters are numbered
        from 0 by the lowest index of a core in them; -1 marks noise and points that are not finite.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `eps` is not positive, or `min_points` is below 1.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(
        Dbscan,
        eps=real(eps, "eps"),
        min_points=whole(min_points, "min_points"),
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.labels[:n], borrowed.family)
