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
_WINDOW = wp.constant(3)  # leaves on either side of one that tell how far neighbours may be
_LARGEST = wp.constant(3.0e38)
_FARTHEST = wp.constant(wp.float64(3.0e38))

_Eight = wp.types.vector(length=int(LEAF), dtype=wp.float32)


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


@wp.kernel
def _lay_out(
    # in
    points_in: wp.array(dtype=wp.vec3),
    size_in: wp.array(dtype=wp.int32),
    # out
    x_out: wp.array(dtype=_Eight),
    y_out: wp.array(dtype=_Eight),
    z_out: wp.array(dtype=_Eight),
):
    """Coordinates of a leaf side by side, for vector instructions; where it has no point, infinitely far."""
    leaf = wp.tid()
    x = _Eight(wp.inf)
    y = _Eight(wp.inf)
    z = _Eight(wp.inf)
    for k in range(LEAF):
        i = leaf * LEAF + k
        if i < size_in[0]:
            p = points_in[i]
            x[k] = p[0]
            y[k] = p[1]
            z[k] = p[2]
    x_out[leaf] = x
    y_out[leaf] = y
    z_out[leaf] = z


@wp.func
def _squares(p: wp.vec3, x: _Eight, y: _Eight, z: _Eight) -> _Eight:
    """Squared distances to the points of a leaf."""
    dx = x - _Eight(p[0])
    dy = y - _Eight(p[1])
    dz = z - _Eight(p[2])
    return wp.cw_mul(dx, dx) + wp.cw_mul(dy, dy) + wp.cw_mul(dz, dz)


@wp.func
def _keep_least(values: wp.array(dtype=wp.float32), first: int, step: int, count: int, wanted: int) -> float:
    """Moves the least `wanted` of `count` numbers to the front (quickselect); gives the greatest of them."""
    low = int(0)
    high = int(count - 1)
    while low < high:
        # The median of three as pivot, put last.
        middle = (low + high) // 2
        a = values[first + low * step]
        b = values[first + middle * step]
        c = values[first + high * step]
        pivot = wp.max(wp.min(a, b), wp.min(wp.max(a, b), c))
        if pivot == a:
            values[first + low * step] = c
        elif pivot == b:
            values[first + middle * step] = c
        values[first + high * step] = pivot
        # Those below the pivot to the front; written so that nothing hangs on a guess of the processor.
        at = first + low * step
        end = first + high * step
        to = int(at)
        while at < end:
            value = values[at]
            values[at] = values[to]
            values[to] = value
            to += wp.where(value < pivot, step, 0)
            at += step
        values[end] = values[to]
        values[to] = pivot
        place = (to - first) // step
        if place == wanted - 1:
            low = place
            high = place
        elif place < wanted - 1:
            low = place + 1
        else:
            high = place - 1
    return values[first + (wanted - 1) * step]


@wp.func
def _append(
    squares: _Eight,
    reach: float,
    wanted: int,
    room: int,
    q: int,
    step: int,
    nearest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
) -> float:
    """Notes which of eight squared distances are within reach; where that fills the list, narrows the reach."""
    to = q + filled[q] * step
    for k in range(LEAF):
        nearest[to] = squares[k]
        to += wp.where(squares[k] < reach, step, 0)
    count = (to - q) // step
    narrowed = float(reach)
    if count > room - LEAF:
        narrowed = _keep_least(nearest, q, step, count, wanted)
        count = wanted
    filled[q] = count
    return narrowed


@wp.kernel
def _mean_distances(
    # in
    points_in: wp.array(dtype=wp.vec3),
    x_in: wp.array(dtype=_Eight),
    y_in: wp.array(dtype=_Eight),
    z_in: wp.array(dtype=_Eight),
    size_in: wp.array(dtype=wp.int32),
    low_in: wp.array(dtype=wp.vec3),
    high_in: wp.array(dtype=wp.vec3),
    leaves: int,
    neighbors: int,
    room: int,
    lanes: int,
    # in out: of each point of a lane its list, how many it has, and within what they are
    nearest: wp.array(dtype=wp.float32),
    filled: wp.array(dtype=wp.int32),
    within: wp.array(dtype=wp.float32),
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
    lane = begin % lanes
    own_low = low_in[leaves + leaf]
    own_high = high_in[leaves + leaf]
    # How far the neighbours of the leaf's centre are, at most: by the points next in the order.
    centre = 0.5 * own_low + 0.5 * own_high
    found = int(0)
    for other in range(wp.max(leaf - _WINDOW, 0), wp.min(leaf + _WINDOW, leaves - 1) + 1):
        squares = _squares(centre, x_in[other], y_in[other], z_in[other])
        for k in range(LEAF):
            nearest[lane + found * lanes] = squares[k]
            found += wp.where(squares[k] < _LARGEST, 1, 0)
    reach = float(wp.inf)
    if found > wanted:
        reach = wp.sqrt(_keep_least(nearest, lane, lanes, found, wanted + 1))
    limit = float(0.0)
    for member in range(members):
        q = lane + member
        filled[q] = 0
        way = reach + wp.sqrt(_distance_squared(points_in[begin + member], centre))
        within[q] = way * way * 1.00001 + 1.0e-37
        limit = wp.max(limit, within[q])
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
                x = x_in[at - leaves]
                y = y_in[at - leaves]
                z = z_in[at - leaves]
                limit = float(0.0)
                for member in range(members):
                    q = lane + member
                    p = points_in[begin + member]
                    near = within[q]
                    if gap_squared(p, low, high) < near:
                        squares = _squares(p, x, y, z)
                        if at - leaves == leaf:
                            for k in range(LEAF):
                                if k == member:
                                    squares[k] = wp.inf
                        near = _append(squares, near, wanted, room, q, lanes, nearest, filled)
                        within[q] = near
                    limit = wp.max(limit, near)
                at = next_node(at, root)
        if root != node:
            node = node >> 1
        root = node ^ 1
        if node == 1:
            node = 0
    for member in range(members):
        q = lane + member
        if filled[q] > wanted and wanted > 0:
            _keep_least(nearest, q, lanes, filled[q], wanted)
        total = wp.float64(0.0)
        for k in range(wanted):
            if k < filled[q]:
                total += wp.sqrt(wp.float64(nearest[q + k * lanes]))
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
        room = max(self.neighbors + 4 * int(LEAF), (2 * int(_WINDOW) + 2) * int(LEAF))
        if room * lanes > 2**31 - 1:
            raise ValueError(f"neighbors {self.neighbors} of capacity {self.capacity} points are too many for one plan")
        keep("_room", room)
        keep("_nearest", wp.zeros(room * lanes, dtype=wp.float32, device=device))
        keep("_filled", wp.zeros(lanes, dtype=wp.int32, device=device))
        keep("_within", wp.zeros(lanes, dtype=wp.float32, device=device))
        keep("_eights", [wp.zeros(tree.leaves, dtype=_Eight, device=device) for _ in range(3)])
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

        run(_lay_out, tree.leaves, [tree.points, tree.size], self._eights)
        boxes = [tree.size, tree.low, tree.high, tree.leaves]
        run(
            _mean_distances,
            tree.leaves,
            [tree.points, *self._eights, *boxes, self.neighbors, self._room, self._lanes],
            [self._nearest, self._filled, self._within, self._mean],
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
