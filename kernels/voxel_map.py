"""A map of points in voxels, as scan registration wants it: points are added, voxels far away go, nearest are found.

Voxels are found by a hash table; each holds up to so many points, none closer to another of its voxel than a spacing
(KISS-ICP: Vizzo et al., 2023). Points of a voxel come in the order of the input, whatever the device.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .voxel_table import (
    FREE,
    add_point,
    cell_of,
    cell_of_key,
    content_of,
    find_slot,
    first_slot,
    is_usable,
    key_of,
    moved_by,
    next_slot,
    offset_in,
)

__all__ = ["VoxelMap"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LAST_KEY = wp.constant(wp.int64(2**63 - 1))
_MOST_POINTS = 255
_DROPPED_POINTS, _DROPPED_VOXELS = (wp.constant(i) for i in range(2))


@wp.kernel
def _insert_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44d),
    size: wp.float64,
    max_points: int,
    spacing_sq: float,
    # in out
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    key_of_voxel: wp.array(dtype=wp.int64),
    points_in_voxel: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    free_count: wp.array(dtype=wp.int32),
    dropped: wp.array(dtype=wp.int32),
):
    """One thread, point after point."""
    inverse_size = wp.float64(1.0) / size
    pose = pose_in[0]
    left = free_count[0]
    for i in range(wp.min(count_in[0], xyz_in.shape[0])):
        p = moved_by(pose, xyz_in[i])
        if is_usable(p, inverse_size):
            cell = cell_of(p, inverse_size)
            slot = find_slot(table, cell)
            voxel = int(-1)
            count = int(0)
            if table[slot, 0] != FREE:
                content = table[slot, 1]
                voxel = int(content >> wp.int64(8))
                count = int(content & wp.int64(255))
            elif left > 0:
                left -= 1
                voxel = free[left]
                table[slot, 0] = key_of(cell)
                key_of_voxel[voxel] = key_of(cell)
            if voxel < 0:
                dropped[_DROPPED_VOXELS] = dropped[_DROPPED_VOXELS] + 1
            else:
                now = add_point(points, voxel, count, max_points, offset_in(p, cell, size), spacing_sq)
                if now != count:
                    table[slot, 1] = content_of(voxel, now)
                    points_in_voxel[voxel] = now
        else:
            dropped[_DROPPED_POINTS] = dropped[_DROPPED_POINTS] + 1
    free_count[0] = left


@wp.kernel
def _sort_keys(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44d),
    size: wp.float64,
    # in out
    dropped: wp.array(dtype=wp.int32),
    # out
    key_out: wp.array(dtype=wp.int64),
    point_out: wp.array(dtype=wp.int32),
    new_out: wp.array(dtype=wp.int32),
):
    """The voxel of each point; points without one sort to the end."""
    i = wp.tid()
    key = _LAST_KEY
    if i < count_in[0]:
        inverse_size = wp.float64(1.0) / size
        p = moved_by(pose_in[0], xyz_in[i])
        if is_usable(p, inverse_size):
            key = key_of(cell_of(p, inverse_size))
        else:
            wp.atomic_add(dropped, _DROPPED_POINTS, 1)
    key_out[i] = key
    point_out[i] = i
    new_out[i] = 0


@wp.kernel
def _mark_new(
    # in
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    table: wp.array2d(dtype=wp.int64),
    # out
    slot_out: wp.array(dtype=wp.int32),
    new_out: wp.array(dtype=wp.int32),
):
    """The slot of each voxel that points fall into, by its first point, which is marked where the voxel is new."""
    j = wp.tid()
    slot_out[j] = -1
    key = key_in[j]
    if key == _LAST_KEY:
        return
    if j > 0 and key_in[wp.max(j - 1, 0)] == key:
        return
    slot = find_slot(table, cell_of_key(key))
    slot_out[j] = slot
    if table[slot, 0] == FREE:
        new_out[point_in[j]] = 1


@wp.kernel
def _insert_segments(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    pose_in: wp.array(dtype=wp.mat44d),
    size: wp.float64,
    max_points: int,
    spacing_sq: float,
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    slot_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    new_in: wp.array(dtype=wp.int32),
    free_in: wp.array(dtype=wp.int32),
    free_count_in: wp.array(dtype=wp.int32),
    # in out
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    key_of_voxel: wp.array(dtype=wp.int64),
    points_in_voxel: wp.array(dtype=wp.int32),
    dropped: wp.array(dtype=wp.int32),
):
    """One voxel a thread, that of its first point: adds the voxel's points in their order."""
    j = wp.tid()
    slot = slot_in[j]
    if slot < 0:
        return
    n = key_in.shape[0]
    key = key_in[j]
    cell = cell_of_key(key)
    voxel = int(-1)
    count = int(0)
    if new_in[point_in[j]] == 1:
        place = free_count_in[0] - rank_in[point_in[j]]
        if place >= 0:
            voxel = free_in[place]
            key_of_voxel[voxel] = key
            found = wp.atomic_cas(table, slot, 0, FREE, key)
            while found != FREE:
                slot = next_slot(slot, table.shape[0] - 1)
                found = wp.atomic_cas(table, slot, 0, FREE, key)
    else:
        content = table[slot, 1]
        voxel = int(content >> wp.int64(8))
        count = int(content & wp.int64(255))
    k = int(j)
    while k < n and key_in[wp.min(k, n - 1)] == key:
        if voxel < 0:
            wp.atomic_add(dropped, _DROPPED_VOXELS, 1)
        else:
            offset = offset_in(moved_by(pose_in[0], xyz_in[point_in[k]]), cell, size)
            count = add_point(points, voxel, count, max_points, offset, spacing_sq)
        k += 1
    if voxel >= 0:
        table[slot, 1] = content_of(voxel, count)
        points_in_voxel[voxel] = count


