"""What a kernel chain found: its counts, gathered on the device into one array, and the arrays trimmed by them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .interop import Family, give
from .voxel import Voxels

if TYPE_CHECKING:
    from .chain import KernelChain

__all__ = ["COUNTS", "ChainDropped", "ChainResult", "collect_counts", "read_counts", "result_of"]

COUNTS = (
    "kept",
    "over_capacity",
    "non_finite",
    "out_of_range",
    "ego",
    "clusters",
    "clusters_without_box",
    "points_without_box",
    "pillars",
    "pillar_points",
    "pillars_beyond",
    "pillar_outside",
    "overflow",
    "sensor_height",
)
"""What a chain counts, in order; `overflow` is 0 or 1, and `sensor_height` the bits of a float32."""

(
    _KEPT,
    _OVER_CAPACITY,
    _NON_FINITE,
    _OUT_OF_RANGE,
    _EGO,
    _CLUSTERS,
    _CLUSTERS_WITHOUT_BOX,
    _POINTS_WITHOUT_BOX,
    _PILLARS,
    _PILLAR_POINTS,
    _PILLARS_BEYOND,
    _PILLAR_OUTSIDE,
    _OVERFLOW,
    _SENSOR_HEIGHT,
) = (wp.constant(i) for i in range(len(COUNTS)))


@wp.kernel
def _collect_counts(
    # in
    offered_in: wp.array(dtype=wp.int32),
    capacity: int,
    kept_in: wp.array(dtype=wp.int32),
    filtered_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    clusters_in: wp.array(dtype=wp.int32),
    max_boxes: int,
    unboxed_in: wp.array(dtype=wp.int32),
    pillars_in: wp.array(dtype=wp.int32),
    unpillared_in: wp.array(dtype=wp.int32),
    # out
    counts_out: wp.array(dtype=wp.int32),
):
    """One thread; the counts of stages that are left out stay zero."""
    over_capacity = wp.max(offered_in[0] - capacity, 0)
    lost = over_capacity
    counts_out[_KEPT] = kept_in[0]
    counts_out[_OVER_CAPACITY] = over_capacity
    for reason in range(3):
        counts_out[_NON_FINITE + reason] = filtered_in[reason]
    if clusters_in:
        counts_out[_CLUSTERS] = clusters_in[0]
        if unboxed_in:
            without = wp.max(clusters_in[0] - max_boxes, 0)
            counts_out[_CLUSTERS_WITHOUT_BOX] = without
            counts_out[_POINTS_WITHOUT_BOX] = unboxed_in[1]
            lost += without
    if pillars_in:
        counts_out[_PILLARS] = pillars_in[0]
        for reason in range(3):
            counts_out[_PILLAR_POINTS + reason] = unpillared_in[reason]
        lost += unpillared_in[1]
    counts_out[_OVERFLOW] = wp.where(lost > 0, 1, 0)
    counts_out[_SENSOR_HEIGHT] = wp.cast(sensor_height_in[0], wp.int32)


def collect_counts(
    counts: wp.array,
    *,
    offered: wp.array,
    capacity: int,
    kept: wp.array,
    filtered: wp.array,
    sensor_height: wp.array,
    clusters: wp.array | None,
    max_boxes: int,
    unboxed: wp.array | None,
    pillars: wp.array | None,
    unpillared: wp.array | None,
) -> None:
    """Gathers the counts of a chain's stages. Allocates nothing, reads nothing back.

    Args:
        counts: Filled in the order of `COUNTS`, int32.
        offered: Points of the frame, shape (1,), int32.
        capacity: Points that there was room for.
        kept: Points that passed the filter, shape (1,), int32.
        filtered: Those that did not: not finite, out of range, ego; shape (3,), int32.
        sensor_height: Shape (1,), float32.
        clusters: How many, shape (1,), int32; None without the stage.
        max_boxes: Boxes that there was room for.
        unboxed: Points not finite, and of clusters without a box, shape (2,), int32; None without the stage.
        pillars: How many, shape (1,), int32; None without the stage.
        unpillared: Points beyond a pillar's room, pillars beyond the room, points outside, shape (3,), int32.
    """
    inputs = [offered, capacity, kept, filtered, sensor_height, clusters, max_boxes, unboxed, pillars, unpillared]
    wp.launch(_collect_counts, 1, inputs=inputs, outputs=[counts], device=counts.device)


@dataclass(frozen=True)
class ChainDropped:
    """What a frame lost on its way through a chain."""

    over_capacity: int
    """Points beyond the chain's capacity."""
    non_finite: int
    """Of the others, points with a coordinate that is not finite."""
    out_of_range: int
    """Of the others, points outside the filter's range."""
    ego: int
    """Of the others, points on the own vehicle."""
    clusters_without_box: int
    """Clusters beyond the room for boxes, those that begin last."""
    points_without_box: int
    """The points of these."""
    pillar_points: int
    """Points beyond the room of their pillar."""
    pillars_beyond: int
    """Pillars beyond the room for pillars, those that begin last."""
    pillar_outside: int
    """Points outside the pillars' range."""


