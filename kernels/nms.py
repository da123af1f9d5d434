"""Non-maximum suppression of oriented boxes: of boxes that overlap from above, the one with the best score stays.

Every pair's overlap becomes one bit, in parallel; one thread then walks the boxes from best to worst. Equal scores
are taken in the order of the input, so the result is one and the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import warp as wp

from .arguments import real, whole
from .box_overlap import SHAPE_ROWS, common_area, find_near, shape_boxes
from .device import DEFAULT_DEVICE, module_apart, resolve_device
from .interop import borrow, count_on, family_of, give
from .plan import capacity_for, plan_for
from .threads import launch_parts, thread_count

__all__ = ["RotatedNms", "rotated_nms"]

# What overlaps too much must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})
_APART = module_apart(__name__, fuse_fp=False)

_LAST = wp.constant(3.0e38)
_A, _B = (wp.constant(row) for row in (2, 3))
_PAIRS_OF_PART = 200_000  # pairs for which a thread of their own is worth its while


@wp.kernel
def _sort_keys(
    # in
    scores_in: wp.array(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    # out
    keys_out: wp.array(dtype=wp.float32),
    order_out: wp.array(dtype=wp.int32),
):
    """Keys that sort the best score first and what is no box last."""
    i = wp.tid()
    key = float(_LAST)
    if i < scores_in.shape[0] and i < count_in[0]:
        score = scores_in[i]
        if score == score:  # not NaN
            key = -score
    keys_out[i] = key
    order_out[i] = i


@wp.func
def _suppresses(shapes: wp.array2d(dtype=wp.float32), i: int, j: int, threshold: float) -> bool:
    """Whether two boxes overlap too much."""
    area = common_area(shapes, i, shapes, j)
    union = 4.0 * (shapes[_A, i] * shapes[_B, i] + shapes[_A, j] * shapes[_B, j]) - area
    return area > threshold * union


@wp.kernel(module=_APART)
def _overlap_bits(
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    boxes: int,
    threshold: float,
    # out
    bits_out: wp.array2d(dtype=wp.uint32),
):
    """Bit j of row i: box j, later in the order than i, overlaps it too much."""
    i, word = wp.tid()  # pyright: ignore[reportAssignmentType]
    n = wp.min(count_in[0], boxes)
    if i >= n or word * 32 >= n or word * 32 + 31 <= i:
        return
    bits = wp.uint32(0)
    for k in range(32):
        j = word * 32 + k
        if j > i and j < n and _suppresses(shapes_in, i, j, threshold):
            bits = bits | (wp.uint32(1) << wp.uint32(k))
    bits_out[i, word] = bits


@wp.kernel
def _overlap_bits_in_parts(
    part: int,
    parts: int,
    # in
    shapes_in: wp.array2d(dtype=wp.float32),
    count_in: wp.array(dtype=wp.int32),
    boxes: int,
    threshold: float,
    # in out: room for the boxes near one
    near: wp.array2d(dtype=wp.int32),
    # out
    bits_out: wp.array2d(dtype=wp.uint32),
):
    """Every so many rows; only boxes that may touch are looked at."""
    n = wp.min(count_in[0], boxes)
    for i in range(part, n, parts):
        for word in range((i + 1) // 32, (n + 31) // 32):
            bits_out[i, word] = wp.uint32(0)
        for k in range(find_near(shapes_in, i, shapes_in, i + 1, n, near, part)):
            j = near[part, k]
            if _suppresses(shapes_in, i, j, threshold):
                bits_out[i, j // 32] = bits_out[i, j // 32] | (wp.uint32(1) << wp.uint32(j % 32))


@wp.kernel
def _keep_greedily(
    # in
    count_in: wp.array(dtype=wp.int32),
    limit: int,
    order_in: wp.array(dtype=wp.int32),
    keys_in: wp.array(dtype=wp.float32),
    bits_in: wp.array2d(dtype=wp.uint32),
    # in out
    gone: wp.array(dtype=wp.uint32),
    # out
    keep_out: wp.array(dtype=wp.int32),
    keep_count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread, best to worst: a box that none before it suppresses is kept and suppresses its own."""
    n = wp.min(count_in[0], limit)
    words = (n + 31) // 32
    for word in range(words):
        gone[word] = wp.uint32(0)
    kept = int(0)
    dropped = int(0)
    for i in range(n):
        word = i // 32
        if keys_in[i] < _LAST and ((gone[word] >> wp.uint32(i % 32)) & wp.uint32(1)) == wp.uint32(0):
            if kept < keep_out.shape[0]:
                keep_out[kept] = order_in[i]
                kept += 1
            else:
                dropped += 1
            for later in range(word, words):
                gone[later] = gone[later] | bits_in[i, later]
    keep_count_out[0] = kept
    dropped_out[0] = dropped + wp.max(count_in[0] - limit, 0)


