"""The plane of the ground near the sensor, from the lowest points of a polar grid.

The lowest point of each cell is a sample of the surface. The lowest of each of 256 patches near the sensor are the
candidates for the plane: RANSAC with draws by a fixed hash, then least squares over the winner's inliers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE, resolve_device

__all__ = ["FIRST_RING", "RINGS", "RING_BITS", "SEGMENTS", "GroundPlane", "above", "cell_of", "lowest_point"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

# The polar grid. A ring is an eighth of an octave of r², so its width is 3 to 6 % of its radius: the float's own bits
# name it. Segments divide the diamond |x| + |y| = 1 evenly, so they are 0.9 to 1.8° wide.
SEGMENTS = wp.constant(256)
RINGS = wp.constant(128)
RING_BITS = wp.constant(20)
FIRST_RING = wp.constant(127 * 8)  # the upper bits of 1 m²

# The patches whose lowest points the plane is fitted to: 32 sectors, 8 octaves of r² from 2 to 32 m.
_BANDS = wp.constant(8)
_CANDIDATES = wp.constant(256)
_FIRST_BAND_RING = wp.constant(16)
_HYPOTHESES = wp.constant(128)
_DRAWS = wp.constant(64)
_NOWHERE = wp.constant(1.0e9)
_STEEPEST = wp.constant(0.35)  # slope of the plane against the sensor, tan 19°
_HEIGHT_SLACK = wp.constant(0.5)  # [m] between the height given and the plane found
_DEFAULT_HEIGHT = wp.constant(1.8)

_HASH = wp.constant(wp.uint32(2654435761))
_LOW_WORD = wp.constant(wp.int64(0x7FFFFFFF))
_FIX = wp.constant(wp.float64(1048576.0))


@wp.func
def cell_of(x: float, y: float) -> int:
    """The polar cell of a position: segment × rings + ring."""
    # The angle as the diamond's, 0 to 4: monotone in the true one, for one division.
    angle = x / (wp.abs(x) + wp.abs(y) + 1.0e-30)
    angle = wp.where(y < 0.0, 3.0 + angle, 1.0 - angle)
    segment = int(angle * (float(SEGMENTS) * 0.25)) & (SEGMENTS - 1)
    ring = (wp.cast(x * x + y * y, wp.int32) >> RING_BITS) - FIRST_RING
    return segment * RINGS + wp.clamp(ring, 0, RINGS - 1)


@wp.kernel
def _bin_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    # in out: zero
    cells: wp.array2d(dtype=wp.int64),
    # out
    cell_out: wp.array(dtype=wp.int32),
):
    """The cell of each point; per cell its lowest point, and the levels of 0.25 m (modulo 16 m) that have points."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    p = xyz_in[i]
    if not (wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]) < 3.0e38):
        cell_out[i] = -1
        return
    cell = cell_of(p[0], p[1])
    cell_out[i] = cell
    z = wp.clamp(p[2], -999.0, 999.0)
    depth = wp.int64(int((1000.0 - z) * 1000.0))
    wp.atomic_max(cells, cell, 0, (depth << wp.int64(32)) | (_LOW_WORD - wp.int64(i)))
    level = int((1000.0 + z) * 4.0) & 63
    wp.atomic_or(cells, cell, 1, wp.int64(1) << wp.int64(level))


@wp.func
def lowest_point(xyz: wp.array(dtype=wp.vec3), key: wp.int64) -> wp.vec3:
    """The lowest point of a cell by the cell's key."""
    return xyz[int(_LOW_WORD - (key & _LOW_WORD))]


@wp.kernel
def _pick_candidates(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    cells_in: wp.array2d(dtype=wp.int64),
    # out
    candidate_out: wp.array(dtype=wp.vec3),
):
    """The lowest point of each patch around the sensor."""
    patch = wp.tid()
    sector = patch / _BANDS
    band = patch % _BANDS
    best = wp.int64(0)
    for s in range(8):
        for k in range(8):
            best = wp.max(best, cells_in[(sector * 8 + s) * RINGS + _FIRST_BAND_RING + band * 8 + k, 0])
    if best == wp.int64(0):
        candidate_out[patch] = wp.vec3(0.0, 0.0, _NOWHERE)
    else:
        candidate_out[patch] = lowest_point(xyz_in, best)