@dataclass(frozen=True, eq=False)
class ChainResult:
    """What a chain found in a frame; the points are those that passed the filter, m of them, in order.

    What belongs to a stage that the chain has not is None.
    """

    xyz: Any
    """Positions [m], shape (m, 3), float32; a Warp array of vec3, shape (m,), in that family."""
    intensity: Any
    """Shape (m,), float32; zero where the input had three columns."""
    index: Any
    """Places in the input, rising, shape (m,), int32."""
    ground: Any
    """Whether each point is ground, shape (m,), bool."""
    height: Any
    """Height of each point above the ground along z [m], shape (m,), float32."""
    sensor_height: float
    """Distance of the frame's origin from the ground near it [m]."""
    labels: Any
    """The cluster of each point, −1 for none, shape (m,), int32; numbered by their lowest point."""
    cluster_count: int
    """How many clusters there are; zero without the stage."""
    boxes: Any
    """x y z of the centre, length width height [m], yaw [rad] by cluster, shape (k, 7), float32, k ≤ cluster_count."""
    pillars: Voxels | None
    """Pillars of the points, as by `voxelize`."""
    channels: Any
    """The detection head's input, as by `pillarize`, shape (C, H, W), float32."""
    bev: Any
    """Maps from above, as by `bev`, shape (3, rows, columns), float32."""
    dropped: ChainDropped
    """What was lost, by reason."""
    overflow: bool
    """Whether there was too little room: for points, boxes or pillars."""


def read_counts(counts: wp.array) -> tuple[dict[str, int], float]:
    """Waits for what `collect_counts` wrote: the counts by name, but for the last; and that, the sensor's height."""
    host = counts.numpy()
    return dict(zip(COUNTS[:-1], host.tolist(), strict=False)), float(host[-1:].view(np.float32)[0])


def result_of(chain: KernelChain, family: Family, copy: bool) -> ChainResult:
    """Waits for the last launch of a chain and trims its arrays, as arrays of a family."""
    counts, sensor_height = read_counts(chain.counts)
    m = counts["kept"]

    def out(array: wp.array | None) -> Any:
        if array is None:
            return None
        if family.device == "cpu" and not array.device.is_cpu:
            return _shown(array.to("cpu"), family)
        return give(array, family) if copy else _shown(array, family)

    def trimmed(array: wp.array | None, length: int) -> Any:
        return None if array is None else out(array[:length])

    pillars = None
    if chain.pillars is not None:
        arrays = (chain.pillars.features, chain.pillars.coords, chain.pillars.counts)
        pillars = Voxels(
            *(trimmed(array, counts["pillars"]) for array in arrays),
            counts["pillar_points"],
            counts["pillars_beyond"],
            counts["pillar_outside"],
        )
    return ChainResult(
        xyz=trimmed(chain.xyz, m),
        intensity=trimmed(chain.intensity, m),
        index=trimmed(chain.index, m),
        ground=trimmed(chain.ground, m),
        height=trimmed(chain.height, m),
        sensor_height=sensor_height,
        labels=trimmed(chain.labels, m),
        cluster_count=counts["clusters"],
        boxes=trimmed(chain.boxes, min(counts["clusters"], chain.config.max_boxes)),
        pillars=pillars,
        channels=None if chain.channels is None else out(chain.channels[0]),
        bev=out(chain.maps),
        dropped=ChainDropped(**{name: counts[name] for name in ChainDropped.__dataclass_fields__}),
        overflow=counts["overflow"] != 0,
    )


def _shown(array: wp.array, family: Family) -> Any:
    """A Warp array as an array of `family` on the same memory, where that is possible."""
    if family.name == "numpy":
        return array.numpy()
    if family.name == "torch":
        return wp.to_torch(array, requires_grad=False)
    return family.namespace.from_dlpack(array) if family.namespace is not None else array
