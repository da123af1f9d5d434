"""The box whose edges the points of a cluster are closest to, as those of the L that a LiDAR sees of a car.

Zhang, Xu, Dong, Dolan: Efficient L-shape fitting for vehicle detection using laser scanners, IV 2017. Headings are
searched with up to 64 points of a cluster, first every fourth, then those about the best. See `boxes.py`.
"""

from __future__ import annotations

import warp as wp

from .box_extent import Extent, extent_of, write_box
from .device import module_apart

__all__ = [
    "DIRECTIONS",
    "GROUPS",
    "SAMPLES",
    "Scores",
    "choose_directions",
    "fit_l_shapes_in_parts",
    "measure_reach",
    "sample_evenly",
    "score_widely",
    "write_boxes",
]

# Which of two like angles wins must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})
_APART = module_apart(__name__, fuse_fp=False)

SAMPLES = wp.constant(64)
DIRECTIONS = 96
"""Headings in a quarter turn."""
_STRIDE = wp.constant(4)  # the first look takes every so many of them
_LANES = wp.constant(8)  # headings that are scored side by side
GROUPS = wp.constant(DIRECTIONS // (int(_STRIDE) * int(_LANES)))
"""Groups of headings of the first look."""
_FAR = wp.constant(1.0e30)

Scores = wp.types.vector(length=8, dtype=wp.float32)


@wp.func
def _sample(
    point: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.int32),
    cluster: int,
    slot: int,
    sample: wp.array2d(dtype=wp.vec2),
):
    """One of up to 64 points of a cluster, evenly in its order, relative to its first."""
    first = start[cluster]
    size = start[cluster + 1] - first
    if slot < wp.min(size, SAMPLES):
        at = slot
        if size > SAMPLES:
            at = slot * (size / SAMPLES) + slot * (size % SAMPLES) / SAMPLES
        p = point[first + at] - point[first]
        sample[cluster, slot] = wp.vec2(p[0], p[1])


# In C++, where a compiler makes vector instructions of the loops: four times as fast as the same in Python. An edge
# that is nearer than a centimetre is no better.
@wp.func_native("""
    constexpr int LANES = 8;
    const int directions = direction.shape[0];
    const float* const given = (const float*)direction.data;
    const float* const points = (const float*)sample.data + cluster * (sample.strides[0] / 4);
    float c[LANES], s[LANES], low_x[LANES], high_x[LANES], low_y[LANES], high_y[LANES], closeness[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
        const int which = (first + lane * step + directions) % directions;
        c[lane] = given[2 * which];
        s[lane] = given[2 * which + 1];
        low_x[lane] = low_y[lane] = high_x[lane] = high_y[lane] = 0.0f;  // the first point's
        closeness[lane] = 0.0f;
    }
    for (int k = 0; k < size; ++k) {
        const float x = points[2 * k], y = points[2 * k + 1];
        for (int lane = 0; lane < LANES; ++lane) {
            const float along = c[lane] * x + s[lane] * y, across = c[lane] * y - s[lane] * x;
            low_x[lane] = along < low_x[lane] ? along : low_x[lane];
            high_x[lane] = along > high_x[lane] ? along : high_x[lane];
            low_y[lane] = across < low_y[lane] ? across : low_y[lane];
            high_y[lane] = across > high_y[lane] ? across : high_y[lane];
        }
    }
    for (int k = 0; k < size; ++k) {
        const float x = points[2 * k], y = points[2 * k + 1];
        for (int lane = 0; lane < LANES; ++lane) {
            const float along = c[lane] * x + s[lane] * y, across = c[lane] * y - s[lane] * x;
            const float behind = along - low_x[lane], ahead = high_x[lane] - along;
            const float right = across - low_y[lane], left = high_y[lane] - across;
            const float off_x = behind < ahead ? behind : ahead, off_y = right < left ? right : left;
            float off = off_x < off_y ? off_x : off_y;
            off = off > 0.01f ? off : 0.01f;
            closeness[lane] += 1.0f / off;
        }
    }
    wp::vec_t<8, wp::float32> scores;
    for (int lane = 0; lane < LANES; ++lane) scores[lane] = closeness[lane];
    return scores;
""")
def _score(
    sample: wp.array2d(dtype=wp.vec2),
    cluster: int,
    size: int,
    direction: wp.array(dtype=wp.vec2),
    first: int,
    step: int,
) -> Scores:
    """How close the samples of a cluster are to the edges of boxes along eight directions; more is better."""


@wp.func
def _best_direction(
    cluster: int,
    size: int,
    sample: wp.array2d(dtype=wp.vec2),
    direction: wp.array(dtype=wp.vec2),
    wide: wp.array2d(dtype=Scores),
) -> int:
    """The best of the directions about the best of the first look; of equals the first."""
    best = float(-_FAR)
    widely = int(0)
    for group in range(GROUPS):
        scores = wide[cluster, group]
        for lane in range(8):
            if scores[lane] > best:
                best = scores[lane]
                widely = group * _LANES + lane
    first = widely * _STRIDE - 4
    close = _score(sample, cluster, size, direction, first, 1)
    best = float(-_FAR)
    chosen = int(0)
    for lane in range(8):
        if close[lane] > best:
            best = close[lane]
            chosen = first + lane
    directions = direction.shape[0]
    return (chosen + directions) % directions


