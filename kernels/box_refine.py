"""Boxes that a network found, turned and moved until the sides that the sensor sees lie on their points.

A network at half-metre cells says headings to some degrees and places to some decimetres; the points of a car say both
better, once it is known that they are a car's. Of headings near the network's, the one is taken whose near sides have
the most points close by: the closeness criterion of Zhang, Xu, Dong, Dolan (Efficient L-shape fitting for vehicle
detection using laser scanners, IV 2017), with the network's as prior. The box then moves part of the way to where its
near sides should be; its size stays the network's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from .device import resolve_device

__all__ = ["BoxRefine"]

# Which heading wins must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_CELL = wp.constant(0.25)  # [m] edge of a cell of the map that tells whose a point may be
_AROUND = wp.constant(0.25)  # [m] by which a box is grown to have its points
_ABOVE_GROUND = wp.constant(0.25)  # [m] over the box's underside; lower points are the road's
_OVER_TOP = wp.constant(0.2)  # [m]
_NOBODY = wp.constant(2**31 - 1)
_ROOM = wp.constant(320)  # points of a box that are looked at
_WANTED = wp.constant(256)  # so many are meant to be, of a box of more
_FEWEST = wp.constant(30)  # points of a box that is refined: of fewer, boxes jump from scan to scan
_HEADINGS = 25
_STEP = wp.constant(float(np.radians(1.0)))
_PRIOR = wp.constant(float(0.03 / np.radians(5.0) ** 2))  # closeness that a heading must gain to be that far off
_BIN = wp.constant(0.02)  # [m]
_BINS = wp.constant(64)  # from the grown box's side inwards
_OUTLIERS = wp.constant(0.01)  # share of the points that may lie outside of a side
_CLOSE = 0.12  # [m] over which being close to a side fades
_WHOLE = wp.constant(1024)  # closeness of a point on a side
_EDGE_OUTLIERS = wp.constant(0.02)
_INSIDE = wp.constant(0.03)  # [m] that such a share of points lies inside of the side
_FARTHEST = wp.constant(0.35)  # [m] farther off, it is not this side that the points show
_BESIDE = wp.constant(0.5)  # [m] that the sensor must be beyond a side to see it
_SHARE = wp.constant(0.5)  # of the way that a box moves


@wp.func
def _local(pose: wp.vec4, x: float, y: float) -> wp.vec2:
    """A place along and across a box whose x, y, and cosine and sine of yaw are these."""
    dx = x - pose[0]
    dy = y - pose[1]
    return wp.vec2(dx * pose[2] + dy * pose[3], dy * pose[2] - dx * pose[3])


@wp.kernel
def _draw(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    keep_count_in: wp.array(dtype=wp.int32),
    kinds_in: wp.array(dtype=wp.int32),
    refined_in: wp.array(dtype=wp.int32),
    low_x: float,
    low_y: float,
    # in out
    owner: wp.array2d(dtype=wp.int32),
    # out
    pose_out: wp.array(dtype=wp.vec4),
    found_out: wp.array(dtype=wp.int32),
    taken_out: wp.array(dtype=wp.int32),
):
    """Marks the cells that a box may have points in; where two may, they are the better one's."""
    k = wp.tid()
    found_out[k] = 0
    taken_out[k] = 0
    if k >= keep_count_in[0]:
        return
    b = keep_in[k]
    if refined_in[kinds_in[b]] == 0:
        return
    pose = wp.vec4(boxes_in[b, 0], boxes_in[b, 1], wp.cos(boxes_in[b, 6]), wp.sin(boxes_in[b, 6]))
    pose_out[k] = pose
    around = _AROUND + 0.71 * _CELL
    c = wp.abs(pose[2])
    s = wp.abs(pose[3])
    half = 0.5 * boxes_in[b, 3] + around
    wide = 0.5 * boxes_in[b, 4] + around
    reach_x = half * c + wide * s
    reach_y = half * s + wide * c
    first_row = wp.max(int(wp.floor((boxes_in[b, 1] - reach_y - low_y) / _CELL)), 0)
    last_row = wp.min(int(wp.floor((boxes_in[b, 1] + reach_y - low_y) / _CELL)), owner.shape[0] - 1)
    first_column = wp.max(int(wp.floor((boxes_in[b, 0] - reach_x - low_x) / _CELL)), 0)
    last_column = wp.min(int(wp.floor((boxes_in[b, 0] + reach_x - low_x) / _CELL)), owner.shape[1] - 1)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            at = _local(pose, low_x + (float(column) + 0.5) * _CELL, low_y + (float(row) + 0.5) * _CELL)
            if wp.abs(at[0]) <= half and wp.abs(at[1]) <= wide:
                wp.atomic_min(owner, row, column, k)


