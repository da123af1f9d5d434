"""Filters: takes out of a cloud what no later stage should see, and says how much and why.

What stays keeps its order. A CPU counts what stays of each part of the cloud, and packs the parts side by side; a GPU
packs by a scan over flags, to the same bytes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import reals
from .device import DEFAULT_DEVICE, resolve_device
from .filter_parts import EGO, KEPT, NON_FINITE, OUT_OF_RANGE, Limits, pack_part
from .interop import Points, adopt, borrow_points, count_on, give
from .parts import parts_for, run_parts
from .plan import capacity_for, plan_for

__all__ = ["Filtered", "PointFilter", "filter_points"]

_EVERYWHERE = (-math.inf, -math.inf, -math.inf, math.inf, math.inf, math.inf)
_NOWHERE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_LEAST_PART = 100_000  # points; fewer are packed sooner than a second thread is woken


@wp.func
def _inside(p: wp.vec3, low: wp.vec3, high: wp.vec3) -> bool:
    return p[0] >= low[0] and p[1] >= low[1] and p[2] >= low[2] and p[0] < high[0] and p[1] < high[1] and p[2] < high[2]


@wp.func
def _verdict(p: wp.vec3, limits: Limits) -> int:
    """The reason why a point goes, the first that holds, or that it stays."""
    if (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]) != 0.0:
        return NON_FINITE
    if not _inside(p, limits.low, limits.high):
        return OUT_OF_RANGE
    if _inside(p, limits.ego_low, limits.ego_high):
        return EGO
    return KEPT


@wp.kernel
def _flag_kept(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    limits: Limits,
    # in out: zero
    dropped: wp.array(dtype=wp.int32),
    # out
    kept_out: wp.array(dtype=wp.int32),
):
    """1 for each point that stays; dim is the capacity, so that the scan finds no leftovers."""
    i = wp.tid()
    kept_out[i] = 0
    if i >= wp.min(count_in[0], xyz_in.shape[0]):
        return
    verdict = _verdict(xyz_in[i], limits)
    if verdict == KEPT:
        kept_out[i] = 1
    else:
        wp.atomic_add(dropped, verdict, 1)


@wp.kernel
def _pack_by_rank(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    kept_in: wp.array(dtype=wp.int32),
    rank_in: wp.array(dtype=wp.int32),
    # out
    xyz_out: wp.array(dtype=wp.vec3),
    intensity_out: wp.array(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
):
    """Writes each kept point to its place: the inclusive scan of the flags, less one."""
    i = wp.tid()
    if i == rank_in.shape[0] - 1:
        count_out[0] = rank_in[i]
    if kept_in[i] == 0:
        return
    place = rank_in[i] - 1
    xyz_out[place] = xyz_in[i]
    if intensity_in:
        intensity_out[place] = intensity_in[i]
    else:
        intensity_out[place] = 0.0
    index_out[place] = i


@wp.kernel
def _gather_rows(
    # in
    table_in: wp.array2d(dtype=wp.float32),
    index_in: wp.array(dtype=wp.int32),
    # out
    rows_out: wp.array2d(dtype=wp.float32),
):
    """One row a thread."""
    i = wp.tid()
    for column in range(table_in.shape[1]):
        rows_out[i, column] = table_in[index_in[i], column]


@dataclass(frozen=True, kw_only=True)
class PointFilter:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    point_range: tuple[float, ...] | None = None
    """xmin ymin zmin xmax ymax zmax [m] of what stays, upper bounds open; None for everywhere."""
    ego_box: tuple[float, ...] | None = None
    """xmin ymin zmin xmax ymax zmax [m] of the own vehicle, whose points go, upper bounds open; None for none."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""
    method: str = "auto"
    """`parts` (packed part by part), `scan` (parallel), or `auto`: `parts` on a CPU, else `scan`. Results are equal."""
    parts: int | None = None
    """How many parts of the cloud are packed at once, by the method `parts`; by default as the threads are worth it."""

    xyz: wp.array = field(init=False, repr=False)
    """Positions of the points that stay [m], shape (capacity,), vec3."""
    intensity: wp.array = field(init=False, repr=False)
    """Their intensities, shape (capacity,), float32."""
    index: wp.array = field(init=False, repr=False)
    """Their places in the input, rising, shape (capacity,), int32."""
    count: wp.array = field(init=False, repr=False)
    """How many stay, shape (1,), int32."""
    dropped: wp.array = field(init=False, repr=False)
    """How many went because not finite, out of range, in the ego box; the first that holds; shape (3,), int32."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be at least 1 point and below 2³¹, not {self.capacity}")
        inside = _EVERYWHERE if self.point_range is None else _checked_box("point_range", self.point_range)
        ego = _NOWHERE if self.ego_box is None else _checked_box("ego_box", self.ego_box)
        limits = Limits()
        limits.low, limits.high = wp.vec3(*inside[:3]), wp.vec3(*inside[3:])
        limits.ego_low, limits.ego_high = wp.vec3(*ego[:3]), wp.vec3(*ego[3:])
        device = resolve_device(self.device)
        if self.method not in ("auto", "parts", "scan"):
            raise ValueError(f"method must be 'auto', 'parts' or 'scan', not {self.method!r}")
        if self.parts is not None and self.parts < 1:
            raise ValueError(f"parts must be at least 1, not {self.parts}")
        by_parts = self.method == "parts" or (self.method == "auto" and device == DEFAULT_DEVICE)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        def buffer(name: str, length: int, dtype: type) -> None:
            keep(name, wp.zeros(length, dtype=dtype, device=device))

        keep("_limits", limits)
        buffer("xyz", self.capacity, wp.vec3)
        buffer("intensity", self.capacity, wp.float32)
        buffer("index", self.capacity, wp.int32)
        buffer("count", 1, wp.int32)
        buffer("dropped", 3, wp.int32)
        keep("_by_parts", by_parts)
        if by_parts:
            keep("_parts", self.parts or parts_for(self.capacity, _LEAST_PART))
            keep("_tally", wp.zeros((self._parts, 3), dtype=wp.int32, device=device))
        else:
            buffer("_kept", self.capacity, wp.int32)
            buffer("_rank", self.capacity, wp.int32)

    def launch(self, xyz: wp.array, intensity: wp.array | None, count: wp.array) -> None:
        """Fills the outputs from the first `count[0]` points.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            intensity: Shape (n,), float32; None where there are none, which gives zeros.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if self._by_parts:
            self._pack(xyz, intensity, count, self.xyz, self.intensity)
            return
        self.dropped.zero_()
        wp.launch(
            _flag_kept,
            self.capacity,
            inputs=[xyz, count, self._limits, self.dropped],
            outputs=[self._kept],
            device=self.device,
        )
        wp.utils.array_scan(self._kept, self._rank, inclusive=True)
        wp.launch(
            _pack_by_rank,
            self.capacity,
            inputs=[xyz, intensity, self._kept, self._rank],
            outputs=[self.xyz, self.intensity, self.index, self.count],
            device=self.device,
        )

    def _pack(
        self,
        xyz: wp.array,
        intensity: wp.array | None,
        count: wp.array,
        packed_xyz: wp.array,
        packed_intensity: wp.array | None,
    ) -> None:
        """Packs part by part into arrays with room for all points."""
        given, parts = [xyz, intensity, count, self._limits], self._parts
        if parts > 1:
            run_parts(pack_part, parts, self.device, [*given, 0], [self._tally, None, None, None, None, None])
        packed = [packed_xyz, packed_intensity, self.index, self.count, self.dropped]
        run_parts(pack_part, parts, self.device, [*given, int(parts > 1)], [self._tally, *packed])

    def _pack_rows(self, points: Points, count: wp.array) -> np.ndarray:
        """Packs points on the host, with all their columns, straight into an array of its own."""
        n, columns = points.table.shape
        host = np.empty((n, columns), np.float32)

        def column(offset: int, dtype: type) -> wp.array:
            return wp.array(
                ptr=host.ctypes.data + 4 * offset if n else None,
                dtype=dtype,
                shape=(n,),
                strides=(4 * columns,),
                device=DEFAULT_DEVICE,
            )

        fourth = column(3, wp.float32) if columns > 3 else None
        self._pack(points.xyz, points.intensity, count, column(0, wp.vec3), fourth)
        kept = int(self.count.numpy()[0])
        if columns > 4:
            rows = wp.array(host, copy=False, device=DEFAULT_DEVICE)
            wp.launch(_gather_rows, kept, inputs=[points.table, self.index], outputs=[rows], device=DEFAULT_DEVICE)
        # A few that stay shall not hold the memory of the many that went.
        return host[:kept] if 2 * kept >= n else host[:kept].copy()


