"""The plane of the ground near the sensor, from the lowest points of a polar grid.

The lowest point of each cell is a sample of the surface. The lowest of each of 256 patches near the sensor are the
candidates for the plane: RANSAC with draws by a fixed hash, then least squares over the winner's inliers.

A GPU bins all points at once. A CPU bins them in parts, each into a table of its own, and merges the tables; what is
kept of a cell is a maximum and a union, so the bytes are the same.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .device import DEFAULT_DEVICE, module_apart, resolve_device
from .ground_parts import bin_part
from .parts import part_start
from .polar_grid import FIRST_RING, LOW_WORD, RING_BITS, RINGS, SEGMENTS, cell_of
from .threads import launch_parts, thread_count

__all__ = ["FIRST_RING", "RINGS", "RING_BITS", "SEGMENTS", "GroundPlane", "above", "lowest_point"]

# Which cell a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})
_APART = module_apart(__name__, fuse_fp=False)

# The patches whose lowest points the plane is fitted to: 32 sectors, 8 octaves of r² from 2 to 32 m.
_SECTORS = wp.constant(32)
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
_FIX = wp.constant(wp.float64(1048576.0))


@wp.func
def _is_finite(p: wp.vec3) -> bool:
    return wp.abs(p[0]) + wp.abs(p[1]) + wp.abs(p[2]) < 3.0e38


@wp.func
def _depth_key(z: float, i: int) -> wp.int64:
    """Grows with the depth of a point below 1000 m, in millimetres; of equals, the first has the highest."""
    depth = wp.int64(int((1000.0 - z) * 1000.0))
    return (depth << wp.int64(32)) | (LOW_WORD - wp.int64(i))


@wp.func
def _level_bit(z: float) -> wp.int64:
    """The level of 0.25 m, modulo 16 m."""
    return wp.int64(1) << wp.int64(int((1000.0 + z) * 4.0) & 63)


@wp.kernel(module=_APART)
def _bin_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    # in out: zero
    cells: wp.array2d(dtype=wp.int64),
    # out
    cell_out: wp.array(dtype=wp.int32),
):
    """The cell of each point; per cell its lowest point, and the levels that have points."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    p = xyz_in[i]
    if not _is_finite(p):
        cell_out[i] = -1
        return
    cell = cell_of(p[0], p[1])
    cell_out[i] = cell
    z = wp.clamp(p[2], -999.0, 999.0)
    wp.atomic_max(cells, cell, 0, _depth_key(z, i))
    wp.atomic_or(cells, cell, 1, _level_bit(z))


@wp.func
def lowest_point(xyz: wp.array(dtype=wp.vec3), key: wp.int64) -> wp.vec3:
    """The lowest point of a cell by the cell's key."""
    return xyz[int(LOW_WORD - (key & LOW_WORD))]


@wp.func
def _candidate_of(xyz: wp.array(dtype=wp.vec3), cells: wp.array2d(dtype=wp.int64), patch: int) -> wp.vec4:
    """The lowest point of a patch, and how far a plane may lie off it."""
    sector = patch / _BANDS
    band = patch % _BANDS
    best = wp.int64(0)
    for s in range(8):
        for k in range(8):
            best = wp.max(best, cells[(sector * 8 + s) * RINGS + _FIRST_BAND_RING + band * 8 + k, 0])
    if best == wp.int64(0):
        return wp.vec4(0.0, 0.0, _NOWHERE, 0.0)
    p = lowest_point(xyz, best)
    return wp.vec4(p[0], p[1], p[2], 0.1 + 0.01 * wp.sqrt(p[0] * p[0] + p[1] * p[1]))


@wp.kernel(module=_APART)
def _pick_candidates(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    cells_in: wp.array2d(dtype=wp.int64),
    # out
    candidate_out: wp.array(dtype=wp.vec4),
):
    """The candidates of all patches around the sensor."""
    patch = wp.tid()
    candidate_out[patch] = _candidate_of(xyz_in, cells_in, patch)


@wp.kernel
def _merge_part(
    # in
    part: int,
    parts: int,
    xyz_in: wp.array(dtype=wp.vec3),
    # in out: the tables of the parts, of which the first becomes that of all
    tables: wp.array2d(dtype=wp.int64),
    # out
    candidate_out: wp.array(dtype=wp.vec4),
):
    """Merges the cells of some sectors and picks the candidates there."""
    size = SEGMENTS * RINGS
    first = part_start(_SECTORS, part, parts)
    last = part_start(_SECTORS, part + 1, parts)
    for other in range(1, parts):
        for cell in range(first * 8 * RINGS, last * 8 * RINGS):
            tables[cell, 0] = wp.max(tables[cell, 0], tables[other * size + cell, 0])
            tables[cell, 1] = tables[cell, 1] | tables[other * size + cell, 1]
    for patch in range(first * _BANDS, last * _BANDS):
        candidate_out[patch] = _candidate_of(xyz_in, tables, patch)