@dataclass(frozen=True, kw_only=True)
class RotatedNms:
    """A plan: suppression among up to `capacity` boxes.

    Attributes:
        keep: Indices of the boxes that stay, best score first, shape (max_output,), int32.
        keep_count: How many they are, shape (1,), int32.
        dropped: Boxes that would have stayed but for `max_output`, and boxes past `capacity`, shape (1,), int32.
    """

    capacity: int
    """Boxes that one launch can take."""
    threshold: float
    """Intersection over union from above beyond which the lesser box goes."""
    max_output: int
    """Most boxes to keep."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if not 0.0 <= self.threshold <= 1.0:
            raise ValueError(f"threshold must be in [0, 1], not {self.threshold}")
        if not (1 <= self.capacity < 2**31 and 1 <= self.max_output < 2**31):
            raise ValueError(
                f"capacity and max_output must be at least 1 and below 2³¹, not {self.capacity} and {self.max_output}"
            )
        device = resolve_device(self.device)

        def buffer(name: str, shape: int | tuple[int, int], dtype: type) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=dtype, device=device))

        words = (self.capacity + 31) // 32
        buffer("_keys", 2 * self.capacity, wp.float32)
        buffer("_order", 2 * self.capacity, wp.int32)
        buffer("_shapes", (SHAPE_ROWS, self.capacity), wp.float32)
        buffer("_bits", (self.capacity, words), wp.uint32)
        buffer("_gone", words, wp.uint32)
        if device == DEFAULT_DEVICE:
            object.__setattr__(self, "_parts", thread_count())
            buffer("_near", (self._parts, self.capacity + 32), wp.int32)
        buffer("keep", self.max_output, wp.int32)
        buffer("keep_count", 1, wp.int32)
        buffer("dropped", 1, wp.int32)

    def launch(self, boxes: wp.array, scores: wp.array, count: wp.array) -> None:
        """Fills `keep`, `keep_count` and `dropped` from the first `count[0]` boxes.

        Args:
            boxes: Shape (n, 7), float32: x y z l w h yaw, n ≤ capacity.
            scores: Shape (n,), float32; a box whose score is NaN is left out.
            count: Shape (1,), int32, on the device.
        """
        n = boxes.shape[0]
        if n > self.capacity:
            raise ValueError(f"{n} boxes are more than the plan's capacity of {self.capacity}")
        device = self.keep.device
        wp.launch(_sort_keys, self.capacity, inputs=[scores, count], outputs=[self._keys, self._order], device=device)
        wp.utils.radix_sort_pairs(self._keys, self._order, self.capacity)
        wp.launch(shape_boxes, n, inputs=[boxes, self._order], outputs=[self._shapes], device=device)
        inputs = [self._shapes, count, n, self.threshold]
        if device.is_cpu:
            parts = max(1, min(self._parts, n * n // _PAIRS_OF_PART))
            launch_parts(_overlap_bits_in_parts, parts, [*inputs, self._near], [self._bits])
        else:
            wp.launch(_overlap_bits, (n, (n + 31) // 32), inputs=inputs, outputs=[self._bits], device=device)
        wp.launch(
            _keep_greedily,
            1,
            inputs=[count, n, self._order, self._keys, self._bits],
            outputs=[self._gone, self.keep, self.keep_count, self.dropped],
            device=device,
        )


def rotated_nms(boxes: Any, scores: Any, threshold: float, max_output: int | None = None) -> Any:
    """The boxes that no better box overlaps too much.

    Args:
        boxes: Shape (n, 7): x y z l w h [m], yaw [rad]; any array family.
        scores: Shape (n,); boxes whose score is NaN are left out.
        threshold: Intersection over union from above beyond which the lesser box goes, in [0, 1].
        max_output: Most boxes to keep; None keeps all that stay.

    Returns:
        Indices into `boxes`, best score first, equal scores in the order of the input; int32, the family of `boxes`.

    Raises:
        ValueError: Shapes that do not fit, a threshold outside [0, 1], or a negative `max_output`.
    """
    if max_output is not None and whole(max_output, "max_output") < 0:
        raise ValueError(f"max_output must be at least 0, not {max_output}")
    family = family_of(boxes, "boxes")
    borrowed, owner = borrow(boxes, wp.float32, (None, 7), "boxes")
    n = borrowed.shape[0]
    ranks, scores_owner = borrow(scores, wp.float32, (n,), "scores")
    capacity = capacity_for(n)
    plan = plan_for(
        RotatedNms, capacity=capacity, threshold=real(threshold, "threshold"), max_output=capacity, device=family.device
    )
    kept = 0
    if n:
        plan.launch(borrowed, ranks, count_on(n, family.device))
        kept = int(plan.keep_count.numpy()[0])
    del owner, scores_owner
    if max_output is not None:
        kept = min(kept, int(max_output))
    if kept == 0:
        return give(wp.zeros(0, dtype=wp.int32, device=family.device), family)
    return give(plan.keep[:kept], family)
