"""What two upright boxes share, and what holds both: the device functions behind `iou.py` and `nms.py`.

The common area of two rectangles is an integral along the edges of one in the frame of the other: by Green's
theorem it is ∮ clamp(x, −a, a) dy over the parts of the edges with |y| ≤ b, for a rectangle of half sizes a, b at
the origin. Nothing is clipped into lists of corners, so edges that coincide need no special case.

The corners of the convex hull of two rectangles come in the order of the eight normals of their sides: between two
of these the outermost corner of each is the same, and one of the two is the hull's.
"""

from __future__ import annotations

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["SHAPE_ROWS", "common_area", "find_near", "generalise_apart", "hull_area", "shape_boxes"]

# What overlaps must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

SHAPE_ROWS = 10
"""Rows of the table that `shape_boxes` fills: x, y, half length, half width, cosine and sine of the yaw, z, half
height, the radius about the corners seen from above, and the volume; the last two are NaN for a box that has none."""

_X, _Y, _A, _B, _C, _S, _Z, _H, _RADIUS, _VOLUME = (wp.constant(row) for row in range(SHAPE_ROWS))


@wp.func_native("return x < low ? low : (x > high ? high : x);")
def _clamped(x: float, low: float, high: float) -> float:
    """Without the care that Warp's own takes of NaN."""


@wp.kernel
def shape_boxes(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    order_in: wp.array(dtype=wp.int32),
    # out
    shapes_out: wp.array2d(dtype=wp.float32),
):
    """What is needed of each box, in the order wanted, if any."""
    i = wp.tid()
    box = int(i)
    if order_in:
        box = order_in[i]
    a = 0.5 * boxes_in[box, 3]
    b = 0.5 * boxes_in[box, 4]
    h = 0.5 * boxes_in[box, 5]
    yaw = boxes_in[box, 6]
    twice = 8.0 * a * b  # the area of two such boxes, which must be a number of float32
    total = boxes_in[box, 0] + boxes_in[box, 1] + twice + yaw
    radius = wp.sqrt(a * a + b * b)
    if not (total - total == 0.0 and a > 0.0 and b > 0.0 and twice > 0.0):
        radius = float(wp.nan)
    shapes_out[_X, i] = boxes_in[box, 0]
    shapes_out[_Y, i] = boxes_in[box, 1]
    shapes_out[_A, i] = a
    shapes_out[_B, i] = b
    shapes_out[_C, i] = wp.cos(yaw)
    shapes_out[_S, i] = wp.sin(yaw)
    shapes_out[_Z, i] = boxes_in[box, 2]
    shapes_out[_H, i] = h
    shapes_out[_RADIUS, i] = radius
    volume = 8.0 * a * b * h
    total += boxes_in[box, 2] + 2.0 * volume
    if not (radius == radius and total - total == 0.0 and h > 0.0 and volume > 0.0):
        volume = float(wp.nan)
    shapes_out[_VOLUME, i] = volume


@wp.func
def _edge_integral(x0: float, y0: float, x1: float, y1: float, a: float, b: float) -> float:
    """∫ clamp(x, −a, a) dy along an edge, over its part with |y| ≤ b."""
    low = _clamped(y0, -b, b)
    high = _clamped(y1, -b, b)
    if low == high:
        return 0.0
    slope = (x1 - x0) / (y1 - y0)
    # Between the ends, which rounding must not leave.
    least = wp.where(x0 < x1, x0, x1)
    most = wp.where(x0 < x1, x1, x0)
    left = _clamped(x0 + (low - y0) * slope, least, most)
    right = _clamped(x0 + (high - y0) * slope, least, most)
    first = wp.where(left < right, left, right)
    last = wp.where(left < right, right, left)
    length = last - first
    mean = _clamped(0.5 * (first + last), -a, a)
    if length > 1.0e-6:
        inner_first = _clamped(first, -a, a)
        inner_last = _clamped(last, -a, a)
        # Shares of the edge left of, right of and within the rectangle.
        below = _clamped(-a - first, 0.0, length)
        above = _clamped(last - a, 0.0, length)
        mean = (a * (above - below) + 0.5 * (inner_first + inner_last) * (inner_last - inner_first)) / length
    return mean * (high - low)


