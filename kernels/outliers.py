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

from .device import DEFAULT_DEVICE
from .interop import borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .point_tree import LEAF, PointTree, gap_squared, next_node

__all__ = ["RadiusOutliers", "StatisticalOutliers", "radius_outliers", "statistical_outliers"]

# Which points are within a radius must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RUN = wp.constant(256)  # points that one thread sums
_MOST_NEIGHBORS = 1024
_FARTHEST = wp.constant(wp.float64(3.0e38))


@wp.func
def _distance_squared(p: wp.vec3, q: wp.vec3) -> float:
    x = p[0] - q[0]
    y = p[1] - q[1]
    z = p[2] - q[2]
    return x * x + y * y + z * z


# ---- by radius


@wp.struct
class _Reach:
    surely: wp.float32  # squared distances in float32 up to here are within the radius whatever the rounding
    surely_not: wp.float32  # and above here they are not
    squared: wp.float64


@wp.func
def _is_near(p: wp.vec3, q: wp.vec3, reach: _Reach) -> bool:
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
    points: wp.array(dtype=wp.vec3), leaf: int, size: int, i: int, p: wp.vec3, reach: _Reach, enough: int
) -> int:
    """How many others of a leaf are near; not more than enough."""
    found = int(0)
    for j in range(leaf * LEAF, wp.min((leaf + 1) * LEAF, size)):
        if j != i and found < enough and _is_near(p, points[j], reach):
            found += 1
    return found


