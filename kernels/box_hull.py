"""The box of least area around a cluster: exact, from the corners of its convex hull. See `boxes.py`.

One side of the rectangle of least area lies along a side of the convex hull (Freeman and Shapira, 1975). Hulls are
found by Quickhull (Eddy, 1977), first of runs of points, wherever those lie in clusters, then of what is left of each
cluster.
"""

from __future__ import annotations

import warp as wp

from .box_extent import Extent, write_box
from .device import module_apart

__all__ = ["RUN", "find_hulls", "find_hulls_in_parts", "fit_hulls", "fit_hulls_in_parts"]

# Which of two like sides wins must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})
_APART = module_apart(__name__, fuse_fp=False)

RUN = wp.constant(128)
"""Points of a run."""

_Side = wp.types.vector(length=6, dtype=wp.float32)  # cosine, sine; ahead, behind, to the left, to the right


@wp.func_native("""
    struct Point { float x, y; };
    struct Pending { int begin, end, farthest; float x, y; };
    Point* const points = (Point*)flat.data + first;
    Point* const corners = (Point*)corner.data + first;
    Pending* const waiting = (Pending*)pending.data + first;
    if (size == 0)
        return 0;
    // From the left end to the right end and back.
    Point a = points[0], b = points[0];
    for (int i = 1; i < size; ++i) {
        const Point p = points[i];
        if (p.x < a.x || (p.x == a.x && p.y < a.y)) a = p;
        if (p.x > b.x || (p.x == b.x && p.y > b.y)) b = p;
    }
    corners[0] = a;
    if (a.x == b.x && a.y == b.y) {
        points[0] = a;
        return 1;
    }
    // How far a point is to the right of a line, as a multiple.
    const auto beyond = [](const Point p, const Point q, const Point r) {
        return (r.x - p.x) * (q.y - p.y) - (r.y - p.y) * (q.x - p.x);
    };
    int begin = 0, end = 0, farthest = 0, waiting_count = 1, count = 1;
    Point p = a, q = b;
    {
        int back = size, back_farthest = 0;
        float most = 0.0f, back_most = 0.0f;
        for (int i = 0; i < back;) {
            const Point r = points[i];
            const float off = beyond(a, b, r);
            if (off > 0.0f) {
                if (off > most) { most = off; farthest = end; }
                points[end++] = r;
                ++i;
            } else if (off < 0.0f) {
                points[i] = points[--back];
                points[back] = r;
                if (-off > back_most) { back_most = -off; back_farthest = back; }
            } else {
                ++i;
            }
        }
        waiting[0] = {back, size, back_farthest, a.x, a.y};
    }
    while (true) {
        if (begin == end) {  // nothing lies beyond the line from p to q: a side of the hull
            if (waiting_count == 0)
                break;
            corners[count++] = q;
            p = q;
            const Pending next = waiting[--waiting_count];
            begin = next.begin;
            end = next.end;
            farthest = next.farthest;
            q.x = next.x;
            q.y = next.y;
            continue;
        }
        // The farthest point is a corner; what is beyond the lines to it goes to the front and to the back.
        const Point c = points[farthest];
        int front = begin, back = end, back_farthest = 0;
        float most = 0.0f, back_most = 0.0f;
        farthest = begin;
        for (int i = begin; i < back;) {
            const Point r = points[i];
            const float off = beyond(p, c, r);
            if (off > 0.0f) {
                if (off > most) { most = off; farthest = front; }
                points[front++] = r;
                ++i;
                continue;
            }
            const float other = beyond(c, q, r);
            if (other > 0.0f) {
                points[i] = points[--back];
                points[back] = r;
                if (other > back_most) { back_most = other; back_farthest = back; }
            } else {
                ++i;
            }
        }
        waiting[waiting_count++] = {back, end, back_farthest, q.x, q.y};
        end = front;
        q = c;
    }
    for (int i = 0; i < count; ++i) points[i] = corners[i];
    return count;
""")
def _hull_of(
    flat: wp.array(dtype=wp.vec2),
    first: int,
    size: int,
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
) -> int:
    """Moves the corners of points' convex hull to the front, counter-clockwise; gives how many there are."""