@wp.func
def above(plane: wp.vec3, p: wp.vec3) -> float:
    """The height of a point above the plane z = a x + b y + c."""
    return p[2] - plane[0] * p[0] - plane[1] * p[1] - plane[2]


@wp.func
def _position(candidate: wp.vec4) -> wp.vec3:
    return wp.vec3(candidate[0], candidate[1], candidate[2])


@wp.func
def _hypothesis(candidates: wp.array(dtype=wp.vec4), number: int) -> wp.vec3:
    """The plane a b c through three candidates drawn by a fixed hash; c is nowhere if they give none."""
    state = wp.uint32(number) * _HASH + wp.uint32(12345)
    p = wp.vec3(0.0, 0.0, _NOWHERE)
    q = wp.vec3(0.0, 0.0, _NOWHERE)
    s = wp.vec3(0.0, 0.0, _NOWHERE)
    drawn = wp.int32(0)
    while drawn < _DRAWS and s[2] == _NOWHERE:
        drawn += 1
        state = state * wp.uint32(1664525) + wp.uint32(1013904223)
        candidate = _position(candidates[int(state >> wp.uint32(24))])
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


@wp.func
def _vote(candidates: wp.array(dtype=wp.vec4), number: int, sensor_height: float) -> wp.int64:
    """A hypothesis and its score, the candidates on it less those under it; zero where it is out of the question."""
    plane = _hypothesis(candidates, number)
    if plane[2] == _NOWHERE or plane[0] * plane[0] + plane[1] * plane[1] > _STEEPEST * _STEEPEST:
        return wp.int64(0)
    if wp.abs(plane[2] + sensor_height) > _HEIGHT_SLACK:  # never where the height is not given, NaN
        return wp.int64(0)
    score = wp.int32(0)
    for j in range(_CANDIDATES):
        candidate = candidates[j]
        off = above(plane, _position(candidate))
        score += wp.where(wp.abs(off) < candidate[3], 2, wp.where(off < 0.0, -1, 0))
    if score <= 0:
        return wp.int64(0)
    return (wp.int64(score) << wp.int64(32)) | wp.int64(_HYPOTHESES - number)


@wp.kernel(module=_APART)
def _vote_planes(
    # in
    candidate_in: wp.array(dtype=wp.vec4),
    sensor_height: float,
    # in out: zero
    best: wp.array(dtype=wp.int64),
):
    """Finds the best hypothesis, of equals the first."""
    vote = _vote(candidate_in, wp.tid(), sensor_height)
    if vote > wp.int64(0):
        wp.atomic_max(best, 0, vote)


@wp.func
def _add_inlier(candidates: wp.array(dtype=wp.vec4), number: int, best: wp.int64, sums: wp.array(dtype=wp.int64)):
    """Adds a candidate that is on the winner to the normal equations of the least-squares plane, in fixed point."""
    plane = _hypothesis(candidates, _HYPOTHESES - int(best & LOW_WORD))
    candidate = candidates[number]
    off = above(plane, _position(candidate))
    if wp.abs(off) < candidate[3]:
        x = wp.float64(candidate[0])
        y = wp.float64(candidate[1])
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


@wp.kernel(module=_APART)
def _sum_inliers(
    # in
    candidate_in: wp.array(dtype=wp.vec4),
    best_in: wp.array(dtype=wp.int64),
    # in out: zero
    sums: wp.array(dtype=wp.int64),
):
    """The normal equations, one candidate a thread."""
    if best_in[0] != wp.int64(0):
        _add_inlier(candidate_in, wp.tid(), best_in[0], sums)


@wp.func
def _fitted_plane(
    candidates: wp.array(dtype=wp.vec4),
    best: wp.int64,
    sums: wp.array(dtype=wp.int64),
    sensor_height: float,
) -> wp.vec3:
    """The winner's plane after the fit, or the level one at the height given or usual if there is no winner."""
    if best == wp.int64(0):
        return wp.vec3(0.0, 0.0, -wp.where(wp.isnan(sensor_height), _DEFAULT_HEIGHT, sensor_height))
    plane = _hypothesis(candidates, _HYPOTHESES - int(best & LOW_WORD))
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


