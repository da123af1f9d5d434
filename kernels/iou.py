"""Overlap of oriented boxes: intersection over union from above and in space, all of one set with all of another.

Generalised intersection over union (Rezatofighi et al., 2019) also tells apart boxes that do not touch: it takes away
the share of an enclosing body that neither fills.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import warp as wp

from .box_overlap import SHAPE_ROWS, common_area, find_near, generalise_apart, hull_area, shape_boxes
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow, family_of, give
from .plan import capacity_for, plan_for
from .threads import launch_parts, thread_count

__all__ = ["GeneralizedIou", "RotatedIou", "giou_3d", "iou_3d", "rotated_iou_bev"]

# What overlaps must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_ENCLOSINGS = ("hull", "box")
# Pairs for which a thread of their own is worth its while.
_PAIRS_OF_PART, _GENERALISED_OF_PART = 100_000, 5_000
_A, _B, _Z, _H, _VOLUME = (wp.constant(row) for row in (2, 3, 6, 7, 9))


@wp.func
def _area(shapes: wp.array2d(dtype=wp.float32), i: int) -> float:
    return 4.0 * shapes[_A, i] * shapes[_B, i]


@wp.func
def _shared_height(shapes: wp.array2d(dtype=wp.float32), i: int, others: wp.array2d(dtype=wp.float32), j: int) -> float:
    """Heights against the first box's, so that boxes far from z = 0 lose nothing."""
    dz = others[_Z, j] - shapes[_Z, i]
    top = wp.min(shapes[_H, i], dz + others[_H, j])
    return top - wp.max(-shapes[_H, i], dz - others[_H, j])


@wp.func
def _overlap(shapes: wp.array2d(dtype=wp.float32), i: int, others: wp.array2d(dtype=wp.float32), j: int) -> wp.vec2:
    """Intersection over union from above and in space."""
    area = common_area(shapes, i, others, j)
    bev = float(0.0)
    space = float(0.0)
    if area > 0.0:
        bev = area / (_area(shapes, i) + _area(others, j) - area)
        volume = area * _shared_height(shapes, i, others, j)
        union = shapes[_VOLUME, i] + others[_VOLUME, j] - volume
        if volume > 0.0 and union > 0.0:  # neither, if one has no volume
            space = volume / union
    return wp.vec2(bev, space)


@wp.kernel
def _iou_matrix(
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    # out
    bev_out: wp.array2d(dtype=wp.float32),
    space_out: wp.array2d(dtype=wp.float32),
):
    """One pair a thread."""
    i, j = wp.tid()  # pyright: ignore[reportAssignmentType]
    if i >= counts_in[0] or j >= counts_in[1]:
        return
    both = _overlap(shapes_in, i, others_in, j)
    bev_out[i, j] = both[0]
    space_out[i, j] = both[1]


@wp.kernel
def _iou_rows(
    part: int,
    parts: int,
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    rows: int,
    columns: int,
    is_clear: bool,
    # in out: room for the boxes near one
    near: wp.array2d(dtype=wp.int32),
    # out: either may be missing
    bev_out: wp.array2d(dtype=wp.float32),
    space_out: wp.array2d(dtype=wp.float32),
):
    """Every so many rows; only pairs that may touch are looked at, the others are zero."""
    last = wp.min(counts_in[1], columns)
    for i in range(part, wp.min(counts_in[0], rows), parts):
        if not is_clear:
            for j in range(last):
                if bev_out:
                    bev_out[i, j] = 0.0
                if space_out:
                    space_out[i, j] = 0.0
        for k in range(find_near(shapes_in, i, others_in, 0, last, near, part)):
            j = near[part, k]
            both = _overlap(shapes_in, i, others_in, j)
            if bev_out:
                bev_out[i, j] = both[0]
            if space_out:
                space_out[i, j] = both[1]


@wp.func
def _generalised(
    shapes: wp.array2d(dtype=wp.float32),
    i: int,
    others: wp.array2d(dtype=wp.float32),
    j: int,
    area: float,
    enclosing_area: float,
) -> float:
    """Generalised intersection over union, given the area shared and that which holds both; -1 without volumes."""
    dz = others[_Z, j] - shapes[_Z, i]
    low = wp.where(-shapes[_H, i] < dz - others[_H, j], -shapes[_H, i], dz - others[_H, j])
    high = wp.where(shapes[_H, i] > dz + others[_H, j], shapes[_H, i], dz + others[_H, j])
    volume = float(0.0)
    if area > 0.0:
        volume = area * wp.max(_shared_height(shapes, i, others, j), 0.0)
    union = shapes[_VOLUME, i] + others[_VOLUME, j] - volume
    # Rounding must not make the enclosing body smaller than what it holds.
    body = enclosing_area * (high - low)
    body = wp.where(body > union, body, union)
    giou = volume / union - (body - union) / body
    return wp.where(giou == giou, giou, -1.0)


