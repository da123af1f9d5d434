"""Oriented boxes around clusters of points: those whose edges the points are closest to, or of the least area.

Points are put in the order of their clusters first; each cluster's box is then found by itself, in `box_l_shape.py`
or `box_hull.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real
from .box_hull import RUN, find_hulls, find_hulls_in_parts, fit_hulls, fit_hulls_in_parts
from .box_l_shape import (
    DIRECTIONS,
    GROUPS,
    SAMPLES,
    Scores,
    choose_directions,
    fit_l_shapes_in_parts,
    measure_reach,
    sample_evenly,
    score_widely,
    write_boxes,
)
from .device import DEFAULT_DEVICE, module_apart, resolve_device
from .interop import borrow, borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .threads import launch_parts, thread_count

__all__ = ["FitBoxes", "fit_boxes"]

_METHODS = ("l_shape", "min_area")
_APART = module_apart(__name__)
_LEAST_OF_PART = 8192  # points for which a thread of their own is worth its while
_NON_FINITE, _TOO_MANY = (wp.constant(i) for i in range(2))


@wp.func
def _is_finite(p: wp.vec3) -> bool:
    return (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]) == 0.0


@wp.kernel
def _count_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # out: per part how many points each cluster has; the highest label, and what is dropped
    place_out: wp.array2d(dtype=wp.int32),
    tally_out: wp.array2d(dtype=wp.int32),
):
    """Counts the points of each cluster in a part of the cloud."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    clusters = place_out.shape[1]
    for c in range(clusters):
        place_out[part, c] = 0
    highest = int(-1)
    non_finite = int(0)
    too_many = int(0)
    share = (n + parts - 1) / parts
    for i in range(part * share, wp.min((part + 1) * share, n)):
        label = label_in[i]
        if label >= 0:
            highest = wp.max(highest, label)
            if label >= clusters:
                too_many += 1
            elif not _is_finite(xyz_in[i]):
                non_finite += 1
            else:
                place_out[part, label] = place_out[part, label] + 1
    tally_out[part, 0] = highest
    tally_out[part, 1] = non_finite
    tally_out[part, 2] = too_many


