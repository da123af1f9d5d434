"""Outliers: points that have too few others around them, or whose neighbours are farther than is usual in the cloud.

Radius and statistical outlier removal as in PCL (Rusu et al., "Towards 3D point cloud based object maps for household
environments", 2008) and Open3D, exact, on a tree of boxes. Distances are summed in a fixed order, so that the same
cloud gives the same answer each time, whatever the threads do.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import warp as wp

from .arguments import real, whole
from .device import DEFAULT_DEVICE
from .interop import borrow_points, count_on, give
from .leaf_lanes import Eight, lay_out, parts_for
from .neighbor_distances import NeighborDistances
from .outlier_parts import Reach, find_lonely_in_parts
from .plan import capacity_for, plan_for
from .point_tree import LEAF, PointTree, gap_squared, next_node
from .threads import launch_parts, thread_count

__all__ = ["RadiusOutliers", "StatisticalOutliers", "radius_outliers", "statistical_outliers"]

# Which points are within a radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(256)  # points that one thread sums


@wp.func
def _distance_squared(p: wp.vec3, q: wp.vec3) -> float:
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    return x * x + y * y + z * z


# ---- by radius


@wp.func
def _is_near(p: wp.vec3, q: wp.vec3, reach: Reach) -> bool:
    """Whether the distance is within the radius, as float64 decides; float32 does where it is sure to agree."""
    squared = _distance_squared(p, q)
    near = squared <= reach.surely
    if squared > reach.surely and squared <= reach.surely_not:
        x = wp.float64(p[0]) - wp.float64(q[0])
        y = wp.float64(p[1]) - wp.float64(q[1])
        z = wp.float64(p[2]) - wp.float64(q[2])
        near = x * x + y * y + z * z <= reach.squared
    return near


@wp.func
def _count_in_leaf(
    points: wp.array(dtype=wp.vec3), leaf: int, size: int, i: int, p: wp.vec3, reach: Reach, enough: int
) -> int:
    """How many others of a leaf are near; not more than enough."""
    found = int(0)
    for j in range(leaf * LEAF, wp.min((leaf + 1) * LEAF, size)):
        if j != i and found < enough and _is_near(p, points[j], reach):
            found += 1
    return found


@wp.func
def _is_lonely(
    i: int,
    size: int,
    points: wp.array(dtype=wp.vec3),
    low: wp.array(dtype=wp.vec3),
    high: wp.array(dtype=wp.vec3),
    leaves: int,
    reach: Reach,
    min_neighbors: int,
) -> bool:
    """Counts a point's neighbours until there are enough, from its own leaf on upwards."""
    p = points[i]
    node = leaves + i // LEAF
    found = _count_in_leaf(points, i // LEAF, size, i, p, reach, min_neighbors)
    while node > 1 and found < min_neighbors:
        root = node ^ 1
        at = int(root)
        while at > 0 and found < min_neighbors:
            if gap_squared(p, low[at], high[at]) > reach.surely_not:
                at = next_node(at, root)
            elif at >= leaves:
                found += _count_in_leaf(points, at - leaves, size, i, p, reach, min_neighbors - found)
                at = next_node(at, root)
            else:
                at = 2 * at
        node = node >> 1
    return found < min_neighbors


@wp.kernel
def _find_lonely(
    # in
    points_in: wp.array(dtype=wp.vec3),
    index_in: wp.array(dtype=wp.int32),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    reach: Reach,
    min_neighbors: int,
    # out: true
    outlier_out: wp.array(dtype=wp.bool),
):
    """One point a thread."""
    i = wp.tid()
    if i < size_in[0]:
        lonely = _is_lonely(i, size_in[0], points_in, low_in, high_in, leaves, reach, min_neighbors)
        outlier_out[index_in[i]] = lonely


# ---- by statistics


@wp.kernel
def _sum_runs(
    # in
    mean_in: wp.array(dtype=wp.float32),
    size_in: wp.array(dtype=wp.int32),
    centre_in: wp.array(dtype=wp.float64),
    squares: int,
    # out
    sums_out: wp.array(dtype=wp.float64),
):
    """Sums a run of numbers, or of the squares of what they are off the centre, in order."""
    run = wp.tid()
    total = wp.float64(0.0)
    for i in range(run * _RUN, wp.min((run + 1) * _RUN, size_in[0])):
        value = wp.float64(mean_in[i])
        if squares != 0:
            value = value - centre_in[0]
            value = value * value
        total += value
    sums_out[run] = total


@wp.kernel
def _sum_sums(
    # in
    sums_in: wp.array(dtype=wp.float64),
    size_in: wp.array(dtype=wp.int32),
    squares: int,
    std_ratio: wp.float64,
    # in out: mean, and the distance up to which a point is kept
    threshold: wp.array(dtype=wp.float64),
):
    """Adds the sums of the runs in order, by one thread."""
    total = wp.float64(0.0)
    for run in range(sums_in.shape[0]):
        total += sums_in[run]
    if squares == 0:
        threshold[0] = total / wp.float64(wp.max(size_in[0], 1))
    else:
        threshold[1] = threshold[0] + std_ratio * wp.sqrt(total / wp.float64(wp.max(size_in[0] - 1, 1)))


@wp.kernel
def _mark_far(
    # in
    mean_in: wp.array(dtype=wp.float32),
    index_in: wp.array(dtype=wp.int32),
    size_in: wp.array(dtype=wp.int32),
    threshold: wp.array(dtype=wp.float64),
    # out: true
    outlier_out: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    if i < size_in[0]:
        outlier_out[index_in[i]] = not (wp.float64(mean_in[i]) <= threshold[1])


@dataclass(frozen=True, kw_only=True)
class RadiusOutliers:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    radius: float
    """How near a neighbour is [m], the radius itself included."""
    min_neighbors: int = 2
    """Others within the radius that a point needs to be kept."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    outlier: wp.array = field(init=False, repr=False, compare=False)
    """Out: true where a point has too few neighbours or is not finite, shape (capacity,), bool; true past the count."""

    def __post_init__(self):
        if not (self.radius > 0 and 1e-15 < self.radius < 1e15):
            raise ValueError(f"radius must be a positive number of metres, not {self.radius}")
        if not 1 <= self.min_neighbors < 2**31:
            raise ValueError(f"min_neighbors must be at least 1 and below 2³¹, not {self.min_neighbors}")
        tree = PointTree(capacity=self.capacity, device=self.device)
        squared = self.radius * self.radius
        reach = Reach()
        reach.squared, reach.surely, reach.surely_not = squared, squared * (1 - 1e-6), squared * (1 + 1e-6)
        object.__setattr__(self, "_tree", tree)
        object.__setattr__(self, "_reach", reach)
        object.__setattr__(self, "_parts", thread_count())
        device = tree.points.device
        eights = [wp.zeros(tree.leaves, dtype=Eight, device=device) for _ in range(3 if device.is_cpu else 0)]
        object.__setattr__(self, "_eights", eights)
        object.__setattr__(self, "outlier", wp.full(self.capacity, True, dtype=wp.bool, device=tree.points.device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `outlier` for the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        tree = self._tree
        tree.build(xyz, count)
        self.outlier.fill_(True)
        given = [tree.low, tree.high, tree.leaves, self._reach, self.min_neighbors]
        if self.outlier.device.is_cpu:
            wp.launch(lay_out, tree.leaves, inputs=[tree.points, tree.size], outputs=self._eights, device=self.device)
            inputs = [tree.index, tree.size, *self._eights, *given]
            launch_parts(find_lonely_in_parts, parts_for(xyz.shape[0], self._parts), inputs, [self.outlier])
        else:
            inputs = [tree.points, tree.index, tree.size, *given]
            wp.launch(_find_lonely, xyz.shape[0], inputs=inputs, outputs=[self.outlier], device=self.device)


@dataclass(frozen=True, kw_only=True)
class StatisticalOutliers:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    neighbors: int = 20
    """Nearest neighbours, without the point itself, whose mean distance is a point's."""
    std_ratio: float = 2.0
    """How many standard deviations above the mean of all points a point's distance may be."""
    capacity: int
    """Points that one launch can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    outlier: wp.array = field(init=False, repr=False, compare=False)
    """Out: true where a point's neighbours are too far or it is not finite, shape (capacity,), bool; true past the
    count."""
    threshold: wp.array = field(init=False, repr=False, compare=False)
    """Out: the mean of all points' distances, and the distance up to which a point is kept [m], shape (2,), float64."""

    def __post_init__(self):
        if not math.isfinite(self.std_ratio):
            raise ValueError(f"std_ratio must be a finite number, not {self.std_ratio}")
        distances = NeighborDistances(capacity=self.capacity, neighbors=self.neighbors, device=self.device)
        device = distances.mean.device

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_distances", distances)
        keep("_sums", wp.zeros(-(-self.capacity // _RUN), dtype=wp.float64, device=device))
        keep("threshold", wp.zeros(2, dtype=wp.float64, device=device))
        keep("outlier", wp.full(self.capacity, True, dtype=wp.bool, device=device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `outlier` for the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        self._distances.launch(xyz, count)
        mean, tree = self._distances.mean, self._distances.tree

        def run(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        for squares in (0, 1):
            run(_sum_runs, self._sums.shape[0], [mean, tree.size, self.threshold, squares], [self._sums])
            run(_sum_sums, 1, [self._sums, tree.size, squares, self.std_ratio], [self.threshold])
        self.outlier.fill_(True)
        run(_mark_far, xyz.shape[0], [mean, tree.index, tree.size, self.threshold], [self.outlier])


def _outliers(points: Any, plan_class: type[Any], **configuration: Any) -> Any:
    borrowed = borrow_points(points)
    n = len(borrowed)
    plan = plan_for(plan_class, capacity=capacity_for(n), device=borrowed.device, **configuration)
    plan.launch(borrowed.xyz, count_on(n, borrowed.device))
    return give(plan.outlier[:n], borrowed.family)


def radius_outliers(points: Any, radius: float, min_neighbors: int = 2) -> Any:
    """Tells which points have too few others around them: `points[~radius_outliers(points, 0.5)]` are the rest.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        radius: How near a neighbour is [m], the radius itself included.
        min_neighbors: Others within the radius that a point needs to be kept; Open3D's `nb_points`.

    Returns:
        True for outliers and for points that are not finite, shape (n,), bool, of the family and on the device of
        `points`. Distances are compared as in float64.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    return _outliers(
        points, RadiusOutliers, radius=real(radius, "radius"), min_neighbors=whole(min_neighbors, "min_neighbors")
    )


def statistical_outliers(points: Any, neighbors: int = 20, std_ratio: float = 2.0) -> Any:
    """Tells which points are farther from their neighbours than is usual in the cloud.

    A point's distance is the mean of those to its nearest neighbours; an outlier's is greater than the mean of all
    points' distances plus `std_ratio` of their standard deviations.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        neighbors: How many neighbours, without the point itself, as in PCL; Open3D counts the point too. Of a cloud
            of fewer points, all the others.
        std_ratio: How many standard deviations a point may be above the mean.

    Returns:
        True for outliers and for points that are not finite, shape (n,), bool, of the family and on the device of
        `points`. Distances are of float32, within 1e-6 of themselves.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    return _outliers(
        points, StatisticalOutliers, neighbors=whole(neighbors, "neighbors"), std_ratio=real(std_ratio, "std_ratio")
    )
