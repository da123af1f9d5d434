"""Euclidean clustering in Taichi: the same labels as `kernels.cluster` gives in Warp.

Space is cut into cells of side radius / √3, so that a cell is one component by itself, and blocks of 4 × 4 × 2 cells,
each of which knows by a bit which of its cells have points. Only blocks are looked up in a hash table: 13 neighbours
each. Components are joined by atomic minimum: the lower root stays, and whom it has displaced is joined in turn.
A radius that grows with the range has cells of several sizes, whose blocks lie far apart in the same table.
Where the device has no 64-bit numbers, pairs whose distance is within 1e-6 of the radius may be decided otherwise.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti

from ..cluster import _LEAST_GROWTH, _SMALLEST_RADIUS
from ..interop import Points
from ..plan import capacity_for, plan_for
from .cell_pairs import (
    Integers,
    Radius,
    Rows,
    Table,
    cell_of,
    cells_reached,
    find,
    level_in,
    levels_reached,
    point_of,
    radius_of,
    touch,
    unite,
)
from .device import DEFAULT_TAICHI, check_count, give_back, has_64_bits, launching, rows_of, start, workspace
from .parallel import NO_POINT, bits_of, block_sums_for, scan

__all__ = ["EuclideanCluster", "cluster"]

_LARGEST_FLOAT = 3.4028235e38
_BLOCKS, _CELLS, _CLUSTERS, _LISTED = range(4)


@ti.func
def _block_of(cells: Table, i: ti.i32) -> ti.math.ivec3:
    return ti.math.ivec3(cells[i, 0] >> 2, cells[i, 1] >> 2, cells[i, 2] >> 1)


@ti.func
def _bit_of(cells: Table, i: ti.i32) -> ti.i32:
    """Which of a block's 32 bits stands for the cell of a point."""
    return ((cells[i, 0] & 3) << 3) | ((cells[i, 1] & 3) << 1) | (cells[i, 2] & 1)


@ti.func
def _is_same(a: ti.math.ivec3, b: ti.math.ivec3) -> ti.i32:
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2]


@ti.func
def _hash_of(block: ti.math.ivec3) -> ti.i32:
    mixed = (block[0] * 73856093) ^ (block[1] * 19349669) ^ (block[2] * 83492791)
    return ((mixed * -1640531535) >> 5) & 0x3FFFFFFF


@ti.func
def _claim(cells: Table, i: ti.i32, table: Integers):
    """Enters a point for its block in the hash table; a lower one takes the place of a higher, which goes on."""
    mask = table.shape[0] - 1
    carried = i
    block = _block_of(cells, i)
    slot = _hash_of(block) & mask
    while carried >= 0:
        there = table[slot]
        if there > carried:
            there = ti.atomic_min(table[slot], carried)
        if there == NO_POINT:
            carried = -1
        else:
            other = _block_of(cells, there)
            if _is_same(other, block):
                carried = -1
            else:
                slot = (slot + 1) & mask
                if there > carried:
                    carried = there
                    block = other


@ti.func
def _lowest_of(cells: Table, block: ti.math.ivec3, table: Integers) -> ti.i32:
    """The lowest point of a block, `NO_POINT` if it has none."""
    mask = table.shape[0] - 1
    slot = _hash_of(block) & mask
    point = table[slot]
    while point != NO_POINT and not _is_same(_block_of(cells, ti.min(point, cells.shape[0] - 1)), block):
        slot = (slot + 1) & mask
        point = table[slot]
    return point