@wp.kernel
def _claim(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    boxes_in: wp.array2d(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.vec4),
    owner_in: wp.array2d(dtype=wp.int32),
    low_x: float,
    low_y: float,
    run: int,
    # in out
    claims: wp.array(dtype=wp.int32),
    # out
    claimed_out: wp.array2d(dtype=wp.int32),
    found_out: wp.array(dtype=wp.int32),
):
    """Lists the points that lie in boxes, with their box, and counts those of each; a thread takes a run of points."""
    first = wp.tid() * run
    last = wp.min(first + run, count_in[0])
    columns = float(owner_in.shape[1])
    rows = float(owner_in.shape[0])
    for i in range(first, last):
        p = xyz_in[i]
        u = (p[0] - low_x) / _CELL
        v = (p[1] - low_y) / _CELL
        if u >= 0.0 and v >= 0.0 and u < columns and v < rows:
            k = owner_in[int(v), int(u)]
            if k != _NOBODY:
                b = keep_in[k]
                half = 0.5 * boxes_in[b, 5]
                above = p[2] - boxes_in[b, 2]
                at = _local(pose_in[k], p[0], p[1])
                inside = wp.abs(at[0]) <= 0.5 * boxes_in[b, 3] + _AROUND
                inside = inside and wp.abs(at[1]) <= 0.5 * boxes_in[b, 4] + _AROUND
                if inside and above > _ABOVE_GROUND - half and above < half + _OVER_TOP:
                    slot = wp.atomic_add(claims, 0, 1)
                    claimed_out[slot, 0] = i
                    claimed_out[slot, 1] = k
                    wp.atomic_add(found_out, k, 1)


@wp.kernel
def _take(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    pose_in: wp.array(dtype=wp.vec4),
    claims_in: wp.array(dtype=wp.int32),
    claimed_in: wp.array2d(dtype=wp.int32),
    found_in: wp.array(dtype=wp.int32),
    run: int,
    # in out
    taken: wp.array(dtype=wp.int32),
    # out
    local_out: wp.array2d(dtype=wp.vec2),
):
    """Takes a box's points, or of many a share by the hash of their numbers, along and across the box."""
    first = wp.tid() * run
    last = wp.min(first + run, claims_in[0])
    for claim in range(first, last):
        i = claimed_in[claim, 0]
        k = claimed_in[claim, 1]
        if found_in[k] >= _FEWEST:
            share = (found_in[k] + _WANTED - 1) / _WANTED
            mixed = wp.uint32(i) * wp.uint32(0x1E3779B1)
            if int((mixed >> wp.uint32(8)) % wp.uint32(share)) == 0:
                slot = wp.atomic_add(taken, k, 1)
                if slot < _ROOM:
                    local_out[k, slot] = _local(pose_in[k], xyz_in[i][0], xyz_in[i][1])


@wp.func
def _depth(p: wp.vec2, c: float, s: float, near: wp.vec2, half: float, wide: float) -> wp.vec2i:
    """How many bins a point lies inwards from the grown near sides of the box turned by the angle of c and s."""
    along = (p[0] * c + p[1] * s) * near[0]
    across = (p[1] * c - p[0] * s) * near[1]
    return wp.vec2i(
        wp.clamp(int(wp.floor((half + _AROUND - along) / _BIN)), 0, _BINS - 1),
        wp.clamp(int(wp.floor((wide + _AROUND - across) / _BIN)), 0, _BINS - 1),
    )


@wp.func
def _sides(
    local: wp.array2d(dtype=wp.vec2),
    k: int,
    n: int,
    c: float,
    s: float,
    near: wp.vec2,
    half: float,
    wide: float,
    outside: int,
    bins: wp.array3d(dtype=wp.int32),
    row: int,
) -> wp.vec2i:
    """The bins of both near sides: outwards of them lie no more than so many points."""
    for i in range(_BINS):
        bins[row, 0, i] = 0
        bins[row, 1, i] = 0
    for j in range(n):
        depth = _depth(local[k, j], c, s, near, half, wide)
        bins[row, 0, depth[0]] = bins[row, 0, depth[0]] + 1
        bins[row, 1, depth[1]] = bins[row, 1, depth[1]] + 1
    side = wp.vec2i(_BINS - 1, _BINS - 1)
    for axis in range(2):
        past = int(0)
        for i in range(_BINS):
            past += bins[row, axis, i]
            if past > outside:
                side[axis] = wp.min(side[axis], i)
    return side