@wp.kernel
def _take_free(
    # in
    rank_in: wp.array(dtype=wp.int32),
    # in out
    free_count: wp.array(dtype=wp.int32),
):
    free_count[0] = wp.max(free_count[0] - rank_in[rank_in.shape[0] - 1], 0)


@wp.func
def _is_far(key: wp.int64, at: wp.vec3d, size: wp.float64, reach: wp.float64) -> bool:
    cell = cell_of_key(key)
    half = wp.float64(0.5)
    centre = wp.vec3d(
        (wp.float64(cell[0]) + half) * size, (wp.float64(cell[1]) + half) * size, (wp.float64(cell[2]) + half) * size
    )
    return wp.length_sq(centre - at) > reach * reach


@wp.func
def _is_due(pose: wp.mat44d, pruned_at: wp.vec3d, step: wp.float64) -> bool:
    return wp.length_sq(wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3]) - pruned_at) > step * step


@wp.kernel
def _prune_in_order(
    # in
    pose_in: wp.array(dtype=wp.mat44d),
    size: wp.float64,
    reach: wp.float64,
    step: wp.float64,
    # in out
    pruned_at: wp.array(dtype=wp.vec3d),
    table: wp.array2d(dtype=wp.int64),
    key_of_voxel: wp.array(dtype=wp.int64),
    points_in_voxel: wp.array(dtype=wp.int32),
    free: wp.array(dtype=wp.int32),
    free_count: wp.array(dtype=wp.int32),
):
    """One thread: frees the voxels that are far, and builds the table anew of the others."""
    pose = pose_in[0]
    if not _is_due(pose, pruned_at[0], step):
        return
    at = wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])
    pruned_at[0] = at
    for slot in range(table.shape[0]):
        table[slot, 0] = FREE
    left = int(0)
    for voxel in range(key_of_voxel.shape[0]):
        key = key_of_voxel[voxel]
        if key != FREE and _is_far(key, at, size, reach):
            key = FREE
            key_of_voxel[voxel] = FREE
        if key == FREE:
            free[left] = voxel
            left += 1
        else:
            slot = find_slot(table, cell_of_key(key))
            table[slot, 0] = key
            table[slot, 1] = content_of(voxel, points_in_voxel[voxel])
    free_count[0] = left


@wp.kernel
def _mark_free(
    # in
    pose_in: wp.array(dtype=wp.mat44d),
    size: wp.float64,
    reach: wp.float64,
    step: wp.float64,
    pruned_at: wp.array(dtype=wp.vec3d),
    # in out
    key_of_voxel: wp.array(dtype=wp.int64),
    table: wp.array2d(dtype=wp.int64),
    # out
    is_free_out: wp.array(dtype=wp.int32),
):
    """Marks the voxels that are free, or far and so free from now on; empties the table; dim is its slots."""
    i = wp.tid()
    due = _is_due(pose_in[0], pruned_at[0], step)
    if due:
        table[i, 0] = FREE
    if i >= key_of_voxel.shape[0]:
        return
    key = key_of_voxel[i]
    at = wp.vec3d(pose_in[0][0, 3], pose_in[0][1, 3], pose_in[0][2, 3])
    if due and key != FREE and _is_far(key, at, size, reach):
        key = FREE
        key_of_voxel[i] = FREE
    is_free_out[i] = wp.where(key == FREE, 1, 0)