@wp.func
def common_area(shapes: wp.array2d(dtype=wp.float32), i: int, others: wp.array2d(dtype=wp.float32), j: int) -> float:
    """The area that two boxes share, seen from above [m²]; zero, too, for what is no box."""
    dx = others[_X, j] - shapes[_X, i]
    dy = others[_Y, j] - shapes[_Y, i]
    reach = shapes[_RADIUS, i] + others[_RADIUS, j]
    if not (dx * dx + dy * dy < reach * reach):
        return 0.0
    c0 = shapes[_C, i]
    s0 = shapes[_S, i]
    c1 = others[_C, j]
    s1 = others[_S, j]
    u = c0 * dx + s0 * dy
    v = c0 * dy - s0 * dx
    cr = c0 * c1 + s0 * s1
    sr = c0 * s1 - s0 * c1
    a = shapes[_A, i]
    b = shapes[_B, i]
    a1 = others[_A, j]
    b1 = others[_B, j]
    lx = a1 * cr
    ly = a1 * sr
    wx = -b1 * sr
    wy = b1 * cr
    area = _edge_integral(u + lx - wx, v + ly - wy, u + lx + wx, v + ly + wy, a, b)
    area += _edge_integral(u + lx + wx, v + ly + wy, u - lx + wx, v - ly + wy, a, b)
    area += _edge_integral(u - lx + wx, v - ly + wy, u - lx - wx, v - ly - wy, a, b)
    area += _edge_integral(u - lx - wx, v - ly - wy, u + lx - wx, v + ly - wy, a, b)
    smaller = 4.0 * wp.where(a * b < a1 * b1, a * b, a1 * b1)
    return _clamped(area, 0.0, smaller)


# The loops in C++, where a compiler makes vector instructions of them.
@wp.func_native("""
    const long long row = others.strides[0] / 4;
    const float* const at = (const float*)others.data;
    const float *xs = at, *ys = at + row, *radii = at + 8 * row;
    const long long own = shapes.strides[0] / 4;
    const float* const me = (const float*)shapes.data + i;
    const float x = me[0], y = me[own], radius = me[8 * own];
    int* const out = found.data + part * (found.strides[0] / 4);
    int count = 0;
    constexpr int BLOCK = 64;
    for (int start = first; start < last; start += BLOCK) {
        const int length = last - start < BLOCK ? last - start : BLOCK;
        int is_near[BLOCK], any = 0;
        for (int k = 0; k < length; ++k) {
            const float dx = xs[start + k] - x, dy = ys[start + k] - y, reach = radii[start + k] + radius;
            is_near[k] = dx * dx + dy * dy < reach * reach;
            any += is_near[k];
        }
        if (any)
            for (int k = 0; k < length; ++k) {
                out[count] = start + k;
                count += is_near[k];
            }
    }
    return count;
""")
def find_near(
    shapes: wp.array2d(dtype=wp.float32),
    i: int,
    others: wp.array2d(dtype=wp.float32),
    first: int,
    last: int,
    found: wp.array2d(dtype=wp.int32),
    part: int,
) -> int:
    """Lists in a row of `found` which others from `first` to before `last` may touch box i; gives how many."""