@wp.func
def _sign(x: float) -> float:
    return wp.where(x < 0.0, -1.0, 1.0)


@wp.kernel
def _score_headings(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.vec4),
    taken_in: wp.array(dtype=wp.int32),
    local_in: wp.array2d(dtype=wp.vec2),
    closeness_in: wp.array(dtype=wp.int32),
    # in out
    bins: wp.array3d(dtype=wp.int32),
    # out
    scores_out: wp.array2d(dtype=wp.float32),
):
    """How close the points are to the nearer of both near sides, at each heading."""
    k, a = wp.tid()  # pyright: ignore[reportAssignmentType]
    n = wp.min(taken_in[k], _ROOM)
    if n == 0:
        return
    b = keep_in[k]
    angle = float(a - scores_out.shape[1] / 2) * _STEP
    c = wp.cos(angle)
    s = wp.sin(angle)
    sensor = _local(pose_in[k], 0.0, 0.0)
    near = wp.vec2(_sign(sensor[0]), _sign(sensor[1]))
    half = 0.5 * boxes_in[b, 3]
    wide = 0.5 * boxes_in[b, 4]
    outside = int(_OUTLIERS * float(n))
    side = _sides(local_in, k, n, c, s, near, half, wide, outside, bins, k * scores_out.shape[1] + a)
    close = int(0)
    for j in range(n):
        depth = _depth(local_in[k, j], c, s, near, half, wide)
        close += closeness_in[wp.min(wp.abs(depth[0] - side[0]), wp.abs(depth[1] - side[1]))]
    scores_out[k, a] = float(close) / float(_WHOLE * n) - _PRIOR * angle * angle


@wp.kernel
def _move(
    # in
    keep_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.vec4),
    taken_in: wp.array(dtype=wp.int32),
    local_in: wp.array2d(dtype=wp.vec2),
    scores_in: wp.array2d(dtype=wp.float32),
    # in out
    bins: wp.array3d(dtype=wp.int32),
    boxes: wp.array2d(dtype=wp.float32),
):
    """Turns a box to the best heading, between two by a parabola, and moves it towards its near sides."""
    k = wp.tid()
    n = wp.min(taken_in[k], _ROOM)
    if n == 0:
        return
    b = keep_in[k]
    headings = scores_in.shape[1]
    best = int(headings / 2)
    for a in range(headings):
        if scores_in[k, a] > scores_in[k, best]:
            best = a
    turn = float(best - headings / 2)
    if best > 0 and best < headings - 1:
        before = scores_in[k, best - 1]
        after = scores_in[k, best + 1]
        bend = before - 2.0 * scores_in[k, best] + after
        if bend < 0.0:
            turn += 0.5 * (before - after) / bend
    turn = turn * _STEP
    c = wp.cos(turn)
    s = wp.sin(turn)
    half = 0.5 * boxes[b, 3]
    wide = 0.5 * boxes[b, 4]
    sensor = _local(pose_in[k], 0.0, 0.0)
    near = wp.vec2(_sign(sensor[0]), _sign(sensor[1]))
    outside = int(_EDGE_OUTLIERS * float(n))
    side = _sides(local_in, k, n, c, s, near, half, wide, outside, bins, k * headings)
    yaw = boxes[b, 6] + turn
    yaw = wp.where(yaw > wp.PI, yaw - 2.0 * wp.PI, wp.where(yaw < -wp.PI, yaw + 2.0 * wp.PI, yaw))
    boxes[b, 6] = yaw
    c = wp.cos(yaw)
    s = wp.sin(yaw)
    gap = wp.vec2(0.0, 0.0)
    for axis in range(2):
        reach = wp.where(axis == 0, half, wide)
        off = _AROUND - (float(side[axis]) + 0.5) * _BIN + _INSIDE
        if wp.abs(sensor[axis]) >= reach + _BESIDE and wp.abs(off) < _FARTHEST:
            gap[axis] = _SHARE * off * near[axis]
    boxes[b, 0] = boxes[b, 0] + c * gap[0] - s * gap[1]
    boxes[b, 1] = boxes[b, 1] + s * gap[0] + c * gap[1]


