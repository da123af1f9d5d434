"""A cloud's points sorted by voxel, for many threads at once, with the voxels numbered by their lowest point."""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE
from .voxel_grid import VoxelGrid, cell_number, voxel_of

__all__ = ["VoxelSort"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})


@wp.kernel
def _sort_keys(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    # out
    key_out: wp.array(dtype=wp.int64),
    point_out: wp.array(dtype=wp.int32),
    first_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """The cell of each point; points without one get the number after the last, and sort to the end."""
    i = wp.tid()
    key = grid.total
    if i < count_in[0]:
        voxel = voxel_of(xyz_in[i], grid)
        if voxel[0] >= 0:
            key = cell_number(voxel, grid)
        else:
            wp.atomic_add(outside_out, 0, 1)
    key_out[i] = key
    point_out[i] = i
    first_out[i] = 0


@wp.kernel
def _mark_heads(
    # in
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    # out
    head_out: wp.array(dtype=wp.int32),
    first_out: wp.array(dtype=wp.int32),
):
    """Marks where a cell begins among the sorted points, and the lowest point of each cell among all points."""
    j = wp.tid()
    head = int(0)
    key = key_in[j]
    if key < grid.total and (j == 0 or key_in[j - 1] != key):
        head = 1
    head_out[j] = head
    if head == 1:
        first_out[point_in[j]] = 1


@wp.kernel
def _mark_starts(
    # in
    head_in: wp.array(dtype=wp.int32),
    segment_in: wp.array(dtype=wp.int32),
    # out
    start_out: wp.array(dtype=wp.int32),
):
    j = wp.tid()
    if head_in[j] == 1:
        start_out[segment_in[j] - 1] = j


class VoxelSort:
    """Workspace to sort clouds of up to `capacity` points; what is in it is for kernels to read."""

    def __init__(self, grid: VoxelGrid, capacity: int, device: str = DEFAULT_DEVICE):
        """Makes it."""

        def buffer(length: int, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=device)

        self._grid = grid
        self._bits = int(grid.total).bit_length()
        self.key = buffer(2 * capacity, wp.int64)
        """The cells in order; the grid's `total` stands for none."""
        self.point = buffer(2 * capacity)
        """The points by cell, in order within one."""
        self.segment = buffer(capacity)
        """Of each sorted point: how many cells there are up to its own."""
        self.start = buffer(capacity)
        """Where each cell begins among the sorted points."""
        self.number = buffer(capacity)
        """Of each point in the order of the input: how many voxels have a point up to it."""
        self._first = buffer(capacity)
        self._head = buffer(capacity)

    def launch(self, xyz: wp.array, count: wp.array, outside: wp.array) -> None:
        """Sorts n > 0 points, and adds those without a voxel to `outside`, shape (1,)."""
        n = xyz.shape[0]
        first, number, head, segment = self._first[:n], self.number[:n], self._head[:n], self.segment[:n]

        def run(kernel: wp.Kernel, inputs: list, outputs: list) -> None:
            wp.launch(kernel, n, inputs=inputs, outputs=outputs, device=xyz.device)

        run(_sort_keys, [xyz, count, self._grid], [self.key, self.point, first, outside])
        wp.utils.radix_sort_pairs(self.key, self.point, n, end_bit=self._bits)
        run(_mark_heads, [self.key, self.point, self._grid], [head, first])
        wp.utils.array_scan(head, segment, inclusive=True)
        wp.utils.array_scan(first, number, inclusive=True)
        run(_mark_starts, [head, segment], [self.start])
