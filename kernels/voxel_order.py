"""A cloud's voxels numbered one after the other, as a CPU does it, in the order of the points.

First the cell of each point, without a branch and in parts, then one thread looks the cells up, point after point, in a
dense grid, or in a hash table where a grid would be too large, and lists the points voxel by voxel. What is done with
the voxels then is cut into parts, and writes them one after the other.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE
from .parts import part_start, parts_for, run_parts
from .voxel_grid import VoxelGrid

__all__ = ["VoxelOrder"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_DENSE_CELLS = 1 << 22  # of 4 bytes: larger grids miss the cache more than a hash table does
_LEAST_PART = 50_000  # points; fewer take less time than waking a second thread

# CELL stands for the type of a cell's number, 32 bits for a dense grid, 64 for a hash table.
_FIND_CELLS = """
    const auto run = [&](const float* __restrict points, const long long step, CELL* __restrict cell) {
        const float low[3] = {grid.low[0], grid.low[1], grid.low[2]};
        const float high[3] = {grid.high[0], grid.high[1], grid.high[2]};
        const float size[3] = {grid.size[0], grid.size[1], grid.size[2]};
        const int cells[3] = {grid.cells[0], grid.cells[1], grid.cells[2]};
        for (long long i = first; i < last; ++i) {
            const float px = points[i * step], py = points[i * step + 1], pz = points[i * step + 2];
            const bool inside = (px >= low[0]) & (py >= low[1]) & (pz >= low[2])
                & (px < high[0]) & (py < high[1]) & (pz < high[2]);
            const int x = (int)(inside ? (px - low[0]) / size[0] : 0.0f);
            const int y = (int)(inside ? (py - low[1]) / size[1] : 0.0f);
            const int z = (int)(inside ? (pz - low[2]) / size[2] : 0.0f);
            const bool exists = inside & (x < cells[0]) & (y < cells[1]) & (z < cells[2]);
            cell[i] = exists ? ((CELL)z * cells[1] + y) * cells[0] + x : -1;
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4, cell_out.data);
    else if (xyz_in.strides[0] == 12) run(points, 3, cell_out.data);
    else run(points, xyz_in.strides[0] / 4, cell_out.data);
"""

# The cells are known, so what is looked up soon can be fetched by now. Of a hash table the 16 cells of a run along x
# share a cache line. FIRST_SLOT of a cell leads to the `slot` with its voxel, or to a free one.
_NUMBER = """
    const CELL* __restrict cells = cell_in.data;
    int* __restrict slots = table.data;
    int* __restrict count = counts_out.data;
    const unsigned mask = (unsigned)table.shape[0] - 1;
    constexpr int AHEAD = 16;
    const auto first_slot = [&](const CELL cell) { return FIRST_SLOT; };
    int voxels = 0, outside = 0;
    for (int i = 0; i < points; ++i) {
        const CELL cell = cells[i];
    #ifndef __CUDA_ARCH__
        if (i + AHEAD < points && cells[i + AHEAD] >= 0) __builtin_prefetch(slots + first_slot(cells[i + AHEAD]));
    #endif
        if (cell < 0) {
            row_out.data[i] = -1;
            ++outside;
            continue;
        }
        auto slot = first_slot(cell);
        int row = slots[slot];
        for (; IS_OTHER; row = slots[slot]) slot = (slot + 1) & mask;
        const bool is_new = row < 0;  // no branch: there is no telling
        row = is_new ? voxels : row;
        voxels += is_new;
        slots[slot] = row;
        slot_of_row.data[row] = (int)slot;
        cell_of_row_out.data[row] = cell;
        count[row] = (is_new ? 0 : count[row]) + 1;
        row_out.data[i] = row;
    }
    int* __restrict end = end_out.data;
    for (int row = 0, before = 0; row < voxels; ++row) {
        slots[slot_of_row.data[row]] = -1;
        end[row] = before;
        before += count[row];
    }
    for (int i = 0; i < points; ++i)
        if (row_out.data[i] >= 0) point_out.data[end[row_out.data[i]]++] = i;
    voxels_out.data[1] = voxels_out.data[0];
    voxels_out.data[0] = voxels;
    outside_out.data[0] = outside;
"""
_IN_GRID = {"FIRST_SLOT": "cell", "IS_OTHER": "false", "CELL": "int"}
_IN_TABLE = {
    "FIRST_SLOT": """((unsigned)((unsigned long long)(cell >> 4) * 0x9E3779B97F4A7C15ull >> 32) << 4
        | (unsigned)(cell & 15)) & mask""",
    "IS_OTHER": "row >= 0 && cell_of_row_out.data[row] != cell",
    "CELL": "long long",
}


def _filled_in(code: str, words: dict[str, str]) -> str:
    for word, meaning in words.items():
        code = code.replace(word, meaning)
    return code


@wp.func_native(_filled_in(_FIND_CELLS, _IN_GRID))
def _find_cells(
    xyz_in: wp.array(dtype=wp.vec3), grid: VoxelGrid, first: int, last: int, cell_out: wp.array(dtype=wp.int32)
):
    """The numbers of the cells of the points first … last − 1, −1 where there is none."""


@wp.func_native(_filled_in(_FIND_CELLS, _IN_TABLE))
def _find_cells_of_many(
    xyz_in: wp.array(dtype=wp.vec3), grid: VoxelGrid, first: int, last: int, cell_out: wp.array(dtype=wp.int64)
):
    """The same for a grid of more than 2³¹ cells."""


@wp.func_native(_filled_in(_NUMBER, _IN_GRID))
def _number(
    points: int,
    cell_in: wp.array(dtype=wp.int32),
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    end_out: wp.array(dtype=wp.int32),
    point_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """Numbers the cells of a dense grid by their first points."""


@wp.func_native(_filled_in(_NUMBER, _IN_TABLE))
def _number_many(
    points: int,
    cell_in: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    end_out: wp.array(dtype=wp.int32),
    point_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """Numbers the cells in a hash table by their first points."""


@wp.kernel
def _find_cells_of_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    # out: one of the two is null
    cell_out: wp.array(dtype=wp.int32),
    cell_of_many_out: wp.array(dtype=wp.int64),
):
    """The cells of one part of the points."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    if cell_out:
        _find_cells(xyz_in, grid, first, last, cell_out)
    else:
        _find_cells_of_many(xyz_in, grid, first, last, cell_of_many_out)


@wp.kernel
def _number_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    found: int,
    # in out: the cells, one of the two null, if they are not yet found; table of voxels, -1 where free, and left so
    cell: wp.array(dtype=wp.int32),
    cell_of_many: wp.array(dtype=wp.int64),
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    # out
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    end_out: wp.array(dtype=wp.int32),
    point_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """One thread, point after point."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    if cell:
        if found == 0:
            _find_cells(xyz_in, grid, 0, n, cell)
        _number(
            n, cell, table, slot_of_row,
            cell_of_row_out, row_out, counts_out, end_out, point_out, voxels_out, outside_out,
        )  # fmt: skip
    else:
        if found == 0:
            _find_cells_of_many(xyz_in, grid, 0, n, cell_of_many)
        _number_many(
            n, cell_of_many, table, slot_of_row,
            cell_of_row_out, row_out, counts_out, end_out, point_out, voxels_out, outside_out,
        )  # fmt: skip


class VoxelOrder:
    """Workspace to number the voxels of clouds of up to `capacity` points; what is in it is for kernels to read."""

    def __init__(self, grid: VoxelGrid, capacity: int, device: str = DEFAULT_DEVICE, parts: int | None = None):
        """Makes it; `parts` is how many parts of a cloud are looked at at once, by default as it is worth."""

        def buffer(length: int, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=device)

        dense = grid.total <= _DENSE_CELLS
        self._grid = grid
        self._device = device
        self._parts = parts or parts_for(capacity, _LEAST_PART)
        slots = int(grid.total) if dense else 2 << max(capacity - 1, 8).bit_length()
        self._table = wp.full(slots, -1, dtype=wp.int32, device=device)
        self._slot_of_row = buffer(capacity)
        self._cells = [buffer(capacity), None] if dense else [None, buffer(capacity, wp.int64)]
        self.cell_of_row = buffer(capacity, wp.int64)
        """The number of each voxel's cell, x fastest."""
        self.row = buffer(capacity)
        """The voxel of each point, −1 where it has none."""
        self.counts = buffer(capacity)
        """Points of each voxel."""
        self.point = buffer(capacity)
        """The points voxel by voxel, in order within one."""
        self.end = buffer(capacity)
        """Where each voxel ends in `point`; it begins `counts` before."""
        self.voxels = wp.zeros(2, dtype=wp.int32, device=device)
        """How many voxels there are, and how many the launch before has found."""

    def launch(self, xyz: wp.array, count: wp.array, outside: wp.array, row: wp.array | None = None) -> None:
        """Numbers the voxels, and says how many points are `outside`, shape (1,); `row` is an array of the caller's."""
        given = [xyz, count, self._grid]
        if self._parts > 1:
            run_parts(_find_cells_of_part, self._parts, self._device, given, self._cells)
        row = self.row if row is None else row
        wp.launch(
            _number_in_order,
            1,
            inputs=[*given, int(self._parts > 1)],
            outputs=[
                *(
                    *self._cells,
                    self._table,
                    self._slot_of_row,
                    self.cell_of_row,
                    row,
                    self.counts,
                    self.end,
                    self.point,
                ),
                *(self.voxels, outside),
            ],
            device=self._device,
        )