@ti.func
def _join_levels(
    cell: ti.math.ivec3,
    a: ti.i32,
    cells: Table,
    table: Integers,
    number: Integers,
    bits: Integers,
    first_cell: Integers,
    begin: Integers,
    size: Integers,
    points: Rows,
    radius: ti.template(),
    in_64_bits: ti.template(),
    # in out
    parent: Integers,
):
    """Unites a cell with those of higher levels that it touches."""
    level = level_in(cell[0])
    for other in range(level + 1, levels_reached(cell, radius, in_64_bits) + 1):
        first, last = cells_reached(cell, other, radius, in_64_bits)
        for x, y, z in ti.ndrange((first[0] >> 2, (last[0] >> 2) + 1), (first[1] >> 2, (last[1] >> 2) + 1),
                                  (first[2] >> 1, (last[2] >> 1) + 1)):  # fmt: skip
            block = _lowest_of(cells, ti.math.ivec3(x, y, z), table)
            left = 0
            if block != NO_POINT:
                block = number[block]
                left = bits[block]
            while left != 0:
                bit = left & -left
                left ^= bit
                place = bits_of(bit - 1)
                there = ti.math.ivec3(4 * x + (place >> 3), 4 * y + ((place >> 1) & 3), 2 * z + (place & 1))
                b = first_cell[block] + bits_of(bits[block] & (bit - 1))
                if (there >= first).all() and (there <= last).all() and find(parent, a) != find(parent, b):
                    near = touch(
                        *(points, begin[a], begin[a] + size[a], begin[b], begin[b] + size[b], level),
                        *(radius, in_64_bits, True),
                    )
                    if near != 0:
                        unite(parent, a, b)