@wp.kernel
def _find_lonely(
    # in
    points_in: wp.array(dtype=wp.vec3),
    index_in: wp.array(dtype=wp.int32),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    reach: _Reach,
    min_neighbors: int,
    # out: true
    outlier_out: wp.array(dtype=wp.bool),
):
    """Counts a point's neighbours until there are enough, from its own leaf on upwards."""
    i = wp.tid()
    size = size_in[0]
    if i >= size:
        return
    p = points_in[i]
    node = leaves + i // LEAF
    found = _count_in_leaf(points_in, i // LEAF, size, i, p, reach, min_neighbors)
    while node > 1 and found < min_neighbors:
        root = node ^ 1
        at = int(root)
        while at > 0 and found < min_neighbors:
            if gap_squared(p, low_in[at], high_in[at]) > reach.surely_not:
                at = next_node(at, root)
            elif at >= leaves:
                found += _count_in_leaf(points_in, at - leaves, size, i, p, reach, min_neighbors - found)
                at = next_node(at, root)
            else:
                at = 2 * at
        node = node >> 1
    if found >= min_neighbors:
        outlier_out[index_in[i]] = False


# ---- by statistics


@wp.func
def _offer(
    squared: float,
    q: int,
    wanted: int,
    first: int,
    lanes: int,
    nearest: wp.array(dtype=wp.float32),
    farthest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    worst: wp.array(dtype=wp.int32),
):
    """Takes a squared distance into a full list in the place of its greatest, or into one that is not full yet."""
    place = filled[q]
    if place < wanted:
        filled[q] = place + 1
    else:
        place = worst[q]
    nearest[first + place * lanes] = squared
    if filled[q] == wanted:
        greatest = float(-1.0)
        at = int(0)
        for k in range(wanted):
            value = nearest[first + k * lanes]
            at = wp.where(value > greatest, k, at)
            greatest = wp.max(value, greatest)
        worst[q] = at
        farthest[q] = greatest


@wp.kernel
def _mean_distances(
    # in
    points_in: wp.array(dtype=wp.vec3),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    neighbors: int,
    lanes: int,
    # in out: per point of a lane its list, the greatest of it and where that is, and how many it has
    nearest: wp.array(dtype=wp.float32),
    farthest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    worst: wp.array(dtype=wp.int32),
    # out
    mean_out: wp.array(dtype=wp.float32),
):
    """The mean distance of each point to its nearest neighbours: a leaf's points together, from it on upwards."""
    leaf = wp.tid()
    size = size_in[0]
    begin = leaf * LEAF
    members = wp.min(LEAF, size - begin)
    if members <= 0:
        return
    wanted = wp.min(neighbors, size - 1)
    lane = (leaf * LEAF) % lanes
    for q in range(lane, lane + members):
        filled[q] = 0
        farthest[q] = wp.inf
    own_low = low_in[leaves + leaf]
    own_high = high_in[leaves + leaf]
    limit = float(wp.inf)
    node = leaves + leaf
    root = int(node)
    while node > 0 and wanted > 0:
        at = int(root)
        while at > 0:
            low = low_in[at]
            high = high_in[at]
            gap = wp.max(wp.max(own_low - high, low - own_high), wp.vec3(0.0))
            if gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] >= limit:
                at = next_node(at, root)
            elif at < leaves:
                at = 2 * at
            else:
                other = (at - leaves) * LEAF
                end = wp.min(other + LEAF, size)
                limit = float(0.0)
                for member in range(members):
                    i = begin + member
                    q = lane + member
                    p = points_in[i]
                    reach = farthest[q]
                    if gap_squared(p, low, high) < reach:
                        for j in range(other, end):
                            squared = _distance_squared(p, points_in[j])
                            if squared < reach and j != i:
                                _offer(squared, q, wanted, q, lanes, nearest, farthest, filled, worst)
                                reach = farthest[q]
                    limit = wp.max(limit, reach)
                at = next_node(at, root)
        if root != node:
            node = node >> 1
        root = node ^ 1
        if node == 1:
            node = 0
    for member in range(members):
        total = wp.float64(0.0)
        for k in range(wanted):
            if k < filled[lane + member]:
                total += wp.sqrt(wp.float64(nearest[lane + member + k * lanes]))
            else:
                total += _FARTHEST  # whose square no float32 holds
        mean_out[begin + member] = float(total / wp.float64(wp.max(wanted, 1)))


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
        if self.min_neighbors < 1:
            raise ValueError(f"min_neighbors must be at least 1, not {self.min_neighbors}")
        tree = PointTree(capacity=self.capacity, device=self.device)
        squared = self.radius * self.radius
        reach = _Reach()
        reach.squared, reach.surely, reach.surely_not = squared, squared * (1 - 1e-6), squared * (1 + 1e-6)
        object.__setattr__(self, "_tree", tree)
        object.__setattr__(self, "_reach", reach)
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
        wp.launch(
            _find_lonely,
            xyz.shape[0],
            inputs=[tree.points, tree.index, tree.size, tree.low, tree.high, tree.leaves, self._reach],
            outputs=[self.min_neighbors, self.outlier],
            device=self.device,
        )


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
        if not 1 <= self.neighbors <= _MOST_NEIGHBORS:
            raise ValueError(f"neighbors must be 1 to {_MOST_NEIGHBORS}, not {self.neighbors}")
        if not math.isfinite(self.std_ratio):
            raise ValueError(f"std_ratio must be a finite number, not {self.std_ratio}")
        tree = PointTree(capacity=self.capacity, device=self.device)
        device = tree.points.device
        # One thread's lists of neighbours stay in its cache; many threads keep theirs side by side.
        lanes = int(LEAF) if device.is_cpu else tree.leaves * int(LEAF)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_tree", tree)
        keep("_lanes", lanes)
        keep("_nearest", wp.zeros(self.neighbors * lanes, dtype=wp.float32, device=device))
        keep("_farthest", wp.zeros(lanes, dtype=wp.float32, device=device))
        keep("_filled", wp.zeros(lanes, dtype=wp.int32, device=device))
        keep("_worst", wp.zeros(lanes, dtype=wp.int32, device=device))
        keep("_mean", wp.zeros(self.capacity, dtype=wp.float32, device=device))
        keep("_sums", wp.zeros(-(-self.capacity // _RUN), dtype=wp.float64, device=device))
        keep("threshold", wp.zeros(2, dtype=wp.float64, device=device))
        keep("outlier", wp.full(self.capacity, True, dtype=wp.bool, device=device))

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `outlier` for the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        tree = self._tree
        tree.build(xyz, count)

        def run(kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
            wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)

        run(
            _mean_distances,
            tree.leaves,
            [tree.points, tree.size, tree.low, tree.high, tree.leaves, self.neighbors, self._lanes],
            [self._nearest, self._farthest, self._filled, self._worst, self._mean],
        )
        for squares in (0, 1):
            run(_sum_runs, self._sums.shape[0], [self._mean, tree.size, self.threshold, squares], [self._sums])
            run(_sum_sums, 1, [self._sums, tree.size, squares, self.std_ratio], [self.threshold])
        self.outlier.fill_(True)
        run(_mark_far, xyz.shape[0], [self._mean, tree.index, tree.size, self.threshold], [self.outlier])


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
    return _outliers(points, RadiusOutliers, radius=float(radius), min_neighbors=int(min_neighbors))


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
    return _outliers(points, StatisticalOutliers, neighbors=int(neighbors), std_ratio=float(std_ratio))
