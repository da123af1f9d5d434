"""Scan registration: the rigid motion that lays a cloud onto a map of points, as LiDAR odometry needs it.

Point-to-point ICP in KISS-ICP's form (Vizzo et al., 2023): the nearest point of the map for each point, a robust kernel
(Geman and McClure), and one Gauss–Newton step on SE(3), again and again until the step is small. The kernel begins wide
and narrows as steps get smaller, so that neither a wrong guess nor what does not belong spoils the result, and steps
that go on the same way are lengthened. Sums run in blocks of fixed order, so the result is the same on every run. Most
points need no new search: one whose nearest was nearer than any other by more than twice its way since still has it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, table, whole
from .device import DEFAULT_DEVICE, resolve_device
from .downsample import VoxelDownsample
from .gauss_newton import COUNT, SQUARES, Step, Sums, narrowed, solve, stepped, stretch_of, terms_of
from .interop import borrow_points, count_on
from .plan import capacity_for, plan_for
from .voxel_map import VoxelMap
from .voxel_table import moved_by, nearest_in_map

__all__ = ["Registration", "ScanRegistration", "register"]

# Sums must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_BLOCK = wp.constant(32)
_ROUNDING = wp.constant(wp.float32(1.0e-4))  # [m], by which distances in float32 may be off at most
_NEVER = wp.constant(wp.float32(-1.0))


@wp.func
def _match(
    i: int,
    xyz: wp.array(dtype=wp.vec3),
    pose: wp.mat44d,
    reach: float,
    scale: float,
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    max_points: int,
    size: wp.float64,
    target: wp.array(dtype=wp.vec3d),
    searched_at: wp.array(dtype=wp.vec3d),
    margin: wp.array(dtype=wp.float32),
) -> tuple[wp.float64, wp.vec3d, wp.vec3d]:
    """The weight, residual and arm of a point.

    `target` is its nearest of the map, when it was looked for from `searched_at`; by its `margin` any other was
    farther, and infinitely far is the target of a point that has none within reach.
    """
    zero = wp.float64(0.0)
    p = moved_by(pose, xyz[i])
    arm = wp.vec3d(p[0] - pose[0, 3], p[1] - pose[1, 3], p[2] - pose[2, 3])
    way = float(wp.length(p - searched_at[i]))
    if not (2.0 * way + _ROUNDING < margin[i]):
        vector, best, other = nearest_in_map(table, points, max_points, p, size, reach * reach)
        found = p
        if best < reach * reach:
            found = p + wp.vec3d(wp.float64(vector[0]), wp.float64(vector[1]), wp.float64(vector[2]))
        else:
            found = wp.vec3d(wp.float64(wp.inf), zero, zero)
        target[i] = found
        searched_at[i] = p
        margin[i] = wp.sqrt(other) - wp.sqrt(best)
    r = p - target[i]
    distance_sq = float(wp.length_sq(r))
    weight = zero
    if distance_sq < reach * reach:
        kernel = wp.float64(scale * scale / (scale * scale + distance_sq))
        weight = kernel * kernel
    return weight, r, arm


@wp.kernel
def _register_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    guess_in: wp.array(dtype=wp.mat44d),
    limits_in: wp.array(dtype=wp.float32),
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    max_points: int,
    size: wp.float64,
    max_iterations: int,
    tolerance: wp.float64,
    # in out
    target: wp.array(dtype=wp.vec3d),
    searched_at: wp.array(dtype=wp.vec3d),
    margin: wp.array(dtype=wp.float32),
    # out
    pose_out: wp.array(dtype=wp.mat44d),
    fit_out: wp.array(dtype=wp.float32),
    iterations_out: wp.array(dtype=wp.int32),
    converged_out: wp.array(dtype=wp.int32),
):
    """One thread: all iterations, until one makes a step below the tolerance."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    pose = guess_in[0]
    for i in range(n):
        margin[i] = _NEVER
    sums = Sums()
    scale = wp.max(limits_in[1], limits_in[2])
    last = Step()
    stretch = wp.float64(1.0)
    iterations = int(0)
    converged = int(0)
    while iterations < max_iterations and converged == 0:
        sums = Sums()
        first = int(0)
        while first < n:
            block = Sums()
            for i in range(first, wp.min(first + _BLOCK, n)):
                weight, r, arm = _match(
                    i, xyz_in, pose, limits_in[0], scale, table, points, max_points, size, target, searched_at, margin,
                )  # fmt: skip
                block += terms_of(weight, r, arm)
            sums += block
            first += _BLOCK
        x = solve(sums)
        stretch = stretch_of(sums, x, last, stretch)
        pose = stepped(pose, stretch * x)
        last = x
        iterations += 1
        if scale <= limits_in[2] and wp.length_sq(x) < tolerance * tolerance:
            converged = 1
        scale = narrowed(scale, limits_in[2], x)
    pose_out[0] = pose
    fit_out[0] = float(sums[COUNT])
    fit_out[1] = float(sums[SQUARES])
    iterations_out[0] = iterations
    converged_out[0] = converged


