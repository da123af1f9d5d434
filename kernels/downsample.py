"""Voxel downsampling: one point per occupied voxel, the centroid of the points in it, the first, or a random one.

Centroids are summed in fixed point, so the result does not depend on the order in which threads run: the same bytes
on every run, on a CPU and on a GPU. A CPU adds runs of points to their voxels in order; a GPU shares a hash table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .arguments import real, whole
from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .parts import parts_for
from .plan import capacity_for, plan_for
from .voxel_sums import VoxelSums

__all__ = ["VoxelDownsample", "voxel_downsample"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LEAST_PART = 500_000  # points; fewer take less time than parts that have to find their own
_FARTHEST = 2.0**20  # [m]; float32 has steps of 6 cm there
_LARGEST_CELL = 2.0**30
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_DRAW, _MIX, _MIX_AGAIN = (wp.constant(wp.uint32(n)) for n in (0x9E3779B9, 0x85EBCA6B, 0xC2B2AE35))
_NEXT = wp.constant(65)  # slots: in the next block, since the neighbours in this one have slots of their own
_NO_POINT = wp.constant(wp.int32(2**31 - 1))
_NO_KEY = wp.constant(wp.int64(2**63 - 1))
_FIRST = wp.constant(1)
_MODES = ("centroid", "first", "random")
# A voxel is one row, one cache line, of 64-bit numbers: cell x and y, cell z and slot, points, sums of x y z.
_COUNT, _SUM, _ROW_WIDTH = (wp.constant(i) for i in (2, 3, 8))


@wp.struct
class _Grid:
    inverse_size: float  # 1 / the edge of a voxel
    limit: float  # of a coordinate [m]: 2²⁰, or less where voxels are so small that they run out of numbers
    scale: float  # fixed point numbers per metre, a power of two
    mode: int
    seed: wp.uint32


@wp.func
def _is_usable(point: wp.vec3, limit: float) -> bool:
    """Finite, and near enough to the origin to be in a voxel that has a number; false for a NaN."""
    x = wp.abs(point[0])
    y = wp.abs(point[1])
    z = wp.abs(point[2])
    # A maximum may hide a NaN, a sum does not; and a small one tells all.
    total = x + y + z
    return total < 0.5 * limit or (total < 4.0 * limit and wp.max(wp.max(x, y), z) < limit)


@wp.func
def _floor(number: float) -> int:
    whole = int(number)
    return whole - wp.where(float(whole) > number, 1, 0)


@wp.func
def _cell_of(point: wp.vec3, inverse_size: float) -> wp.vec3i:
    return wp.vec3i(_floor(point[0] * inverse_size), _floor(point[1] * inverse_size), _floor(point[2] * inverse_size))


@wp.func
def _differ(a: wp.vec3i, b: wp.vec3i) -> bool:
    return ((a[0] ^ b[0]) | (a[1] ^ b[1]) | (a[2] ^ b[2])) != 0  # one branch, where `or` makes three


@wp.func
def _hash(cell: wp.vec3i) -> int:
    """Blocks of 8 × 8 × 1 cells are spread over the table; within one, neighbours in space share cache lines."""
    block = (
        wp.uint32(cell[0] >> 3) * wp.uint32(73856093)
        ^ wp.uint32(cell[1] >> 3) * wp.uint32(19349669)
        ^ wp.uint32(cell[2]) * wp.uint32(83492791)
    )
    within = ((cell[0] & 7) << 3) | (cell[1] & 7)
    return int((((block * _SPREAD) >> wp.uint32(8)) << wp.uint32(6)) & wp.uint32(0x3FFFFFC0)) | within


@wp.func
def _key_of(point: int, seed: wp.uint32) -> wp.int64:
    """A number drawn for a point, by MurmurHash3's finalizer, and the point: the least of a voxel's is chosen."""
    drawn = wp.uint32(point) * _DRAW + seed
    drawn = (drawn ^ (drawn >> wp.uint32(16))) * _MIX
    drawn = (drawn ^ (drawn >> wp.uint32(13))) * _MIX_AGAIN
    drawn = (drawn ^ (drawn >> wp.uint32(16))) >> wp.uint32(1)
    return (wp.int64(drawn) << wp.int64(32)) | wp.int64(point)


@wp.func
def _fixed(coordinate: float, scale: float) -> wp.int64:
    """A coordinate in units of 1 / scale, a power of two: exact from 1 m or 2 m on, else cut off below 1 µm."""
    return wp.int64(coordinate * scale)


@wp.func
def _centroid(sums: wp.array2d(dtype=wp.int64), row: int, scale: float) -> wp.vec3:
    inverse = wp.float64(1.0) / (wp.float64(sums[row, _COUNT]) * wp.float64(scale))
    return wp.vec3(
        float(wp.float64(sums[row, _SUM]) * inverse),
        float(wp.float64(sums[row, _SUM + 1]) * inverse),
        float(wp.float64(sums[row, _SUM + 2]) * inverse),
    )


@wp.kernel
def _choose_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: _Grid,
    # in out: table of voxel numbers, -1 where free, and left so
    table: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.vec3i),
    slots: wp.array(dtype=wp.int32),
    keys: wp.array(dtype=wp.int64),
    # out
    chosen_out: wp.array(dtype=wp.int32),
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread, point after point: keeps of each voxel the first point, or the one with the least key."""
    mask = table.shape[0] - 1
    voxels = int(0)
    dropped = int(0)
    voxel = int(-1)
    before = wp.vec3i(0, 0, 0)
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        point = xyz_in[i]
        if _is_usable(point, grid.limit):
            cell = _cell_of(point, grid.inverse_size)
            if voxel < 0 or _differ(cell, before):
                before = cell
                slot = _hash(cell) & mask
                voxel = table[slot]
                while voxel >= 0 and _differ(cells[voxel], cell):
                    slot = (slot + _NEXT) & mask
                    voxel = table[slot]
                if voxel < 0:
                    voxel = voxels
                    voxels += 1
                    table[slot] = voxel
                    cells[voxel] = cell
                    slots[voxel] = slot
                    keys[voxel] = _NO_KEY
                    chosen_out[voxel] = i
            if grid.mode != _FIRST:
                key = _key_of(i, grid.seed)
                if key < keys[voxel]:
                    keys[voxel] = key
                    chosen_out[voxel] = i
        else:
            dropped += 1
    for v in range(voxels):
        centroids_out[v] = xyz_in[chosen_out[v]]
        table[slots[v]] = -1
    centroid_count_out[0] = voxels
    dropped_out[0] = dropped


