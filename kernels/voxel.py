"""Voxelization, hard and with fixed capacities: the first points of each voxel, as networks for point clouds want them.

First come, first served: voxels are numbered by the lowest index of a point in them, and keep their first points in
the order of the input. A CPU does just that, for one run of points in a voxel after the other, then writes the voxels
in parts, one after the other. A GPU gets the same bytes from a stable sort by cell.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import reals, table, whole
from .backend import uses_taichi
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .parts import packed_parts, part_start, parts_for
from .plan import capacity_for, plan_for
from .voxel_grid import VoxelGrid, grid_of, voxel_of, write_coords
from .voxel_order import VoxelOrder
from .voxel_sort import VoxelSort

__all__ = ["Voxelize", "Voxels", "voxelize"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_LEAST_PART = 250_000  # points; fewer take less time than waking a second thread
_DROPPED_POINTS, _DROPPED_VOXELS, _OUTSIDE = (wp.constant(i) for i in range(3))


@wp.func
def _write_features(
    xyz: wp.array(dtype=wp.vec3),
    extra: wp.array2d(dtype=wp.float32),
    point: int,
    place: int,
    features: wp.array(dtype=wp.float32),
):
    """Copies a point's columns to a place, counted in points from the start of `features`."""
    columns = extra.shape[1]
    base = place * (columns + 3)
    position = xyz[point]
    features[base] = position[0]
    features[base + 1] = position[1]
    features[base + 2] = position[2]
    for column in range(columns):
        features[base + 3 + column] = extra[point, column]