@wp.func_native("""
    const float* const corners = (const float*)flat.data + 2 * first;
    constexpr int LANES = 8;
    wp::vec_t<6, wp::float32> best(0.0f);
    best[0] = 1.0f;
    float least = INFINITY;
    for (int side = 0; side < count; side += LANES) {
        float c[LANES], s[LANES], low_x[LANES], high_x[LANES], low_y[LANES], high_y[LANES];
        for (int lane = 0; lane < LANES; ++lane) {
            const int from = side + lane < count ? side + lane : 0, to = from + 1 < count ? from + 1 : 0;
            const float dx = corners[2 * to] - corners[2 * from], dy = corners[2 * to + 1] - corners[2 * from + 1];
            const float length = sqrtf(dx * dx + dy * dy);
            c[lane] = length > 0.0f ? dx / length : 1.0f;
            s[lane] = length > 0.0f ? dy / length : 0.0f;
            low_x[lane] = low_y[lane] = high_x[lane] = high_y[lane] = 0.0f;
        }
        for (int k = 0; k < count; ++k) {
            const float x = corners[2 * k], y = corners[2 * k + 1];
            for (int lane = 0; lane < LANES; ++lane) {
                const float along = c[lane] * x + s[lane] * y, across = c[lane] * y - s[lane] * x;
                low_x[lane] = along < low_x[lane] ? along : low_x[lane];
                high_x[lane] = along > high_x[lane] ? along : high_x[lane];
                low_y[lane] = across < low_y[lane] ? across : low_y[lane];
                high_y[lane] = across > high_y[lane] ? across : high_y[lane];
            }
        }
        for (int lane = 0; lane < LANES && side + lane < count; ++lane) {
            const float area = (high_x[lane] - low_x[lane]) * (high_y[lane] - low_y[lane]);
            if (area < least) {
                least = area;
                best[0] = c[lane];
                best[1] = s[lane];
                best[2] = high_x[lane];
                best[3] = -low_x[lane];
                best[4] = high_y[lane];
                best[5] = -low_y[lane];
            }
        }
    }
    return best;
""")
def _best_side(flat: wp.array(dtype=wp.vec2), first: int, count: int) -> _Side:
    """The side of a hull along which a rectangle around it, and around the origin, has the least area."""


@wp.func
def _find_hulls_of_run(
    run: int,
    clusters: int,
    point: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.int32),
    flat: wp.array(dtype=wp.vec2),
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    corner_count: wp.array(dtype=wp.int32),
    height: wp.array(dtype=wp.vec2),
):
    """The hulls of what lies of each cluster in a run, relative to the cluster's first point."""
    begin = run * RUN
    end = wp.min(begin + RUN, start[clusters])
    # The cluster of the first point: the last that begins there or before.
    cluster = int(0)
    high = int(clusters)
    while cluster + 1 < high:
        middle = (cluster + high) / 2
        if start[middle] <= begin:
            cluster = middle
        else:
            high = middle
    first = int(begin)
    while first < end:
        while start[cluster + 1] <= first:
            cluster += 1
        last = wp.min(start[cluster + 1], end)
        origin = point[start[cluster]]
        low = float(0.0)
        top = float(0.0)
        for k in range(first, last):
            p = point[k] - origin
            flat[k] = wp.vec2(p[0], p[1])
            low = wp.where(p[2] < low, p[2], low)
            top = wp.where(p[2] > top, p[2], top)
        height[first] = wp.vec2(top, -low)
        corner_count[first] = _hull_of(flat, first, last - first, corner, pending)
        first = last