@wp.kernel
def _gather_shared(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: _Grid,
    # in out: a table of points that stand for their voxels, -1 where free; lowest points; sums or least keys, or null
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    sums: wp.array2d(dtype=wp.int64),
    keys: wp.array(dtype=wp.int64),
    # out
    slot_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Adds each point to its voxel's slot, which whichever point comes first claims for the voxel."""
    i = wp.tid()
    slot_out[i] = -1
    if i >= count_in[0]:
        return
    point = xyz_in[i]
    if not _is_usable(point, grid.limit):
        wp.atomic_add(dropped_out, 0, 1)
        return
    cell = _cell_of(point, grid.inverse_size)
    mask = table.shape[0] - 1
    slot = _hash(cell) & mask
    found = wp.atomic_cas(table, slot, -1, i)
    while found >= 0 and _differ(_cell_of(xyz_in[wp.max(found, 0)], grid.inverse_size), cell):
        slot = (slot + _NEXT) & mask
        found = wp.atomic_cas(table, slot, -1, i)
    slot_out[i] = slot
    wp.atomic_min(lowest, slot, i)
    if sums:
        wp.atomic_add(sums, slot, _COUNT, wp.int64(1))
        for axis in range(3):
            wp.atomic_add(sums, slot, _SUM + axis, _fixed(point[axis], grid.scale))
    if keys:
        wp.atomic_min(keys, slot, _key_of(i, grid.seed))


@wp.kernel
def _mark_lowest(
    # in
    slot_in: wp.array(dtype=wp.int32),
    lowest_in: wp.array(dtype=wp.int32),
    # out
    head_out: wp.array(dtype=wp.int32),
):
    """Marks the lowest point of each voxel: it speaks for the voxel from here on."""
    i = wp.tid()
    head = int(0)
    slot = slot_in[i]
    if slot >= 0 and lowest_in[slot] == i:
        head = 1
    head_out[i] = head


@wp.kernel
def _emit_centroids(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    slot_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    grid: _Grid,
    # in out: left with all slots free again
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    sums: wp.array2d(dtype=wp.int64),
    keys: wp.array(dtype=wp.int64),
    # out
    chosen_out: wp.array(dtype=wp.int32),
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
):
    """Writes one point per head, in the order of the heads, and frees the slots that were used."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        centroid_count_out[0] = rank_in[i]
    if head_in[i] == 0:
        return
    slot = slot_in[i]
    place = rank_in[i] - 1
    if sums:
        centroids_out[place] = _centroid(sums, slot, grid.scale)
        for column in range(4):
            sums[slot, _COUNT + column] = wp.int64(0)
    else:
        chosen = i
        if keys:
            chosen = int(keys[slot] & wp.int64(0x7FFFFFFF))
            keys[slot] = _NO_KEY
        chosen_out[place] = chosen
        centroids_out[place] = xyz_in[chosen]
    table[slot] = -1
    lowest[slot] = _NO_POINT


@dataclass(frozen=True, kw_only=True)
class VoxelDownsample:
    """A plan: workspace for clouds of up to `capacity` points, of which it keeps the `centroids`."""

    voxel_size: float
    """Edge of a voxel [m], > 0."""
    capacity: int
    """Points that one launch can take."""
    mode: str = "centroid"
    """What stands for a voxel: the `centroid` of its points, the `first` of them, or one at `random`."""
    seed: int = 0
    """Of the mode `random`."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (in parts), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""
    parts: int | None = None
    """How many parts are worked on at once, by the method `in_order`; by default as the threads are worth it."""
    centroids: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), vec3 [m], ordered by the lowest index of a point in the voxel; in the modes `first` and
    `random` the points chosen."""
    chosen: wp.array = field(init=False, repr=False, compare=False)
    """Out: which points those are, shape (capacity,), int32; in the mode `centroid` its length is 0."""
    centroid_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many centroids there are."""
    dropped: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32: points skipped since they are not finite or more than 2²⁰ m off the origin."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not (self.voxel_size > 0 and math.isfinite(self.voxel_size)):
            raise ValueError(f"voxel_size must be > 0 m and finite, not {self.voxel_size}")
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 and below 2³¹, not {self.capacity}")
        if self.mode not in _MODES:
            raise ValueError(f"mode must be 'centroid', 'first' or 'random', not {self.mode!r}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        if self.parts is not None and not 1 <= self.parts <= 64:
            raise ValueError(f"parts must be 1 to 64, not {self.parts}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
        slots = 2 << (self.capacity - 1).bit_length()
        centroids, random = self.mode == "centroid", self.mode == "random"
        grid = _Grid()
        grid.inverse_size = 1.0 / self.voxel_size
        grid.limit = min(_FARTHEST, _LARGEST_CELL * self.voxel_size)
        # As fine as leaves room for `capacity` points at 2²⁰ m in one sum of 63 bits.
        grid.scale = 2.0 ** (43 - max(21, self.capacity.bit_length()))
        grid.mode = _MODES.index(self.mode)
        grid.seed = self.seed & 0xFFFFFFFF

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffers(length: int, dtype: type, *names: str) -> None:
            for name in names:
                keep(name, wp.empty(length, dtype=dtype, device=device))

        keep("_sequential", sequential)
        keep("_grid", grid)
        keep("_sums", None)
        keep("_keys", None)
        buffers(self.capacity, wp.vec3, "centroids")
        buffers(0 if centroids else self.capacity, wp.int32, "chosen")
        keep("centroid_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("dropped", wp.zeros(1, dtype=wp.int32, device=device))
        if not (sequential and centroids):
            keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
        if not sequential:
            keep("_lowest", wp.full(slots, 2**31 - 1, dtype=wp.int32, device=device))
            buffers(self.capacity, wp.int32, "_slot", "_head", "_rank")
            if centroids:
                keep("_sums", wp.zeros((slots, _ROW_WIDTH), dtype=wp.int64, device=device))
            elif random:
                keep("_keys", wp.full(slots, 2**63 - 1, dtype=wp.int64, device=device))
        elif centroids:
            parts = self.parts or parts_for(self.capacity, _LEAST_PART)
            numbers = (self._grid.inverse_size, self._grid.limit, self._grid.scale)
            results = [self.centroids, self.centroid_count, self.dropped]
            keep("_summed", VoxelSums(self.capacity, parts, device, numbers, *results))
        else:
            buffers(self.capacity, wp.vec3i, "_cells")
            buffers(self.capacity, wp.int32, "_slots")
            buffers(self.capacity, wp.int64, "_keys")

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")

        def run(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        given, results = [xyz, count, self._grid], [self.centroids, self.centroid_count]
        if self._sequential:
            if self.mode == "centroid":
                self._summed.launch(xyz, count)
            else:
                workspace = [self._table, self._cells, self._slots, self._keys]
                run(_choose_in_order, 1, given, [*workspace, self.chosen, *results, self.dropped])
            return
        self.dropped.zero_()
        if n == 0:
            self.centroid_count.zero_()
            return
        slot, head, rank = self._slot[:n], self._head[:n], self._rank[:n]
        shared = [self._table, self._lowest, self._sums, self._keys]
        run(_gather_shared, n, given, [*shared, slot, self.dropped])
        run(_mark_lowest, n, [slot, self._lowest], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(_emit_centroids, n, [xyz, slot, head, rank, self._grid], [*shared, self.chosen, *results])


def voxel_downsample(points: Any, voxel_size: float, mode: str = "centroid", *, seed: int = 0) -> Any:
    """Replaces the points of each voxel by one.

    A point's voxel is floor(position × (1 / voxel_size)) in float32. Points that are not finite, or more than 2²⁰ m
    (1049 km) off the origin along an axis, are skipped.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        voxel_size: Edge of a voxel [m], > 0.
        mode: What stands for a voxel: the `centroid` of its points, the `first` of them, or one at `random`, any of
            them with the same chance.
        seed: Of the mode `random`: with the same seed, the same points are chosen, on every device.

    Returns:
        Positions [m], shape (m, 3), float32, m ≤ n, ordered by the lowest index of a point in the voxel; of the same
        family and on the same device as `points` (a Warp array is one of vec3, shape (m,)).

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, `voxel_size` is not positive, or `mode` is not known.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(
        VoxelDownsample,
        voxel_size=real(voxel_size, "voxel_size"),
        mode=mode,
        seed=whole(seed, "seed", bits=64) if mode == "random" else 0,
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.centroids[: int(plan.centroid_count.numpy()[0])], borrowed.family)