@dataclass(frozen=True, kw_only=True)
class BoxRefine:
    """A plan: refines up to `boxes` boxes of some classes with up to `capacity` points.

    All sums are integers, so the result does not depend on the order of threads.
    """

    capacity: int
    """Points that one launch can take."""
    boxes: int
    """Boxes that one launch can take."""
    refined: Sequence[bool]
    """Whether boxes of each class are refined, in the order of the network."""
    origin: tuple[float, float] = (-60.0, -60.0)
    """Lowest x and y that points of boxes have [m]."""
    size: tuple[float, float] = (120.0, 120.0)
    """Extent along x and y from there [m]."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if self.capacity < 1 or self.boxes < 1:
            raise ValueError(f"capacity and boxes must be at least 1, not {self.capacity} and {self.boxes}")
        if not len(self.refined):
            raise ValueError("refined must say so of each class, not of none")
        if not (self.size[0] > 0.0 and self.size[1] > 0.0):
            raise ValueError(f"size must be positive, not {self.size}")
        device = resolve_device(self.device)

        def keep(name: str, value: object) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        columns, rows = (int(np.ceil(extent / float(_CELL))) for extent in self.size)
        buffer("_owner", (rows, columns), wp.int32)
        buffer("_claims", 1, wp.int32)
        buffer("_claimed", (self.capacity, 2), wp.int32)
        buffer("_found", self.boxes, wp.int32)
        buffer("_taken", self.boxes, wp.int32)
        buffer("_pose", self.boxes, wp.vec4)
        buffer("_local", (self.boxes, int(_ROOM)), wp.vec2)
        buffer("_bins", (self.boxes * _HEADINGS, 2, int(_BINS)), wp.int32)
        buffer("_scores", (self.boxes, _HEADINGS), wp.float32)
        away = np.arange(int(_BINS)) * float(_BIN) / _CLOSE
        keep("_closeness", wp.array(np.rint(int(_WHOLE) * np.exp(-(away**2))), dtype=wp.int32, device=device))
        keep("_refined", wp.array(np.asarray(self.refined, np.int32), dtype=wp.int32, device=device))

    def launch(
        self, xyz: wp.array, count: wp.array, boxes: wp.array, kinds: wp.array, keep: wp.array, keep_count: wp.array
    ) -> None:
        """Changes x, y and yaw of some boxes in place; of those with few points or of other classes nothing.

        Args:
            xyz: Positions in the frame of the boxes, whose origin is the sensor [m], shape (n,), vec3, n ≤ capacity.
            count: Number of points, shape (1,), int32.
            boxes: Shape (b, 7), float32: x y z l w h yaw.
            kinds: Their classes, as indices into `refined`, shape (b,), int32.
            keep: Which of them, the best first, shape (k,), int32, k ≤ `boxes`.
            keep_count: How many of these, shape (1,), int32.
        """
        n, most = xyz.shape[0], keep.shape[0]
        if n > self.capacity or most > self.boxes:
            raise ValueError(
                f"{n} points and {most} boxes are more than the plan's capacity of {self.capacity} and {self.boxes}"
            )
        device = self._owner.device
        low = [float(value) for value in self.origin]
        # Runs of points are what a CPU is fast at, and single points a GPU.
        run = 256 if device.is_cpu else 1
        threads = (n + run - 1) // run
        self._owner.fill_(int(_NOBODY))
        self._claims.zero_()
        wp.launch(
            _draw, most, inputs=[boxes, keep, keep_count, kinds, self._refined, *low],
            outputs=[self._owner, self._pose, self._found, self._taken], device=device,
        )  # fmt: skip
        wp.launch(
            _claim, threads, inputs=[xyz, count, boxes, keep, self._pose, self._owner, *low, run],
            outputs=[self._claims, self._claimed, self._found], device=device,
        )  # fmt: skip
        wp.launch(
            _take, threads, inputs=[xyz, self._pose, self._claims, self._claimed, self._found, run],
            outputs=[self._taken, self._local], device=device,
        )  # fmt: skip
        wp.launch(
            _score_headings, (most, _HEADINGS),
            inputs=[boxes, keep, self._pose, self._taken, self._local, self._closeness],
            outputs=[self._bins, self._scores], device=device,
        )  # fmt: skip
        wp.launch(
            _move, most, inputs=[keep, self._pose, self._taken, self._local, self._scores], outputs=[self._bins, boxes],
            device=device,
        )  # fmt: skip