@ti.kernel
def _cluster(
    # in
    rows: Rows,
    count: ti.i32,
    include: Integers,
    has_include: ti.i32,
    radius: Radius,
    in_64_bits: ti.template(),
    grows: ti.template(),
    min_size: ti.i32,
    offsets: Table,
    windows: Table,
    # out: workspace
    table: Integers,
    cells: Table,
    lowest: Integers,
    number: Integers,
    rank: Integers,
    cell_of_point: Integers,
    bits: Integers,
    block_point: Integers,
    first_cell: Integers,
    size: Integers,
    begin: Integers,
    points: Rows,
    parent: Integers,
    members: Integers,
    cell_lowest: Integers,
    sums: Integers,
    # out
    totals: Integers,
    labels: Integers,
):
    for slot in range(table.shape[0]):
        table[slot] = NO_POINT
    # Blocks, by their lowest point.
    for i in range(count):
        p = point_of(rows, i)
        takes_part = (
            ti.abs(p[0]) <= _LARGEST_FLOAT and ti.abs(p[1]) <= _LARGEST_FLOAT and ti.abs(p[2]) <= _LARGEST_FLOAT
        )
        if has_include != 0:
            takes_part = takes_part and include[i] != 0
        lowest[i] = ti.select(takes_part, 0, -1)
        if takes_part:
            cell = cell_of(p, radius, in_64_bits, grows)
            for k in ti.static(range(3)):
                cells[i, k] = cell[k]
    for i in range(count):
        if lowest[i] >= 0:
            _claim(cells, i, table)
    for i in range(count):
        if lowest[i] >= 0:
            lowest[i] = _lowest_of(cells, _block_of(cells, i), table)
        number[i] = ti.i32(lowest[i] == i)
    scan(number, count, sums, totals, _BLOCKS)
    for b in range(totals[_BLOCKS]):
        bits[b] = 0
    for i in range(count):
        if lowest[i] >= 0:
            b = number[lowest[i]]
            bit = 1 << _bit_of(cells, i)
            if (bits[b] & bit) == 0:
                ti.atomic_or(bits[b], bit)
            if lowest[i] == i:
                block_point[b] = i
    # Cells, block by block, and the points of each.
    for b in range(totals[_BLOCKS]):
        first_cell[b] = bits_of(bits[b])
    scan(first_cell, totals[_BLOCKS], sums, totals, _CELLS)
    for c in range(totals[_CELLS]):
        size[c] = 0
        parent[c] = c
        members[c] = 0
        cell_lowest[c] = NO_POINT
    for i in range(count):
        c = -1
        if lowest[i] >= 0:
            b = number[lowest[i]]
            c = first_cell[b] + bits_of(bits[b] & ((1 << _bit_of(cells, i)) - 1))
            rank[i] = ti.atomic_add(size[c], 1)
        cell_of_point[i] = c
    for c in range(totals[_CELLS]):
        begin[c] = size[c]
    scan(begin, totals[_CELLS], sums, totals, _LISTED)
    for i in range(count):
        c = cell_of_point[i]
        if c >= 0:
            place = begin[c] + rank[i]
            for k in ti.static(range(3)):
                points[place, k] = rows[i, k]
    # Components: each block's cells with one another, then with those of its neighbours, the nearest first.
    for pair in range(totals[_BLOCKS] * offsets.shape[0]):
        o = pair // totals[_BLOCKS]
        a_block = pair - o * totals[_BLOCKS]
        block = _block_of(cells, block_point[a_block])
        b_block = a_block
        if o > 0:
            wanted = block + ti.math.ivec3(offsets[o, 0], offsets[o, 1], offsets[o, 2])
            b_block = _lowest_of(cells, wanted, table)
            if b_block == NO_POINT:
                b_block = -1
            else:
                b_block = number[b_block]
        if b_block >= 0:
            a_bits = bits[a_block]
            a = first_cell[a_block]
            while a_bits != 0:
                a_bit = a_bits & -a_bits
                a_bits ^= a_bit
                b_bits = bits[b_block] & windows[o, bits_of(a_bit - 1)]
                while b_bits != 0:
                    b_bit = b_bits & -b_bits
                    b_bits ^= b_bit
                    b = first_cell[b_block] + bits_of(bits[b_block] & (b_bit - 1))
                    if find(parent, a) != find(parent, b):
                        near = touch(
                            *(points, begin[a], begin[a] + size[a], begin[b], begin[b] + size[b]),
                            *(level_in(4 * block[0]), radius, in_64_bits, grows),
                        )
                        if near != 0:
                            unite(parent, a, b)
                a += 1
    # And with cells of other levels.
    if ti.static(grows):
        for b in range(totals[_BLOCKS]):
            left = bits[b]
            a = first_cell[b]
            while left != 0:
                bit = left & -left
                left ^= bit
                place = bits_of(bit - 1)
                block = _block_of(cells, block_point[b])
                cell = ti.math.ivec3(
                    4 * block[0] + (place >> 3), 4 * block[1] + ((place >> 1) & 3), 2 * block[2] + (place & 1)
                )
                _join_levels(
                    *(cell, a, cells, table, number, bits, first_cell, begin, size, points, radius, in_64_bits, parent)
                )
                a += 1
    # Labels.
    for c in range(totals[_CELLS]):
        ti.atomic_add(members[find(parent, c)], size[c])
    for i in range(count):
        if cell_of_point[i] >= 0:
            root = find(parent, cell_of_point[i])
            cell_of_point[i] = root
            if cell_lowest[root] > i:
                ti.atomic_min(cell_lowest[root], i)
    for i in range(count):
        head = 0
        root = cell_of_point[i]
        if root >= 0:
            head = ti.i32(cell_lowest[root] == i and members[root] >= min_size)
        number[i] = head
    scan(number, count, sums, totals, _CLUSTERS)
    for i in range(count):
        label = -1
        root = cell_of_point[i]
        if root >= 0 and members[root] >= min_size:
            label = number[cell_lowest[root]]
        labels[i] = label


def _neighbours() -> tuple[np.ndarray, np.ndarray]:
    """A block's own place and 13 of its neighbours', nearest first, and which of their cells may touch each cell."""
    offsets = [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) >= (0, 0, 0)]
    offsets = np.array(sorted(offsets, key=lambda offset: sum(abs(o) for o in offset)), np.int32)
    bit = np.arange(32)
    cell = np.stack([bit >> 3, (bit >> 1) & 3, bit & 1], axis=1)
    there = offsets[:, None] * [4, 4, 2] + cell[None]
    may_touch = (np.abs(there[:, None] - cell[None, :, None]) <= 2).all(axis=-1)
    may_touch[0] &= bit[:, None] < bit[None]  # each pair of a block's own cells once
    windows = (may_touch.astype(np.uint32) << bit.astype(np.uint32)).sum(axis=-1, dtype=np.uint32)
    return offsets, windows.view(np.int32)