@wp.kernel
def _giou_matrix(
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    as_box: bool,
    # out
    giou_out: wp.array2d(dtype=wp.float32),
):
    """One pair a thread."""
    i, j = wp.tid()  # pyright: ignore[reportAssignmentType]
    if i < counts_in[0] and j < counts_in[1]:
        area = common_area(shapes_in, i, others_in, j)
        around = hull_area(shapes_in, i, others_in, j, as_box)
        giou_out[i, j] = _generalised(shapes_in, i, others_in, j, area, around)


@wp.kernel
def _giou_rows(
    part: int,
    parts: int,
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    others_in: wp.array2d(dtype=wp.float32),
    counts_in: wp.array(dtype=wp.int32),
    as_box: bool,
    rows: int,
    columns: int,
    # in out: room for the boxes near one
    near: wp.array2d(dtype=wp.int32),
    # out
    giou_out: wp.array2d(dtype=wp.float32),
):
    """Every so many rows: first all pairs as if they did not touch, then those that may."""
    last = wp.min(counts_in[1], columns)
    for i in range(part, wp.min(counts_in[0], rows), parts):
        generalise_apart(shapes_in, i, others_in, last, as_box, giou_out)
        for k in range(find_near(shapes_in, i, others_in, 0, last, near, part)):
            j = near[part, k]
            area = common_area(shapes_in, i, others_in, j)
            around = hull_area(shapes_in, i, others_in, j, as_box)
            giou_out[i, j] = _generalised(shapes_in, i, others_in, j, area, around)