@wp.kernel
def _rebuild(
    # in
    pose_in: wp.array(dtype=wp.mat44d),
    step: wp.float64,
    pruned_at: wp.array(dtype=wp.vec3d),
    key_of_voxel: wp.array(dtype=wp.int64),
    points_in_voxel: wp.array(dtype=wp.int32),
    is_free_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    # in out
    table: wp.array2d(dtype=wp.int64),
    # out
    free_out: wp.array(dtype=wp.int32),
    free_count_out: wp.array(dtype=wp.int32),
):
    """Puts each voxel that is left into the table, and the others on the list of free ones."""
    voxel = wp.tid()
    if not _is_due(pose_in[0], pruned_at[0], step):
        return
    if voxel == rank_in.shape[0] - 1:
        free_count_out[0] = rank_in[voxel]
    if is_free_in[voxel] == 1:
        free_out[rank_in[voxel] - 1] = voxel
        return
    key = key_of_voxel[voxel]
    slot = first_slot(cell_of_key(key), table.shape[0] - 1)
    found = wp.atomic_cas(table, slot, 0, FREE, key)
    while found != FREE:
        slot = next_slot(slot, table.shape[0] - 1)
        found = wp.atomic_cas(table, slot, 0, FREE, key)
    table[slot, 1] = content_of(voxel, points_in_voxel[voxel])


@wp.kernel
def _note_place(
    # in
    pose_in: wp.array(dtype=wp.mat44d),
    step: wp.float64,
    # in out
    pruned_at: wp.array(dtype=wp.vec3d),
):
    pose = pose_in[0]
    if _is_due(pose, pruned_at[0], step):
        pruned_at[0] = wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])


@wp.kernel
def _clear(
    # out
    table_out: wp.array2d(dtype=wp.int64),
    key_of_voxel_out: wp.array(dtype=wp.int64),
    free_out: wp.array(dtype=wp.int32),
    free_count_out: wp.array(dtype=wp.int32),
):
    """Frees all voxels, so that the first taken is number 0; dim is the table's slots."""
    i = wp.tid()
    table_out[i, 0] = FREE
    voxels = free_out.shape[0]
    if i < voxels:
        key_of_voxel_out[i] = FREE
        free_out[i] = voxels - 1 - i
    if i == 0:
        free_count_out[0] = voxels


