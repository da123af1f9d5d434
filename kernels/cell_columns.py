"""A cloud's points by cell, for a CPU: sorted by x, y and z, so that cells stand in columns and columns in rows.

First the cell of each point, for each part of the work a share of the points; then each part sorts the points of a
range of rows, and from there on has the cells of these to itself. `column_sort.py` has the sort, `cell_pairs.py` says
what a cell is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from .cell_pairs import Radius, cell_of, is_finite
from .column_sort import LAYOUT, LEFT_OUT, bits_for, sort_cells
from .device import DEFAULT_DEVICE
from .parts import part_start
from .threads import PackedLaunch, launch_parts, run_in_turn, thread_count
from .unchecked import put

__all__ = ["CellColumns", "aligned", "is_before", "parts_for"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_POINTS_WORTH_A_THREAD = 100_000  # fewer take less time than waking a second thread


@wp.func
def aligned(mask: wp.uint64, by: int) -> wp.uint64:
    """A mask moved by a number of heights; up to 63 of them, beyond which nothing is left."""
    moved = wp.uint64(0)
    if by >= 0 and by < 64:
        moved = mask >> wp.uint64(by)
    elif by < 0 and by > -64:
        moved = mask << wp.uint64(-by)
    return moved


@wp.func
def is_before(column: wp.vec4i, x: int, y: int) -> bool:
    """Whether a column comes before x and y."""
    return column[0] < x or (column[0] == x and column[1] < y)


# A block of points at a time, without a branch, which a compiler makes vector instructions of.
@wp.func_native("""
    constexpr int BLOCK = 256, NOWHERE = -2147483647 - 1;
    constexpr double FAR = 1073741824.0;
    const double inverse_side = radius.inverse_side;
    const unsigned char* __restrict include = has_include ? include_in.data : nullptr;
    const auto run = [&](const float* __restrict point, const long long step) {
        float along[3][BLOCK];
        int usable[BLOCK];
        for (int start = first; start < last; start += BLOCK) {
            const int length = last - start < BLOCK ? last - start : BLOCK, left = used - start;
            for (int k = 0; k < length; ++k)
                for (int axis = 0; axis < 3; ++axis) along[axis][k] = point[(start + k) * step + axis];
            for (int k = 0; k < length; ++k) {
                const float x = along[0][k], y = along[1][k], z = along[2][k];
                usable[k] = ((x - x) + (y - y) + (z - z) == 0.0f) & (k < left);
            }
            if (include != nullptr)
                for (int k = 0; k < length; ++k) usable[k] &= include[start + k] != 0;
            int far = 0;
            for (int axis = 0; axis < 3; ++axis) {
                int* __restrict out = cells_out.data + (long long)axis * cells_out.shape[1] + start;
                for (int k = 0; k < length; ++k) {
                    const double scaled = (double)(usable[k] ? along[axis][k] : 0.0f) * inverse_side;
                    const bool is_far = (scaled >= FAR) | (scaled <= -FAR);
                    far |= (int)is_far;
                    const int whole = (int)(is_far ? 0.0 : scaled);
                    const int cell = whole - (scaled < (double)whole);
                    out[k] = axis > 0 || usable[k] ? cell : NOWHERE;
                }
            }
            if (far) return false;
            int* __restrict number = cell_of_point.data + start;
            for (int k = 0; k < length; ++k) number[k] = -1;  // of points that take part it is set later
        }
        return true;
    };
    const float* points = (const float*)xyz_in.data;
    if (xyz_in.strides[0] == 16) return run(points, 4);
    if (xyz_in.strides[0] == 12) return run(points, 3);
    return run(points, xyz_in.strides[0] / 4);