@wp.func
def above(plane: wp.vec3, p: wp.vec3) -> float:
    """The height of a point above the plane z = a x + b y + c."""
    return p[2] - plane[0] * p[0] - plane[1] * p[1] - plane[2]


@wp.func
def _plane_tolerance(p: wp.vec3) -> float:
    return 0.1 + 0.01 * wp.sqrt(p[0] * p[0] + p[1] * p[1])


@wp.func
def _hypothesis(candidates: wp.array(dtype=wp.vec3), number: int) -> wp.vec3:
    """The plane a b c through three candidates drawn by a fixed hash; c is nowhere if they give none."""
    state = wp.uint32(number) * _HASH + wp.uint32(12345)
    p = wp.vec3(0.0, 0.0, _NOWHERE)
    q = wp.vec3(0.0, 0.0, _NOWHERE)
    s = wp.vec3(0.0, 0.0, _NOWHERE)
    drawn = wp.int32(0)
    while drawn < _DRAWS and s[2] == _NOWHERE:
        drawn += 1
        state = state * wp.uint32(1664525) + wp.uint32(1013904223)
        candidate = candidates[int(state >> wp.uint32(24))]
        if candidate[2] != _NOWHERE:
            if p[2] == _NOWHERE:
                p = candidate
            elif q[2] == _NOWHERE:
                if wp.length(candidate - p) > 3.0:
                    q = candidate
            else:
                area = (q[0] - p[0]) * (candidate[1] - p[1]) - (q[1] - p[1]) * (candidate[0] - p[0])
                if wp.abs(area) > 12.0:
                    s = candidate
    if s[2] == _NOWHERE:
        return s
    normal = wp.cross(q - p, s - p)
    a = -normal[0] / normal[2]
    b = -normal[1] / normal[2]
    return wp.vec3(a, b, p[2] - a * p[0] - b * p[1])


@wp.kernel
def _vote_planes(
    # in
    candidate_in: wp.array(dtype=wp.vec3),
    sensor_height: float,
    # in out: zero
    best: wp.array(dtype=wp.int64),
):
    """Scores a hypothesis by the candidates on it, less those under it."""
    number = wp.tid()
    plane = _hypothesis(candidate_in, number)
    if plane[2] == _NOWHERE or plane[0] * plane[0] + plane[1] * plane[1] > _STEEPEST * _STEEPEST:
        return
    if wp.abs(plane[2] + sensor_height) > _HEIGHT_SLACK:  # never where the height is not given, NaN
        return
    score = wp.int32(0)
    for j in range(_CANDIDATES):
        p = candidate_in[j]
        off = above(plane, p)
        if wp.abs(off) < _plane_tolerance(p):
            score += 2
        elif off < 0.0:
            score -= 1
    if score > 0:
        wp.atomic_max(best, 0, (wp.int64(score) << wp.int64(32)) | wp.int64(_HYPOTHESES - number))


@wp.kernel
def _sum_inliers(
    # in
    candidate_in: wp.array(dtype=wp.vec3),
    best_in: wp.array(dtype=wp.int64),
    # in out: zero
    sums: wp.array(dtype=wp.int64),
):
    """Normal equations of the least-squares plane through the winner's candidates, in fixed point."""
    if best_in[0] == wp.int64(0):
        return
    plane = _hypothesis(candidate_in, _HYPOTHESES - int(best_in[0] & _LOW_WORD))
    p = candidate_in[wp.tid()]
    off = above(plane, p)
    if wp.abs(off) < _plane_tolerance(p):
        x = wp.float64(p[0])
        y = wp.float64(p[1])
        z = wp.float64(off)
        wp.atomic_add(sums, 0, wp.int64(1))
        wp.atomic_add(sums, 1, wp.int64(x * _FIX))
        wp.atomic_add(sums, 2, wp.int64(y * _FIX))
        wp.atomic_add(sums, 3, wp.int64(z * _FIX))
        wp.atomic_add(sums, 4, wp.int64(x * x * _FIX))
        wp.atomic_add(sums, 5, wp.int64(x * y * _FIX))
        wp.atomic_add(sums, 6, wp.int64(y * y * _FIX))
        wp.atomic_add(sums, 7, wp.int64(x * z * _FIX))
        wp.atomic_add(sums, 8, wp.int64(y * z * _FIX))