@wp.func
def _settle(plane: wp.vec3, plane_out: wp.array(dtype=wp.vec3), found_height_out: wp.array(dtype=wp.float32)):
    plane_out[0] = plane
    found_height_out[0] = -plane[2] / wp.sqrt(1.0 + plane[0] * plane[0] + plane[1] * plane[1])


@wp.kernel(module=_APART)
def _settle_plane(
    # in
    candidate_in: wp.array(dtype=wp.vec4),
    best_in: wp.array(dtype=wp.int64),
    sums_in: wp.array(dtype=wp.int64),
    sensor_height: float,
    # out
    plane_out: wp.array(dtype=wp.vec3),
    found_height_out: wp.array(dtype=wp.float32),
):
    """The plane, and how far the origin is from it."""
    _settle(_fitted_plane(candidate_in, best_in[0], sums_in, sensor_height), plane_out, found_height_out)


@wp.kernel
def _fit_in_order(
    # in
    candidate_in: wp.array(dtype=wp.vec4),
    sensor_height: float,
    # in out: zero
    sums: wp.array(dtype=wp.int64),
    # out
    plane_out: wp.array(dtype=wp.vec3),
    found_height_out: wp.array(dtype=wp.float32),
):
    """Votes, sums and settles, by one thread."""
    best = wp.int64(0)
    for number in range(_HYPOTHESES):
        best = wp.max(best, _vote(candidate_in, number, sensor_height))
    if best > wp.int64(0):
        for number in range(_CANDIDATES):
            _add_inlier(candidate_in, number, best, sums)
    _settle(_fitted_plane(candidate_in, best, sums, sensor_height), plane_out, found_height_out)


@dataclass(frozen=True, kw_only=True)
class GroundPlane:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    sensor_height: float | None = None
    """Height of the frame's origin above the ground [m], held to within 0.5 m; None to estimate it in each launch."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`parts` (of a CPU, one for each thread), `shared` (parallel), or `auto`: `parts` on a CPU, else `shared`.

    The results are equal."""

    parts: int = field(init=False, repr=False)
    """In how many parts a CPU works; 0 where the work is shared."""
    cell: wp.array = field(init=False, repr=False)
    """The polar cell of each point, segment × rings + ring, −1 if it is not finite; shape (capacity,), int32."""
    cells: wp.array = field(init=False, repr=False)
    """Per polar cell the key of its lowest point, zero if none, and the levels with points; shape (cells, 2), int64."""
    plane: wp.array = field(init=False, repr=False)
    """The plane z = a x + b y + c, as a b c, shape (1,), vec3."""
    found_height: wp.array = field(init=False, repr=False)
    """Distance of the frame's origin from the plane [m], shape (1,), float32."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if self.sensor_height is not None and not math.isfinite(self.sensor_height):
            raise ValueError(f"sensor_height must be finite [m] or None, not {self.sensor_height}")
        device = resolve_device(self.device)

        def keep(name: str, array: wp.array) -> None:
            object.__setattr__(self, name, array)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        if self.method not in ("auto", "parts", "shared"):
            raise ValueError(f"method must be 'auto', 'parts' or 'shared', not {self.method!r}")
        in_parts = self.method == "parts" or (self.method == "auto" and device == DEFAULT_DEVICE)
        parts = thread_count() if in_parts else 1
        keep("parts", parts if in_parts else 0)
        size = int(SEGMENTS * RINGS)
        # One array of what each launch clears: per cell and part two words, the best hypothesis, the sums of the fit.
        buffer("_scratch", 2 * size * parts + 10, wp.int64)
        keep("_tables", self._scratch[: 2 * size * parts].reshape((size * parts, 2)))
        keep("cells", self._tables[:size])
        keep("_best", self._scratch[-10:-9])
        keep("_sums", self._scratch[-9:])
        buffer("_candidate", int(_CANDIDATES), wp.vec4)
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
        self._scratch.zero_()
        if self.parts:
            launch_parts(bin_part, self.parts, [xyz, count, self._tables], [self.cell])
            launch_parts(_merge_part, self.parts, [xyz, self._tables], [self._candidate])
            self._run(_fit_in_order, 1, [self._candidate, given, self._sums], [self.plane, self.found_height])
            return
        fit = [self._candidate, self._best, self._sums]
        self._run(_bin_points, n, [xyz, count, self.cells], [self.cell])
        self._run(_pick_candidates, int(_CANDIDATES), [xyz, self.cells], [self._candidate])
        self._run(_vote_planes, int(_HYPOTHESES), [self._candidate, given, self._best], [])
        self._run(_sum_inliers, int(_CANDIDATES), fit, [])
        self._run(_settle_plane, 1, [*fit, given], [self.plane, self.found_height])

    def _run(self, kernel: Any, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)