@wp.kernel
def _begin(
    # in
    guess_in: wp.array(dtype=wp.mat44d),
    limits_in: wp.array(dtype=wp.float32),
    # out
    margin_out: wp.array(dtype=wp.float32),
    scale_out: wp.array(dtype=wp.float32),
    last_out: wp.array(dtype=wp.float64),
    pose_out: wp.array(dtype=wp.mat44d),
    iterations_out: wp.array(dtype=wp.int32),
    converged_out: wp.array(dtype=wp.int32),
):
    i = wp.tid()
    margin_out[i] = _NEVER
    if i == 0:
        pose_out[0] = guess_in[0]
        scale_out[0] = wp.max(limits_in[1], limits_in[2])
        for k in range(6):
            last_out[k] = wp.float64(0.0)
        last_out[6] = wp.float64(1.0)
        iterations_out[0] = 0
        converged_out[0] = 0


@wp.kernel
def _match_all(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    pose_in: wp.array(dtype=wp.mat44d),
    limits_in: wp.array(dtype=wp.float32),
    scale_in: wp.array(dtype=wp.float32),
    converged_in: wp.array(dtype=wp.int32),
    table: wp.array2d(dtype=wp.int64),
    points: wp.array(dtype=wp.vec3),
    max_points: int,
    size: wp.float64,
    # in out
    target: wp.array(dtype=wp.vec3d),
    searched_at: wp.array(dtype=wp.vec3d),
    margin: wp.array(dtype=wp.float32),
    # out
    weight_out: wp.array(dtype=wp.float64),
    residual_out: wp.array(dtype=wp.vec3d),
    arm_out: wp.array(dtype=wp.vec3d),
):
    """One point a thread."""
    i = wp.tid()
    if converged_in[0] == 1:
        return
    weight = wp.float64(0.0)
    r = wp.vec3d()
    arm = wp.vec3d()
    if i < count_in[0]:
        weight, r, arm = _match(
            i, xyz_in, pose_in[0], limits_in[0], scale_in[0], table, points, max_points, size, target, searched_at,
            margin,
        )  # fmt: skip
    weight_out[i] = weight
    residual_out[i] = r
    arm_out[i] = arm


@wp.kernel
def _sum_blocks(
    # in
    converged_in: wp.array(dtype=wp.int32),
    weight_in: wp.array(dtype=wp.float64),
    residual_in: wp.array(dtype=wp.vec3d),
    arm_in: wp.array(dtype=wp.vec3d),
    # out
    partial_out: wp.array2d(dtype=wp.float64),
):
    """One term of one block a thread."""
    block, term = wp.tid()  # pyright: ignore[reportAssignmentType]
    if converged_in[0] == 1:
        return
    total = wp.float64(0.0)
    for i in range(block * _BLOCK, wp.min((block + 1) * _BLOCK, weight_in.shape[0])):
        terms = terms_of(weight_in[i], residual_in[i], arm_in[i])
        total += terms[term]
    partial_out[block, term] = total


@wp.kernel
def _sum_all(
    # in
    converged_in: wp.array(dtype=wp.int32),
    partial_in: wp.array2d(dtype=wp.float64),
    blocks: int,
    # out
    sums_out: wp.array(dtype=wp.float64),
):
    """One term a thread."""
    term = wp.tid()
    if converged_in[0] == 1:
        return
    total = wp.float64(0.0)
    for block in range(blocks):
        total += partial_in[block, term]
    sums_out[term] = total


