"""Oriented boxes around clusters of points.

The heading of a cluster is searched for, all clusters and angles at once: by the closeness of its points to the edges
of the box, which suits the L that a LiDAR sees of a car (Zhang, Xu, Dong, Dolan: Efficient L-shape fitting for vehicle
detection using laser scanners, IV 2017), or by the least area. The search looks at up to 64 points of a cluster; the
extents are those of all its points.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .box_samples import FAR, SAMPLES, sample_evenly, sample_extremes, sample_extremes_in_order
from .device import DEFAULT_DEVICE, resolve_device
from .interop import borrow, borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["FitBoxes", "fit_boxes"]

# Which of two like angles wins must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_EDGE = wp.constant(0.01)  # [m] nearer to an edge than this is no better
_AREA = wp.constant(1)
_METHODS = {
    # name: (criterion, directions in a quarter turn); the first look takes every fourth
    "l_shape": (0, 96),
    "min_area": (1, 384),
}
_STRIDE = wp.constant(4)
_LANES = wp.constant(8)  # directions that one thread scores side by side: a CPU's compiler makes vectors of them
_vec8 = wp.types.vector(length=8, dtype=wp.float32)
_NON_FINITE, _TOO_MANY = (wp.constant(i) for i in range(2))


@wp.func
def _is_finite(p: wp.vec3) -> bool:
    return (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]) == 0.0


@wp.kernel
def _sort_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # out
    start_out: wp.array(dtype=wp.int32),
    order_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Points by cluster, and in order within one; a counting sort by one thread."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    clusters = start_out.shape[0] - 1
    for c in range(clusters + 1):
        start_out[c] = 0
    highest = int(-1)
    non_finite = int(0)
    too_many = int(0)
    for i in range(n):
        label = label_in[i]
        if label >= 0:
            highest = wp.max(highest, label)
            if label >= clusters:
                too_many += 1
            elif not _is_finite(xyz_in[i]):
                non_finite += 1
            else:
                start_out[label + 1] = start_out[label + 1] + 1
    for c in range(clusters):
        start_out[c + 1] = start_out[c + 1] + start_out[c]
    for i in range(n):
        label = label_in[i]
        if label >= 0 and label < clusters and _is_finite(xyz_in[i]):
            order_out[start_out[label]] = i
            start_out[label] = start_out[label] + 1
    # Each start now stands where the next cluster begins.
    for c in range(clusters):
        start_out[clusters - c] = start_out[clusters - c - 1]
    start_out[0] = 0
    cluster_count_out[0] = wp.min(highest + 1, clusters)
    dropped_out[_NON_FINITE] = non_finite
    dropped_out[_TOO_MANY] = too_many


@wp.kernel
def _key_points(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    clusters: int,
    # in out: zero
    cluster_count: wp.array(dtype=wp.int32),
    dropped: wp.array(dtype=wp.int32),
    # out
    key_out: wp.array(dtype=wp.int32),
    order_out: wp.array(dtype=wp.int32),
):
    """The cluster of each point, or the number of clusters where it has none, as a key to sort by."""
    i = wp.tid()
    order_out[i] = i
    key_out[i] = clusters
    if i >= count_in[0]:
        return
    label = label_in[i]
    if label < 0:
        return
    wp.atomic_max(cluster_count, 0, wp.min(label + 1, clusters))
    if label >= clusters:
        wp.atomic_add(dropped, _TOO_MANY, 1)
    elif not _is_finite(xyz_in[i]):
        wp.atomic_add(dropped, _NON_FINITE, 1)
    else:
        key_out[i] = label


@wp.kernel
def _find_starts(
    # in
    key_in: wp.array(dtype=wp.int32),
    n: int,
    # out
    start_out: wp.array(dtype=wp.int32),
):
    """Where each cluster begins among the sorted keys: the first that is not less."""
    cluster = wp.tid()
    low = int(0)
    high = int(n)
    while low < high:
        middle = (low + high) / 2
        if key_in[middle] < cluster:
            low = middle + 1
        else:
            high = middle
    start_out[cluster] = low


@wp.func
def _score(
    sample: wp.array2d(dtype=wp.vec2),
    cluster: int,
    size: int,
    direction: wp.array(dtype=wp.vec2),
    first: int,
    step: int,
    criterion: int,
) -> _vec8:
    """How well boxes along eight directions fit the samples of a cluster; more is better."""
    cos = _vec8()
    sin = _vec8()
    directions = direction.shape[0]
    for lane in range(8):
        d = direction[(first + lane * step + directions) % directions]
        cos[lane] = d[0]
        sin[lane] = d[1]
    low_along = _vec8(FAR)
    low_across = _vec8(FAR)
    high_along = _vec8(-FAR)
    high_across = _vec8(-FAR)
    for k in range(size):
        p = sample[cluster, k]
        along = cos * p[0] + sin * p[1]
        across = cos * p[1] - sin * p[0]
        low_along = wp.min(low_along, along)
        high_along = wp.max(high_along, along)
        low_across = wp.min(low_across, across)
        high_across = wp.max(high_across, across)
    if criterion == _AREA:
        return wp.cw_mul(low_along - high_along, high_across - low_across)
    closeness = _vec8()
    one = _vec8(1.0)
    edge = _vec8(_EDGE)
    for k in range(size):
        p = sample[cluster, k]
        along = cos * p[0] + sin * p[1]
        across = cos * p[1] - sin * p[0]
        off_along = wp.min(along - low_along, high_along - along)
        off_across = wp.min(across - low_across, high_across - across)
        closeness += wp.cw_div(one, wp.max(wp.min(off_along, off_across), edge))
    return closeness


@wp.kernel
def _score_widely(
    # in
    sample_in: wp.array2d(dtype=wp.vec2),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    criterion: int,
    # out
    score_out: wp.array2d(dtype=_vec8),
):
    """The score of every fourth direction."""
    cluster, group = wp.tid()  # pyright: ignore[reportAssignmentType]
    size = wp.min(start_in[cluster + 1] - start_in[cluster], SAMPLES)
    if size > 0:
        first = group * _LANES * _STRIDE
        score_out[cluster, group] = _score(sample_in, cluster, size, direction_in, first, _STRIDE, criterion)


@wp.kernel
def _choose_directions(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    order_in: wp.array(dtype=wp.int32),
    sample_in: wp.array2d(dtype=wp.vec2),
    direction_in: wp.array(dtype=wp.vec2),
    wide_in: wp.array2d(dtype=_vec8),
    criterion: int,
    # out
    chosen_out: wp.array(dtype=wp.int32),
    origin_out: wp.array(dtype=wp.vec3),
    reach_out: wp.array2d(dtype=wp.float32),
):
    """The best of the directions about the best of the first look; of equals the first. Clears the reach."""
    cluster = wp.tid()
    size = wp.min(start_in[cluster + 1] - start_in[cluster], SAMPLES)
    chosen_out[cluster] = 0
    if size == 0:
        return
    best = float(-FAR)
    wide = int(0)
    for group in range(wide_in.shape[1]):
        scores = wide_in[cluster, group]
        for lane in range(8):
            if scores[lane] > best:
                best = scores[lane]
                wide = group * _LANES + lane
    first = wide * _STRIDE - 4
    close = _score(sample_in, cluster, size, direction_in, first, 1, criterion)
    best = float(-FAR)
    chosen = int(0)
    for lane in range(8):
        if close[lane] > best:
            best = close[lane]
            chosen = first + lane
    directions = direction_in.shape[0]
    chosen_out[cluster] = (chosen + directions) % directions
    origin_out[cluster] = xyz_in[order_in[start_in[cluster]]]
    for side in range(6):
        reach_out[cluster, side] = -FAR


@wp.func
def _widen(reach: wp.array2d(dtype=wp.float32), cluster: int, side: int, distance: float):
    """Most points widen nothing: a look is cheaper than an atomic."""
    if distance > reach[cluster, side]:
        wp.atomic_max(reach, cluster, side, distance)
    if -distance > reach[cluster, side + 1]:
        wp.atomic_max(reach, cluster, side + 1, -distance)


@wp.kernel
def _measure_reach(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    chosen_in: wp.array(dtype=wp.int32),
    origin_in: wp.array(dtype=wp.vec3),
    # in out
    reach: wp.array2d(dtype=wp.float32),
):
    """How far the points of each cluster reach from its first: forward, back, left, right, up, down."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    label = label_in[i]
    if label < 0 or label >= chosen_in.shape[0]:
        return
    p = xyz_in[i]
    if not _is_finite(p):
        return
    p = p - origin_in[label]
    d = direction_in[chosen_in[label]]
    _widen(reach, label, 0, d[0] * p[0] + d[1] * p[1])
    _widen(reach, label, 2, d[0] * p[1] - d[1] * p[0])
    _widen(reach, label, 4, p[2])