@dataclass(frozen=True, kw_only=True)
class _Pairs:
    """Workspace for pairs of up to `rows` boxes with up to `columns` others."""

    rows: int
    columns: int
    device: str = DEFAULT_DEVICE

    def __post_init__(self):
        if self.rows < 1 or self.columns < 1:
            raise ValueError(f"rows and columns must be at least 1, not {self.rows} and {self.columns}")
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("shapes", wp.zeros((SHAPE_ROWS, self.rows), dtype=wp.float32, device=device))
        keep("other_shapes", wp.zeros((SHAPE_ROWS, self.columns), dtype=wp.float32, device=device))
        if device == DEFAULT_DEVICE:
            keep("parts", thread_count())
            # Lists of different parts end in different lines of the cache.
            keep("near", wp.zeros((self.parts, self.columns + 32), dtype=wp.int32, device=device))

    def shape(self, boxes: wp.array, others: wp.array) -> None:
        """Prepares the boxes of both sets."""
        n, m = boxes.shape[0], others.shape[0]
        if n > self.rows or m > self.columns:
            raise ValueError(f"{n} boxes with {m} others are more than the plan's {self.rows} × {self.columns}")
        for given, shapes in ((boxes, self.shapes), (others, self.other_shapes)):
            wp.launch(shape_boxes, given.shape[0], inputs=[given, None], outputs=[shapes], device=self.shapes.device)

    def launch(
        self,
        rows: wp.Kernel,
        matrix: wp.Kernel,
        inputs: list,
        outputs: list,
        pairs: tuple[int, int],
        of_rows: list,
        of_part: int,
    ) -> None:
        """Launches the kernel for rows on a CPU, in parts and with inputs of its own, else that for pairs."""
        if self.shapes.device.is_cpu:
            parts = max(1, min(self.parts, pairs[0] * pairs[1] // of_part))
            launch_parts(rows, parts, [*inputs, *of_rows, self.near], outputs)
        else:
            wp.launch(matrix, pairs, inputs=inputs, outputs=outputs, device=self.shapes.device)


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
        object.__setattr__(self, "_pairs", _Pairs(rows=self.rows, columns=self.columns, device=self.device))
        for name in ("bev", "space"):
            matrix = wp.zeros((self.rows, self.columns), dtype=wp.float32, device=resolve_device(self.device))
            object.__setattr__(self, name, matrix)

    def launch(self, boxes: wp.array, others: wp.array, counts: wp.array) -> None:
        """Fills `bev` and `space` for the first `counts[0]` of `boxes` and the first `counts[1]` of `others`.

        Args:
            boxes: Shape (n, 7), float32: x y z l w h yaw, n ≤ rows.
            others: Shape (m, 7), float32, m ≤ columns.
            counts: Shape (2,), int32, on the device.
        """
        _find_overlaps(self._pairs, boxes, others, counts, [self.bev, self.space])


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
        if self.enclosing not in _ENCLOSINGS:
            raise ValueError(f"enclosing must be one of {', '.join(_ENCLOSINGS)}, not {self.enclosing!r}")
        object.__setattr__(self, "_pairs", _Pairs(rows=self.rows, columns=self.columns, device=self.device))
        matrix = wp.zeros((self.rows, self.columns), dtype=wp.float32, device=resolve_device(self.device))
        object.__setattr__(self, "giou", matrix)

    def launch(self, boxes: wp.array, others: wp.array, counts: wp.array) -> None:
        """Fills `giou` for the first `counts[0]` of `boxes` and the first `counts[1]` of `others`.

        Args:
            boxes: Shape (n, 7), float32: x y z l w h yaw, n ≤ rows.
            others: Shape (m, 7), float32, m ≤ columns.
            counts: Shape (2,), int32, on the device.
        """
        _find_generalised(self._pairs, boxes, others, counts, [self.giou], enclosing=self.enclosing)


def _find_overlaps(
    pairs: _Pairs, boxes: wp.array, others: wp.array, counts: wp.array, outputs: list, *, is_clear: bool = False
) -> None:
    n, m = boxes.shape[0], others.shape[0]
    pairs.shape(boxes, others)
    inputs = [pairs.shapes, pairs.other_shapes, counts]
    pairs.launch(_iou_rows, _iou_matrix, inputs, outputs, (n, m), [n, m, is_clear], _PAIRS_OF_PART)


def _find_generalised(
    pairs: _Pairs, boxes: wp.array, others: wp.array, counts: wp.array, outputs: list, *, enclosing: str
) -> None:
    n, m = boxes.shape[0], others.shape[0]
    pairs.shape(boxes, others)
    inputs = [pairs.shapes, pairs.other_shapes, counts, enclosing == "box"]
    pairs.launch(_giou_rows, _giou_matrix, inputs, outputs, (n, m), [n, m], _GENERALISED_OF_PART)


@lru_cache(maxsize=64)
def _counts_on(n: int, m: int, device: str) -> wp.array:
    """Two counts on a device, kept between calls: to be read only."""
    return wp.array([n, m], dtype=wp.int32, device=device)


def _matrix(a: Any, b: Any, which: str, **configuration: Any) -> Any:
    family = family_of(a, "a")
    boxes, owner = borrow(a, wp.float32, (None, 7), "a")
    others, other_owner = borrow(b, wp.float32, (None, 7), "b")
    if str(boxes.device) != str(others.device):
        raise ValueError(f"a is on {boxes.device} and b on {others.device}; both must be on one device")
    n, m = boxes.shape[0], others.shape[0]
    if n == 0 or m == 0:
        return give(wp.zeros((n, m), dtype=wp.float32, device=boxes.device), family)
    size = {
        "rows": capacity_for(n) if n > 64 else 64,
        "columns": capacity_for(m) if m > 64 else 64,
        "device": family.device,
    }
    counts = _counts_on(n, m, family.device)
    if family.device != DEFAULT_DEVICE:
        plan = plan_for(GeneralizedIou if which == "giou" else RotatedIou, **size, **configuration)
        plan.launch(boxes, others, counts)
        return give(getattr(plan, which)[:n, :m].contiguous(), family)
    # Straight onto an array of its own, whose pages are zero and not there until something is written to them.
    host = np.zeros((n, m), np.float32)
    matrix = wp.array(host, copy=False, device=DEFAULT_DEVICE)
    pairs = plan_for(_Pairs, **size)
    if which == "giou":
        _find_generalised(pairs, boxes, others, counts, [matrix], **configuration)
    else:
        outputs = [matrix if which == name else None for name in ("bev", "space")]
        _find_overlaps(pairs, boxes, others, counts, outputs, is_clear=True)
    del owner, other_owner
    return adopt(host, family)


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
    return _matrix(a, b, "giou", enclosing=enclosing)