def _checked_box(name: str, box: Sequence[float]) -> tuple[float, ...]:
    """The six numbers of a box, low corner first."""
    numbers = reals(box, name)
    if len(numbers) != 6 or not all(low < high for low, high in zip(numbers[:3], numbers[3:], strict=True)):
        raise ValueError(f"{name} must be xmin ymin zmin xmax ymax zmax with min < max, not {box}")
    return numbers


@dataclass(frozen=True, eq=False)
class Filtered:
    """What `filter_points` left, and how much went why."""

    points: Any
    """The points that stay, all their columns, in order, shape (m, C), float32."""
    index: Any
    """Their places in the input, shape (m,), int32."""
    non_finite: int
    """Points that went because a coordinate is not finite."""
    out_of_range: int
    """Of the others, those outside `point_range`."""
    ego: int
    """Of the others, those inside `ego_box`."""


def filter_points(
    points: Any, *, point_range: Sequence[float] | None = None, ego_box: Sequence[float] | None = None
) -> Filtered:
    """Takes out points that are not finite, out of range, or on the own vehicle.

    Args:
        points: Positions [m] and whatever else in further columns, shape (n, 3 or more), floating.
        point_range: xmin ymin zmin xmax ymax zmax [m] of what stays, upper bounds open; by default everywhere.
        ego_box: The same of the own vehicle, whose points go; by default none.

    Returns:
        The points that stay, as float32, of the family and on the device of `points`, and the counts of the others.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    n, columns = borrowed.table.shape
    plan = plan_for(
        PointFilter,
        capacity=capacity_for(n),
        point_range=None if point_range is None else _checked_box("point_range", point_range),
        ego_box=None if ego_box is None else _checked_box("ego_box", ego_box),
        device=borrowed.device,
    )
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, borrowed.intensity, count)
        kept = int(plan.count.numpy()[0])
        rows = wp.empty((kept, columns), dtype=wp.float32, device=borrowed.device)
        wp.launch(_gather_rows, kept, inputs=[borrowed.table, plan.index], outputs=[rows], device=borrowed.device)
        stayed = give(rows, borrowed.family)
    else:
        host = plan._pack_rows(borrowed, count)
        kept = len(host)
        stayed = adopt(host, borrowed.family)
    non_finite, out_of_range, ego = (int(number) for number in plan.dropped.numpy())
    return Filtered(stayed, give(plan.index[:kept], borrowed.family), non_finite, out_of_range, ego)
