"""The points of each voxel summed by the threads of a CPU, each with a hash table and voxels of its own.

First each point's cell and slot, in parts by points. The slot says whose the point is: blocks of 8 × 8 × 1 cells are
dealt to the parts. Each part then goes through its points in order; and last its voxels are numbered, together with the
others', by their first points, since each part has its own in that order.

A voxel is one row, one cache line, of 64-bit numbers: cell x and y, cell z and slot, points, sums of x y z.
"""

from __future__ import annotations

import warp as wp

from .parts import packed_parts, part_start

__all__ = ["VoxelSums"]

# Which voxel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})


@wp.func_native("""
    const auto run = [&](const float* __restrict points, const long long step, int* __restrict cells,
                         int* __restrict slots) {
        for (long long i = first; i < last; ++i) {
            const float x = points[i * step], y = points[i * step + 1], z = points[i * step + 2];
            // All comparisons are false for a NaN.
            const bool usable = (x < limit) & (x > -limit) & (y < limit) & (y > -limit) & (z < limit) & (z > -limit);
            const float u = usable ? x * inverse_size : 0.0f, v = usable ? y * inverse_size : 0.0f;
            const float w = usable ? z * inverse_size : 0.0f;
            const int a = (int)u, b = (int)v, c = (int)w;
            const int cell_x = a - ((float)a > u), cell_y = b - ((float)b > v), cell_z = c - ((float)c > w);
            const unsigned block = (unsigned)(cell_x >> 3) * 73856093u ^ (unsigned)(cell_y >> 3) * 19349669u
                ^ (unsigned)cell_z * 83492791u;
            const unsigned within = (unsigned)((cell_x & 7) << 3 | (cell_y & 7));
            const unsigned slot = ((block * 0x9E3779B1u >> 8) << 6 | within) & mask;
            cells[3 * i] = cell_x;
            cells[3 * i + 1] = cell_y;
            cells[3 * i + 2] = cell_z;
            slots[i] = usable ? (int)slot : -1;
        }
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) run(points, 4, (int*)cells_out.data, slots_out.data);
    else if (xyz_in.strides[0] == 12) run(points, 3, (int*)cells_out.data, slots_out.data);
    else run(points, xyz_in.strides[0] / 4, (int*)cells_out.data, slots_out.data);
""")
def _find_cells(
    xyz_in: wp.array(dtype=wp.vec3),
    inverse_size: float,
    limit: float,
    mask: int,
    first: int,
    last: int,
    cells_out: wp.array(dtype=wp.vec3i),
    slots_out: wp.array(dtype=wp.int32),
):
    """Of the points first … last − 1 the cell and its first slot; those of a block of cells lie side by side."""


@wp.kernel
def _find_cells_of_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    inverse_size: float,
    limit: float,
    slots: int,
    # out
    cells_out: wp.array(dtype=wp.vec3i),
    slots_out: wp.array(dtype=wp.int32),
):
    """Of each point of a part its cell along x y z, and the slot where a hash table has it first, or −1."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    first = part_start(n, part, parts)
    last = part_start(n, part + 1, parts)
    _find_cells(xyz_in, inverse_size, limit, slots - 1, first, last, cells_out, slots_out)


@wp.func_native("""
    constexpr int XY = 0, Z_SLOT = 1, COUNT = 2, SUM = 3, ROW = 8, ROW_AHEAD = 12, SLOT_AHEAD = 24;
    const long long step = xyz_in.strides[0] / 4, capacity = rows.shape[1];
    const float* __restrict xyz = (const float*)xyz_in.data;
    const int* __restrict cells = (const int*)cells_in.data;
    const int* __restrict slot_of_point = slots_in.data;
    const int slots = table.shape[1], mask = slots - 1;
    int* __restrict voxel_in = table.data + (long long)slots * part;
    long long* __restrict all_rows = rows.data + capacity * ROW * part;
    int* __restrict first_of_voxel = first_out.data + capacity * part;
    int* __restrict own = own_out.data + capacity * part;

    int block_bits = 0;
    while (64 << block_bits < slots) ++block_bits;
    int owned = 0, unusable = 0;
    for (int i = 0; i < points; ++i) {
        const int slot = slot_of_point[i];
        own[owned] = i;
        owned += (slot >= 0) & ((int)((unsigned)(slot >> 6) * (unsigned)parts >> block_bits) == part);
        unusable += slot < 0;
    }

    int voxels = 0;
    for (int k = 0; k < owned; ++k) {
    #ifndef __CUDA_ARCH__
        // What is looked up soon is fetched by now, first the slot, then the row.
        if (k + SLOT_AHEAD < owned) {
            const int row = voxel_in[slot_of_point[own[k + ROW_AHEAD]]];
            __builtin_prefetch(voxel_in + slot_of_point[own[k + SLOT_AHEAD]]);
            __builtin_prefetch(all_rows + (long long)ROW * (row < 0 ? voxels : row), 1);
        }
    #endif
        const int i = own[k];
        int slot = slot_of_point[i], row = voxel_in[slot];
        const long long xy = (long long)cells[3ll * i] << 32 | (unsigned)cells[3ll * i + 1], z = cells[3ll * i + 2];
        long long* __restrict at = all_rows + (long long)ROW * (row < 0 ? 0 : row);
        while ((row >= 0) & ((at[XY] != xy) | (at[Z_SLOT] >> 32 != z))) {
            slot = (slot + 65) & mask;  // in the next block, since the neighbours in this one have slots of their own
            row = voxel_in[slot];
            at = all_rows + (long long)ROW * (row < 0 ? 0 : row);
        }
        const bool is_new = row < 0;  // no branch: there is no telling
        const long long keep = is_new ? 0 : -1;
        first_of_voxel[voxels] = i;
        row = is_new ? voxels : row;
        voxels += is_new;
        voxel_in[slot] = row;
        at = all_rows + (long long)ROW * row;
        at[XY] = xy;
        at[Z_SLOT] = z << 32 | slot;
        at[COUNT] = (at[COUNT] & keep) + 1;
        for (int axis = 0; axis < 3; ++axis)
            at[SUM + axis] = (at[SUM + axis] & keep) + (long long)(xyz[step * i + axis] * scale);
    }
    voxels_out.data[part] = voxels;
    if (part == 0) dropped_out.data[0] = unusable;
