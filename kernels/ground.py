"""Ground segmentation: which points are ground, and how high every point stands above it.

A polar sweep, after the idea of FugSeg and of line fitting before it (Himmelsbach, von Hundelshausen, Wünsche: Fast
segmentation of 3D point clouds for ground vehicles, IV 2010). The lowest point of each cell of a polar grid is a sample
of the surface. A plane through the samples near the sensor (RANSAC, then least squares) gives the sensor's height and
tilt. Each segment of the grid is walked outwards from that plane, taking the samples that a road, a kerb or a slope can
reach, and each cell is held to the median of its neighbours across segments. A point is judged by its height above the
surface of its cell: strictly where something stands on the cell, loosely where nothing does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, reals
from .backend import uses_taichi
from .device import DEFAULT_DEVICE, module_apart, resolve_device
from .ground_parts import GroundLimits, judge_cells_part, judge_points_part
from .ground_plane import GroundPlane, above, lowest_point
from .interop import adopt, borrow_points, count_on, give
from .parts import part_start
from .plan import capacity_for, plan_for
from .polar_grid import FIRST_RING, RING_BITS, RINGS, SEGMENTS, cell_of
from .threads import launch_parts

__all__ = ["Ground", "GroundSegment", "elevation_grid", "segment_ground"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})
_APART = module_apart(__name__, fuse_fp=False)

# The sweep.
_START = wp.constant(2.5)  # [m] from the sensor, where the plane itself is the last sample
_STEP = wp.constant(0.2)  # [m] a sample may lie off the prediction, a kerb
_STEP_PER_METRE = wp.constant(0.03)  # and more after a gap
_SLOPE_MEMORY = wp.constant(1.0)  # [m] of way in which the slope is learnt
_SLOPE_LIMIT = wp.constant(0.12)  # of the surface against the plane
_NONE = wp.constant(1.0e9)
_EXTEND = wp.constant(2.0)  # [m] that the last slope holds beyond the last sample

# The verdict.
_OFF_MEDIAN = wp.constant(0.02)  # [m] a cell may lie off its neighbours' median
_GRADIENT_LIMIT = wp.constant(0.15)
_STANDS_FROM = wp.constant(0.25)  # [m] above the surface where a thing that stands on a cell has points,
_STANDS_LEVELS = wp.constant(wp.uint64(63))  # up to 1.5 m more: six levels of 0.25 m
_TOP_BARE = wp.constant(0.32)  # [m] up to which points are ground on a bare cell
_TOP_OCCUPIED = wp.constant(0.07)  # and on one where something stands
_BOTTOM = wp.constant(0.3)  # [m] below which a point is noise
_BOTTOM_PER_METRE = wp.constant(0.02)
_FARTHEST = wp.constant(65536.0)  # r² where the last ring ends


@wp.func
def _sweep(
    segment: int,
    xyz_in: wp.array(dtype=wp.vec3),
    cells_in: wp.array2d(dtype=wp.int64),
    plane: wp.vec3,
    radius_in: wp.array(dtype=wp.float32),
    rise_out: wp.array(dtype=wp.float32),
):
    """Walks a segment outwards over its samples; out: how far the surface rises above the plane in each cell."""
    first = segment * RINGS
    last_r = wp.float32(_START)
    last_rise = wp.float32(0.0)
    slope = wp.float32(0.0)
    below_rise = wp.float32(_NONE)  # of the last sample that lay too low
    below_r = wp.float32(0.0)
    filled = wp.int32(0)  # the rings before this one have their rise
    for ring in range(RINGS):
        key = cells_in[first + ring, 0]
        if key != wp.int64(0):
            p = lowest_point(xyz_in, key)
            r = wp.sqrt(p[0] * p[0] + p[1] * p[1])
            rise = above(plane, p)
            run = wp.max(r - last_r, 0.05)
            off = rise - last_rise - slope * run
            taken = wp.abs(off) <= _STEP + _STEP_PER_METRE * run
            if not taken and off < 0.0:
                # One low sample is noise. Two that agree are the ground, and what was taken before stood on it.
                if wp.abs(rise - below_rise) < _STEP + _STEP_PER_METRE * (r - below_r):
                    taken = True
                    last_rise = below_rise
                    last_r = below_r
                    run = wp.max(r - last_r, 0.05)
                    slope = 0.0
                else:
                    below_rise = rise
                    below_r = r
            if taken:
                for k in range(filled, ring + 1):
                    share = wp.clamp((radius_in[k] - last_r) / run, 0.0, 1.0)
                    rise_out[first + k] = last_rise + share * (rise - last_rise)
                filled = ring + 1
                steepness = wp.clamp((rise - last_rise) / run, -_SLOPE_LIMIT, _SLOPE_LIMIT)
                slope += run / (run + _SLOPE_MEMORY) * (steepness - slope)
                last_rise = rise
                last_r = r
                below_rise = _NONE
    for k in range(filled, RINGS):
        rise_out[first + k] = last_rise + slope * wp.clamp(radius_in[k] - last_r, 0.0, _EXTEND)


@wp.kernel(module=_APART)
def _sweep_segments(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    cells_in: wp.array2d(dtype=wp.int64),
    plane_in: wp.array(dtype=wp.vec3),
    radius_in: wp.array(dtype=wp.float32),
    # out
    rise_out: wp.array(dtype=wp.float32),
):
    """One segment a thread."""
    _sweep(wp.tid(), xyz_in, cells_in, plane_in[0], radius_in, rise_out)


@wp.kernel
def _sweep_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    cells_in: wp.array2d(dtype=wp.int64),
    plane_in: wp.array(dtype=wp.vec3),
    radius_in: wp.array(dtype=wp.float32),
    # out
    rise_out: wp.array(dtype=wp.float32),
):
    """Some of the segments."""
    for segment in range(part_start(SEGMENTS, part, parts), part_start(SEGMENTS, part + 1, parts)):
        _sweep(segment, xyz_in, cells_in, plane_in[0], radius_in, rise_out)


@wp.func
def _median5(a: float, b: float, c: float, d: float, e: float) -> float:
    low = wp.max(wp.min(a, b), wp.min(c, d))
    high = wp.min(wp.max(a, b), wp.max(c, d))
    return wp.max(wp.min(low, high), wp.min(wp.max(low, high), e))


@wp.func
def _reconciled(rise: wp.array(dtype=wp.float32), radius: wp.array(dtype=wp.float32), cell: int) -> wp.vec2:
    """The rise in the middle of a cell, held to the median across segments, and its gradient outwards."""
    last = SEGMENTS * RINGS - 1
    own = rise[cell]
    median = _median5(
        rise[(cell - 2 * RINGS) & last],
        rise[(cell - RINGS) & last],
        own,
        rise[(cell + RINGS) & last],
        rise[(cell + 2 * RINGS) & last],
    )
    ring = cell & (RINGS - 1)
    inner = wp.max(ring - 1, 0)
    outer = wp.min(ring + 1, RINGS - 1)
    gradient = (rise[cell - ring + outer] - rise[cell - ring + inner]) / (radius[outer] - radius[inner])
    return wp.vec2(
        wp.clamp(own, median - _OFF_MEDIAN, median + _OFF_MEDIAN),
        wp.clamp(gradient, -_GRADIENT_LIMIT, _GRADIENT_LIMIT),
    )


@wp.kernel(module=_APART)
def _judge_cells(
    # in
    cells_in: wp.array2d(dtype=wp.int64),
    rise_in: wp.array(dtype=wp.float32),
    radius_in: wp.array(dtype=wp.float32),
    centre_in: wp.array(dtype=wp.vec2),
    plane_in: wp.array(dtype=wp.vec3),
    # out
    surface_out: wp.array(dtype=wp.vec4),
):
    """Per cell with points: the rise of its surface as u + v r², and the heights between which points are ground."""
    cell = wp.tid()
    if cells_in[cell, 0] == wp.int64(0):
        return
    surface = _reconciled(rise_in, radius_in, cell)
    r = radius_in[cell & (RINGS - 1)]
    centre = centre_in[cell]
    plane = plane_in[0]
    z = surface[0] + plane[0] * centre[0] + plane[1] * centre[1] + plane[2]
    # A wall, a car, a trunk stands on the cell if the levels above its surface have points.
    level = wp.uint64(int(wp.ceil((1000.0 + wp.clamp(z, -900.0, 900.0) + _STANDS_FROM) * 4.0)) & 63)
    levels = wp.uint64(cells_in[cell, 1])
    levels = (levels >> level) | (levels << ((wp.uint64(64) - level) & wp.uint64(63)))
    top = wp.where((levels & _STANDS_LEVELS) == wp.uint64(0), _TOP_BARE, _TOP_OCCUPIED)
    half = 0.5 * surface[1]
    surface_out[cell] = wp.vec4(surface[0] - half * r, half / r, top, -_BOTTOM - _BOTTOM_PER_METRE * r)


@wp.kernel(module=_APART)
def _judge_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    cell_in: wp.array(dtype=wp.int32),
    plane_in: wp.array(dtype=wp.vec3),
    surface_in: wp.array(dtype=wp.vec4),
    # out
    mask_out: wp.array(dtype=wp.bool),
    height_out: wp.array(dtype=wp.float32),
):
    """The height of each point above the surface of its cell, and whether that is ground."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    cell = cell_in[i]
    if cell < 0:
        mask_out[i] = False
        height_out[i] = wp.nan
        return
    p = xyz_in[i]
    surface = surface_in[cell]
    r2 = wp.min(p[0] * p[0] + p[1] * p[1], _FARTHEST)
    height = above(plane_in[0], p) - surface[0] - surface[1] * r2
    height_out[i] = height
    mask_out[i] = height < surface[2] and height > surface[3]