@wp.kernel
def _write_boxes(
    # in
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    chosen_in: wp.array(dtype=wp.int32),
    origin_in: wp.array(dtype=wp.vec3),
    reach_in: wp.array2d(dtype=wp.float32),
    min_size: float,
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """Centre, sizes and yaw of each cluster, the longer side along the yaw."""
    cluster = wp.tid()
    if start_in[cluster + 1] == start_in[cluster]:
        for column in range(7):
            boxes_out[cluster, column] = wp.nan
        return
    middle = wp.vec3()
    size = wp.vec3()
    for axis in range(3):
        ahead = reach_in[cluster, 2 * axis]
        behind = reach_in[cluster, 2 * axis + 1]
        middle[axis] = 0.5 * (ahead - behind)
        size[axis] = wp.max(ahead + behind, min_size)
    d = direction_in[chosen_in[cluster]]
    origin = origin_in[cluster]
    boxes_out[cluster, 0] = origin[0] + d[0] * middle[0] - d[1] * middle[1]
    boxes_out[cluster, 1] = origin[1] + d[1] * middle[0] + d[0] * middle[1]
    boxes_out[cluster, 2] = origin[2] + middle[2]
    yaw = 0.5 * wp.pi * float(chosen_in[cluster]) / float(direction_in.shape[0])
    if size[1] > size[0]:  # the length lies across
        yaw = wp.where(chosen_in[cluster] == 0, 0.5 * wp.pi, yaw - 0.5 * wp.pi)
    boxes_out[cluster, 3] = wp.max(size[0], size[1])
    boxes_out[cluster, 4] = wp.min(size[0], size[1])
    boxes_out[cluster, 5] = size[2]
    boxes_out[cluster, 6] = yaw


@dataclass(frozen=True, kw_only=True)
class FitBoxes:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    max_clusters: int
    """Boxes that one launch can fit; points of clusters beyond are counted in `dropped`."""
    method: str = "l_shape"
    """`l_shape`, closeness to the edges, or `min_area`, the least area."""
    min_size: float = 0.1
    """Least length, width and height of a box [m]."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    boxes: wp.array = field(init=False, repr=False)
    """Per label x y z of the centre, length width height [m], yaw [rad], shape (max_clusters, 7), float32.

    NaN for a label without points."""
    cluster_count: wp.array = field(init=False, repr=False)
    """The highest label and one, at most `max_clusters`, shape (1,), int32."""
    dropped: wp.array = field(init=False, repr=False)
    """Labelled points left out: not finite, of labels from `max_clusters`; shape (2,), int32."""

    def __post_init__(self):
        if self.capacity < 1:
            raise ValueError(f"capacity must be at least 1 point, not {self.capacity}")
        if self.max_clusters < 1:
            raise ValueError(f"max_clusters must be at least 1, not {self.max_clusters}")
        if self.method not in _METHODS:
            raise ValueError(f"method must be one of {', '.join(_METHODS)}, not {self.method!r}")
        if not self.min_size > 0:
            raise ValueError(f"min_size must be > 0 m, not {self.min_size}")
        device = resolve_device(self.device)
        criterion, directions = _METHODS[self.method]
        angle = np.arange(directions) * (np.pi / 2 / directions)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: type) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        keep("_criterion", criterion)
        keep(
            "_direction",
            wp.array(np.stack([np.cos(angle), np.sin(angle)], axis=1), dtype=wp.vec2, device=device),
        )
        clusters = self.max_clusters
        buffer("_start", clusters + 1, wp.int32)
        buffer("_order", self.capacity if device == DEFAULT_DEVICE else 2 * self.capacity, wp.int32)
        buffer("_sample", (clusters, int(SAMPLES)), wp.vec2)
        buffer("_wide", (clusters, directions // int(_STRIDE * _LANES)), _vec8)
        buffer("_chosen", clusters, wp.int32)
        buffer("_origin", clusters, wp.vec3)
        buffer("_reach", (clusters, 6), wp.float32)
        buffer("boxes", (clusters, 7), wp.float32)
        buffer("cluster_count", 1, wp.int32)
        buffer("dropped", 2, wp.int32)
        if device != DEFAULT_DEVICE:
            buffer("_key", 2 * self.capacity, wp.int32)

    def launch(self, xyz: wp.array, labels: wp.array, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            labels: The cluster of each point from 0 on, negative for none, shape (n,), int32.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if labels.shape[0] != n:
            raise ValueError(f"labels must have {n} entries as xyz has rows, not {labels.shape[0]}")
        clusters, criterion = self.max_clusters, self._criterion
        self._sort(xyz, labels, count)
        # Where the cluster heads.
        if criterion == int(_AREA):
            inputs = [xyz, self._start, self._order, self._direction]
            if self.boxes.device.is_cpu:
                self._run(sample_extremes_in_order, clusters, inputs, [self._sample])
            else:
                self._run(sample_extremes, (clusters, int(SAMPLES) // 4), inputs, [self._sample])
        else:
            inputs = [xyz, self._start, self._order]
            self._run(sample_evenly, (clusters, int(SAMPLES)), inputs, [self._sample])
        inputs = [self._sample, self._start, self._direction, criterion]
        self._run(_score_widely, self._wide.shape, inputs, [self._wide])
        inputs = [xyz, self._start, self._order, self._sample, self._direction, self._wide, criterion]
        self._run(_choose_directions, clusters, inputs, [self._chosen, self._origin, self._reach])
        # How far it reaches.
        inputs = [xyz, labels, count, self._direction, self._chosen, self._origin, self._reach]
        self._run(_measure_reach, n, inputs, [])
        inputs = [self._start, self._direction, self._chosen, self._origin, self._reach, self.min_size]
        self._run(_write_boxes, clusters, inputs, [self.boxes])

    def _sort(self, xyz: wp.array, labels: wp.array, count: wp.array) -> None:
        """Puts the points in order of their clusters."""
        n, clusters = xyz.shape[0], self.max_clusters
        if self.boxes.device.is_cpu:
            outputs = [self._start, self._order, self.cluster_count, self.dropped]
            self._run(_sort_in_order, 1, [xyz, labels, count], outputs)
            return
        self.cluster_count.zero_()
        self.dropped.zero_()
        inputs = [xyz, labels, count, clusters, self.cluster_count, self.dropped]
        self._run(_key_points, n, inputs, [self._key, self._order])
        if n:
            wp.utils.radix_sort_pairs(self._key, self._order, n, end_bit=clusters.bit_length())
        self._run(_find_starts, clusters + 1, [self._key, n], [self._start])

    def _run(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)


def fit_boxes(points: Any, labels: Any, *, method: str = "l_shape", min_size: float = 0.1) -> Any:
    """Fits an upright box to each cluster.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        labels: The cluster of each point, 0 … k − 1, negative for none, shape (n,), integer.
        method: `l_shape`, headings in steps of 0.94°, or `min_area`, in steps of 0.23°.
        min_size: Least length, width and height of a box [m]: a single point gets a cube of it, points in a line a box
            of that width.

    Returns:
        A box per label: centre x y z, length width height [m], yaw about z from x in (−π/2, π/2] [rad], length ≥ width;
        shape (k, 7), float32, of the family and on the device of `points`. All points that are finite lie within,
        to rounding. A label without such points gets NaN.

    Raises:
        TypeError: `points` is not a floating array, or `labels` not one of integers.
        ValueError: A shape or a number does not fit, or the method is not known; the message says which.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    clusters, owner = borrow(labels, wp.int32, (n,), "labels")
    if str(clusters.device) != borrowed.device:
        raise ValueError(f"labels must lie on the device of points, {borrowed.device}, not on {clusters.device}")
    k = int(clusters.numpy().max()) + 1 if n else 0
    plan = plan_for(
        FitBoxes,
        capacity=capacity_for(n),
        max_clusters=max(64, 1 << (max(k, 1) - 1).bit_length()),
        method=method,
        min_size=float(min_size),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, clusters, count_on(n, borrowed.device))
    del owner  # kept until here, for the memory of the labels
    return give(plan.boxes[: max(k, 0)], borrowed.family)