@wp.kernel
def _step(
    # in
    sums_in: wp.array(dtype=wp.float64),
    limits_in: wp.array(dtype=wp.float32),
    tolerance: wp.float64,
    # in out: the kernel's scale; the last step, and by how much it was lengthened
    scale: wp.array(dtype=wp.float32),
    last: wp.array(dtype=wp.float64),
    pose: wp.array(dtype=wp.mat44d),
    iterations: wp.array(dtype=wp.int32),
    converged: wp.array(dtype=wp.int32),
    # out
    fit_out: wp.array(dtype=wp.float32),
):
    """One thread: the step, unless the last was small enough."""
    if converged[0] == 1:
        return
    sums = Sums()
    for term in range(18):
        sums[term] = sums_in[term]
    x = solve(sums)
    before = Step()
    for k in range(6):
        before[k] = last[k]
        last[k] = x[k]
    stretch = stretch_of(sums, x, before, last[6])
    last[6] = stretch
    pose[0] = stepped(pose[0], stretch * x)
    iterations[0] = iterations[0] + 1
    if scale[0] <= limits_in[2] and wp.length_sq(x) < tolerance * tolerance:
        converged[0] = 1
    scale[0] = narrowed(scale[0], limits_in[2], x)
    fit_out[0] = float(sums[COUNT])
    fit_out[1] = float(sums[SQUARES])


