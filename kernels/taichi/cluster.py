"""Euclidean clustering in Taichi: the same labels as `kernels.cluster` gives in Warp.

Space is cut into cells of side radius / √3, so that a cell is one component by itself, and blocks of 4 × 4 × 2 cells,
each of which knows by a bit which of its cells have points. Only blocks are looked up in a hash table: 13 neighbours
each. Components are joined by atomic minimum: the lower root stays, and whom it has displaced is joined in turn.
Where the device has no 64-bit numbers, pairs whose distance is within 1e-6 of the radius may be decided otherwise.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti

from ..cluster import _SMALLEST_RADIUS
from ..interop import Points
from ..plan import capacity_for, plan_for
from .device import DEFAULT_TAICHI, check_count, give_back, has_64_bits, launching, rows_of, start, workspace
from .parallel import NO_POINT, bits_of, block_sums_for, scan

__all__ = ["EuclideanCluster", "cluster"]

_LARGEST_CELL = 2.0**30
_LARGEST_FLOAT = 3.4028235e38
_BRUTE_FORCE = 4096.0  # pairs of points up to which nothing beats trying them all
_BLOCKS, _CELLS, _CLUSTERS, _LISTED = range(4)

_Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
_Table = ti.types.ndarray(dtype=ti.i32, ndim=2)
_Rows = ti.types.ndarray(dtype=ti.f32, ndim=2)
_Radius = ti.types.struct(
    inverse_side=ti.f32,
    surely=ti.f32,  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not=ti.f32,  # and above here they are not
    wide=ti.types.vector(4, ti.i32),  # words of two float64: the inverse of a cell's side, the radius squared
)


@ti.func
def _wide(low: ti.i32, high: ti.i32) -> ti.f64:
    """The float64 of two words."""
    return ti.bit_cast((ti.i64(high) << 32) | ti.i64(ti.u32(low)), ti.f64)


@ti.func
def _cell_along(coordinate: ti.f32, radius: ti.template(), in_64_bits: ti.template()) -> ti.i32:
    """The cell's index along an axis; where float32 has no neighbours within a cell any more, the number's own bits."""
    cell = 0
    if ti.static(in_64_bits):
        scaled = ti.f64(coordinate) * _wide(radius.wide[0], radius.wide[1])
        if ti.abs(scaled) < _LARGEST_CELL:
            cell = ti.i32(ti.floor(scaled))
        elif coordinate > 0.0:
            cell = ti.bit_cast(coordinate, ti.i32)
        else:
            cell = -ti.bit_cast(-coordinate, ti.i32)
    else:
        scaled = coordinate * radius.inverse_side
        if ti.abs(scaled) < _LARGEST_CELL:
            cell = ti.i32(ti.floor(scaled))
        elif coordinate > 0.0:
            cell = ti.bit_cast(coordinate, ti.i32)
        else:
            cell = -ti.bit_cast(-coordinate, ti.i32)
    return cell


@ti.func
def _point(rows: _Rows, i: ti.i32) -> ti.math.vec3:
    return ti.math.vec3(rows[i, 0], rows[i, 1], rows[i, 2])


@ti.func
def _block_of(cells: _Table, i: ti.i32) -> ti.math.ivec3:
    return ti.math.ivec3(cells[i, 0] >> 2, cells[i, 1] >> 2, cells[i, 2] >> 1)


@ti.func
def _bit_of(cells: _Table, i: ti.i32) -> ti.i32:
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
def _claim(cells: _Table, i: ti.i32, table: _Integers):
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
def _lowest_of(cells: _Table, block: ti.math.ivec3, table: _Integers) -> ti.i32:
    """The lowest point of a block, `NO_POINT` if it has none."""
    mask = table.shape[0] - 1
    slot = _hash_of(block) & mask
    point = table[slot]
    while point != NO_POINT and not _is_same(_block_of(cells, ti.min(point, cells.shape[0] - 1)), block):
        slot = (slot + 1) & mask
        point = table[slot]
    return point


@ti.func
def _is_near(p: ti.math.vec3, q: ti.math.vec3, radius: ti.template(), in_64_bits: ti.template()) -> ti.i32:
    """Whether the distance is within the radius, as float64 decides; float32 does where it is sure to agree."""
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    squared = x * x + y * y + z * z
    near = ti.i32(squared <= radius.surely)
    if ti.static(in_64_bits):  # noqa: SIM102 (one of the two is compiled away)
        if squared > radius.surely and squared <= radius.surely_not:
            dx = ti.f64(p[0]) - ti.f64(q[0])
            dy = ti.f64(p[1]) - ti.f64(q[1])
            dz = ti.f64(p[2]) - ti.f64(q[2])
            near = ti.i32(dx * dx + dy * dy + dz * dz <= _wide(radius.wide[2], radius.wide[3]))
    return near


@ti.func
def _is_by_box(p: ti.math.vec3, low: ti.math.vec3, high: ti.math.vec3, radius: ti.template()) -> ti.i32:
    """Whether a point may be within the radius of a point in a box."""
    x = ti.max(low[0] - p[0], p[0] - high[0], 0.0)
    y = ti.max(low[1] - p[1], p[1] - high[1], 0.0)
    z = ti.max(low[2] - p[2], p[2] - high[2], 0.0)
    return x * x + y * y + z * z <= radius.surely_not


@ti.func
def _touch(
    points: _Rows,
    a_begin: ti.i32,
    a_end: ti.i32,
    b_begin: ti.i32,
    b_end: ti.i32,
    radius: ti.template(),
    in_64_bits: ti.template(),
) -> ti.i32:
    """Whether any point of one cell is within the radius of any point of another.

    Of crowded cells, only what lies near the box of what is left of the other is tried.
    """
    far = ti.math.vec3(_LARGEST_FLOAT, _LARGEST_FLOAT, _LARGEST_FLOAT)
    a_low = -far
    a_high = far
    b_low = -far
    b_high = far
    a_left = a_end - a_begin
    b_left = b_end - b_begin
    rounds = ti.select(ti.f32(a_left) * ti.f32(b_left) > _BRUTE_FORCE, 8, 0)
    while rounds > 0:
        rounds -= 1
        left = 0
        low = far
        high = -far
        for i in range(a_begin, a_end):
            p = _point(points, i)
            if _is_by_box(p, b_low, b_high, radius):
                low = ti.min(low, p)
                high = ti.max(high, p)
                left += 1
        narrowed = left < a_left
        a_low = low
        a_high = high
        a_left = left
        left = 0
        low = far
        high = -far
        if a_left > 0:
            for j in range(b_begin, b_end):
                q = _point(points, j)
                if _is_by_box(q, a_low, a_high, radius):
                    low = ti.min(low, q)
                    high = ti.max(high, q)
                    left += 1
        narrowed = narrowed or left < b_left
        b_low = low
        b_high = high
        b_left = left
        if a_left == 0 or b_left == 0 or (rounds < 7 and not narrowed):
            rounds = 0
    near = 0
    i = a_begin
    while i < a_end and near == 0 and a_left > 0 and b_left > 0:
        p = _point(points, i)
        if _is_by_box(p, b_low, b_high, radius):
            j = b_begin
            while j < b_end and near == 0:
                near = _is_near(p, _point(points, j), radius, in_64_bits)
                j += 1
        i += 1
    return near


@ti.func
def _find(parent: _Integers, cell: ti.i32) -> ti.i32:
    """The root of a cell. Halves the path; a write lost to another thread leaves an ancestor all the same."""
    root = cell
    above = parent[root]
    while above != root:
        after = parent[above]
        parent[root] = after
        root = after
        above = parent[root]
    return root


@ti.func
def _unite(parent: _Integers, a: ti.i32, b: ti.i32):
    """Joins two components; the lower root stays."""
    low = _find(parent, a)
    high = _find(parent, b)
    while low != high:
        if low > high:
            swap = low
            low = high
            high = swap
        there = ti.atomic_min(parent[high], low)
        if there == high:
            high = low
        else:
            # Another thread was first: what it had hung the root to belongs to us too.
            high = _find(parent, there)
            low = _find(parent, low)


@ti.kernel
def _cluster(
    # in
    rows: _Rows,
    count: ti.i32,
    include: _Integers,
    has_include: ti.i32,
    radius: _Radius,
    in_64_bits: ti.template(),
    min_size: ti.i32,
    offsets: _Table,
    windows: _Table,
    # out: workspace
    table: _Integers,
    cells: _Table,
    lowest: _Integers,
    number: _Integers,
    rank: _Integers,
    cell_of_point: _Integers,
    bits: _Integers,
    block_point: _Integers,
    first_cell: _Integers,
    size: _Integers,
    begin: _Integers,
    points: _Rows,
    parent: _Integers,
    members: _Integers,
    cell_lowest: _Integers,
    sums: _Integers,
    # out
    totals: _Integers,
    labels: _Integers,
):
    for slot in range(table.shape[0]):
        table[slot] = NO_POINT
    # Blocks, by their lowest point.
    for i in range(count):
        p = _point(rows, i)
        takes_part = (
            ti.abs(p[0]) <= _LARGEST_FLOAT and ti.abs(p[1]) <= _LARGEST_FLOAT and ti.abs(p[2]) <= _LARGEST_FLOAT
        )
        if has_include != 0:
            takes_part = takes_part and include[i] != 0
        lowest[i] = ti.select(takes_part, 0, -1)
        if takes_part:
            for k in ti.static(range(3)):
                cells[i, k] = _cell_along(p[k], radius, in_64_bits)
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
                    if _find(parent, a) != _find(parent, b):
                        near = _touch(
                            *(points, begin[a], begin[a] + size[a], begin[b], begin[b] + size[b], radius, in_64_bits)
                        )
                        if near != 0:
                            _unite(parent, a, b)
                a += 1
    # Labels.
    for c in range(totals[_CELLS]):
        ti.atomic_add(members[_find(parent, c)], size[c])
    for i in range(count):
        if cell_of_point[i] >= 0:
            root = _find(parent, cell_of_point[i])
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
        for name in ("min_size", "capacity"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        start(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        with launching:
            in_64_bits = has_64_bits()
            keep("_in_64_bits", in_64_bits)
            # A hair shorter, so that no rounding makes the diagonal longer than the radius.
            inverse_side = math.sqrt(3.0) / (self.radius * (1.0 - 1e-6))
            squared = self.radius * self.radius
            keep(
                "_radius",
                _Radius(
                    inverse_side=math.sqrt(3.0) / (self.radius * (1.0 - 1e-3)),
                    surely=squared * (1.0 - 1e-6) if in_64_bits else squared,
                    surely_not=squared * (1.0 + 1e-6),
                    wide=np.array([inverse_side, squared]).view(np.int32).tolist(),
                ),
            )
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


def cluster(points: Points, radius: float, min_size: int) -> Any:
    """As `kernels.cluster.cluster` with one radius everywhere, for points that are borrowed already."""
    device = start()
    n = len(points)
    plan = plan_for(EuclideanCluster, radius=radius, min_size=min_size, capacity=capacity_for(n), device=device)
    labels = np.zeros(max(n, 1), np.int32)
    plan._launch_into(rows_of(points), n, None, labels)
    return give_back(labels[:n], points)
