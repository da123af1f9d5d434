"""Ground segmentation in Taichi: the polar sweep of `kernels.ground`, step by step.

The lowest point of a cell is found in two passes, since there is no 64-bit atomic maximum on every device. Where the
device has no 64-bit numbers the plane is fitted in float32, which moves it by micrometres.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import taichi as ti

from .. import ground as warp_ground
from .. import ground_plane as warp_plane
from ..ground import Ground
from ..interop import Points
from ..plan import capacity_for, plan_for
from .device import DEFAULT_TAICHI, check_count, give_back, has_64_bits, launching, rows_of, start, workspace
from .parallel import NO_POINT

__all__ = ["GroundSegment", "segment_ground"]

_SEGMENTS, _RINGS = int(warp_plane.SEGMENTS), int(warp_plane.RINGS)
_CELLS = _SEGMENTS * _RINGS
_BANDS, _CANDIDATES, _HYPOTHESES = 8, 256, 128
_FIX = 1048576.0
_DEPTH, _FIRST, _LEVELS, _UPPER_LEVELS = range(4)  # the columns of a cell

_Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
_Table = ti.types.ndarray(dtype=ti.i32, ndim=2)
_Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
_Rows = ti.types.ndarray(dtype=ti.f32, ndim=2)


@ti.func
def _cell_of(x: ti.f32, y: ti.f32) -> ti.i32:
    """The polar cell of a position, segment × rings + ring, as `kernels.ground_plane` names it."""
    angle = x / (ti.abs(x) + ti.abs(y) + 1.0e-30)
    angle = ti.select(y < 0.0, 3.0 + angle, 1.0 - angle)
    segment = ti.i32(angle * (_SEGMENTS * 0.25)) & (_SEGMENTS - 1)
    ring = (ti.bit_cast(x * x + y * y, ti.i32) >> warp_plane.RING_BITS) - warp_plane.FIRST_RING
    return segment * _RINGS + ti.math.clamp(ring, 0, _RINGS - 1)


@ti.func
def _depth_of(z: ti.f32) -> ti.i32:
    """How low a point is [mm], above zero."""
    return ti.i32((1000.0 - ti.math.clamp(z, -999.0, 999.0)) * 1000.0)


@ti.func
def _point(rows: _Rows, i: ti.i32) -> ti.math.vec3:
    return ti.math.vec3(rows[i, 0], rows[i, 1], rows[i, 2])


@ti.func
def _above(plane: ti.math.vec3, p: ti.math.vec3) -> ti.f32:
    """The height of a point above the plane z = a x + b y + c."""
    return p[2] - plane[0] * p[0] - plane[1] * p[1] - plane[2]


@ti.func
def _is_on(off: ti.f32, p: ti.math.vec3) -> ti.i32:
    return ti.abs(off) < 0.1 + 0.01 * ti.sqrt(p[0] * p[0] + p[1] * p[1])


@ti.func
def _hypothesis(candidates: _Rows, number: ti.i32) -> ti.math.vec3:
    """The plane a b c through three candidates drawn by a fixed hash; c is nowhere if they give none."""
    state = number * -1640531535 + 12345
    points = ti.Matrix.zero(ti.f32, 3, 3)
    have = 0
    drawn = 0
    while drawn < warp_plane._DRAWS and have < 3:
        drawn += 1
        state = state * 1664525 + 1013904223
        candidate = _point(candidates, (state >> 24) & 255)
        if candidate[2] != warp_plane._NOWHERE:
            if have == 0:
                points[0, :] = candidate
                have = 1
            elif have == 1:
                x = candidate[0] - points[0, 0]
                y = candidate[1] - points[0, 1]
                z = candidate[2] - points[0, 2]
                if ti.sqrt(x * x + y * y + z * z) > 3.0:
                    points[1, :] = candidate
                    have = 2
            else:
                area = (points[1, 0] - points[0, 0]) * (candidate[1] - points[0, 1]) - (points[1, 1] - points[0, 1]) * (
                    candidate[0] - points[0, 0]
                )
                if ti.abs(area) > 12.0:
                    points[2, :] = candidate
                    have = 3
    plane = ti.math.vec3(0.0, 0.0, warp_plane._NOWHERE)
    if have == 3:
        u = ti.math.vec3(points[1, 0] - points[0, 0], points[1, 1] - points[0, 1], points[1, 2] - points[0, 2])
        v = ti.math.vec3(points[2, 0] - points[0, 0], points[2, 1] - points[0, 1], points[2, 2] - points[0, 2])
        down = u[0] * v[1] - u[1] * v[0]
        a = -(u[1] * v[2] - u[2] * v[1]) / down
        b = -(u[2] * v[0] - u[0] * v[2]) / down
        plane = ti.math.vec3(a, b, points[0, 2] - a * points[0, 0] - b * points[0, 1])
    return plane


@ti.func
def _fit_in_64_bits(candidates: _Rows, plane: ti.math.vec3) -> ti.math.vec3:
    """What least squares over the plane's candidates adds to it; sums in fixed point, as in Warp."""
    n = ti.i64(0)
    sums = ti.Vector.zero(ti.i64, 8)
    for j in range(_CANDIDATES):
        p = _point(candidates, j)
        off = _above(plane, p)
        if _is_on(off, p):
            x = ti.f64(p[0])
            y = ti.f64(p[1])
            z = ti.f64(off)
            n += 1
            sums[0] += ti.i64(x * _FIX)
            sums[1] += ti.i64(y * _FIX)
            sums[2] += ti.i64(z * _FIX)
            sums[3] += ti.i64(x * x * _FIX)
            sums[4] += ti.i64(x * y * _FIX)
            sums[5] += ti.i64(y * y * _FIX)
            sums[6] += ti.i64(x * z * _FIX)
            sums[7] += ti.i64(y * z * _FIX)
    whole = ti.f64(n) * _FIX
    x = ti.f64(sums[0]) / whole
    y = ti.f64(sums[1]) / whole
    z = ti.f64(sums[2]) / whole
    xx = ti.f64(sums[3]) / whole - x * x
    xy = ti.f64(sums[4]) / whole - x * y
    yy = ti.f64(sums[5]) / whole - y * y
    xz = ti.f64(sums[6]) / whole - x * z
    yz = ti.f64(sums[7]) / whole - y * z
    determinant = xx * yy - xy * xy
    more = ti.math.vec3(0.0, 0.0, 0.0)
    if determinant >= 1.0:
        a = (xz * yy - yz * xy) / determinant
        b = (yz * xx - xz * xy) / determinant
        more = ti.math.vec3(ti.f32(a), ti.f32(b), ti.f32(z - a * x - b * y))
    return more