@dataclass(frozen=True, kw_only=True)
class EuclideanCluster:
    """A plan: workspace on Taichi's device for clouds of up to `capacity` points; `launch` reads nothing back."""

    radius: float
    """Longest step [m] that joins two points."""
    radius_per_metre: float = 0.0
    """By how much it grows per metre of range, 0 or 1e-5 … 1: two points then go by the one nearer to the origin."""
    min_size: int = 1
    """Points that make a cluster; smaller ones get the label -1."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_TAICHI
    """Taichi's device, as `start` takes it."""

    labels: Any = field(init=False, repr=False, compare=False)
    """Out: ti.Ndarray, shape (capacity,), int32: clusters numbered by their lowest point from 0, or -1."""
    totals: Any = field(init=False, repr=False, compare=False)
    """Out: ti.Ndarray of int32: blocks and cells with points, clusters, points that took part."""

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
        start(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        with launching:
            in_64_bits = has_64_bits()
            keep("_in_64_bits", in_64_bits)
            keep("_radius", radius_of(self.radius, self.radius_per_metre, in_64_bits))
            for name, values in zip(("_offsets", "_windows"), _neighbours(), strict=True):
                array = workspace(values.shape, ti.i32)
                array.from_numpy(values)
                keep(name, array)
            keep("_table", workspace(2 << (self.capacity - 1).bit_length(), ti.i32))
            keep("_no_include", workspace(1, ti.i32))
            keep("_cells", workspace((self.capacity, 3), ti.i32))
            keep("_points", workspace((self.capacity, 3), ti.f32))
            for name in ("lowest", "number", "rank", "cell_of_point", "bits", "block_point", "first_cell"):
                keep(f"_{name}", workspace(self.capacity, ti.i32))
            for name in ("size", "begin", "parent", "members", "cell_lowest"):
                keep(f"_{name}", workspace(self.capacity, ti.i32))
            keep("_sums", workspace(block_sums_for(self.capacity), ti.i32))
            keep("totals", workspace(4, ti.i32))
            keep("labels", workspace(self.capacity, ti.i32))

    def launch(self, points: Any, count: int, include: Any = None) -> None:
        """Fills `labels` and `totals` from the first `count` points.

        Args:
            points: ti.Ndarray or contiguous NumPy array, float32, shape (n, 3 or more), count ≤ n ≤ capacity: x y z [m]
                and what is not looked at.
            count: How many points there are.
            include: ti.Ndarray or NumPy array, int32, shape (count or more,): where it is zero, a point takes no part
                and gets the label -1.
        """
        self._launch_into(points, count, include, self.labels)

    def _launch_into(self, points: Any, count: int, include: Any, labels: Any) -> None:
        check_count(count, points, self.capacity)
        if include is not None and include.shape[0] < count:
            raise ValueError(f"include must have at least {count} rows, as there are points, not {include.shape[0]}")
        with launching:
            _cluster(
                *(points, count, self._no_include if include is None else include, int(include is not None)),
                *(
                    self._radius,
                    self._in_64_bits,
                    self.radius_per_metre > 0,
                    self.min_size,
                    self._offsets,
                    self._windows,
                    self._table,
                    self._cells,
                ),
                *(self._lowest, self._number, self._rank, self._cell_of_point, self._bits, self._block_point),
                *(self._first_cell, self._size, self._begin, self._points, self._parent, self._members),
                *(self._cell_lowest, self._sums, self.totals, labels),
            )


def cluster(points: Points, radius: float, min_size: int, radius_per_metre: float = 0.0) -> Any:
    """As `kernels.cluster.cluster`, for points that are borrowed already."""
    device = start()
    n = len(points)
    plan = plan_for(
        EuclideanCluster,
        radius=radius,
        radius_per_metre=radius_per_metre,
        min_size=min_size,
        capacity=capacity_for(n),
        device=device,
    )
    labels = np.zeros(max(n, 1), np.int32)
    plan._launch_into(rows_of(points), n, None, labels)
    return give_back(labels[:n], points)