@wp.func_native("""
    const int others = extra_in.shape[1], columns = 3 + others;
    const long long nx = grid.cells[0], ny = grid.cells[1];
    const long long step = xyz_in.strides[0] / 4, step_other = extra_in.strides[0] / 4;
    const float* __restrict xyz = (const float*)xyz_in.data;
    const float* __restrict extra = extra_in.data;
    const bool four_together = columns == 4 && step == step_other && extra == xyz + 3;
    const int* __restrict first_of = first_in.data;
    constexpr int ROWS_AHEAD = 8;
    // The first points of a voxel, one run of them after the other.
    const auto copy = [&](float* __restrict to, const int row, int left, const int width, const auto& copy_point) {
        for (int run = head_in.data[row]; left > 0; run = next_in.data[run]) {
            const int size = first_of[run + 1] - first_of[run], length = size < left ? size : left;
            for (int k = 0; k < length; ++k, to += width) copy_point(to, (long long)(first_of[run] + k));
            left -= length;
        }
    };
    for (int row = first; row < last; ++row) {
        float* __restrict to = features_out.data + (long long)row * max_points * columns;
    #ifndef __CUDA_ARCH__
        // Rows are too far apart for the processor to see what comes next.
        if (row + ROWS_AHEAD < last) {
            const int soon = filled.data ? 1 : max_points * columns;
            for (int k = 0; k < soon; k += 16) __builtin_prefetch(to + ROWS_AHEAD * max_points * columns + k, 1);
        }
    #endif
        int kept = 0;
        if (row < voxels) {
            const int all = counts_in.data[row];
            kept = all < max_points ? all : max_points;
            counts_out.data[row] = kept;
            const long long cell = cell_of_row_in.data[row], rest = cell / nx;
            coords_out.data[3 * row] = (int)(rest / ny);
            coords_out.data[3 * row + 1] = (int)(rest % ny);
            coords_out.data[3 * row + 2] = (int)(cell % nx);
            if (four_together)
                copy(to, row, kept, 4, [&](float* __restrict to, const long long point) {
                    for (int column = 0; column < 4; ++column) to[column] = xyz[step * point + column];
                });
            else
                copy(to, row, kept, columns, [&](float* __restrict to, const long long point) {
                    for (int column = 0; column < 3; ++column) to[column] = xyz[step * point + column];
                    for (int column = 0; column < others; ++column) to[3 + column] = extra[step_other * point + column];
                });
        }
        const int written = filled.data ? filled.data[row] : max_points;
        if (filled.data) filled.data[row] = kept;
        for (int k = kept * columns; k < written * columns; ++k) to[k] = 0.0f;
    }
""")
def _write_rows(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    counts_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    next_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    cell_of_row_in: wp.array(dtype=wp.int64),
    max_points: int,
    voxels: int,
    first: int,
    last: int,
    # in out
    filled: wp.array(dtype=wp.int32),
    # out
    features_out: wp.array(dtype=wp.float32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Writes the rows first … last − 1, each from its first number to its last."""


@wp.kernel
def _write_voxels(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    counts_in: wp.array(dtype=wp.int32),
    head_in: wp.array(dtype=wp.int32),
    next_in: wp.array(dtype=wp.int32),
    first_in: wp.array(dtype=wp.int32),
    cell_of_row_in: wp.array(dtype=wp.int64),
    voxels_in: wp.array(dtype=wp.int32),
    max_points: int,
    max_voxels: int,
    # in out: points that the launch before has left in each row, or null where nobody knows
    filled: wp.array(dtype=wp.int32),
    # out
    features_out: wp.array(dtype=wp.float32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    voxel_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Writes one of the parts that the rows are cut into; those beyond the voxels are cleared."""
    voxels = wp.min(voxels_in[0], max_voxels)
    rows = voxels
    if filled:
        rows = wp.max(voxels, wp.min(voxels_in[1], max_voxels))
    _write_rows(
        xyz_in, extra_in, grid, counts_in, head_in, next_in, first_in, cell_of_row_in, max_points, voxels,
        part_start(rows, part, parts), part_start(rows, part + 1, parts),
        filled, features_out, coords_out, counts_out,
    )  # fmt: skip
    if part == 0:
        crowded = int(0)
        for row in range(voxels):
            crowded += wp.max(counts_in[row] - max_points, 0)
        voxel_count_out[0] = voxels
        dropped_out[_DROPPED_POINTS] = crowded
        dropped_out[_DROPPED_VOXELS] = voxels_in[0] - voxels


@wp.kernel
def _fill_sorted(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    extra_in: wp.array2d(dtype=wp.float32),
    grid: VoxelGrid,
    max_points: int,
    max_voxels: int,
    key_in: wp.array(dtype=wp.int64),
    point_in: wp.array(dtype=wp.int32),
    segment_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    number_in: wp.array(dtype=wp.int32),
    # out
    features_out: wp.array(dtype=wp.float32),
    coords_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
    voxel_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Copies each sorted point to its place: its rank in the cell, in the voxel that the cell's first point numbers."""
    j = wp.tid()
    last = xyz_in.shape[0] - 1
    if j == last:
        voxels = number_in[last]
        voxel_count_out[0] = wp.min(voxels, max_voxels)
        dropped_out[_DROPPED_VOXELS] = wp.max(voxels - max_voxels, 0)
    key = key_in[j]
    if key == grid.total:
        return
    start = start_in[segment_in[j] - 1]
    voxel = number_in[point_in[start]] - 1
    if voxel >= max_voxels:
        return
    rank = j - start
    if rank < max_points:
        _write_features(xyz_in, extra_in, point_in[j], voxel * max_points + rank, features_out)
    else:
        wp.atomic_add(dropped_out, _DROPPED_POINTS, 1)
    if rank == 0:
        write_coords(voxel_of(xyz_in[point_in[j]], grid), voxel, coords_out)
    if j == last or key_in[j + 1] != key:
        counts_out[voxel] = wp.min(rank + 1, max_points)


class _Given:
    """Memory of features that a caller was given; once nobody holds it, it serves again: new memory costs more."""

    def __init__(self, rows: int, max_points: int, columns: int):
        self.host = np.empty((rows, max_points, columns), np.float32)
        self.features = wp.array(self.host.reshape(-1), copy=False, device=DEFAULT_DEVICE)
        self._own_references = self._references()

    def _references(self) -> int:
        return sys.getrefcount(self.host)

    def is_free(self, rows: int) -> bool:
        """Whether there is room for so many rows, and neither an array nor a view of it is anybody's."""
        return rows <= len(self.host) and self._references() == self._own_references


@dataclass(frozen=True, kw_only=True)
class Voxelize:
    """A plan: workspace to voxelize clouds of up to `capacity` points, of which it keeps `features` and the rest."""

    voxel_size: tuple[float, float, float]
    """Edges of a voxel along x y z [m], > 0."""
    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax [m], upper bounds open."""
    columns: int = 4
    """Columns of a point, ≥ 3: x y z and what else it carries."""
    max_points: int = 32
    """Points that a voxel keeps."""
    max_voxels: int = 40_000
    """Voxels that are kept."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (in parts), `sort` (parallel), or `auto`: `in_order` on a CPU, else `sort`. Results are equal."""
    parts: int | None = None
    """How many parts are written at once, by the method `in_order`; by default as the threads are worth it."""

    features: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels, max_points, columns), float32; zero where a voxel has no point."""
    coords: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels, 3), int32, cell indices z y x."""
    counts: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (max_voxels,), int32, points kept in each voxel."""
    voxel_count: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (1,), int32, how many voxels there are; from there on `features` are zero, and other rows old."""
    dropped: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (3,), int32: points beyond max_points, voxels beyond max_voxels, points outside or not finite."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        grid = grid_of(self.voxel_size, self.point_range)
        for name, least in (("columns", 3), ("max_points", 1), ("max_voxels", 1), ("capacity", 1)):
            if not least <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least {least} and below 2³¹, not {getattr(self, name)}")
        size = self.max_voxels * self.max_points * self.columns
        if size >= 1 << 31:
            raise ValueError(
                f"max_voxels × max_points × columns must stay below 2³¹ numbers, not {size}; lower max_voxels"
            )
        if self.method not in ("auto", "in_order", "sort"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'sort', not {self.method!r}")
        if self.parts is not None and self.parts < 1:
            raise ValueError(f"parts must be at least 1, not {self.parts}")
        device = resolve_device(self.device)
        sequential = self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.empty(shape, dtype=dtype, device=device))

        keep("_grid", grid)
        keep("_sequential", sequential)
        keep("_features", wp.zeros(size, dtype=wp.float32, device=device))
        keep("features", self._features.reshape((self.max_voxels, self.max_points, self.columns)))
        buffer("coords", (self.max_voxels, 3), wp.int32)
        buffer("counts", self.max_voxels, wp.int32)
        keep("voxel_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("dropped", wp.zeros(3, dtype=wp.int32, device=device))
        keep("_outside", self.dropped[int(_OUTSIDE) :])
        if sequential:
            by_voxel = VoxelOrder(grid, self.capacity, self._outside, device=device, parts=self.parts)
            keep("_ordered", by_voxel)
            keep("_filled", wp.zeros(self.max_voxels, dtype=wp.int32, device=device))
            given = [by_voxel.counts, by_voxel.head, by_voxel.next, by_voxel.first, by_voxel.cell_of_row]
            write = packed_parts(
                _write_voxels,
                self.parts or parts_for(self.capacity, _LEAST_PART),
                device,
                [None, None, grid, *given, by_voxel.voxels, self.max_points, self.max_voxels],
                [None, None, self.coords, self.counts, self.voxel_count, self.dropped],
            )
            keep("_write", write)
            keep("_given", None)
        else:
            keep("_sorted", VoxelSort(grid, self.capacity, device))

    def launch(self, xyz: wp.array, count: wp.array, extra: wp.array | None = None) -> None:
        """Fills the outputs from the first `count[0]` points; allocates nothing, reads nothing back.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            extra: The columns after the third, float32, shape (n, columns - 3), or (n,) where it is one column.
        """
        extra = self._checked(xyz, extra)
        if self._sequential:
            self._ordered.launch(xyz, count)
            self._write(xyz_in=xyz, extra_in=extra, filled=self._filled, features_out=self._features)
        else:
            self._launch_sort(xyz, count, extra)

    def _checked(self, xyz: wp.array, extra: wp.array | None) -> wp.array:
        """`extra` with two dimensions, after a look at the shapes."""
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if extra is None:
            extra = wp.array(ptr=None, dtype=wp.float32, shape=(n, 0), device=self.device)
        elif extra.ndim == 1:
            extra = wp.array(
                ptr=extra.ptr, dtype=wp.float32, shape=(n, 1), strides=(extra.strides[0], 4), device=extra.device
            )
        if extra.shape != (n, self.columns - 3):
            raise ValueError(f"extra must have shape ({n}, {self.columns - 3}), not {extra.shape}")
        return extra

    def _launch_for_caller(self, xyz: wp.array, count: wp.array, extra: wp.array) -> np.ndarray:
        """In order: as `launch`, but the features are the caller's own, since they are too many to copy."""
        self._ordered.launch(xyz, count)
        voxels = min(int(self._ordered.voxels.numpy()[0]), self.max_voxels)
        given = self._given
        if given is None or not given.is_free(voxels):
            given = _Given(min(voxels + voxels // 4 + 1, self.max_voxels), self.max_points, self.columns)
            object.__setattr__(self, "_given", given)
        self._write(xyz_in=xyz, extra_in=extra, filled=None, features_out=given.features)
        return given.host[:voxels]

    def _launch_sort(self, xyz: wp.array, count: wp.array, extra: wp.array) -> None:
        n = xyz.shape[0]
        self._features.zero_()
        self.dropped.zero_()
        if n == 0:
            self.voxel_count.zero_()
            return
        by_voxel = self._sorted
        by_voxel.launch(xyz, count, self._outside)
        wp.launch(
            _fill_sorted,
            n,
            inputs=[
                *(xyz, extra, self._grid, self.max_points, self.max_voxels),
                *(by_voxel.key, by_voxel.point, by_voxel.segment[:n], by_voxel.start, by_voxel.number[:n]),
            ],
            outputs=[self._features, self.coords, self.counts, self.voxel_count, self.dropped],
            device=self.device,
        )


@dataclass(frozen=True, eq=False)
class Voxels:
    """The occupied voxels, in order of the lowest index of a point in them; arrays of the input's family."""

    features: Any
    """The columns of the points, shape (V, max_points, C), float32, in the order of the input, then zeros."""
    coords: Any
    """Cell indices z y x, shape (V, 3), int32."""
    counts: Any
    """Points kept in each voxel, shape (V,), int32."""
    dropped_points: int
    """Points left out since their voxel already had `max_points`."""
    dropped_voxels: int
    """Voxels left out, with all their points, since there were already `max_voxels`."""
    outside: int
    """Points left out since they are not finite or not in `point_range`."""

    def __len__(self) -> int:
        return self.counts.shape[0]


def voxelize(
    points: Any,
    voxel_size: float | Sequence[float],
    point_range: Sequence[float],
    max_points: int = 32,
    max_voxels: int = 40_000,
    *,
    backend: str = "warp",
) -> Voxels:
    """Sorts points into voxels, or pillars where a voxel is as high as the range; first come, first served.

    A point's cell is floor((position - minimum) / size) in float32, as in SECOND's and spconv's voxelizers, whose
    results these are, to the bit, as long as the range is a whole number of voxels; else the last voxel is cut short.

    Args:
        points: Positions [m] and other columns, shape (n, C), C ≥ 3, floating; NumPy, torch, Warp or DLPack.
        voxel_size: Edge of a voxel [m], one for all axes or three along x y z.
        point_range: xmin ymin zmin xmax ymax zmax [m]; upper bounds open.
        max_points: Points that a voxel keeps; later ones are dropped and counted.
        max_voxels: Voxels kept; later ones are dropped with their points and counted.
        backend: `warp`, or `taichi`, whose voxels are the same.

    Returns:
        Features, coordinates and counts of the occupied voxels, on the device of `points`.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit, or there is no such backend; the message says which.
        ImportError: The backend is Taichi, which is not installed.
    """
    borrowed = borrow_points(points)
    edges = table(voxel_size, "voxel_size").ravel()
    if edges.size not in (1, 3):
        raise ValueError(f"voxel_size must be one number or three, not {edges.size}")
    size = tuple(float(edge) for edge in np.broadcast_to(edges, 3))
    limits = reals(point_range, "point_range")
    max_points, max_voxels = whole(max_points, "max_points"), whole(max_voxels, "max_voxels")
    if len(limits) != 6:
        raise ValueError(f"point_range must have six numbers, xmin ymin zmin xmax ymax zmax, not {len(limits)}")
    if uses_taichi(backend):
        from .taichi import voxel as in_taichi

        return in_taichi.voxelize(borrowed, size, limits, max_points, max_voxels)
    n, columns = borrowed.table.shape
    plan = plan_for(
        Voxelize,
        voxel_size=size,
        point_range=limits,
        columns=columns,
        max_points=max_points,
        max_voxels=max_voxels,
        capacity=capacity_for(n),
        device=borrowed.device,
    )
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count, borrowed.extra)
        voxels = int(plan.voxel_count.numpy()[0])
        features = give(plan.features[:voxels], borrowed.family)
    else:
        host = plan._launch_for_caller(borrowed.xyz, count, plan._checked(borrowed.xyz, borrowed.extra))
        voxels = len(host)
        features = adopt(host, borrowed.family)
    dropped_points, dropped_voxels, outside = (int(number) for number in plan.dropped.numpy())
    return Voxels(
        features,
        give(plan.coords[:voxels], borrowed.family),
        give(plan.counts[:voxels], borrowed.family),
        dropped_points,
        dropped_voxels,
        outside,
    )
