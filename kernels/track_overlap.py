"""Generalised overlap in space of two upright boxes in double precision, for use in kernels of tracking."""

from __future__ import annotations

import warp as wp

from . import device  # noqa: F401  (starts Warp quietly)

__all__ = ["Vec7", "giou"]

Vec7 = wp.types.vector(length=7, dtype=wp.float64)


@wp.func_native("""
    // In the frame of a; the second box is clipped by the four edges of the first (Sutherland and Hodgman, 1974).
    const double c = cos(a[6]), s = sin(a[6]), dx = b[0] - a[0], dy = b[1] - a[1];
    const double u = c * dx + s * dy, v = c * dy - s * dx, ct = cos(b[6] - a[6]), st = sin(b[6] - a[6]);
    const double ha = 0.5 * a[3], wa = 0.5 * a[4], hb = 0.5 * b[3], wb = 0.5 * b[4];
    double x[2][12], y[2][12];
    const double ex[4] = {hb, -hb, -hb, hb}, ey[4] = {wb, wb, -wb, -wb};
    double left = -ha, right = ha, low = -wa, high = wa;
    for (int k = 0; k < 4; ++k) {
        x[0][k] = u + ct * ex[k] - st * ey[k];
        y[0][k] = v + st * ex[k] + ct * ey[k];
        left = x[0][k] < left ? x[0][k] : left;
        right = x[0][k] > right ? x[0][k] : right;
        low = y[0][k] < low ? y[0][k] : low;
        high = y[0][k] > high ? y[0][k] : high;
    }
    int count = 4, now = 0;
    for (int side = 0; side < 4 && count > 0; ++side) {
        int kept = 0;
        const int other = 1 - now;
        for (int k = 0; k < count; ++k) {
            const int n = k + 1 < count ? k + 1 : 0;
            const double sign = side & 1 ? -1.0 : 1.0;
            const double p = side < 2 ? ha - sign * x[now][k] : wa - sign * y[now][k];
            const double q = side < 2 ? ha - sign * x[now][n] : wa - sign * y[now][n];
            if (p >= 0.0) {
                x[other][kept] = x[now][k];
                y[other][kept++] = y[now][k];
            }
            if ((p >= 0.0) != (q >= 0.0)) {
                const double t = p / (p - q);
                x[other][kept] = x[now][k] + t * (x[now][n] - x[now][k]);
                y[other][kept++] = y[now][k] + t * (y[now][n] - y[now][k]);
            }
        }
        count = kept;
        now = other;
    }
    double twice = 0.0;
    for (int k = 0; k < count; ++k) {
        const int n = k + 1 < count ? k + 1 : 0;
        twice += x[now][k] * y[now][n] - y[now][k] * x[now][n];
    }
    const double area = 0.5 * (twice < 0.0 ? -twice : twice);
    const double top = a[2] + 0.5 * a[5], floor_a = a[2] - 0.5 * a[5];
    const double top_b = b[2] + 0.5 * b[5], floor_b = b[2] - 0.5 * b[5];
    const double shared = (top < top_b ? top : top_b) - (floor_a > floor_b ? floor_a : floor_b);
    const double volume = shared > 0.0 ? area * shared : 0.0;
    const double both = a[3] * a[4] * a[5] + b[3] * b[4] * b[5] - volume;
    const double body = (right - left) * (high - low)
        * ((top > top_b ? top : top_b) - (floor_a < floor_b ? floor_a : floor_b));
    return volume / both - (body - both) / body;
""")
def giou(a: Vec7, b: Vec7) -> wp.float64:
    """Intersection over union less the share of the enclosing box, along the first one's axes, that neither fills.

    Args:
        a: x y z l w h yaw, of positive size.
        b: Likewise.
    """