@dataclass(frozen=True, kw_only=True)
class ScanRegistration:
    """A plan: workspace to register clouds of up to `capacity` points."""

    capacity: int
    """Points that one launch can take."""
    max_iterations: int = 50
    """Steps at most."""
    tolerance: float = 1e-4
    """A step below is the last: the norm of its translation [m] and rotation vector [rad] together."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`in_order` (one thread), `shared` (parallel), or `auto`: `in_order` on a CPU, else `shared`: equal results."""

    pose: wp.array = field(init=False, repr=False, compare=False)
    """Out: map from sensor, shape (1,), mat44d."""
    fit: wp.array = field(init=False, repr=False, compare=False)
    """Out: shape (2,), float32: how many points had one of the map in reach before the last step, and the sum of
    their squared distances [m²]."""
    iterations: wp.array = field(init=False, repr=False, compare=False)
    """Out: steps made, shape (1,), int32."""
    converged: wp.array = field(init=False, repr=False, compare=False)
    """Out: 1 where the last step was below the tolerance, shape (1,), int32."""

    def __post_init__(self):
        for name in ("capacity", "max_iterations"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if not self.tolerance >= 0:
            raise ValueError(f"tolerance must be ≥ 0, not {self.tolerance}")
        if self.method not in ("auto", "in_order", "shared"):
            raise ValueError(f"method must be 'auto', 'in_order' or 'shared', not {self.method!r}")
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        keep("_sequential", self.method == "in_order" or (self.method == "auto" and device == DEFAULT_DEVICE))
        buffer("pose", 1, wp.mat44d)
        buffer("fit", 2, wp.float32)
        buffer("iterations", 1, wp.int32)
        buffer("converged", 1, wp.int32)
        buffer("_target", self.capacity, wp.vec3d)
        buffer("_searched_at", self.capacity, wp.vec3d)
        buffer("_margin", self.capacity, wp.float32)
        if not self._sequential:
            buffer("_weight", self.capacity, wp.float64)
            buffer("_residual", self.capacity, wp.vec3d)
            buffer("_arm", self.capacity, wp.vec3d)
            buffer("_partial", (-(-self.capacity // int(_BLOCK)), 18), wp.float64)
            buffer("_sums", 18, wp.float64)
            buffer("_scale", 1, wp.float32)
            buffer("_last", 7, wp.float64)

    def launch(self, xyz: wp.array, count: wp.array, voxel_map: VoxelMap, guess: wp.array, limits: wp.array) -> None:
        """Fills the outputs; allocates nothing, reads nothing back.

        Args:
            xyz: Positions in the sensor's frame [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
            voxel_map: What to lay them onto, on the same device.
            guess: Map from sensor to begin with, shape (1,), mat44d.
            limits: Shape (3,), float32: how far a point of the map may be to count [m], and the first and the final
                scale c [m] of the robust kernel, which weighs a distance d by (c² / (c² + d²))².
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        the_map = [voxel_map.table, voxel_map.points, voxel_map.max_points, voxel_map.voxel_size]
        found = [self._target, self._searched_at, self._margin]
        state = [self.pose, self.iterations, self.converged]
        if self._sequential:
            self._run(
                _register_in_order,
                1,
                [xyz, count, guess, limits, *the_map, self.max_iterations, self.tolerance],
                [*found, self.pose, self.fit, self.iterations, self.converged],
            )
            return
        blocks = -(-n // int(_BLOCK))
        terms = [self._weight[:n], self._residual[:n], self._arm[:n]]
        self.fit.zero_()
        self._run(_begin, max(n, 1), [guess, limits], [self._margin, self._scale, self._last, *state])
        for _ in range(self.max_iterations):
            self._run(
                _match_all,
                n,
                [xyz, count, self.pose, limits, self._scale, self.converged, *the_map],
                [*found, *terms],
            )
            self._run(_sum_blocks, (blocks, 18), [self.converged, *terms], [self._partial])
            self._run(_sum_all, 18, [self.converged, self._partial, blocks], [self._sums])
            self._run(_step, 1, [self._sums, limits, self.tolerance], [self._scale, self._last, *state, self.fit])

    def _run(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.pose.device)


@dataclass(frozen=True, eq=False)
class Registration:
    """What `register` found."""

    transform: np.ndarray
    """Target from source, shape (4, 4), float64."""
    fitness: float
    """Share of the source's points, after downsampling, that have one of the target in reach."""
    rmse: float
    """Root of the mean squared distance of these [m]; NaN where there is none."""
    iterations: int
    """Steps made."""
    converged: bool
    """Whether the last step was below the tolerance."""


@lru_cache(maxsize=64)
def _limits(device: str, *limits: float) -> wp.array:
    return wp.array(limits, dtype=wp.float32, device=device)


def register(
    source: Any,
    target: Any,
    *,
    initial: np.ndarray | None = None,
    voxel_size: float = 1.0,
    max_distance: float = 1.0,
    robust_scale: float = 0.3,
    max_iterations: int = 50,
    tolerance: float = 1e-4,
) -> Registration:
    """Finds the rigid motion that lays a cloud onto another (KISS-ICP's registration: Vizzo et al., 2023).

    The target becomes a map with up to 20 points a voxel, and the source is thinned out to a centroid for each half
    voxel. The robust kernel begins half as wide as `max_distance`. Points that are not finite are left out.

    Args:
        source: Positions [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack.
        target: Likewise, shape (m, 3 or more), on the same device.
        initial: Target from source to begin with, shape (4, 4); by default the identity.
        voxel_size: Edge of a voxel of the map [m]: nearest points are found up to about this distance.
        max_distance: Points farther apart do not count [m].
        robust_scale: The final scale c of the kernel [m], which weighs points a distance d apart by (c² / (c² + d²))².
        max_iterations: Steps at most.
        tolerance: A step below is the last, its translation [m] and rotation vector [rad] together.

    Returns:
        The motion and how well it fits.

    Raises:
        TypeError: A cloud is not a floating array.
        ValueError: A shape or a number does not fit, or the devices differ; the message says which.
    """
    for name, value in (("max_distance", max_distance), ("robust_scale", robust_scale)):
        if not (real(value, name) > 0 and math.isfinite(value)):
            raise ValueError(f"{name} must be > 0 m and finite, not {value}")
    guess = np.eye(4) if initial is None else table(initial, "initial")
    if guess.shape != (4, 4) or not np.isfinite(guess).all():
        raise ValueError(f"initial must be a finite matrix of shape (4, 4), not of shape {guess.shape}")
    moving, fixed = borrow_points(source, "source"), borrow_points(target, "target")
    device = moving.device
    if fixed.device != device:
        raise ValueError(f"source is on {device} and target on {fixed.device}; both must be on one device")
    n, m = len(moving), len(fixed)
    voxel_map = plan_for(
        VoxelMap,
        voxel_size=real(voxel_size, "voxel_size"),
        capacity=capacity_for(m),
        max_voxels=capacity_for(m),
        device=device,
    )
    thinned = plan_for(VoxelDownsample, voxel_size=0.5 * float(voxel_size), capacity=capacity_for(n), device=device)
    plan = plan_for(
        ScanRegistration,
        capacity=capacity_for(n),
        max_iterations=whole(max_iterations, "max_iterations"),
        tolerance=real(tolerance, "tolerance"),
        device=device,
    )
    voxel_map.clear()
    voxel_map.launch(fixed.xyz, count_on(m, device), _identity(device))
    thinned.launch(moving.xyz, count_on(n, device))
    begin = wp.array(guess[None], dtype=wp.mat44d, device=device)
    limits = _limits(device, float(max_distance), 0.5 * float(max_distance), float(robust_scale))
    plan.launch(thinned.centroids, thinned.centroid_count, voxel_map, begin, limits)
    points = int(thinned.centroid_count.numpy()[0])
    matched, squares = (float(number) for number in plan.fit.numpy())
    return Registration(
        plan.pose.numpy()[0].copy(),
        matched / points if points else 0.0,
        math.sqrt(squares / matched) if matched else math.nan,
        int(plan.iterations.numpy()[0]),
        bool(plan.converged.numpy()[0]),
    )


@lru_cache(maxsize=16)
def _identity(device: str) -> wp.array:
    return wp.array(np.eye(4)[None], dtype=wp.mat44d, device=device)