@wp.func
def _fitted_plane(
    candidates: wp.array(dtype=wp.vec3),
    best: wp.array(dtype=wp.int64),
    sums: wp.array(dtype=wp.int64),
    sensor_height: float,
) -> wp.vec3:
    """The winner's plane after the fit, or the level one at the height given or usual if there is no winner."""
    if best[0] == wp.int64(0):
        return wp.vec3(0.0, 0.0, -wp.where(wp.isnan(sensor_height), _DEFAULT_HEIGHT, sensor_height))
    plane = _hypothesis(candidates, _HYPOTHESES - int(best[0] & _LOW_WORD))
    n = wp.float64(sums[0]) * _FIX
    x = wp.float64(sums[1]) / n
    y = wp.float64(sums[2]) / n
    z = wp.float64(sums[3]) / n
    xx = wp.float64(sums[4]) / n - x * x
    xy = wp.float64(sums[5]) / n - x * y
    yy = wp.float64(sums[6]) / n - y * y
    xz = wp.float64(sums[7]) / n - x * z
    yz = wp.float64(sums[8]) / n - y * z
    determinant = xx * yy - xy * xy
    if determinant < wp.float64(1.0):
        return plane
    a = (xz * yy - yz * xy) / determinant
    b = (yz * xx - xz * xy) / determinant
    return plane + wp.vec3(float(a), float(b), float(z - a * x - b * y))


@wp.kernel
def _settle_plane(
    # in
    candidate_in: wp.array(dtype=wp.vec3),
    best_in: wp.array(dtype=wp.int64),
    sums_in: wp.array(dtype=wp.int64),
    sensor_height: float,
    # out
    plane_out: wp.array(dtype=wp.vec3),
    found_height_out: wp.array(dtype=wp.float32),
):
    """The plane, and how far the origin is from it."""
    plane = _fitted_plane(candidate_in, best_in, sums_in, sensor_height)
    plane_out[0] = plane
    found_height_out[0] = -plane[2] / wp.sqrt(1.0 + plane[0] * plane[0] + plane[1] * plane[1])


@dataclass(frozen=True, kw_only=True)
class GroundPlane:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    sensor_height: float | None = None
    """Height of the frame's origin above the ground [m], held to within 0.5 m; None to estimate it in each launch."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    cell: wp.array = field(init=False, repr=False)
    """The polar cell of each point, segment × rings + ring, −1 if it is not finite; shape (capacity,), int32."""
    cells: wp.array = field(init=False, repr=False)
    """Per polar cell the key of its lowest point, zero if none, and the levels with points; shape (cells, 2), int64."""
    plane: wp.array = field(init=False, repr=False)
    """The plane z = a x + b y + c, as a b c, shape (1,), vec3."""
    found_height: wp.array = field(init=False, repr=False)
    """Distance of the frame's origin from the plane [m], shape (1,), float32."""

    def __post_init__(self):
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1 point, not {self.capacity}")
        if self.sensor_height is not None and not math.isfinite(self.sensor_height):
            raise ValueError(f"sensor_height must be finite [m] or None, not {self.sensor_height}")
        device = resolve_device(self.device)

        def keep(name: str, array: wp.array) -> None:
            object.__setattr__(self, name, array)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        size = int(SEGMENTS * RINGS)
        # One array of what each launch clears: per cell two words, the best hypothesis, the sums of the fit.
        buffer("_scratch", 2 * size + 10, wp.int64)
        keep("cells", self._scratch[: 2 * size].reshape((size, 2)))
        keep("_best", self._scratch[2 * size : 2 * size + 1])
        keep("_sums", self._scratch[2 * size + 1 :])
        buffer("_candidate", int(_CANDIDATES), wp.vec3)
        buffer("cell", self.capacity, wp.int32)
        buffer("plane", 1, wp.vec3)
        buffer("found_height", 1, wp.float32)

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points.

        Args:
            xyz: Positions [m] in a frame with z up and the sensor on its z axis, shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        given = math.nan if self.sensor_height is None else self.sensor_height
        fit = [self._candidate, self._best, self._sums]
        self._scratch.zero_()
        self._run(_bin_points, n, [xyz, count, self.cells], [self.cell])
        self._run(_pick_candidates, int(_CANDIDATES), [xyz, self.cells], [self._candidate])
        self._run(_vote_planes, int(_HYPOTHESES), [self._candidate, given, self._best], [])
        self._run(_sum_inliers, int(_CANDIDATES), fit, [])
        self._run(_settle_plane, 1, [*fit, given], [self.plane, self.found_height])

    def _run(self, kernel: Any, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)