@ti.func
def _fit_in_32_bits(candidates: _Rows, plane: ti.math.vec3) -> ti.math.vec3:
    """The same with float32 sums about the mean."""
    n = 0.0
    mean = ti.math.vec3(0.0, 0.0, 0.0)
    for j in range(_CANDIDATES):
        p = _point(candidates, j)
        off = _above(plane, p)
        if _is_on(off, p):
            n += 1.0
            mean += ti.math.vec3(p[0], p[1], off)
    mean /= n
    xx = 0.0
    xy = 0.0
    yy = 0.0
    xz = 0.0
    yz = 0.0
    for j in range(_CANDIDATES):
        p = _point(candidates, j)
        off = _above(plane, p)
        if _is_on(off, p):
            x = p[0] - mean[0]
            y = p[1] - mean[1]
            z = off - mean[2]
            xx += x * x
            xy += x * y
            yy += y * y
            xz += x * z
            yz += y * z
    determinant = xx * yy - xy * xy
    more = ti.math.vec3(0.0, 0.0, 0.0)
    if determinant >= n * n:
        a = (xz * yy - yz * xy) / determinant
        b = (yz * xx - xz * xy) / determinant
        more = ti.math.vec3(a, b, mean[2] - a * mean[0] - b * mean[1])
    return more