@wp.kernel
def _add_counts(
    parts: int,
    # in out: counts become the places where parts put their points
    place: wp.array2d(dtype=wp.int32),
    # in
    tally_in: wp.array2d(dtype=wp.int32),
    # out
    start_out: wp.array(dtype=wp.int32),
    cluster_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread."""
    clusters = place.shape[1]
    total = int(0)
    for c in range(clusters):
        start_out[c] = total
        for part in range(parts):
            count = place[part, c]
            place[part, c] = total
            total += count
    start_out[clusters] = total
    highest = int(-1)
    non_finite = int(0)
    too_many = int(0)
    for part in range(parts):
        highest = wp.max(highest, tally_in[part, 0])
        non_finite += tally_in[part, 1]
        too_many += tally_in[part, 2]
    cluster_count_out[0] = wp.min(highest + 1, clusters)
    dropped_out[_NON_FINITE] = non_finite
    dropped_out[_TOO_MANY] = too_many


@wp.kernel
def _place_in_parts(
    part: int,
    parts: int,
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # in out
    place: wp.array2d(dtype=wp.int32),
    # out
    point_out: wp.array(dtype=wp.vec3),
):
    """Copies the points in the order of their clusters, and in their own within one."""
    n = wp.min(count_in[0], xyz_in.shape[0])
    share = (n + parts - 1) / parts
    for i in range(part * share, wp.min((part + 1) * share, n)):
        label = label_in[i]
        if label >= 0 and label < place.shape[1]:
            p = xyz_in[i]
            if _is_finite(p):
                point_out[place[part, label]] = p
                place[part, label] = place[part, label] + 1


@wp.kernel(module=_APART)
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


@wp.kernel(module=_APART)
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


@wp.kernel(module=_APART)
def _copy_in_order(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    order_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    # out
    point_out: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    if i < start_in[start_in.shape[0] - 1]:
        point_out[i] = xyz_in[order_in[i]]


def _in_parts(device: str) -> bool:
    """Whether few threads do much each, as suits a CPU, or many little."""
    return device == DEFAULT_DEVICE


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
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        if not 1 <= self.max_clusters < 2**31:
            raise ValueError(f"max_clusters must be at least 1 and below 2³¹, not {self.max_clusters}")
        if self.method not in _METHODS:
            raise ValueError(f"method must be one of {', '.join(_METHODS)}, not {self.method!r}")
        if not self.min_size > 0:
            raise ValueError(f"min_size must be > 0 m, not {self.min_size}")
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, shape: int | tuple[int, ...], dtype: Any) -> None:
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

        clusters = self.max_clusters
        keep("_parts", thread_count() if _in_parts(device) else 0)
        buffer("_start", clusters + 1, wp.int32)
        buffer("_point", self.capacity, wp.vec3)
        buffer("boxes", (clusters, 7), wp.float32)
        buffer("cluster_count", 1, wp.int32)
        buffer("dropped", 2, wp.int32)
        if self._parts:
            buffer("_place", (self._parts, clusters), wp.int32)
            buffer("_tally", (self._parts, 3), wp.int32)
        else:
            buffer("_key", 2 * self.capacity, wp.int32)
            buffer("_order", 2 * self.capacity, wp.int32)
        if self.method == "min_area":
            buffer("_flat", self.capacity, wp.vec2)
            buffer("_corner", self.capacity, wp.vec2)
            buffer("_pending", (self.capacity, 5), wp.float32)
            buffer("_corner_count", self.capacity, wp.int32)
            buffer("_height", self.capacity, wp.vec2)
        else:
            angle = np.arange(DIRECTIONS) * (np.pi / 2 / DIRECTIONS)
            rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            keep("_direction", wp.array(rays, dtype=wp.vec2, device=device))
            buffer("_sample", (clusters, int(SAMPLES)), wp.vec2)
            buffer("_wide", (clusters, int(GROUPS)), Scores)
            buffer("_chosen", clusters, wp.int32)
            buffer("_reach", (clusters, 6), wp.float32)

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
        parts = max(1, min(self._parts, n // _LEAST_OF_PART)) if self._parts else 0
        self._sort(xyz, labels, count, parts)
        if self.method == "min_area":
            self._fit_hulls(n, parts)
        else:
            self._fit_l_shapes(n, parts)

    def _sort(self, xyz: wp.array, labels: wp.array, count: wp.array, parts: int) -> None:
        """Puts the points in the order of their clusters."""
        n, clusters = xyz.shape[0], self.max_clusters
        given = [xyz, labels, count]
        if parts:
            launch_parts(_count_in_parts, parts, given, [self._place, self._tally])
            outputs = [self._start, self.cluster_count, self.dropped]
            self._run(_add_counts, 1, [parts, self._place, self._tally], outputs)
            launch_parts(_place_in_parts, parts, given, [self._place, self._point])
            return
        self.cluster_count.zero_()
        self.dropped.zero_()
        inputs = [*given, clusters, self.cluster_count, self.dropped]
        self._run(_key_points, n, inputs, [self._key, self._order])
        if n:
            wp.utils.radix_sort_pairs(self._key, self._order, n, end_bit=clusters.bit_length())
        self._run(_find_starts, clusters + 1, [self._key, n], [self._start])
        self._run(_copy_in_order, n, [xyz, self._order, self._start], [self._point])

    def _fit_hulls(self, n: int, parts: int) -> None:
        found = [self._point, self._start]
        room = [self._corner, self._pending]
        hulls = [self._flat, self._corner_count, self._height]
        rest = [self.min_size, self._flat, *room, *hulls[1:]]
        if parts:
            launch_parts(find_hulls_in_parts, parts, [*found, *room], hulls)
            launch_parts(fit_hulls_in_parts, parts, [*found, *rest], [self.boxes])
        else:
            self._run(find_hulls, -(-n // int(RUN)), [*found, *room], hulls)
            self._run(fit_hulls, self.max_clusters, [*found, *rest], [self.boxes])

    def _fit_l_shapes(self, n: int, parts: int) -> None:
        found, clusters = [self._point, self._start], self.max_clusters
        if parts:
            inputs = [*found, self._direction, self.min_size, self._sample, self._wide]
            launch_parts(fit_l_shapes_in_parts, parts, inputs, [self.boxes])
            return
        directed = [self._start, self._direction]
        self._run(sample_evenly, (clusters, int(SAMPLES)), found, [self._sample])
        self._run(score_widely, (clusters, int(GROUPS)), [self._sample, *directed], [self._wide])
        outputs = [self._chosen, self._reach]
        self._run(choose_directions, clusters, [self._sample, *directed, self._wide], outputs)
        self._run(measure_reach, n, [self._point, self._key, *directed, self._chosen], [self._reach])
        inputs = [*found, self._direction, self._chosen, self._reach, self.min_size]
        self._run(write_boxes, clusters, inputs, [self.boxes])

    def _run(self, kernel: Any, dim: int | tuple[int, ...], inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim, inputs=inputs, outputs=outputs, device=self.device)


def fit_boxes(points: Any, labels: Any, *, method: str = "l_shape", min_size: float = 0.1) -> Any:
    """Fits an upright box to each cluster.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        labels: The cluster of each point, 0 … k − 1, negative for none, shape (n,), integer.
        method: `l_shape`, headings in steps of 0.94° (Zhang, Xu, Dong, Dolan, IV 2017), or `min_area`, exact.
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
        min_size=real(min_size, "min_size"),
        device=borrowed.device,
    )
    plan.launch(borrowed.xyz, clusters, count_on(n, borrowed.device))
    del owner  # kept until here, for the memory of the labels
    return give(plan.boxes[: max(k, 0)], borrowed.family)