""")
def _sum_voxels(
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    points: int,
    cells_in: wp.array(dtype=wp.vec3i),
    slots_in: wp.array(dtype=wp.int32),
    scale: float,
    table: wp.array2d(dtype=wp.int32),
    rows: wp.array3d(dtype=wp.int64),
    own_out: wp.array2d(dtype=wp.int32),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Lists the points of a part, and adds each to its voxel."""


@wp.kernel
def _sum_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    cells_in: wp.array(dtype=wp.vec3i),
    slots_in: wp.array(dtype=wp.int32),
    scale: float,
    # in out: of each part a table of its voxels, -1 where free
    table: wp.array2d(dtype=wp.int32),
    # out: of each part its voxels and points, the first point of each voxel, and how many voxels there are
    rows_out: wp.array3d(dtype=wp.int64),
    own_out: wp.array2d(dtype=wp.int32),
    first_out: wp.array2d(dtype=wp.int32),
    voxels_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Adds the points of a part to their voxels, as integers in units of 1 / scale, a power of two."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    _sum_voxels(
        part, parts, xyz_in, n, cells_in, slots_in, scale,
        table, rows_out, own_out, first_out, voxels_out, dropped_out,
    )  # fmt: skip


@wp.func_native("""
    constexpr int Z_SLOT = 1, COUNT = 2, SUM = 3, ROW = 8, MOST = 64;
    const long long capacity = rows_in.shape[1];
    const long long* __restrict rows = rows_in.data + capacity * ROW * part;
    const int* __restrict first = first_in.data + capacity * part;
    float* __restrict centroids = (float*)centroids_out.data;
    int passed[MOST] = {};
    int place = 0;
    for (int voxel = 0; voxel < voxels_in.data[part]; ++voxel, ++place) {
        for (int other = 0; other < parts; ++other) {
            if (other == part) continue;
            const int* __restrict theirs = first_in.data + capacity * other;
            int& at = passed[other];
            for (; at < voxels_in.data[other] && theirs[at] < first[voxel]; ++at) ++place;
        }
        const long long* __restrict row = rows + (long long)ROW * voxel;
        const double inverse = 1.0 / ((double)row[COUNT] * (double)scale);
        for (int axis = 0; axis < 3; ++axis)
            centroids[3ll * place + axis] = (float)((double)row[SUM + axis] * inverse);
        table.data[(long long)table.shape[1] * part + (int)(row[Z_SLOT] & 0x7FFFFFFF)] = -1;
    }
    if (part == 0) {
        int voxels = 0;
        for (int each = 0; each < parts; ++each) voxels += voxels_in.data[each];
        centroid_count_out.data[0] = voxels;
    }
""")
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
            grid: 1 / the edge of a voxel, the reach, the integers per metre.
            centroids: Shape (capacity,), vec3.
            centroid_count: Shape (1,), int32.
            dropped: Shape (1,), int32: points out of reach.
        """

        def buffer(shape: int | tuple[int, ...], dtype: type = wp.int32) -> wp.array:
            return wp.empty(shape, dtype=dtype, device=device)

        inverse_size, limit, scale = grid
        slots = max(64, 2 << (capacity - 1).bit_length())
        cells, first_slots = buffer(capacity, wp.vec3i), buffer(capacity)
        table = wp.full((parts, slots), -1, dtype=wp.int32, device=device)
        # Whose a point is, is not known before: memory that is not used is not there either.
        rows = buffer((parts, capacity, 8), wp.int64)
        own, first, voxels = buffer((parts, capacity)), buffer((parts, capacity)), buffer(parts)
        self._find_cells = packed_parts(
            _find_cells_of_part, parts, device, [None, None, inverse_size, limit, slots], [cells, first_slots]
        )
        self._sum = packed_parts(
            _sum_part,
            parts,
            device,
            [None, None, cells, first_slots, scale],
            [table, rows, own, first, voxels, dropped],
        )
        self._write = packed_parts(
            _write_part, parts, device, [rows, first, voxels, scale], [table, centroids, centroid_count]
        )

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Sums the first `count[0]` points."""
        self._find_cells(xyz_in=xyz, count_in=count)
        self._sum(xyz_in=xyz, count_in=count)
        self._write()