@ti.func
def _sweep(rows: _Rows, cells: _Table, plane: ti.math.vec3, radius: _Floats, segment: ti.i32, rise_of: _Floats):
    """Walks a segment outwards over its samples: how far the surface rises above the plane in each cell."""
    first = segment * _RINGS
    last_r = ti.f32(warp_ground._START)
    last_rise = 0.0
    slope = 0.0
    below_rise = ti.f32(warp_ground._NONE)  # of the last sample that lay too low
    below_r = 0.0
    filled = 0  # the rings before this one have their rise
    for ring in range(_RINGS):
        if cells[first + ring, _DEPTH] > 0:
            p = _point(rows, cells[first + ring, _FIRST])
            r = ti.sqrt(p[0] * p[0] + p[1] * p[1])
            rise = _above(plane, p)
            run = ti.max(r - last_r, 0.05)
            off = rise - last_rise - slope * run
            taken = ti.i32(ti.abs(off) <= warp_ground._STEP + warp_ground._STEP_PER_METRE * run)
            if taken == 0 and off < 0.0:
                # One low sample is noise. Two that agree are the ground, and what was taken before stood on it.
                agreeing = warp_ground._STEP + warp_ground._STEP_PER_METRE * (r - below_r)
                if ti.abs(rise - below_rise) < agreeing:
                    taken = 1
                    last_rise = below_rise
                    last_r = below_r
                    run = ti.max(r - last_r, 0.05)
                    slope = 0.0
                else:
                    below_rise = rise
                    below_r = r
            if taken != 0:
                for k in range(filled, ring + 1):
                    share = ti.math.clamp((radius[k] - last_r) / run, 0.0, 1.0)
                    rise_of[first + k] = last_rise + share * (rise - last_rise)
                filled = ring + 1
                steepness = ti.math.clamp((rise - last_rise) / run, -warp_ground._SLOPE_LIMIT, warp_ground._SLOPE_LIMIT)
                slope += run / (run + warp_ground._SLOPE_MEMORY) * (steepness - slope)
                last_rise = rise
                last_r = r
                below_rise = warp_ground._NONE
    for k in range(filled, _RINGS):
        rise_of[first + k] = last_rise + slope * ti.math.clamp(radius[k] - last_r, 0.0, warp_ground._EXTEND)


@ti.func
def _median5(a: ti.f32, b: ti.f32, c: ti.f32, d: ti.f32, e: ti.f32) -> ti.f32:
    low = ti.max(ti.min(a, b), ti.min(c, d))
    high = ti.min(ti.max(a, b), ti.max(c, d))
    return ti.max(ti.min(low, high), ti.min(ti.max(low, high), e))


@ti.func
def _stands(levels: ti.i32, upper_levels: ti.i32, z: ti.f32) -> ti.i32:
    """Whether the six levels of 0.25 m above the height z have points."""
    level = ti.i32(ti.ceil((1000.0 + ti.math.clamp(z, -900.0, 900.0) + warp_ground._STANDS_FROM) * 4.0))
    found = 0
    for k in range(6):
        own = (level + k) & 63
        word = ti.select(own < 32, levels, upper_levels)
        found |= (word >> (own & 31)) & 1
    return found


@ti.func
def _judge_cell(
    cell: ti.i32,
    cells: _Table,
    rise: _Floats,
    radius: _Floats,
    centre: _Rows,
    plane: ti.math.vec3,
    surface: _Rows,
):
    """The rise of a cell's surface as u + v r², and the heights between which points are ground."""
    last = _CELLS - 1
    own = rise[cell]
    median = _median5(
        rise[(cell - 2 * _RINGS) & last],
        rise[(cell - _RINGS) & last],
        own,
        rise[(cell + _RINGS) & last],
        rise[(cell + 2 * _RINGS) & last],
    )
    ring = cell & (_RINGS - 1)
    inner = ti.max(ring - 1, 0)
    outer = ti.min(ring + 1, _RINGS - 1)
    gradient = (rise[cell - ring + outer] - rise[cell - ring + inner]) / (radius[outer] - radius[inner])
    gradient = ti.math.clamp(gradient, -warp_ground._GRADIENT_LIMIT, warp_ground._GRADIENT_LIMIT)
    middle = ti.math.clamp(own, median - warp_ground._OFF_MEDIAN, median + warp_ground._OFF_MEDIAN)
    r = radius[ring]
    z = middle + plane[0] * centre[cell, 0] + plane[1] * centre[cell, 1] + plane[2]
    top = ti.f32(warp_ground._TOP_BARE)
    if _stands(cells[cell, _LEVELS], cells[cell, _UPPER_LEVELS], z):
        top = warp_ground._TOP_OCCUPIED
    half = 0.5 * gradient
    surface[cell, 0] = middle - half * r
    surface[cell, 1] = half / r
    surface[cell, 2] = top
    surface[cell, 3] = -warp_ground._BOTTOM - warp_ground._BOTTOM_PER_METRE * r