@wp.kernel(module=_APART)
def _sample_elevation(
    # in
    rise_in: wp.array(dtype=wp.float32),
    radius_in: wp.array(dtype=wp.float32),
    plane_in: wp.array(dtype=wp.vec3),
    low: wp.vec2,
    cell_size: float,
    # out
    elevation_out: wp.array2d(dtype=wp.float32),
):
    """The surface in the middle of each square of a grid."""
    row, column = wp.tid()  # pyright: ignore[reportAssignmentType]
    x = low[0] + (float(row) + 0.5) * cell_size
    y = low[1] + (float(column) + 0.5) * cell_size
    cell = cell_of(x, y)
    r = radius_in[cell & (RINGS - 1)]
    surface = _reconciled(rise_in, radius_in, cell)
    plane = plane_in[0]
    rise = surface[0] + 0.5 * surface[1] / r * (wp.min(x * x + y * y, _FARTHEST) - r * r)
    elevation_out[row, column] = plane[0] * x + plane[1] * y + plane[2] + rise


@dataclass(frozen=True, kw_only=True)
class GroundSegment:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    sensor_height: float | None = None
    """Height of the frame's origin above the ground [m], held to within 0.5 m; None to estimate it in each launch."""
    grid_range: tuple[float, float, float, float] = (-50.0, -50.0, 50.0, 50.0)
    """xmin ymin xmax ymax of the elevation grid [m]."""
    cell_size: float = 1.0
    """Edge of a square of the elevation grid [m]."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """As for `GroundPlane`."""

    mask: wp.array = field(init=False, repr=False)
    """Whether each point is ground, shape (capacity,), bool."""
    height: wp.array = field(init=False, repr=False)
    """Height of each point above the ground along z [m], shape (capacity,), float32; NaN where it is not finite."""
    found_height: wp.array = field(init=False, repr=False)
    """Distance of the frame's origin from the plane of the ground near it [m], shape (1,), float32."""
    plane: wp.array = field(init=False, repr=False)
    """That plane, z = a x + b y + c, as a b c, shape (1,), vec3."""
    elevation: wp.array = field(init=False, repr=False)
    """z of the ground in the middle of each square, row = x, column = y, float32; filled by `launch_elevation`."""

    def __post_init__(self):
        if not (self.cell_size > 0 and math.isfinite(self.cell_size)):
            raise ValueError(f"cell_size must be > 0 m and finite, not {self.cell_size}")
        xmin, ymin, xmax, ymax = self.grid_range
        if not (xmin < xmax and ymin < ymax and all(math.isfinite(limit) for limit in self.grid_range)):
            raise ValueError(f"grid_range must be xmin ymin xmax ymax, finite, with min < max, not {self.grid_range}")
        fit = GroundPlane(
            capacity=self.capacity, sensor_height=self.sensor_height, device=self.device, method=self.method
        )
        device = resolve_device(self.device)
        squares = (max(1, round((xmax - xmin) / self.cell_size)), max(1, round((ymax - ymin) / self.cell_size)))
        if squares[0] * squares[1] >= 2**31:
            raise ValueError(
                f"grid_range has {squares[0]} × {squares[1]} squares, 2³¹ or more; choose a larger cell_size"
            )

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        size = int(SEGMENTS * RINGS)
        radius, centre = _grid_centres()
        limits = GroundLimits()
        limits.off_median, limits.gradient, limits.stands_from = _OFF_MEDIAN, _GRADIENT_LIMIT, _STANDS_FROM
        limits.stands_levels, limits.top_bare, limits.top_occupied = _STANDS_LEVELS, _TOP_BARE, _TOP_OCCUPIED
        limits.bottom, limits.bottom_per_metre, limits.farthest = _BOTTOM, _BOTTOM_PER_METRE, _FARTHEST
        keep("_fit", fit)
        keep("_limits", limits)
        keep("plane", fit.plane)
        keep("found_height", fit.found_height)
        keep("_radius", wp.array(radius, dtype=wp.float32, device=device))
        keep("_centre", wp.array(centre, dtype=wp.vec2, device=device))
        buffer("_rise", size, wp.float32)
        buffer("_surface", size, wp.vec4)
        buffer("mask", self.capacity, wp.bool)
        buffer("height", self.capacity, wp.float32)
        buffer("elevation", squares, wp.float32)

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `mask`, `height`, `found_height` and `plane` from the first `count[0]` points.

        Args:
            xyz: Positions [m] in a frame with z up and the sensor on its z axis, shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        self._launch_into(xyz, count, self.mask, self.height)

    def launch_elevation(self) -> None:
        """Fills `elevation` from what the last `launch` found."""
        self._run(
            _sample_elevation,
            self.elevation.shape,
            [self._rise, self._radius, self.plane, wp.vec2(*self.grid_range[:2]), self.cell_size],
            [self.elevation],
        )

    def _run(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

    def _launch_into(self, xyz: wp.array, count: wp.array, mask: wp.array, height: wp.array) -> None:
        fit = self._fit
        fit.launch(xyz, count)
        sweep = [xyz, fit.cells, fit.plane, self._radius]
        cells = [fit.cells, self._rise, self._radius, self._centre, fit.plane]
        points = [xyz, count, fit.cell, fit.plane, self._surface]
        if fit.parts:
            launch_parts(_sweep_part, fit.parts, sweep, [self._rise])
            launch_parts(judge_cells_part, fit.parts, [*cells, self._limits], [self._surface])
            launch_parts(judge_points_part, fit.parts, [*points, self._limits], [mask, height])
            return
        self._run(_sweep_segments, int(SEGMENTS), sweep, [self._rise])
        self._run(_judge_cells, int(SEGMENTS * RINGS), cells, [self._surface])
        self._run(_judge_points, xyz.shape[0], points, [mask, height])


def _grid_centres() -> tuple[np.ndarray, np.ndarray]:
    """The radius in the middle of each ring, and the middle of each cell."""
    bits = (np.arange(RINGS, dtype=np.int32) + FIRST_RING << RING_BITS) + (1 << (RING_BITS - 1))
    radius = np.sqrt(bits.astype(np.int32).view(np.float32))
    angle = (np.arange(SEGMENTS) + 0.5) * (4 / SEGMENTS)
    x = np.where(angle < 2, 1 - angle, angle - 3)
    y = np.where(angle < 2, 1, -1) * (1 - np.abs(x))
    directions = np.stack([x, y], axis=1) / np.hypot(x, y)[:, None]
    centre = directions[:, None, :] * radius[None, :, None]
    return radius, centre.reshape(-1, 2).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Ground:
    """What `segment_ground` found."""

    mask: Any
    """Whether each point is ground, shape (n,), bool."""
    height: Any
    """Height of each point above the ground along z [m], shape (n,), float32; NaN for points that are not finite."""
    sensor_height: float
    """Distance of the frame's origin from the plane of the ground near it [m]."""


def segment_ground(points: Any, *, sensor_height: float | None = None, backend: str = "warp") -> Ground:
    """Tells the ground from what stands on it.

    The sensor may be tilted by up to 15°, the ground may be hilly, and points below it are told as noise (not ground).
    Points within 1 m and beyond 256 m of the z axis share the innermost and outermost ring.

    Args:
        points: Positions [m] in a frame with z up and the sensor on its z axis, shape (n, 3 or more), floating.
        sensor_height: Height of the frame's origin above the ground [m], if known, to within 0.5 m: zero in a vehicle's
            frame that lies on the ground. By default it is estimated, and taken as 1.8 m where fewer than three patches
            between 2 and 32 m have points.
        backend: `warp`, or `taichi`, whose heights are the same but for rounding.

    Returns:
        Mask and height, of the family and on the device of `points`, and the sensor's height.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: It has not at least three columns, `sensor_height` is not finite, or there is no such backend.
        ImportError: The backend is Taichi, which is not installed.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    height = None if sensor_height is None else real(sensor_height, "sensor_height")
    if uses_taichi(backend):
        from .taichi import ground as in_taichi

        return in_taichi.segment_ground(borrowed, height)
    plan = plan_for(GroundSegment, capacity=capacity_for(n), sensor_height=height, device=borrowed.device)
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count)
        mask, heights = give(plan.mask[:n], borrowed.family), give(plan.height[:n], borrowed.family)
    else:
        # Straight into arrays of their own.
        host_mask, host_height = np.empty(n, bool), np.empty(n, np.float32)
        plan._launch_into(
            borrowed.xyz,
            count,
            wp.array(host_mask, dtype=wp.bool, copy=False, device=DEFAULT_DEVICE),
            wp.array(host_height, dtype=wp.float32, copy=False, device=DEFAULT_DEVICE),
        )
        mask, heights = adopt(host_mask, borrowed.family), adopt(host_height, borrowed.family)
    return Ground(mask, heights, float(plan.found_height.numpy()[0]))


def elevation_grid(
    points: Any,
    *,
    grid_range: Sequence[float] = (-50.0, -50.0, 50.0, 50.0),
    cell_size: float = 1.0,
    sensor_height: float | None = None,
) -> Any:
    """The ground's surface as a grid.

    Args:
        points: As for `segment_ground`.
        grid_range: xmin ymin xmax ymax [m].
        cell_size: Edge of a square [m].
        sensor_height: As for `segment_ground`.

    Returns:
        z of the ground in the middle of each square [m], shape ((xmax − xmin) / cell_size, (ymax − ymin) / cell_size),
        float32, row = x and column = y, both rising; of the family and on the device of `points`. Where no ground is
        seen it is carried on from where some is.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    limits = reals(grid_range, "grid_range")
    if len(limits) != 4:
        raise ValueError(f"grid_range must have four numbers, xmin ymin xmax ymax, not {len(limits)}")
    plan = plan_for(
        GroundSegment,
        capacity=capacity_for(len(borrowed)),
        sensor_height=None if sensor_height is None else real(sensor_height, "sensor_height"),
        grid_range=limits,
        cell_size=real(cell_size, "cell_size"),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, count_on(len(borrowed), borrowed.device))
    plan.launch_elevation()
    return give(plan.elevation, borrowed.family)
