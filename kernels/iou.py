"""Overlap of oriented boxes: intersection over union from above and in space, all of one set with all of another.

The common area of two rectangles is an integral along the edges of one in the frame of the other: by Green's
theorem it is ∮ clamp(x, −a, a) dy over the parts of the edges with |y| ≤ b, for a rectangle of half sizes a, b at
the origin. Nothing is clipped into lists of corners, so edges that coincide need no special case.

Generalised intersection over union (Rezatofighi et al., 2019) also tells apart boxes that do not touch: it takes away
the share of an enclosing body that neither fills.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from .device import resolve_device
from .interop import borrow, family_of, give
from .plan import capacity_for, plan_for

__all__ = ["GeneralizedIou", "RotatedIou", "bev_intersection", "giou_3d", "iou_3d", "rotated_iou_bev"]

_ENCLOSINGS = ("hull", "box")
_HULL = wp.constant(0)
_Eight = wp.types.vector(length=8, dtype=wp.float32)


@wp.func
def _edge_integral(x0: float, y0: float, x1: float, y1: float, a: float, b: float) -> float:
    """∫ clamp(x, −a, a) dy along an edge, over its part with |y| ≤ b."""
    low = wp.clamp(y0, -b, b)
    high = wp.clamp(y1, -b, b)
    if low == high:
        return 0.0
    slope = (x1 - x0) / (y1 - y0)
    # Between the ends, which rounding must not leave.
    left = wp.clamp(x0 + (low - y0) * slope, wp.min(x0, x1), wp.max(x0, x1))
    right = wp.clamp(x0 + (high - y0) * slope, wp.min(x0, x1), wp.max(x0, x1))
    first = wp.min(left, right)
    last = wp.max(left, right)
    length = last - first
    mean = wp.clamp(0.5 * (first + last), -a, a)
    if length > 1.0e-6:
        below = wp.max(wp.min(last, -a) - first, 0.0)
        above = wp.max(last - wp.max(first, a), 0.0)
        inner_first = wp.clamp(first, -a, a)
        inner_last = wp.clamp(last, -a, a)
        mean = (a * (above - below) + 0.5 * (inner_first + inner_last) * (inner_last - inner_first)) / length
    return mean * (high - low)


@wp.func
def bev_intersection(
    x0: float,
    y0: float,
    l0: float,
    w0: float,
    yaw0: float,
    x1: float,
    y1: float,
    l1: float,
    w1: float,
    yaw1: float,
) -> float:
    """The area common to two rectangles [m²], each centre x y, length, width and yaw."""
    dx = x1 - x0
    dy = y1 - y0
    reach = 0.5 * (wp.sqrt(l0 * l0 + w0 * w0) + wp.sqrt(l1 * l1 + w1 * w1))
    # Written so that a NaN ends here too.
    if not (dx * dx + dy * dy < reach * reach):
        return 0.0
    c = wp.cos(yaw0)
    s = wp.sin(yaw0)
    u = c * dx + s * dy
    v = c * dy - s * dx
    cr = wp.cos(yaw1 - yaw0)
    sr = wp.sin(yaw1 - yaw0)
    lx = 0.5 * l1 * cr
    ly = 0.5 * l1 * sr
    wx = -0.5 * w1 * sr
    wy = 0.5 * w1 * cr
    a = 0.5 * l0
    b = 0.5 * w0
    area = _edge_integral(u + lx - wx, v + ly - wy, u + lx + wx, v + ly + wy, a, b)
    area += _edge_integral(u + lx + wx, v + ly + wy, u - lx + wx, v - ly + wy, a, b)
    area += _edge_integral(u - lx + wx, v - ly + wy, u - lx - wx, v - ly - wy, a, b)
    area += _edge_integral(u - lx - wx, v - ly - wy, u + lx - wx, v + ly - wy, a, b)
    return wp.clamp(area, 0.0, wp.min(l0 * w0, l1 * w1))


@wp.kernel
def _iou_matrix(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    # out
    bev_out: wp.array2d(dtype=wp.float32),
    space_out: wp.array2d(dtype=wp.float32),
):
    """One pair a thread: intersection over union from above and in space."""
    i, j = wp.tid()  # pyright: ignore[reportAssignmentType]
    if i >= counts_in[0] or j >= counts_in[1]:
        return
    l0 = boxes_in[i, 3]
    w0 = boxes_in[i, 4]
    h0 = boxes_in[i, 5]
    l1 = others_in[j, 3]
    w1 = others_in[j, 4]
    h1 = others_in[j, 5]
    area = bev_intersection(
        boxes_in[i, 0],
        boxes_in[i, 1],
        l0,
        w0,
        boxes_in[i, 6],
        others_in[j, 0],
        others_in[j, 1],
        l1,
        w1,
        others_in[j, 6],
    )
    bev = float(0.0)
    space = float(0.0)
    if area > 0.0:
        bev = area / (l0 * w0 + l1 * w1 - area)
        z0 = boxes_in[i, 2]
        z1 = others_in[j, 2]
        top = wp.min(z0 + 0.5 * h0, z1 + 0.5 * h1)
        bottom = wp.max(z0 - 0.5 * h0, z1 - 0.5 * h1)
        volume = area * wp.max(top - bottom, 0.0)
        if volume > 0.0:
            space = volume / (l0 * w0 * h0 + l1 * w1 * h1 - volume)
    bev_out[i, j] = bev
    space_out[i, j] = space


@wp.func
def _hull_area(x_in: _Eight, y_in: _Eight) -> float:
    """The area of the convex hull of eight points: its upper chain less its lower one (Andrew, 1979)."""
    x = _Eight(x_in)
    y = _Eight(y_in)
    for i in range(1, 8):
        px = x[i]
        py = y[i]
        k = int(i)
        while k > 0 and (x[wp.max(k - 1, 0)] > px or (x[wp.max(k - 1, 0)] == px and y[wp.max(k - 1, 0)] > py)):
            x[k] = x[k - 1]
            y[k] = y[k - 1]
            k -= 1
        x[k] = px
        y[k] = py
    area = float(0.0)
    for chain in range(2):
        sign = 1.0 - 2.0 * float(chain)
        hx = _Eight()
        hy = _Eight()
        size = int(0)
        for i in range(8):
            turning = int(1)
            while size > 1 and turning == 1:
                ax = hx[size - 1] - hx[size - 2]
                ay = hy[size - 1] - hy[size - 2]
                bx = x[i] - hx[size - 2]
                by = y[i] - hy[size - 2]
                if sign * (ax * by - ay * bx) >= 0.0:
                    size -= 1
                else:
                    turning = 0
            hx[size] = x[i]
            hy[size] = y[i]
            size += 1
        for i in range(1, size):
            area += sign * 0.5 * (hy[i] + hy[i - 1]) * (hx[i] - hx[i - 1])
    return area


@wp.func
def _enclosing_area(
    x0: float,
    y0: float,
    l0: float,
    w0: float,
    yaw0: float,
    x1: float,
    y1: float,
    l1: float,
    w1: float,
    yaw1: float,
    enclosing: int,
) -> float:
    """The area of the convex hull of two rectangles, or of the rectangle along the first that holds both."""
    c = wp.cos(yaw0)
    s = wp.sin(yaw0)
    u = c * (x1 - x0) + s * (y1 - y0)
    v = c * (y1 - y0) - s * (x1 - x0)
    cr = wp.cos(yaw1 - yaw0)
    sr = wp.sin(yaw1 - yaw0)
    lx = 0.5 * l1 * cr
    ly = 0.5 * l1 * sr
    wx = -0.5 * w1 * sr
    wy = 0.5 * w1 * cr
    a = 0.5 * l0
    b = 0.5 * w0
    if enclosing == _HULL:
        x = _Eight(a, -a, -a, a, u + lx + wx, u - lx + wx, u - lx - wx, u + lx - wx)
        y = _Eight(b, b, -b, -b, v + ly + wy, v - ly + wy, v - ly - wy, v + ly - wy)
        return _hull_area(x, y)
    reach_x = wp.abs(lx) + wp.abs(wx)
    reach_y = wp.abs(ly) + wp.abs(wy)
    length = wp.max(a, u + reach_x) - wp.min(-a, u - reach_x)
    return length * (wp.max(b, v + reach_y) - wp.min(-b, v - reach_y))


@wp.func
def _has_volume(boxes: wp.array2d(dtype=wp.float32), i: int) -> bool:
    total = float(0.0)
    for column in range(7):
        total += wp.abs(boxes[i, column])  # a sum, which is not finite if one of its terms is not
    return wp.isfinite(total) and boxes[i, 3] > 0.0 and boxes[i, 4] > 0.0 and boxes[i, 5] > 0.0


@wp.kernel
def _giou_matrix(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    enclosing: int,
    # out
    giou_out: wp.array2d(dtype=wp.float32),
):
    """One pair a thread: generalised intersection over union in space."""
    i, j = wp.tid()  # pyright: ignore[reportAssignmentType]
    if i >= counts_in[0] or j >= counts_in[1]:
        return
    giou_out[i, j] = -1.0
    if not (_has_volume(boxes_in, i) and _has_volume(others_in, j)):
        return
    x0 = boxes_in[i, 0]
    y0 = boxes_in[i, 1]
    z0 = boxes_in[i, 2]
    l0 = boxes_in[i, 3]
    w0 = boxes_in[i, 4]
    h0 = boxes_in[i, 5]
    yaw0 = boxes_in[i, 6]
    x1 = others_in[j, 0]
    y1 = others_in[j, 1]
    z1 = others_in[j, 2]
    l1 = others_in[j, 3]
    w1 = others_in[j, 4]
    h1 = others_in[j, 5]
    yaw1 = others_in[j, 6]
    area = bev_intersection(x0, y0, l0, w0, yaw0, x1, y1, l1, w1, yaw1)
    # Heights against the first box's, so that boxes far from z = 0 lose nothing.
    dz = z1 - z0
    low = wp.min(-0.5 * h0, dz - 0.5 * h1)
    high = wp.max(0.5 * h0, dz + 0.5 * h1)
    shared = wp.max(wp.min(0.5 * h0, dz + 0.5 * h1) - wp.max(-0.5 * h0, dz - 0.5 * h1), 0.0)
    volume = area * shared
    union = l0 * w0 * h0 + l1 * w1 * h1 - volume
    # Rounding must not make the enclosing body smaller than what it holds.
    body = wp.max(_enclosing_area(x0, y0, l0, w0, yaw0, x1, y1, l1, w1, yaw1, enclosing) * (high - low), union)
    giou_out[i, j] = volume / union - (body - union) / body


@dataclass(frozen=True, kw_only=True)
class RotatedIou:
    """A plan: overlaps of up to `rows` boxes with up to `columns` others.

    Attributes:
        bev: Intersection over union from above, shape (rows, columns), float32; entries past the counts are stale.
        space: The same in space.
    """

    rows: int
    """Boxes of the first set that one launch can take."""
    columns: int
    """Boxes of the second set."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"rows and columns must be at least 1, not {self.rows} and {self.columns}")
        device = resolve_device(self.device)
        for name in ("bev", "space"):
            matrix = wp.zeros((self.rows, self.columns), dtype=wp.float32, device=device)
            object.__setattr__(self, name, matrix)

    def launch(self, boxes: wp.array, others: wp.array, counts: wp.array) -> None:
        """Fills `bev` and `space` for the first `counts[0]` of `boxes` and the first `counts[1]` of `others`.

        Args:
            boxes: Shape (n, 7), float32: x y z l w h yaw, n ≤ rows.
            others: Shape (m, 7), float32, m ≤ columns.
            counts: Shape (2,), int32, on the device.
        """
        _check_fits(self, boxes, others)
        wp.launch(
            _iou_matrix,
            (boxes.shape[0], others.shape[0]),
            inputs=[boxes, others, counts],
            outputs=[self.bev, self.space],
            device=self.bev.device,
        )