@ti.kernel
def _segment(
    # in
    rows: _Rows,
    count: ti.i32,
    height_is_given: ti.i32,
    given_height: ti.f32,
    in_64_bits: ti.template(),
    radius: _Floats,
    centre: _Rows,
    # out: workspace
    cells: _Table,
    cell_of_point: _Integers,
    candidates: _Rows,
    hypotheses: _Rows,
    scores: _Integers,
    rise: _Floats,
    surface: _Rows,
    # out
    found: _Floats,
    mask: _Integers,
    height: _Floats,
):
    for cell in range(_CELLS):
        cells[cell, _DEPTH] = 0
        cells[cell, _FIRST] = NO_POINT
        cells[cell, _LEVELS] = 0
        cells[cell, _UPPER_LEVELS] = 0
    # Per cell its lowest depth, and the levels of 0.25 m (modulo 16 m) that have points.
    for i in range(count):
        p = _point(rows, i)
        cell = -1
        if ti.abs(p[0]) + ti.abs(p[1]) + ti.abs(p[2]) < 3.0e38:
            cell = _cell_of(p[0], p[1])
            depth = _depth_of(p[2])
            if cells[cell, _DEPTH] < depth:
                ti.atomic_max(cells[cell, _DEPTH], depth)
            level = ti.i32((1000.0 + ti.math.clamp(p[2], -999.0, 999.0)) * 4.0)
            bit = 1 << (level & 31)
            word = ti.select((level & 32) == 0, _LEVELS, _UPPER_LEVELS)
            if (cells[cell, word] & bit) == 0:
                ti.atomic_or(cells[cell, word], bit)
        cell_of_point[i] = cell
    # The first of the points that are as low.
    for i in range(count):
        cell = cell_of_point[i]
        if cell >= 0 and cells[cell, _DEPTH] == _depth_of(rows[i, 2]) and cells[cell, _FIRST] > i:
            ti.atomic_min(cells[cell, _FIRST], i)
    # The lowest point of each patch around the sensor.
    for patch in range(_CANDIDATES):
        depth = 0
        first = 0
        for k in range(64):
            ring = warp_plane._FIRST_BAND_RING + (patch % _BANDS) * 8 + (k & 7)
            cell = ((patch // _BANDS) * 8 + (k >> 3)) * _RINGS + ring
            own = cells[cell, _DEPTH]
            if own > depth or (own == depth and own > 0 and cells[cell, _FIRST] < first):
                depth = own
                first = cells[cell, _FIRST]
        candidate = ti.math.vec3(0.0, 0.0, warp_plane._NOWHERE)
        if depth > 0:
            candidate = _point(rows, first)
        candidates[patch, 0] = candidate[0]
        candidates[patch, 1] = candidate[1]
        candidates[patch, 2] = candidate[2]
    # A hypothesis scores by the candidates on it, less those under it.
    for number in range(_HYPOTHESES):
        plane = _hypothesis(candidates, number)
        score = 0
        steepness = plane[0] * plane[0] + plane[1] * plane[1]
        fits = plane[2] != warp_plane._NOWHERE and steepness <= warp_plane._STEEPEST * warp_plane._STEEPEST
        if height_is_given != 0:
            fits = fits and ti.abs(plane[2] + given_height) <= warp_plane._HEIGHT_SLACK
        if fits:
            for j in range(_CANDIDATES):
                p = _point(candidates, j)
                off = _above(plane, p)
                if _is_on(off, p):
                    score += 2
                elif off < 0.0:
                    score -= 1
        scores[number] = score
        hypotheses[number, 0] = plane[0]
        hypotheses[number, 1] = plane[1]
        hypotheses[number, 2] = plane[2]
    # The plane: the best hypothesis, fitted to its candidates.
    for _ in range(1):
        best = -1
        score = 0
        for number in range(_HYPOTHESES):
            if scores[number] > score:
                score = scores[number]
                best = number
        level_height = ti.f32(warp_plane._DEFAULT_HEIGHT)
        if height_is_given != 0:
            level_height = given_height
        plane = ti.math.vec3(0.0, 0.0, -level_height)
        if best >= 0:
            plane = _point(hypotheses, best)
            if ti.static(in_64_bits):
                plane += _fit_in_64_bits(candidates, plane)
            else:
                plane += _fit_in_32_bits(candidates, plane)
        found[0] = plane[0]
        found[1] = plane[1]
        found[2] = plane[2]
        found[3] = -plane[2] / ti.sqrt(1.0 + plane[0] * plane[0] + plane[1] * plane[1])
    for segment in range(_SEGMENTS):
        _sweep(rows, cells, ti.math.vec3(found[0], found[1], found[2]), radius, segment, rise)
    for cell in range(_CELLS):
        if cells[cell, _DEPTH] > 0:
            _judge_cell(cell, cells, rise, radius, centre, ti.math.vec3(found[0], found[1], found[2]), surface)
    for i in range(count):
        cell = cell_of_point[i]
        is_ground = 0
        above = ti.math.nan
        if cell >= 0:
            p = _point(rows, i)
            r2 = ti.min(p[0] * p[0] + p[1] * p[1], warp_ground._FARTHEST)
            above = _above(ti.math.vec3(found[0], found[1], found[2]), p) - surface[cell, 0] - surface[cell, 1] * r2
            is_ground = ti.i32(above < surface[cell, 2] and above > surface[cell, 3])
        height[i] = above
        mask[i] = is_ground


@dataclass(frozen=True, kw_only=True)
class GroundSegment:
    """A plan: workspace on Taichi's device for clouds of up to `capacity` points; `launch` reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    sensor_height: float | None = None
    """Height of the frame's origin above the ground [m], held to within 0.5 m; None to estimate it in each launch."""
    device: str = DEFAULT_TAICHI
    """Taichi's device, as `start` takes it."""

    mask: Any = field(init=False, repr=False, compare=False)
    """Out: whether each point is ground, ti.Ndarray, shape (capacity,), int32, 1 or 0."""
    height: Any = field(init=False, repr=False, compare=False)
    """Out: height of each point above the ground along z [m], ti.Ndarray, shape (capacity,), float32; NaN where it is
    not finite."""
    found: Any = field(init=False, repr=False, compare=False)
    """Out: the plane of the ground near the sensor z = a x + b y + c, as a b c, and the origin's distance from it [m];
    ti.Ndarray, shape (4,), float32."""

    def __post_init__(self):
        """Checks the numbers and makes the workspace."""
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if self.sensor_height is not None and not np.isfinite(self.sensor_height):
            raise ValueError(f"sensor_height must be finite [m] or None, not {self.sensor_height}")
        start(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        with launching:
            keep("_in_64_bits", has_64_bits())
            for name, values in zip(("_radius", "_centre"), warp_ground._grid_centres(), strict=True):
                array = workspace(values.shape, ti.f32)
                array.from_numpy(values)
                keep(name, array)
            keep("_cells", workspace((_CELLS, 4), ti.i32))
            keep("_cell_of_point", workspace(self.capacity, ti.i32))
            keep("_candidates", workspace((_CANDIDATES, 3), ti.f32))
            keep("_hypotheses", workspace((_HYPOTHESES, 3), ti.f32))
            keep("_scores", workspace(_HYPOTHESES, ti.i32))
            keep("_rise", workspace(_CELLS, ti.f32))
            keep("_surface", workspace((_CELLS, 4), ti.f32))
            keep("found", workspace(4, ti.f32))
            keep("mask", workspace(self.capacity, ti.i32))
            keep("height", workspace(self.capacity, ti.f32))

    def launch(self, points: Any, count: int) -> None:
        """Fills `mask`, `height` and `found` from the first `count` points.

        Args:
            points: ti.Ndarray or contiguous NumPy array, float32, shape (n, 3 or more), count ≤ n ≤ capacity: x y z [m]
                in a frame with z up and the sensor on its z axis.
            count: How many points there are.
        """
        self._launch_into(points, count, self.found, self.mask, self.height)

    def _launch_into(self, points: Any, count: int, found: Any, mask: Any, height: Any) -> None:
        check_count(count, points, self.capacity)
        given = self.sensor_height
        with launching:
            _segment(
                *(points, count, int(given is not None), given or 0.0, self._in_64_bits, self._radius, self._centre),
                *(self._cells, self._cell_of_point, self._candidates, self._hypotheses, self._scores, self._rise),
                *(self._surface, found, mask, height),
            )


def segment_ground(points: Points, sensor_height: float | None) -> Ground:
    """As `kernels.ground.segment_ground`, for points that are borrowed already."""
    device = start()
    n = len(points)
    plan = plan_for(GroundSegment, capacity=capacity_for(n), sensor_height=sensor_height, device=device)
    found, mask, height = np.zeros(4, np.float32), np.zeros(max(n, 1), np.int32), np.zeros(max(n, 1), np.float32)
    plan._launch_into(rows_of(points), n, found, mask, height)
    return Ground(give_back(mask[:n] != 0, points), give_back(height[:n], points), float(found[3]))