@wp.kernel(module=_APART)
def find_hulls(
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    # in out: workspace
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    # out: at the first point of each cluster in a run
    flat_out: wp.array(dtype=wp.vec2),
    corner_count_out: wp.array(dtype=wp.int32),
    height_out: wp.array(dtype=wp.vec2),
):
    """One run a thread."""
    _find_hulls_of_run(
        wp.tid(), start_in.shape[0] - 1, point_in, start_in, flat_out, corner, pending, corner_count_out, height_out
    )


@wp.kernel
def find_hulls_in_parts(
    part: int,
    parts: int,
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    # in out: workspace
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    # out: at the first point of each cluster in a run
    flat_out: wp.array(dtype=wp.vec2),
    corner_count_out: wp.array(dtype=wp.int32),
    height_out: wp.array(dtype=wp.vec2),
):
    """Every so many runs."""
    clusters = start_in.shape[0] - 1
    for run in range(part, (start_in[clusters] + RUN - 1) / RUN, parts):
        _find_hulls_of_run(run, clusters, point_in, start_in, flat_out, corner, pending, corner_count_out, height_out)


@wp.func
def _fit_hull(
    cluster: int,
    point: wp.array(dtype=wp.vec3),
    start: wp.array(dtype=wp.int32),
    min_size: float,
    flat: wp.array(dtype=wp.vec2),
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    corner_count: wp.array(dtype=wp.int32),
    height: wp.array(dtype=wp.vec2),
    boxes: wp.array2d(dtype=wp.float32),
):
    """Joins the hulls of a cluster's runs, and writes its box."""
    first = start[cluster]
    last = start[cluster + 1]
    if first == last:
        for column in range(7):
            boxes[cluster, column] = wp.nan
        return
    count = corner_count[first]
    reach = height[first]
    run = int((first / RUN + 1) * RUN)
    if run < last:
        while run < last:
            for k in range(corner_count[run]):
                flat[first + count + k] = flat[run + k]
            count += corner_count[run]
            reach = wp.max(reach, height[run])
            run += RUN
        count = _hull_of(flat, first, count, corner, pending)
    side = _best_side(flat, first, count)
    c = side[0]
    s = side[1]
    ahead = wp.vec4(side[2], side[3], side[4], side[5])
    for _ in range(3):  # quarter turns, into the first quadrant
        if not (c > 0.0 and s >= 0.0):
            turned = -c
            c = s
            s = turned
            ahead = wp.vec4(ahead[3], ahead[2], ahead[0], ahead[1])
    extent = Extent(ahead[0], ahead[1], ahead[2], ahead[3], reach[0], reach[1])
    write_box(cluster, point[first], c, s, wp.atan2(s, c), extent, min_size, boxes)


@wp.kernel(module=_APART)
def fit_hulls(
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    min_size: float,
    # in out: the hulls of runs, and workspace
    flat: wp.array(dtype=wp.vec2),
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    corner_count: wp.array(dtype=wp.int32),
    height: wp.array(dtype=wp.vec2),
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """One cluster a thread."""
    _fit_hull(wp.tid(), point_in, start_in, min_size, flat, corner, pending, corner_count, height, boxes_out)


@wp.kernel
def fit_hulls_in_parts(
    part: int,
    parts: int,
    # in
    point_in: wp.array(dtype=wp.vec3),
    start_in: wp.array(dtype=wp.int32),
    min_size: float,
    # in out: the hulls of runs, and workspace
    flat: wp.array(dtype=wp.vec2),
    corner: wp.array(dtype=wp.vec2),
    pending: wp.array2d(dtype=wp.float32),
    corner_count: wp.array(dtype=wp.int32),
    height: wp.array(dtype=wp.vec2),
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
):
    """Every so many clusters."""
    for cluster in range(part, start_in.shape[0] - 1, parts):
        _fit_hull(cluster, point_in, start_in, min_size, flat, corner, pending, corner_count, height, boxes_out)