@wp.func
def _write(
    cluster: int,
    origin: wp.vec3,
    chosen: int,
    direction: wp.array(dtype=wp.vec2),
    reach: Extent,
    min_size: float,
    boxes: wp.array2d(dtype=wp.float32),
):
    d = direction[chosen]
    yaw = 0.5 * wp.pi * float(chosen) / float(direction.shape[0])
    write_box(cluster, origin, d[0], d[1], yaw, reach, min_size, boxes)


@wp.kernel
def fit_l_shapes_in_parts(
    part: int,
    parts: int,
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    min_size: float,
    # in out: workspace
    sample: wp.array2d(dtype=wp.vec2),
    wide: wp.array2d(dtype=Scores),
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """Every so many clusters, from samples to boxes."""
    for cluster in range(part, start_in.shape[0] - 1, parts):
        first = start_in[cluster]
        size = start_in[cluster + 1] - first
        if size == 0:
            for column in range(7):
                boxes_out[cluster, column] = wp.nan
            continue
        looked_at = wp.min(size, SAMPLES)
        for slot in range(looked_at):
            _sample(point_in, start_in, cluster, slot, sample)
        for group in range(GROUPS):
            wide[cluster, group] = _score(sample, cluster, looked_at, direction_in, group * _LANES * _STRIDE, _STRIDE)
        chosen = _best_direction(cluster, looked_at, sample, direction_in, wide)
        origin = point_in[first]
        d = direction_in[chosen]
        reach = extent_of(point_in, first, size, origin, d[0], d[1])
        _write(cluster, origin, chosen, direction_in, reach, min_size, boxes_out)


# ---- the same, for many threads


@wp.kernel(module=_APART)
def sample_evenly(
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    # out
    sample_out: wp.array2d(dtype=wp.vec2),
):
    """One sample a thread."""
    cluster, slot = wp.tid()  # pyright: ignore[reportAssignmentType]
    _sample(point_in, start_in, cluster, slot, sample_out)


@wp.kernel(module=_APART)
def score_widely(
    # in
    sample_in: wp.array2d(dtype=wp.vec2),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    # out
    score_out: wp.array2d(dtype=Scores),
):
    """The scores of every fourth direction, eight a thread."""
    cluster, group = wp.tid()  # pyright: ignore[reportAssignmentType]
    size = wp.min(start_in[cluster + 1] - start_in[cluster], SAMPLES)
    if size > 0:
        score_out[cluster, group] = _score(sample_in, cluster, size, direction_in, group * _LANES * _STRIDE, _STRIDE)


@wp.kernel(module=_APART)
def choose_directions(
    # in
    sample_in: wp.array2d(dtype=wp.vec2),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    wide_in: wp.array2d(dtype=Scores),
    # out
    chosen_out: wp.array(dtype=wp.int32),
    reach_out: wp.array2d(dtype=wp.float32),
):
    """One cluster a thread. Clears the reach to that of the first point."""
    cluster = wp.tid()
    size = wp.min(start_in[cluster + 1] - start_in[cluster], SAMPLES)
    if size > 0:
        chosen_out[cluster] = _best_direction(cluster, size, sample_in, direction_in, wide_in)
    for side in range(6):
        reach_out[cluster, side] = 0.0


@wp.func
def _widen(reach: wp.array2d(dtype=wp.float32), cluster: int, side: int, distance: float):
    """Most points widen nothing: a look is cheaper than an atomic."""
    if distance > reach[cluster, side]:
        wp.atomic_max(reach, cluster, side, distance)
    if -distance > reach[cluster, side + 1]:
        wp.atomic_max(reach, cluster, side + 1, -distance)


@wp.kernel(module=_APART)
def measure_reach(
    # in
    point_in: wp.array(dtype=wp.vec3),
    label_in: wp.array(dtype=wp.int32),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    chosen_in: wp.array(dtype=wp.int32),
    # in out
    reach: wp.array2d(dtype=wp.float32),
):
    """One point a thread, in the order of the clusters: how far they reach from their first."""
    i = wp.tid()
    clusters = chosen_in.shape[0]
    if i >= start_in[clusters]:
        return
    cluster = label_in[i]
    p = point_in[i] - point_in[start_in[cluster]]
    d = direction_in[chosen_in[cluster]]
    _widen(reach, cluster, 0, d[0] * p[0] + d[1] * p[1])
    _widen(reach, cluster, 2, d[0] * p[1] - d[1] * p[0])
    _widen(reach, cluster, 4, p[2])


@wp.kernel(module=_APART)
def write_boxes(
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    direction_in: wp.array(dtype=wp.vec2),
    chosen_in: wp.array(dtype=wp.int32),
    reach_in: wp.array2d(dtype=wp.float32),
    min_size: float,
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """One cluster a thread."""
    cluster = wp.tid()
    first = start_in[cluster]
    if start_in[cluster + 1] == first:
        for column in range(7):
            boxes_out[cluster, column] = wp.nan
        return
    reach = Extent()
    for side in range(6):
        reach[side] = reach_in[cluster, side]
    _write(cluster, point_in[first], chosen_in[cluster], direction_in, reach, min_size, boxes_out)