_HULL = """
    // One rectangle lies along the axes about the origin; the other's sides are turned into the first quadrant.
    const auto hull_area = [](float a, float b, float u, float v, float l, float w, float cr, float sr) {
        const int across = cr * sr < 0.0f;
        const float rc = cr < 0.0f ? -cr : cr, rs = sr < 0.0f ? -sr : sr;
        const float c = across ? rs : rc, s = across ? rc : rs;
        const float p = across ? w : l, q = across ? l : w;
        const float ex = p * c, ey = p * s, fx = -q * s, fy = q * c;
        // Corners of both that are outermost from one normal to the next, and the normals.
        const float ax[8] = {a, a, -a, -a, -a, -a, a, a}, ay[8] = {b, b, b, b, -b, -b, -b, -b};
        const float bx[8] = {u + ex - fx, u + ex + fx, u + ex + fx, u - ex + fx,
                             u - ex + fx, u - ex - fx, u - ex - fx, u + ex - fx};
        const float by[8] = {v + ey - fy, v + ey + fy, v + ey + fy, v - ey + fy,
                             v - ey + fy, v - ey - fy, v - ey - fy, v + ey - fy};
        const float nx[9] = {1.0f, c, 0.0f, -s, -1.0f, -c, 0.0f, s, 1.0f};
        const float ny[9] = {0.0f, s, 1.0f, c, 0.0f, -s, -1.0f, -c, 0.0f};
        float first_x = 0.0f, first_y = 0.0f, last_x = 0.0f, last_y = 0.0f, twice = 0.0f;
        for (int k = 0; k < 8; ++k) {
            const float dx = bx[k] - ax[k], dy = by[k] - ay[k];
            const int from = nx[k] * dx + ny[k] * dy > 0.0f, to = nx[k + 1] * dx + ny[k + 1] * dy > 0.0f;
            const float from_x = from ? bx[k] : ax[k], from_y = from ? by[k] : ay[k];
            const float to_x = to ? bx[k] : ax[k], to_y = to ? by[k] : ay[k];
            if (k == 0) {
                first_x = from_x;
                first_y = from_y;
            } else {
                twice += last_x * from_y - last_y * from_x;
            }
            twice += from_x * to_y - from_y * to_x;
            last_x = to_x;
            last_y = to_y;
        }
        return 0.5f * (twice + last_x * first_y - last_y * first_x);
    };
    const auto box_area = [](float a, float b, float u, float v, float l, float w, float cr, float sr) {
        const float c = cr < 0.0f ? -cr : cr, s = sr < 0.0f ? -sr : sr;
        const float reach_x = l * c + w * s, reach_y = l * s + w * c;
        const float right = a > u + reach_x ? a : u + reach_x, left = -a < u - reach_x ? -a : u - reach_x;
        const float top = b > v + reach_y ? b : v + reach_y, bottom = -b < v - reach_y ? -b : v - reach_y;
        return (right - left) * (top - bottom);
    };
    const long long own = shapes.strides[0] / 4, row = others.strides[0] / 4;
    const float* const me = (const float*)shapes.data + i;
    const float x0 = me[0], y0 = me[own], a0 = me[2 * own], b0 = me[3 * own], c0 = me[4 * own], s0 = me[5 * own];
    const auto enclosing = [&](const float* other, const auto& area) {
        const float dx = other[0] - x0, dy = other[row] - y0, c1 = other[4 * row], s1 = other[5 * row];
        return area(a0, b0, c0 * dx + s0 * dy, c0 * dy - s0 * dx, other[2 * row], other[3 * row],
                    c0 * c1 + s0 * s1, c0 * s1 - s0 * c1);
    };
    const float* const they = (const float*)others.data;
"""


@wp.func_native(_HULL + "return as_box ? enclosing(they + j, box_area) : enclosing(they + j, hull_area);")
def hull_area(
    shapes: wp.array2d(dtype=wp.float32), i: int, others: wp.array2d(dtype=wp.float32), j: int, as_box: bool
) -> float:
    """The area of the convex hull of two boxes, or of the rectangle along the first that holds both [m²]."""


@wp.func_native(
    _HULL
    + """
    float* const out = (float*)giou.data + i * (giou.strides[0] / 4);
    const float z = me[6 * own], h = me[7 * own], volume = me[9 * own];
    const auto generalise = [&](const auto& area) {
        for (int j = 0; j < count; ++j) {
            const float dz = they[6 * row + j] - z, other_h = they[7 * row + j];
            const float low = -h < dz - other_h ? -h : dz - other_h, high = h > dz + other_h ? h : dz + other_h;
            const float both = volume + they[9 * row + j];
            float body = enclosing(they + j, area) * (high - low);
            body = body > both ? body : both;
            const float apart = 0.0f - (body - both) / body;
            out[j] = apart == apart ? apart : -1.0f;
        }
    };
    if (as_box)
        generalise(box_area);
    else
        generalise(hull_area);
    return count;
"""
)
def generalise_apart(
    shapes: wp.array2d(dtype=wp.float32),
    i: int,
    others: wp.array2d(dtype=wp.float32),
    count: int,
    as_box: bool,
    giou: wp.array2d(dtype=wp.float32),
) -> int:
    """Generalised intersection over union of one box with others as if they did not touch: row i of `giou`."""
