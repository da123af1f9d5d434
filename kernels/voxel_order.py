"""A cloud's voxels numbered one after the other, as a CPU does it, in the order of the points.

Points one after the other in a scan are mostly in one voxel. So first, without a branch and in parts by points, these
runs are found, then one thread looks up the cell of each run, in a dense grid, or in a hash table where a grid would be
too large, and links the runs of a voxel. What is done with the voxels then is cut into parts, and writes them one
after the other.
"""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE
from .parts import packed_parts, part_start, parts_for
from .point_lanes import LOAD_POINTS
from .voxel_grid import VoxelGrid

__all__ = ["VoxelOrder"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_DENSE_CELLS = 1 << 22  # of 4 bytes: larger grids miss the cache more than a hash table does
_LEAST_PART = 250_000  # points; fewer take less time than waking a second thread

# CELL stands for the type of a cell's number, 32 bits for a dense grid, 64 for a hash table.
_FIND_RUNS = (
    LOAD_POINTS
    + """
    constexpr int BLOCK = 256;
    const float low[3] = {grid.low[0], grid.low[1], grid.low[2]};
    const float high[3] = {grid.high[0], grid.high[1], grid.high[2]};
    const float size[3] = {grid.size[0], grid.size[1], grid.size[2]};
    const int cells[3] = {grid.cells[0], grid.cells[1], grid.cells[2]};
    const float* points = (const float*)xyz_in.data;
    const long long step = xyz_in.strides[0] / 4;
    float along[3][BLOCK];
    CELL cell[BLOCK + 1];  // the first is that of the point before the block
    int is_new[BLOCK];
    const int begin = first + part;  // each part has one run more than points
    CELL* __restrict cell_of = cell_out.data;
    int* __restrict first_of = first_out.data;
    int run = begin - 1;
    cell[0] = -2;  // as no point's
    first_of[begin] = first;
    for (int start = first; start < last; start += BLOCK) {
        const int length = last - start < BLOCK ? last - start : BLOCK;
        load_points(points + step * start, step, length, along);
        for (int k = 0; k < length; ++k) {
            const float px = along[0][k], py = along[1][k], pz = along[2][k];
            const bool inside = (px >= low[0]) & (py >= low[1]) & (pz >= low[2])
                & (px < high[0]) & (py < high[1]) & (pz < high[2]);
            const int x = (int)(inside ? (px - low[0]) / size[0] : 0.0f);
            const int y = (int)(inside ? (py - low[1]) / size[1] : 0.0f);
            const int z = (int)(inside ? (pz - low[2]) / size[2] : 0.0f);
            const bool exists = inside & (x < cells[0]) & (y < cells[1]) & (z < cells[2]);
            cell[k + 1] = exists ? ((CELL)z * cells[1] + y) * cells[0] + x : -1;
        }
        for (int k = 0; k < length; ++k) is_new[k] = cell[k] != cell[k + 1];
        for (int k = 0; k < length; ++k) {
            run += is_new[k];
            cell_of[run] = cell[k + 1];
            first_of[run + 1] = start + k + 1;
        }
        cell[0] = cell[length];
    }
    ranges_out.data[part] = wp::vec2i(begin, run + 1);
"""
)

# The cells are known, so what is looked up soon can be fetched by now. Of a hash table the 16 cells of a run along x
# share a cache line. FIRST_SLOT of a cell leads to the `slot` with its voxel, or to a free one.
_NUMBER = """
    const CELL* __restrict cell_of = cell_in.data;
    const int* __restrict first_of = first_in.data;
    int* __restrict slots = table.data;
    int* __restrict count = counts_out.data;
    int* __restrict head = head_out.data;
    int* __restrict next = next_out.data;
    int* __restrict tail = tail_of_row.data;
    const unsigned mask = (unsigned)table.shape[0] - 1;
    constexpr int AHEAD = 16;
    const auto first_slot = [&](const CELL cell) { return FIRST_SLOT; };
    int voxels = 0, outside = 0;
    for (int p = 0; p < ranges_in.shape[0]; ++p) {
        const int end = ranges_in.data[p][1];
        for (int run = ranges_in.data[p][0]; run < end; ++run) {
        #ifndef __CUDA_ARCH__
            if (run + AHEAD < end && cell_of[run + AHEAD] >= 0)
                __builtin_prefetch(slots + first_slot(cell_of[run + AHEAD]), 1);
        #endif
            const CELL cell = cell_of[run];
            const int size = first_of[run + 1] - first_of[run];
            int row = -1;
            if (cell < 0) outside += size;
            else {
                auto slot = first_slot(cell);
                row = slots[slot];
                for (; IS_OTHER; row = slots[slot]) slot = (slot + 1) & mask;
                if (row < 0) {
                    row = voxels++;
                    slots[slot] = row;
                    slot_of_row.data[row] = (int)slot;
                    cell_of_row_out.data[row] = cell;
                    count[row] = size;
                    head[row] = run;
                } else {
                    count[row] += size;
                    next[tail[row]] = run;
                }
                tail[row] = run;
            }
            if (row_out.data)
                for (int k = 0; k < size; ++k) row_out.data[first_of[run] + k] = row;
        }
    }
    for (int row = 0; row < voxels; ++row) slots[slot_of_row.data[row]] = -1;
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


@wp.func_native(_filled_in(_FIND_RUNS, _IN_GRID))
def _find_runs(
    part: int,
    first: int,
    last: int,
    xyz_in: wp.array(dtype=wp.vec3),
    grid: VoxelGrid,
    cell_out: wp.array(dtype=wp.int32),
    first_out: wp.array(dtype=wp.int32),
    ranges_out: wp.array(dtype=wp.vec2i),
):
    """The runs of the points first … last − 1: the numbers of their cells, −1 where there is none."""


@wp.func_native(_filled_in(_FIND_RUNS, _IN_TABLE))
def _find_runs_of_many(
    part: int,
    first: int,
    last: int,
    xyz_in: wp.array(dtype=wp.vec3),
    grid: VoxelGrid,
    cell_out: wp.array(dtype=wp.int64),
    first_out: wp.array(dtype=wp.int32),
    ranges_out: wp.array(dtype=wp.vec2i),
):
    """The same for a grid of more than 2³¹ cells."""


@wp.func_native(_filled_in(_NUMBER, _IN_GRID))
def _number(
    cell_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    ranges_in: wp.array(dtype=wp.vec2i),
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    tail_of_row: wp.array(dtype=wp.int32),
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    head_out: wp.array(dtype=wp.int32),
    next_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """Numbers the cells of a dense grid by their first points."""


@wp.func_native(_filled_in(_NUMBER, _IN_TABLE))
def _number_many(
    cell_in: wp.array(dtype=wp.int64),
    first_in: wp.array(dtype=wp.int32),
    ranges_in: wp.array(dtype=wp.vec2i),
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    tail_of_row: wp.array(dtype=wp.int32),
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    head_out: wp.array(dtype=wp.int32),
    next_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """Numbers the cells in a hash table by their first points."""


@wp.kernel
def _find_runs_of_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    grid: VoxelGrid,
    # out: one of the first two is null
    cell_out: wp.array(dtype=wp.int32),
    cell_of_many_out: wp.array(dtype=wp.int64),
    first_out: wp.array(dtype=wp.int32),
    ranges_out: wp.array(dtype=wp.vec2i),
):
    """The runs of one part of the points, and where they are."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    if cell_out:
        _find_runs(part, first, last, xyz_in, grid, cell_out, first_out, ranges_out)
    else:
        _find_runs_of_many(part, first, last, xyz_in, grid, cell_of_many_out, first_out, ranges_out)


@wp.kernel
def _number_in_order(
    # in: one of the first two is null
    cell_in: wp.array(dtype=wp.int32),
    cell_of_many_in: wp.array(dtype=wp.int64),
    first_in: wp.array(dtype=wp.int32),
    ranges_in: wp.array(dtype=wp.vec2i),
    # in out: table of voxels, -1 where free, and left so
    table: wp.array(dtype=wp.int32),
    slot_of_row: wp.array(dtype=wp.int32),
    tail_of_row: wp.array(dtype=wp.int32),
    # out; the second may be null
    cell_of_row_out: wp.array(dtype=wp.int64),
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    head_out: wp.array(dtype=wp.int32),
    next_out: wp.array(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    outside_out: wp.array(dtype=wp.int32),
):
    """One thread, run after run."""
    if cell_in:
        _number(
            cell_in, first_in, ranges_in, table, slot_of_row, tail_of_row,
            cell_of_row_out, row_out, counts_out, head_out, next_out, voxels_out, outside_out,
        )  # fmt: skip
    else:
        _number_many(
            cell_of_many_in, first_in, ranges_in, table, slot_of_row, tail_of_row,
            cell_of_row_out, row_out, counts_out, head_out, next_out, voxels_out, outside_out,
        )  # fmt: skip


class VoxelOrder:
    """Workspace to number the voxels of clouds of up to `capacity` points; what is in it is for kernels to read.

    The points of a voxel are those of its runs, `head` and, as long as there are points left, the `next` of each. A
    run's begin at `first`, and end before that of the run after it.
    """

    def __init__(
        self,
        grid: VoxelGrid,
        capacity: int,
        outside: wp.array,
        row: wp.array | None = None,
        device: str = DEFAULT_DEVICE,
        parts: int | None = None,
    ):
        """Makes it.

        Args:
            grid: The cells.
            capacity: Points that one launch can take.
            outside: Out: how many points are in no cell, shape (1,), int32.
            row: Out, if wanted: the voxel of each point, −1 where it has none, shape (capacity,), int32.
            device: A Warp device.
            parts: How many parts of a cloud are looked at at once, by default as it is worth.
        """

        def buffer(length: int = capacity, dtype: type = wp.int32) -> wp.array:
            return wp.empty(length, dtype=dtype, device=device)

        dense = grid.total <= _DENSE_CELLS
        parts = parts or parts_for(capacity, _LEAST_PART)
        slots = int(grid.total) if dense else 2 << max(capacity - 1, 8).bit_length()
        runs = capacity + parts
        cells = [buffer(runs), None] if dense else [None, buffer(runs, wp.int64)]
        ranges = buffer(parts, wp.vec2i)
        table = wp.full(slots, -1, dtype=wp.int32, device=device)
        self.first = buffer(runs)
        """The first point of each run."""
        self.next = buffer(runs)
        """The next run of the same voxel."""
        self.head = buffer()
        """The first run of each voxel."""
        self.counts = buffer()
        """Points of each voxel."""
        self.cell_of_row = buffer(dtype=wp.int64)
        """The number of each voxel's cell, x fastest."""
        self.voxels = wp.zeros(2, dtype=wp.int32, device=device)
        """How many voxels there are, and how many the launch before has found."""
        self._find_runs = packed_parts(
            _find_runs_of_part, parts, device, [None, None, grid], [*cells, self.first, ranges]
        )
        self._number = packed_parts(
            _number_in_order,
            None,
            device,
            [*cells, self.first, ranges],
            [
                *(table, buffer(), buffer(), self.cell_of_row, row),
                *(self.counts, self.head, self.next, self.voxels, outside),
            ],
        )

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Numbers the voxels of the first `count[0]` points."""
        self._find_runs(xyz_in=xyz, count_in=count)
        self._number()
