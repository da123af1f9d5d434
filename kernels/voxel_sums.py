"""The points of each voxel summed on a CPU: by one thread at once, or by a few, each with voxels of its own.

Points one after the other in a scan are mostly in one voxel. So these runs are found first, a block of points at a time
and without a branch: the cell of each, and the sums of all points before it, from which its own follow. A hash table
then leads to the voxel of each run; most are of a voxel that is not there yet.

Several threads find the runs in parts by points; then each goes through all of them in order, and adds those that are
its own to their voxels: the slot where its hash table has a voxel first says whose that is, as blocks of 8 × 8 × 1
cells are dealt to the parts. Last the voxels are numbered, together with the others', by their first points, since each
part has its own in that order.
"""

from __future__ import annotations

import warp as wp

from .parts import packed_parts, part_start
from .point_lanes import LOAD_POINTS

__all__ = ["VoxelSums"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN_WORDS, _ROW_WORDS = 6, 6  # of 64 bits

# What a run and a voxel are in memory. A run's points end, and its sums are complete, where the one after it begins.
_RECORDS = """
    struct Run {
        long long before[4];  // sums along x y z of all points of the part before the run, and how many these are
        int cell[3], slot;
    };
    struct Row {
        long long sum[4];
        int cell[3], slot;
    };
"""


# C++ for what follows: `add_runs(start, length, run)` puts the runs of a block of points after `run`, the last of those
# before, and gives the last; the one after that is where it ends.
_FIND = (
    LOAD_POINTS
    + """
    constexpr int BLOCK = 128;
    const float* points = (const float*)xyz_in.data;
    const long long step = xyz_in.strides[0] / 4;
    float along[3][BLOCK];
    int cell[3][BLOCK + 1], slot[BLOCK + 1];  // the first is of the point before the block
    int cell_and_slot[BLOCK][4], is_new[BLOCK];
    long long fixed_and_one[BLOCK][4], before[4] = {0, 0, 0, 0};
    for (int axis = 0; axis < 3; ++axis) cell[axis][0] = 0;
    slot[0] = -2;  // as no point's
    const auto add_runs = [&](const int start, const int length, Run* run) {
        load_points(points + step * start, step, length, along);
        for (int k = 0; k < length; ++k) {
            float x = along[0][k], y = along[1][k], z = along[2][k];
            // All comparisons are false for a NaN.
            const bool usable = (x < limit) & (x > -limit) & (y < limit) & (y > -limit) & (z < limit) & (z > -limit);
            along[0][k] = x = usable ? x : 0.0f;
            along[1][k] = y = usable ? y : 0.0f;
            along[2][k] = z = usable ? z : 0.0f;
            const float u = x * inverse_size, v = y * inverse_size, w = z * inverse_size;
            const int a = (int)u, b = (int)v, c = (int)w;
            const int cell_x = a - ((float)a > u), cell_y = b - ((float)b > v), cell_z = c - ((float)c > w);
            const unsigned block = (unsigned)(cell_x >> 3) * 73856093u ^ (unsigned)(cell_y >> 3) * 19349669u
                ^ (unsigned)cell_z * 83492791u;
            const unsigned within = (unsigned)((cell_x & 7) << 3 | (cell_y & 7));
            cell[0][k + 1] = cell_x;
            cell[1][k + 1] = cell_y;
            cell[2][k + 1] = cell_z;
            slot[k + 1] = usable ? (int)(((block * 0x9E3779B1u >> 8) << 6 | within) & (unsigned)(slots - 1)) : -1;
        }
        for (int k = 0; k < length; ++k)
            is_new[k] = ((slot[k] ^ slot[k + 1]) | (cell[0][k] ^ cell[0][k + 1]) | (cell[1][k] ^ cell[1][k + 1])
                | (cell[2][k] ^ cell[2][k + 1])) != 0;
        for (int k = 0; k < length; ++k) {
            for (int axis = 0; axis < 3; ++axis) {
                cell_and_slot[k][axis] = cell[axis][k + 1];
                fixed_and_one[k][axis] = (long long)(along[axis][k] * scale);
            }
            cell_and_slot[k][3] = slot[k + 1];
            fixed_and_one[k][3] = 1;
        }
        for (int k = 0; k < length; ++k) {
            run += is_new[k];
            memcpy(run->cell, cell_and_slot[k], sizeof(cell_and_slot[k]));
            for (int n = 0; n < 4; ++n) before[n] += fixed_and_one[k][n];
            memcpy(run[1].before, before, sizeof(before));
        }
        for (int axis = 0; axis < 3; ++axis) cell[axis][0] = cell[axis][length];
        slot[0] = slot[length];
        return run;
    };
"""
)

# `sum_run(run, end)` adds a run to its voxel, or makes that; `end` is the run after it.
_SUM = """
    const int slots = table.shape[1];
    int* __restrict voxel_in = table.data + (long long)slots * part;
    Row* __restrict row = (Row*)rows.data + rows.shape[1] * part;
    int* __restrict first_of_row = first_out.data + rows.shape[1] * part;
    int voxels = 0;
    const auto fetch = [&](const Run& run) {
    #ifndef __CUDA_ARCH__
        __builtin_prefetch(voxel_in + (run.slot < 0 ? 0 : run.slot), 1);
    #endif
    };
    const auto sum_run = [&](const Run& run, const Run& end, const int first_point) {
        int slot = run.slot, found = voxel_in[slot];
        while (found >= 0 && ((row[found].cell[0] ^ run.cell[0]) | (row[found].cell[1] ^ run.cell[1])
                | (row[found].cell[2] ^ run.cell[2])) != 0) {
            slot = (slot + 65) & (slots - 1);  // in the next block, since the neighbours in this one have their own
            found = voxel_in[slot];
        }
        if (found < 0) {
            for (int n = 0; n < 4; ++n) row[voxels].sum[n] = end.before[n] - run.before[n];
            memcpy(row[voxels].cell, run.cell, sizeof(run.cell));
            row[voxels].slot = slot;
            first_of_row[voxels] = first_point + (int)run.before[3];
            voxel_in[slot] = voxels++;
        } else
            for (int n = 0; n < 4; ++n) row[found].sum[n] += end.before[n] - run.before[n];
    };
"""


@wp.func_native(
    _RECORDS
    + _SUM
    + _FIND
    + """
    Run runs[BLOCK + 2];
    memcpy(runs[0].before, before, sizeof(before));
    memcpy(runs[1].before, before, sizeof(before));
    runs[0].slot = -1;  // as if an unusable run of no points came first
    Run* last = runs;
    long long unusable = 0;
    const auto sum = [&](const int length) {
        for (int r = 0; r < length; ++r) {
            if (runs[r].slot >= 0) sum_run(runs[r], runs[r + 1], 0);
            else unusable += runs[r + 1].before[3] - runs[r].before[3];
        }
    };
    for (int start = 0; start < points_in; start += BLOCK) {
        last = add_runs(start, points_in - start < BLOCK ? points_in - start : BLOCK, last);
        const int length = (int)(last - runs);
        for (int r = 0; r <= length; ++r) fetch(runs[r]);
        sum(length);
        runs[0] = last[0];
        memcpy(runs[1].before, before, sizeof(before));
        last = runs;
    }
    if (points_in > 0) sum(1);
    voxels_out.data[0] = voxels;
    dropped_out.data[0] = (int)unusable;
"""
)
def _sum_at_once(
    part: int,
    xyz_in: wp.array(dtype=wp.vec3),
    points_in: int,
    inverse_size: float,
    limit: float,
    scale: float,
    table: wp.array2d(dtype=wp.int32),
    rows: wp.array3d(dtype=wp.int64),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Adds the runs of one block of points after the other to their voxels."""


@wp.kernel
def _sum_all(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    inverse_size: float,
    limit: float,
    scale: float,
    # in out: a table of voxels, -1 where free
    table: wp.array2d(dtype=wp.int32),
    # out: the voxels, the first point of each, and how many there are
    rows_out: wp.array3d(dtype=wp.int64),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """All voxels, by one thread: no run leaves its cache."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    _sum_at_once(0, xyz_in, n, inverse_size, limit, scale, table, rows_out, first_out, voxels_out, dropped_out)


@wp.func_native(
    _RECORDS
    + _FIND
    + """
    Run* const runs = (Run*)runs_out.data + first + part;  // each part has one more than points
    memcpy(runs->before, before, sizeof(before));
    Run* last = runs - 1;
    for (int start = first; start < end; start += BLOCK)
        last = add_runs(start, end - start < BLOCK ? end - start : BLOCK, last);
    range_out.data[part] = wp::vec3i(first + part, first + part + (int)(last + 1 - runs), first);
"""
)
def _find_runs(
    part: int,
    first: int,
    end: int,
    xyz_in: wp.array(dtype=wp.vec3),
    inverse_size: float,
    limit: float,
    scale: float,
    slots: int,
    runs_out: wp.array2d(dtype=wp.int64),
    range_out: wp.array(dtype=wp.vec3i),
):
    """The runs of the points first … end − 1; those of a block of cells have slots side by side."""


@wp.kernel
def _find_runs_of_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    inverse_size: float,
    limit: float,
    scale: float,
    slots: int,
    # out
    runs_out: wp.array2d(dtype=wp.int64),
    range_out: wp.array(dtype=wp.vec3i),
):
    """The runs of each part; where these are, first and end, and which is the first point."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    end = part_start(n, part + 1, parts)
    _find_runs(part, first, end, xyz_in, inverse_size, limit, scale, slots, runs_out, range_out)


@wp.func_native(
    _RECORDS
    + _SUM
    + """
    constexpr int AHEAD = 16;
    const Run* __restrict runs = (const Run*)runs_in.data;
    int block_bits = 0;
    while (64 << block_bits < slots) ++block_bits;
    long long unusable = 0;
    for (int p = 0; p < parts; ++p) {
        const int end = ranges_in.data[p][1], first_point = ranges_in.data[p][2];
        for (int r = ranges_in.data[p][0]; r < end; ++r) {
            if (r + AHEAD < end) fetch(runs[r + AHEAD]);
            const int slot = runs[r].slot;
            if (slot < 0) unusable += runs[r + 1].before[3] - runs[r].before[3];
            else if ((int)((unsigned)(slot >> 6) * (unsigned)parts >> block_bits) == part)
                sum_run(runs[r], runs[r + 1], first_point);
        }
    }
    voxels_out.data[part] = voxels;
    if (part == 0) dropped_out.data[0] = (int)unusable;
"""
)
def _sum_own(
    part: int,
    parts: int,
    runs_in: wp.array2d(dtype=wp.int64),
    ranges_in: wp.array(dtype=wp.vec3i),
    table: wp.array2d(dtype=wp.int32),
    rows: wp.array3d(dtype=wp.int64),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Adds the runs of a part's blocks of cells to their voxels."""


@wp.kernel
def _sum_part(
    # in
    part: int,
    parts: int,
    runs_in: wp.array2d(dtype=wp.int64),
    ranges_in: wp.array(dtype=wp.vec3i),
    # in out: of each part a table of its voxels, -1 where free
    table: wp.array2d(dtype=wp.int32),
    # out: of each part its voxels, the first point of each, and how many there are
    rows_out: wp.array3d(dtype=wp.int64),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """The voxels of a part."""
    _sum_own(part, parts, runs_in, ranges_in, table, rows_out, first_out, voxels_out, dropped_out)


@wp.func_native(
    _RECORDS
    + """
    constexpr int MOST = 64;
    const long long capacity = rows_in.shape[1];
    const Row* __restrict row = (const Row*)rows_in.data + capacity * part;
    const int* __restrict first = first_in.data + capacity * part;
    float* __restrict centroids = (float*)centroids_out.data;
    int* __restrict voxel_in = table.data + (long long)table.shape[1] * part;
    int passed[MOST] = {};
    const bool at_once = voxels_in.data[part] > table.shape[1] / 16;  // are all slots freed, rather than one by one
    int place = 0;
    for (int voxel = 0; voxel < voxels_in.data[part]; ++voxel, ++place) {
        for (int other = 0; other < parts; ++other) {
            if (other == part) continue;
            const int* __restrict theirs = first_in.data + capacity * other;
            int& at = passed[other];
            for (; at < voxels_in.data[other] && theirs[at] < first[voxel]; ++at) ++place;
        }
        const double inverse = 1.0 / ((double)row[voxel].sum[3] * (double)scale);
        for (int axis = 0; axis < 3; ++axis)
            centroids[3ll * place + axis] = (float)((double)row[voxel].sum[axis] * inverse);
        if (!at_once) voxel_in[row[voxel].slot] = -1;
    }
    if (at_once) memset(voxel_in, -1, sizeof(int) * table.shape[1]);
    if (part == 0) {
        int voxels = 0;
        for (int each = 0; each < parts; ++each) voxels += voxels_in.data[each];
        centroid_count_out.data[0] = voxels;
    }
"""
)
def _write_centroids(
    part: int,
    parts: int,
    rows_in: wp.array3d(dtype=wp.int64),
    first_in: wp.array2d(dtype=wp.int32),
    voxels_in: wp.array(dtype=wp.int32),
    scale: float,
    table: wp.array2d(dtype=wp.int32),
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
):
    """A voxel's place is how many voxels, of all parts, have a lower first point."""


@wp.kernel
def _write_part(
    # in
    part: int,
    parts: int,
    rows_in: wp.array3d(dtype=wp.int64),
    first_in: wp.array2d(dtype=wp.int32),
    voxels_in: wp.array(dtype=wp.int32),
    scale: float,
    # in out: left free
    table: wp.array2d(dtype=wp.int32),
    # out
    centroids_out: wp.array(dtype=wp.vec3),
    centroid_count_out: wp.array(dtype=wp.int32),
):
    """The centroids of a part's voxels, at their places among those of all parts."""
    _write_centroids(part, parts, rows_in, first_in, voxels_in, scale, table, centroids_out, centroid_count_out)


class VoxelSums:
    """Workspace to sum the voxels of clouds of up to `capacity` points, cut into `parts`, at most 64."""

    def __init__(
        self,
        capacity: int,
        parts: int,
        device: str,
        grid: tuple[float, float, float],
        centroids: wp.array,
        centroid_count: wp.array,
        dropped: wp.array,
    ):
        """Makes it to fill `centroids` and the counts.

        Args:
            capacity: Points that one launch can take.
            parts: Into how many the work is cut.
            device: A Warp device.
            grid: 1 / the edge of a voxel, the reach, the integers per metre, a power of two.
            centroids: Shape (capacity,), vec3.
            centroid_count: Shape (1,), int32.
            dropped: Shape (1,), int32: points out of reach.
        """

        def buffer(shape: int | tuple[int, ...], dtype: type = wp.int32) -> wp.array:
            return wp.empty(shape, dtype=dtype, device=device)

        slots = max(64, 2 << (capacity - 1).bit_length())
        table = wp.full((parts, slots), -1, dtype=wp.int32, device=device)
        # Whose a run is, is not known before: memory that is not used is not there either.
        rows, first = buffer((parts, capacity, _ROW_WORDS), wp.int64), buffer((parts, capacity))
        voxels = buffer(parts)
        summed = [table, rows, first, voxels, dropped]
        if parts == 1:
            self._first = packed_parts(_sum_all, None, device, [None, None, *grid], summed)
            self._second = None
        else:
            runs, ranges = buffer((capacity + parts, _RUN_WORDS), wp.int64), buffer(parts, wp.vec3i)
            self._first = packed_parts(_find_runs_of_part, parts, device, [None, None, *grid, slots], [runs, ranges])
            self._second = packed_parts(_sum_part, parts, device, [runs, ranges], summed)
        self._write = packed_parts(
            _write_part, parts, device, [rows, first, voxels, grid[2]], [table, centroids, centroid_count]
        )

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Sums the first `count[0]` points."""
        self._first(xyz_in=xyz, count_in=count)
        if self._second is not None:
            self._second()
        self._write()
