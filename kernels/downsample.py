"""Voxel downsampling: one point per occupied voxel, the centroid of the points in it.

Centroids are summed in fixed point, so the result does not depend on the order in which threads run: the same bytes
on every run, on a CPU and on a GPU. A CPU goes through the points once, in order; a GPU shares a hash table.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["VoxelDownsample", "voxel_downsample"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_FARTHEST = wp.constant(wp.float32(2.0**20))  # [m]; float32 has steps of 6 cm there
_LARGEST_CELL = wp.constant(wp.float32(2.0**30))
_SPREAD = wp.constant(wp.uint32(0x9E3779B1))
_NO_POINT = wp.constant(wp.int32(2**31 - 1))
# A voxel is one row, one cache line, of 64-bit numbers: cell x and y, cell z and slot, points, sums of x y z.
_XY, _Z_SLOT, _COUNT, _SUM, _ROW_WIDTH = (wp.constant(i) for i in (0, 1, 2, 3, 8))


@wp.func
def _is_usable(point: wp.vec3, inverse_size: float) -> bool:
    """Finite, within 2²⁰ m of the origin, and in a voxel that has a number; false for a NaN."""
    reach = wp.max(wp.max(wp.abs(point[0]), wp.abs(point[1])), wp.abs(point[2]))
    total = wp.abs(point[0]) + wp.abs(point[1]) + wp.abs(point[2])  # a maximum may hide a NaN, a sum does not
    return total < 4.0 * _FARTHEST and reach < _FARTHEST and reach * inverse_size < _LARGEST_CELL


@wp.func
def _cell_of(point: wp.vec3, inverse_size: float) -> wp.vec3i:
    return wp.vec3i(
        int(wp.floor(point[0] * inverse_size)),
        int(wp.floor(point[1] * inverse_size)),
        int(wp.floor(point[2] * inverse_size)),
    )


@wp.func
def _differ(a: wp.vec3i, b: wp.vec3i) -> bool:
    return a[0] != b[0] or a[1] != b[1] or a[2] != b[2]


@wp.func
def _hash(cell: wp.vec3i) -> int:
    mixed = (
        wp.uint32(cell[0]) * wp.uint32(73856093)
        ^ wp.uint32(cell[1]) * wp.uint32(19349669)
        ^ wp.uint32(cell[2]) * wp.uint32(83492791)
    )
    return int((mixed * _SPREAD) >> wp.uint32(1))


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
def _gather_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    inverse_size: float,
    scale: float,
    # in out: table of voxel numbers, -1 where free, and left so
    table: wp.array(dtype=wp.int32),
    rows: wp.array2d(dtype=wp.int64),
    # out
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread, point after point: adds each to its voxel; then the centroids, voxel after voxel."""
    mask = table.shape[0] - 1
    voxels = int(0)
    dropped = int(0)
    voxel = int(-1)
    xy_before = wp.int64(0)
    z_before = wp.int64(0)
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        point = xyz_in[i]
        if _is_usable(point, inverse_size):
            cell = _cell_of(point, inverse_size)
            xy = (wp.int64(cell[0]) << wp.int64(32)) | wp.int64(wp.uint32(cell[1]))
            z = wp.int64(cell[2])
            # Neighbours in a scan are mostly neighbours in space: often it is the voxel of the point before.
            if voxel < 0 or xy != xy_before or z != z_before:
                xy_before = xy
                z_before = z
                slot = _hash(cell) & mask
                voxel = table[slot]
                while voxel >= 0 and (rows[voxel, _XY] != xy or (rows[voxel, _Z_SLOT] >> wp.int64(32)) != z):
                    slot = (slot + 1) & mask
                    voxel = table[slot]
                if voxel < 0:
                    voxel = voxels
                    voxels += 1
                    table[slot] = voxel
                    rows[voxel, _XY] = xy
                    rows[voxel, _Z_SLOT] = (z << wp.int64(32)) | wp.int64(slot)
                    rows[voxel, _COUNT] = wp.int64(0)
                    rows[voxel, _SUM] = wp.int64(0)
                    rows[voxel, _SUM + 1] = wp.int64(0)
                    rows[voxel, _SUM + 2] = wp.int64(0)
            rows[voxel, _COUNT] = rows[voxel, _COUNT] + wp.int64(1)
            rows[voxel, _SUM] = rows[voxel, _SUM] + _fixed(point[0], scale)
            rows[voxel, _SUM + 1] = rows[voxel, _SUM + 1] + _fixed(point[1], scale)
            rows[voxel, _SUM + 2] = rows[voxel, _SUM + 2] + _fixed(point[2], scale)
        else:
            dropped += 1
    for v in range(voxels):
        centroids_out[v] = _centroid(rows, v, scale)
        table[int(rows[v, _Z_SLOT] & wp.int64(0x7FFFFFFF))] = -1
    centroid_count_out[0] = voxels
    dropped_out[0] = dropped