@dataclass(frozen=True, kw_only=True)
class VoxelMap:
    """A plan: a map of up to `max_voxels` voxels, to which clouds of up to `capacity` points are added."""

    voxel_size: float
    """Edge of a voxel [m], > 0; what is nearest to a point is looked for in its voxel and the 26 around it."""
    capacity: int
    """Points that one launch can take."""
    max_voxels: int = 65_536
    """Voxels that the map can hold."""
    max_points: int = 20
    """Points that a voxel can hold, at most 255; none is closer to another than voxel_size / √max_points."""
    max_distance: float | None = None
    """Voxels farther from the sensor go [m], whenever it has moved by a tenth of this; None: none ever goes."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""

    table: wp.array = field(init=False, repr=False, compare=False)
    """The hash table, shape (slots, 2), int64: the key of a cell, -1 where free, and its voxel << 8 | points."""
    points: wp.array = field(init=False, repr=False, compare=False)
    """Points against the low corner of their voxel [m], shape (max_voxels × max_points,), vec3."""
    free_count: wp.array = field(init=False, repr=False, compare=False)
    """Voxels that are free, shape (1,), int32."""
    dropped: wp.array = field(init=False, repr=False, compare=False)
    """Points left out since the last `clear`, shape (2,), int32: not finite or more than 2²⁰ voxels off the origin;
    in a voxel for which there was no room."""

    def __post_init__(self):
        if not (self.voxel_size > 0 and math.isfinite(self.voxel_size)):
            raise ValueError(f"voxel_size must be > 0 m and finite, not {self.voxel_size}")
        for name in ("capacity", "max_voxels"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if not 1 <= self.max_points <= _MOST_POINTS:
            raise ValueError(f"max_points must be 1 to {_MOST_POINTS}, not {self.max_points}")
        if self.max_voxels * self.max_points >= 1 << 31:
            raise ValueError(f"max_voxels × max_points must stay below 2³¹, not {self.max_voxels * self.max_points}")
        if self.max_distance is not None and not self.max_distance > 0:
            raise ValueError(f"max_distance must be > 0 m or None, not {self.max_distance}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        slots = max(128, 4 << (self.max_voxels - 1).bit_length())
        keep("_sequential", self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE))
        buffer("table", (slots, 2), wp.int64)
        keep("points", wp.empty(self.max_voxels * self.max_points, dtype=wp.vec3, device=device))
        buffer("_key_of_voxel", self.max_voxels, wp.int64)
        buffer("_points_in_voxel", self.max_voxels, wp.int32)
        buffer("_free", self.max_voxels, wp.int32)
        buffer("free_count", 1, wp.int32)
        buffer("dropped", 2, wp.int32)
        buffer("_pruned_at", 1, wp.vec3d)
        if not self._sequential:
            buffer("_is_free", self.max_voxels, wp.int32)
            buffer("_free_rank", self.max_voxels, wp.int32)
            buffer("_key", 2 * self.capacity, wp.int64)
            buffer("_point", 2 * self.capacity, wp.int32)
            for name in ("_new", "_rank", "_slot"):
                buffer(name, self.capacity, wp.int32)
        self.clear()

    def clear(self) -> None:
        """Empties the map; allocates nothing, reads nothing back."""
        self._pruned_at.zero_()
        self.dropped.zero_()
        self._run(_clear, self.table.shape[0], [], [self.table, self._key_of_voxel, self._free, self.free_count])

    def launch(self, xyz: wp.array, count: wp.array, pose: wp.array) -> None:
        """Adds the first `count[0]` points, then lets far voxels go; allocates nothing, reads nothing back.

        Args:
            xyz: Positions in the sensor's frame [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            pose: Map from sensor, shape (1,), mat44d.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        spacing_sq = self.voxel_size * self.voxel_size / self.max_points
        settings = [self.voxel_size, self.max_points, spacing_sq]
        if n == 0:
            pass
        elif self._sequential:
            voxels = [self._key_of_voxel, self._points_in_voxel, self._free, self.free_count]
            outputs = [self.table, self.points, *voxels, self.dropped]
            self._run(_insert_in_order, 1, [xyz, count, pose, *settings], outputs)
        else:
            self._insert_shared(xyz, count, pose, settings)
        if self.max_distance is not None:
            self._prune(pose)

    def _insert_shared(self, xyz: wp.array, count: wp.array, pose: wp.array, settings: list) -> None:
        n = xyz.shape[0]
        new, rank, slot = self._new[:n], self._rank[:n], self._slot[:n]
        self._run(_sort_keys, n, [xyz, count, pose, self.voxel_size], [self.dropped, self._key, self._point, new])
        wp.utils.radix_sort_pairs(self._key, self._point, n)
        key, point = self._key[:n], self._point[:n]
        self._run(_mark_new, n, [key, point, self.table], [slot, new])
        wp.utils.array_scan(new, rank, inclusive=True)
        self._run(
            _insert_segments,
            n,
            [xyz, pose, *settings, key, point, slot, rank, new, self._free, self.free_count],
            [self.table, self.points, self._key_of_voxel, self._points_in_voxel, self.dropped],
        )
        self._run(_take_free, 1, [rank], [self.free_count])

    def _prune(self, pose: wp.array) -> None:
        size, reach, step = self.voxel_size, self.max_distance, self.max_distance / 10.0
        keys, counts = self._key_of_voxel, self._points_in_voxel
        if self._sequential:
            outputs = [self._pruned_at, self.table, keys, counts, self._free, self.free_count]
            self._run(_prune_in_order, 1, [pose, size, reach, step], outputs)
            return
        inputs = [pose, size, reach, step, self._pruned_at]
        self._run(_mark_free, self.table.shape[0], inputs, [keys, self.table, self._is_free])
        wp.utils.array_scan(self._is_free, self._free_rank, inclusive=True)
        inputs = [pose, step, self._pruned_at, keys, counts, self._is_free, self._free_rank]
        self._run(_rebuild, self.max_voxels, inputs, [self.table, self._free, self.free_count])
        self._run(_note_place, 1, [pose, step], [self._pruned_at])

    def _run(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.table.device)

    def to_numpy(self) -> np.ndarray:
        """All points of the map [m], voxel by voxel, shape (m, 3), float64; reads back."""
        keys = self._key_of_voxel.numpy()
        voxels = np.flatnonzero(keys != -1)
        low = (1 << 21) - 1
        cells = np.stack([keys >> 42, (keys >> 21) & low, keys & low], axis=1)[voxels] - (1 << 20)
        counts = self._points_in_voxel.numpy()[voxels]
        taken = np.arange(self.max_points) < counts[:, None]
        offsets = self.points.numpy().reshape(self.max_voxels, self.max_points, 3)[voxels][taken]
        return np.repeat(cells * self.voxel_size, counts, axis=0) + offsets