""")
def _find_near_cells(
    first: int,
    last: int,
    used: int,
    xyz_in: wp.array(dtype=wp.vec3),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    cells_out: wp.array2d(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
) -> bool:
    """As `_find_cells` for the points first … last − 1 and one radius; False where a point is too far out for that."""
    return False


@wp.kernel
def _find_cells(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    include_in: wp.array(dtype=wp.uint8),
    has_include: int,
    radius: Radius,
    # out; and how many points there are to label
    cells_out: wp.array2d(dtype=wp.int32),
    cell_of_point: wp.array(dtype=wp.int32),
    point_count_out: wp.array(dtype=wp.int32),
):
    """Finds the cell of each point."""
    n = xyz_in.shape[0]
    used = wp.min(count_in[0], n)
    i = part_start(n, part, parts)
    end = part_start(n, part + 1, parts)
    if part == 0:
        point_count_out[0] = n
    if radius.per_metre == wp.float64(0.0) and _find_near_cells(
        i, end, used, xyz_in, include_in, has_include, radius, cells_out, cell_of_point
    ):
        return
    while i < end:
        point = xyz_in[i]
        usable = i < used and is_finite(point)
        if usable and has_include != 0:
            usable = include_in[i] != wp.uint8(0)
        cell = wp.vec3i(LEFT_OUT, 0, 0)
        if usable:
            cell = cell_of(point, radius)
        for axis in range(3):
            cells_out[axis, i] = cell[axis]
        put(cell_of_point, i, -1)
        i += 1


def parts_for(capacity: int) -> int:
    """Into how many parts the work on clouds of up to `capacity` points is cut."""
    return max(1, min(thread_count(), capacity // _POINTS_WORTH_A_THREAD))


class CellColumns:
    """Workspace to sort clouds of up to `capacity` points into columns of cells; what is in it is for kernels."""

    def __init__(self, radius: Radius, capacity: int, parts: int | None = None, ordered: bool = True):
        """Makes it.

        Args:
            radius: What the side of the cells follows from.
            capacity: Points that one launch can take.
            parts: Into how many the work is cut; by default as `parts_for` says.
            ordered: Whether `order` is wanted.
        """
        self.parts = parts_for(capacity) if parts is None else parts

        def buffer(shape: int | tuple[int, int] = capacity, dtype: type = wp.int32) -> wp.array:
            return wp.empty(shape, dtype=dtype, device=DEFAULT_DEVICE)

        self.radius = radius
        self.point_count = wp.zeros(1, dtype=wp.int32, device=DEFAULT_DEVICE)
        """Rows of the cloud, whether they take part or not."""
        self.order = buffer() if ordered else None
        """The points' indices by cell, in each cell in their own order."""
        self.points = buffer(dtype=wp.vec3)
        """The points in this order."""
        self.cell_of_point = buffer()
        """The number of each point's cell, or -1 for points that are left out."""
        self.stacks = buffer(capacity + self.parts, wp.vec2i)
        """Of each cell its z, and where its points begin; they end where those of the next begin."""
        self.columns = buffer(capacity + 1, wp.vec4i)
        """Of each column x, y, its first cell, and the one after its last; columns of one x are of one part."""
        self.ranges = wp.zeros(self.parts, dtype=wp.vec4i, device=DEFAULT_DEVICE)
        """Of each part its first cell, the one after its last, its first column, and the one after its last."""
        cells = buffer((3, capacity))
        self._find_cells = PackedLaunch(
            _find_cells,
            min(self.parts, parts_for(capacity)),
            [None, None, None, 0, radius],
            [cells, self.cell_of_point, self.point_count],
        )
        words = bits_for(capacity, self.parts) + 1
        self.bits = [
            *(buffer((self.parts, words), wp.uint64), buffer((self.parts, words)), buffer(capacity + self.parts)),
            buffer((self.parts, LAYOUT)),
        ]
        """Where columns are, for `FIND_COLUMNS`."""
        self._sort_cells = self.packed(
            sort_cells,
            [None, cells, self.point_count, int(radius.per_metre > 0)],
            [
                *(buffer(), buffer(), buffer(dtype=wp.uint64), buffer(), buffer(capacity + self.parts)),
                *self.bits,
                *(self.order, self.cell_of_point, self.points, self.stacks, self.columns, self.ranges),
            ],
        )

    def packed(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any]) -> PackedLaunch:
        """The launch of a kernel once per part."""
        return PackedLaunch(kernel, self.parts, inputs, outputs)

    def run(self, kernel: Any, inputs: Sequence[Any], outputs: Sequence[Any]) -> None:
        """Launches a kernel once per part."""
        launch_parts(kernel, self.parts, inputs, outputs)

    def launch(
        self,
        xyz: wp.array,
        count: wp.array,
        include: wp.array,
        has_include: int,
        then: PackedLaunch | None = None,
    ) -> None:
        """Fills everything; `then` is launched on it, each part where it was sorted."""
        self._find_cells.launch(xyz_in=xyz, count_in=count, include_in=include, has_include=has_include)
        sort = self._sort_cells.calls(xyz_in=xyz)
        run_in_turn(sort, then.calls() if then else [lambda: None] * len(sort))