@wp.kernel
def _gather_shared(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    inverse_size: float,
    scale: float,
    # in out: a table of points that stand for their voxels, -1 where free; lowest points; counts and sums
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    sums: wp.array2d(dtype=wp.int64),
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
    if not _is_usable(point, inverse_size):
        wp.atomic_add(dropped_out, 0, 1)
        return
    cell = _cell_of(point, inverse_size)
    mask = table.shape[0] - 1
    slot = _hash(cell) & mask
    found = wp.atomic_cas(table, slot, -1, i)
    while found >= 0 and _differ(_cell_of(xyz_in[wp.max(found, 0)], inverse_size), cell):
        slot = (slot + 1) & mask
        found = wp.atomic_cas(table, slot, -1, i)
    slot_out[i] = slot
    wp.atomic_min(lowest, slot, i)
    wp.atomic_add(sums, slot, _COUNT, wp.int64(1))
    for axis in range(3):
        wp.atomic_add(sums, slot, _SUM + axis, _fixed(point[axis], scale))


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
    slot_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    scale: float,
    # in out: left with all slots free again
    table: wp.array(dtype=wp.int32),
    lowest: wp.array(dtype=wp.int32),
    sums: wp.array2d(dtype=wp.int64),
    # out
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
):
    """Writes one centroid per head, in the order of the heads, and frees the slots that were used."""
    i = wp.tid()
    if i == head_in.shape[0] - 1:
        centroid_count_out[0] = rank_in[i]
    if head_in[i] == 0:
        return
    slot = slot_in[i]
    centroids_out[rank_in[i] - 1] = _centroid(sums, slot, scale)
    table[slot] = -1
    lowest[slot] = _NO_POINT
    for column in range(4):
        sums[slot, _COUNT + column] = wp.int64(0)


@dataclass(frozen=True, kw_only=True)
class VoxelDownsample:
    """A plan: workspace for clouds of up to `capacity` points, of which it keeps the `centroids`."""

    voxel_size: float
    """Edge of a voxel [m], > 0."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""
    centroids: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (capacity,), vec3 [m], ordered by the lowest index of a point in the voxel."""
    centroid_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many centroids there are."""
    dropped: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32: points skipped since they are not finite or more than 2²⁰ m off the origin."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not (self.voxel_size > 0 and math.isfinite(self.voxel_size)):
            raise ValueError(f"voxel_size must be > 0 m and finite, not {self.voxel_size}")
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1, not {self.capacity}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)
        slots = 2 << (self.capacity - 1).bit_length()

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_sequential", sequential)
        # As fine as leaves room for `capacity` points at 2²⁰ m in one sum of 63 bits.
        keep("_scale", 2.0 ** (43 - max(21, self.capacity.bit_length())))
        keep("_table", wp.full(slots, -1, dtype=wp.int32, device=device))
        keep("centroids", wp.empty(self.capacity, dtype=wp.vec3, device=device))
        keep("centroid_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("dropped", wp.zeros(1, dtype=wp.int32, device=device))
        if sequential:
            keep("_rows", wp.empty((self.capacity, _ROW_WIDTH), dtype=wp.int64, device=device))
        else:
            keep("_lowest", wp.full(slots, 2**31 - 1, dtype=wp.int32, device=device))
            keep("_sums", wp.zeros((slots, _ROW_WIDTH), dtype=wp.int64, device=device))
            for name in ("_slot", "_head", "_rank"):
                keep(name, wp.empty(self.capacity, dtype=wp.int32, device=device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        inverse_size = 1.0 / self.voxel_size
        results = [self.centroids, self.centroid_count]
        if self._sequential:
            wp.launch(
                _gather_in_order,
                1,
                inputs=[xyz, count, inverse_size, self._scale],
                outputs=[self._table, self._rows, *results, self.dropped],
                device=self.device,
            )
            return
        self.dropped.zero_()
        if n == 0:
            self.centroid_count.zero_()
            return
        slot, head, rank = self._slot[:n], self._head[:n], self._rank[:n]
        shared = [self._table, self._lowest, self._sums]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=self.device)

        run(_gather_shared, [xyz, count, inverse_size, self._scale], [*shared, slot, self.dropped])
        run(_mark_lowest, [slot, self._lowest], [head])
        wp.utils.array_scan(head, rank, inclusive=True)
        run(_emit_centroids, [slot, head, rank, self._scale], [*shared, *results])


def voxel_downsample(points: Any, voxel_size: float) -> Any:
    """Replaces the points of each voxel by their centroid.

    A point's voxel is floor(position × (1 / voxel_size)) in float32. Points that are not finite, or more than 2²⁰ m
    (1049 km) off the origin along an axis, are skipped.

    Args:
        points: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack. Columns after the third
            are ignored.
        voxel_size: Edge of a voxel [m], > 0.

    Returns:
        Centroids [m], shape (m, 3), float32, m ≤ n, ordered by the lowest index of a point in the voxel; of the same
        family and on the same device as `points` (a Warp array is one of vec3, shape (m,)).

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: `points` has not at least three columns, or `voxel_size` is not positive.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(VoxelDownsample, voxel_size=float(voxel_size), capacity=capacity_for(n), device=borrowed.device)
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.centroids[: int(plan.centroid_count.numpy()[0])], borrowed.family)
