"""Boxes as a second look at their points has them: scores, classes, places and sizes from what a network said of each.

The score is a weighted geometric mean of the first stage's score, the probability of the class, and how far the box is
thought to overlap its object, as in CIA-SSD (Zheng et al., AAAI 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from .device import resolve_device

__all__ = ["RESIDUALS", "BoxRescore"]

RESIDUALS = ("dx", "dy", "dz", "log_l", "log_w", "log_h", "dyaw")
"""In the box's frame: of the centre, as parts of the diagonal seen from above and of the height; of the sizes, as
logarithms of ratios; of the heading [rad]."""

_MOST = wp.constant(1.0)  # of a residual; what is larger is no small correction


@wp.kernel
def _choose(
    # in
    scores_in: wp.array(dtype=wp.float32),
    kinds_in: wp.array(dtype=wp.int32),
    keep_in: wp.array(dtype=wp.int32),
    keep_count_in: wp.array(dtype=wp.int32),
    powers_in: wp.array(dtype=wp.float32),
    first_weight: float,
    least: float,
    # out
    chosen_out: wp.array(dtype=wp.int32),
    chosen_count_out: wp.array(dtype=wp.int32),
):
    """One thread: in their order, the boxes whose score can still become high enough."""
    chosen = int(0)
    for k in range(wp.min(keep_count_in[0], keep_in.shape[0])):
        b = keep_in[k]
        if wp.pow(scores_in[b], first_weight * powers_in[kinds_in[b]]) >= least:
            chosen_out[chosen] = b
            chosen += 1
    chosen_count_out[0] = chosen


@wp.kernel
def _rescore(
    # in
    boxes_in: wp.array2d(dtype=wp.float32),
    scores_in: wp.array(dtype=wp.float32),
    keep_in: wp.array(dtype=wp.int32),
    keep_count_in: wp.array(dtype=wp.int32),
    said_in: wp.array2d(dtype=wp.float32),
    moved_in: wp.array(dtype=wp.int32),
    size_shares_in: wp.array(dtype=wp.float32),
    powers_in: wp.array(dtype=wp.float32),
    first_weight: float,
    class_weight: float,
    overlap_weight: float,
    least: float,
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
    scores_out: wp.array(dtype=wp.float32),
    kinds_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """One thread a box; the first also counts those that nobody looks at though their score would do."""
    k = wp.tid()
    most = scores_out.shape[0]
    if k == 0:
        count_out[0] = wp.min(keep_count_in[0], most)
        dropped = int(0)
        for other in range(most, keep_count_in[0]):
            if scores_in[keep_in[other]] >= least:
                dropped += 1
        dropped_out[0] = dropped
    if k >= keep_count_in[0]:
        return
    b = keep_in[k]
    kinds = moved_in.shape[0]
    best = int(1)
    highest = said_in[k, 0]
    for kind in range(1, kinds + 1):
        if said_in[k, kind] > said_in[k, best]:
            best = kind
        highest = wp.max(highest, said_in[k, kind])
    whole = float(0.0)
    for kind in range(kinds + 1):
        whole += wp.exp(said_in[k, kind] - highest)
    probability = wp.exp(said_in[k, best] - highest) / whole
    overlap = 1.0 / (1.0 + wp.exp(-said_in[k, kinds + 1]))
    score = wp.pow(scores_in[b], first_weight) * wp.pow(probability, class_weight) * wp.pow(overlap, overlap_weight)
    score = wp.pow(score, powers_in[best - 1])
    # NaN, which suppression leaves out.
    scores_out[k] = wp.where(score >= least, score, wp.nan)
    kinds_out[k] = best - 1
    for value in range(7):
        boxes_out[k, value] = boxes_in[b, value]
    if moved_in[best - 1] == 0:
        return
    first = kinds + 2
    c = wp.cos(boxes_in[b, 6])
    s = wp.sin(boxes_in[b, 6])
    diagonal = wp.sqrt(boxes_in[b, 3] * boxes_in[b, 3] + boxes_in[b, 4] * boxes_in[b, 4])
    along = wp.clamp(said_in[k, first], -_MOST, _MOST) * diagonal
    across = wp.clamp(said_in[k, first + 1], -_MOST, _MOST) * diagonal
    boxes_out[k, 0] = boxes_in[b, 0] + along * c - across * s
    boxes_out[k, 1] = boxes_in[b, 1] + along * s + across * c
    boxes_out[k, 2] = boxes_in[b, 2] + wp.clamp(said_in[k, first + 2], -_MOST, _MOST) * boxes_in[b, 5]
    share = size_shares_in[best - 1]
    for size in range(3):
        grown = share * wp.clamp(said_in[k, first + 3 + size], -_MOST, _MOST)
        boxes_out[k, 3 + size] = boxes_in[b, 3 + size] * wp.exp(grown)
    yaw = boxes_in[b, 6] + wp.clamp(said_in[k, first + 6], -_MOST, _MOST)
    boxes_out[k, 6] = wp.where(yaw > wp.PI, yaw - wp.TAU, wp.where(yaw < -wp.PI, yaw + wp.TAU, yaw))


@dataclass(frozen=True, kw_only=True)
class BoxRescore:
    """A plan: new boxes of up to `boxes` old ones.

    Attributes:
        chosen: What `choose` left, shape (candidates,), int32.
        chosen_count: How many they are, shape (1,), int32.
        boxes_out: Shape (boxes, 7), float32.
        scores: Shape (boxes,), float32; NaN where a score is too low.
        kinds: Shape (boxes,), int32.
        count: How many they are, shape (1,), int32.
        dropped: Boxes after the first `boxes` whose old score would do, shape (1,), int32.
    """

    boxes: int
    """Boxes that one launch looks at."""
    candidates: int
    """Boxes that those are chosen from, at most."""
    moved: Sequence[bool]
    """Whether boxes of each class take the residuals too, in the order of the network."""
    size_shares: Sequence[float]
    """How far the sizes of boxes of each class go from the old ones to those that the network says, 0 to 1."""
    powers: Sequence[float]
    """Of scores of each class, above 0: so that one threshold fits all classes."""
    weights: tuple[float, float, float]
    """Exponents of the old score, of the probability of the class, and of the overlap; they add up to 1."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if self.boxes < 1 or self.candidates < 1:
            raise ValueError(f"boxes and candidates must be at least 1, not {self.boxes} and {self.candidates}")
        if not len(self.moved):
            raise ValueError("moved must say so of each class, not of none")
        if not all(weight >= 0.0 for weight in self.weights) or abs(sum(self.weights) - 1.0) > 1e-6:
            raise ValueError(f"weights must be at least 0 and add up to 1, not {self.weights}")
        if len(self.size_shares) != len(self.moved) or not all(0.0 <= share <= 1.0 for share in self.size_shares):
            raise ValueError(f"size_shares must be {len(self.moved)} of 0 to 1, not {self.size_shares}")
        if len(self.powers) != len(self.moved) or not all(power > 0.0 for power in self.powers):
            raise ValueError(f"powers must be {len(self.moved)} above 0, not {self.powers}")
        device = resolve_device(self.device)

        def buffer(name: str, shape: int | tuple[int, int], dtype: type) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=dtype, device=device))

        moved = wp.array(np.asarray(self.moved, np.int32), dtype=wp.int32, device=device)
        object.__setattr__(self, "_moved", moved)
        shares = wp.array(np.asarray(self.size_shares, np.float32), dtype=wp.float32, device=device)
        object.__setattr__(self, "_size_shares", shares)
        powers = wp.array(np.asarray(self.powers, np.float32), dtype=wp.float32, device=device)
        object.__setattr__(self, "_powers", powers)
        buffer("chosen", self.candidates, wp.int32)
        buffer("chosen_count", 1, wp.int32)
        buffer("boxes_out", (self.boxes, 7), wp.float32)
        buffer("scores", self.boxes, wp.float32)
        buffer("kinds", self.boxes, wp.int32)
        buffer("count", 1, wp.int32)
        buffer("dropped", 1, wp.int32)

    def choose(self, scores: wp.array, kinds: wp.array, keep: wp.array, keep_count: wp.array, least: float) -> None:
        """Fills `chosen` and `chosen_count`: boxes that, certain to be of their class, would reach the least score.

        Args:
            scores: Shape (b,), float32, in [0, 1].
            kinds: Their classes, shape (b,), int32.
            keep: Which of them, shape (k,), int32, k ≤ `candidates`.
            keep_count: How many of these, shape (1,), int32.
            least: Least new score.
        """
        if keep.shape[0] > self.candidates:
            raise ValueError(f"{keep.shape[0]} boxes are more than the plan's {self.candidates} candidates")
        inputs = [scores, kinds, keep, keep_count, self._powers, float(self.weights[0]), float(least)]
        outputs = [self.chosen, self.chosen_count]
        wp.launch(_choose, 1, inputs=inputs, outputs=outputs, device=self.scores.device)

    def launch(
        self, boxes: wp.array, scores: wp.array, keep: wp.array, keep_count: wp.array, said: wp.array, least: float
    ) -> None:
        """Fills `boxes_out`, `scores`, `kinds`, `count` and `dropped`.

        Args:
            boxes: Shape (b, 7), float32: x y z l w h yaw.
            scores: Shape (b,), float32, in [0, 1].
            keep: Which of them, the best first, shape (k,), int32.
            keep_count: How many of these, shape (1,), int32.
            said: Of each of the first `boxes` of those, shape (boxes, 1 + classes + 1 + 7), float32: logits of nothing
                and of the classes, of the overlap, and the `RESIDUALS`.
            least: Least new score.
        """
        wanted = (self.boxes, 2 + len(self.moved) + len(RESIDUALS))
        if tuple(said.shape) != wanted:
            raise ValueError(f"said must have the shape {wanted}, not {tuple(said.shape)}")
        how = [self._moved, self._size_shares, self._powers, *map(float, self.weights), float(least)]
        wp.launch(
            _rescore,
            min(self.boxes, keep.shape[0]),
            inputs=[boxes, scores, keep, keep_count, said, *how],
            outputs=[self.boxes_out, self.scores, self.kinds, self.count, self.dropped],
            device=self.scores.device,
        )