@dataclass(frozen=True, kw_only=True)
class GeneralizedIou:
    """A plan: generalised overlaps in space of up to `rows` boxes with up to `columns` others.

    Attributes:
        giou: Generalised intersection over union, −1 to 1, shape (rows, columns), float32; entries past the counts are
            stale.
    """

    rows: int
    """Boxes of the first set that one launch can take."""
    columns: int
    """Boxes of the second set."""
    enclosing: str = "hull"
    """The enclosing body, upright: `hull`, the smallest convex one; `box`, the box along that of the first set."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"rows and columns must be at least 1, not {self.rows} and {self.columns}")
        if self.enclosing not in _ENCLOSINGS:
            raise ValueError(f"enclosing must be one of {', '.join(_ENCLOSINGS)}, not {self.enclosing!r}")
        matrix = wp.zeros((self.rows, self.columns), dtype=wp.float32, device=resolve_device(self.device))
        object.__setattr__(self, "giou", matrix)

    def launch(self, boxes: wp.array, others: wp.array, counts: wp.array) -> None:
        """Fills `giou` for the first `counts[0]` of `boxes` and the first `counts[1]` of `others`.

        Args:
            boxes: Shape (n, 7), float32: x y z l w h yaw, n ≤ rows.
            others: Shape (m, 7), float32, m ≤ columns.
            counts: Shape (2,), int32, on the device.
        """
        _check_fits(self, boxes, others)
        wp.launch(
            _giou_matrix,
            (boxes.shape[0], others.shape[0]),
            inputs=[boxes, others, counts, _ENCLOSINGS.index(self.enclosing)],
            outputs=[self.giou],
            device=self.giou.device,
        )


def _check_fits(plan: RotatedIou | GeneralizedIou, boxes: wp.array, others: wp.array) -> None:
    if boxes.shape[0] > plan.rows or others.shape[0] > plan.columns:
        raise ValueError(
            f"{boxes.shape[0]} boxes with {others.shape[0]} others are more than the plan's "
            f"{plan.rows} × {plan.columns}"
        )


def _matrix(a: Any, b: Any, which: str, plan_class: type = RotatedIou, **configuration: Any) -> Any:
    family = family_of(a, "a")
    boxes, owner = borrow(a, wp.float32, (None, 7), "a")
    others, other_owner = borrow(b, wp.float32, (None, 7), "b")
    if str(boxes.device) != str(others.device):
        raise ValueError(f"a is on {boxes.device} and b on {others.device}; both must be on one device")
    n, m = boxes.shape[0], others.shape[0]
    if n == 0 or m == 0:
        return give(wp.zeros((n, m), dtype=wp.float32, device=boxes.device), family)
    plan = plan_for(
        plan_class,
        rows=capacity_for(n) if n > 64 else 64,
        columns=capacity_for(m) if m > 64 else 64,
        device=family.device,
        **configuration,
    )
    plan.launch(boxes, others, wp.array([n, m], dtype=wp.int32, device=boxes.device))
    result = give(getattr(plan, which)[:n, :m].contiguous(), family)
    del owner, other_owner
    return result


def rotated_iou_bev(a: Any, b: Any) -> Any:
    """Intersection over union from above, of every box of one set with every box of another.

    Args:
        a: Boxes, shape (n, 7): x y z l w h [m], yaw [rad]; any array family.
        b: Boxes, shape (m, 7), on the same device.

    Returns:
        Shape (n, m), float32, of the family of `a`. A box that is not finite, or of no area, overlaps nothing.

    Raises:
        ValueError: A shape is not (n, 7), or the devices differ.
    """
    return _matrix(a, b, "bev")


def iou_3d(a: Any, b: Any) -> Any:
    """Intersection over union in space; the boxes stand upright.

    Args:
        a: Boxes, shape (n, 7): x y z l w h [m], yaw [rad]; any array family.
        b: Boxes, shape (m, 7), on the same device.

    Returns:
        Shape (n, m), float32, of the family of `a`.

    Raises:
        ValueError: A shape is not (n, 7), or the devices differ.
    """
    return _matrix(a, b, "space")


def giou_3d(a: Any, b: Any, *, enclosing: str = "hull") -> Any:
    """Generalised intersection over union in space (Rezatofighi et al., 2019); the boxes stand upright.

    IoU − (V − U) / V, with the volume U of the union and V of a body that encloses both: 1 for equal boxes, 0 for
    boxes that fill their enclosure without overlap, towards −1 the further apart they are.

    Args:
        a: Boxes, shape (n, 7): x y z l w h [m], yaw [rad]; any array family.
        b: Boxes, shape (m, 7), on the same device.
        enclosing: The enclosing body, upright: `hull`, the smallest convex one, as in the paper; `box`, the box along
            that of `a` (`models.geometry.box_overlap`), which is cheaper.

    Returns:
        Shape (n, m), float32, of the family of `a`. A box that is not finite, or of no volume, is −1 to all.

    Raises:
        ValueError: A shape is not (n, 7), the devices differ, or there is no such enclosing body.
    """
    if enclosing not in _ENCLOSINGS:
        raise ValueError(f"enclosing must be one of {', '.join(_ENCLOSINGS)}, not {enclosing!r}")
    return _matrix(a, b, "giou", GeneralizedIou, enclosing=enclosing)
