"""What the network should say of a frame, and how far off it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn import functional

from .network import HEAD_CLASSES, REGRESSION, UNFOLD

if TYPE_CHECKING:
    from .windows import Batch

__all__ = ["Targets", "draw_targets", "loss", "overlap"]

_CELL = 0.5  # [m] edge of an output cell
# An object with fewer returns is neither asked for nor counted as false.
_FEWEST_POINTS = np.array([5, 4, 4, 3, 4])
# Spread of a peak [output cells]: about a third of the object's narrow side, never less than a cell needs.
_LEAST_SPREAD = 0.7
# Cells round the centre that learn the box too, so that a peak one cell off still gives a good one.
_NEIGHBOURHOOD = 1
_SPEED = 10.0  # [m/s] of a velocity of 1 in the maps
# The overlap says nothing of headings, which therefore weigh more.
_WEIGHTS = torch.tensor([1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 2.0, 2.0, 0.3, 0.3])
# Of the heat maps: people and riders are a third as many as vehicles, and look less alike.
_CLASS_WEIGHTS = torch.tensor([1.0, 1.5, 1.5, 1.0, 1.0])
# Of what a box lacks of its overlap: 0.2 m are much for a person and little for a bus, which L1 does not know.
_OVERLAP_WEIGHT = 1.5


@dataclass(frozen=True, kw_only=True)
class Targets:
    """For one frame, on the output grid of H rows along y and W columns along x."""

    heat: np.ndarray
    """Shape (classes, H, W), float32: 1 at centres, falling off around them."""
    mask: np.ndarray
    """Shape (classes, H, W), float32: 0 where no answer is wrong."""
    values: np.ndarray
    """Shape (regression, H, W), float32."""
    weight: np.ndarray
    """Shape (H, W), float32: 0 where there is no box to learn."""
    velocity: np.ndarray
    """Over ground along the grid's axes [10 m/s], shape (2, H, W), float32; NaN where it is unknown."""


def draw_targets(
    boxes: np.ndarray,
    classes: np.ndarray,
    points_in: np.ndarray,
    origin: tuple[float, float],
    cell: float,
    shape: tuple[int, int],
    ground: float = 0.0,
    velocities: np.ndarray | None = None,
) -> Targets:
    """Draws the maps of one frame.

    Args:
        boxes: Shape (k, 7); centres in the frame of the grid.
        classes: Shape (k,), indices into `HEAD_CLASSES`; others are left out.
        points_in: Returns of each object, shape (k,).
        origin: Lowest x and y of the grid [m].
        cell: Edge of an output cell [m].
        shape: H, W.
        ground: Height of the ground in the frame of the boxes, as the network is told [m].
        velocities: Of the objects along the grid's axes [m/s], shape (k, 2); None or of no rows: unknown.
    """
    height, width = shape
    heat = np.zeros((len(HEAD_CLASSES), height, width), np.float32)
    mask = np.ones_like(heat)
    values = np.zeros((len(REGRESSION), height, width), np.float32)
    weight = np.zeros((height, width), np.float32)
    velocity = np.full((2, height, width), np.nan, np.float32)
    known = velocities is not None and len(velocities) == len(boxes)
    u = (boxes[:, 0] - origin[0]) / cell
    v = (boxes[:, 1] - origin[1]) / cell
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height) & (classes < len(HEAD_CLASSES))
    # Far ones first, so that where two claim a cell the better seen has it.
    for k in sorted(np.flatnonzero(inside), key=lambda k: int(points_in[k])):
        z, length, wide, tall, yaw = (float(value) for value in boxes[k, 2:])
        kind = int(classes[k])
        column, row = int(u[k]), int(v[k])
        if points_in[k] < _FEWEST_POINTS[kind]:
            reach = int(np.ceil(0.5 * max(length, wide) / cell))
            window = np.s_[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
            mask[kind][window] = 0.0
            continue
        spread = max(_LEAST_SPREAD, min(length, wide) / cell / 5.0)
        reach = int(np.ceil(3.0 * spread))
        rows = np.arange(max(row - reach, 0), min(row + reach + 1, height))
        columns = np.arange(max(column - reach, 0), min(column + reach + 1, width))
        square = (rows[:, None] - row) ** 2 + (columns[None, :] - column) ** 2
        peak = np.exp(-square / (2.0 * spread * spread)).astype(np.float32)
        window = np.ix_(rows, columns)
        heat[kind][window] = np.maximum(heat[kind][window], peak)
        log_size = np.log([max(length, 0.05), max(wide, 0.05), max(tall, 0.05)])
        fixed = [z - ground, *log_size, np.cos(2 * yaw), np.sin(2 * yaw), np.cos(yaw), np.sin(yaw)]
        for r in range(max(row - _NEIGHBOURHOOD, 0), min(row + _NEIGHBOURHOOD + 1, height)):
            for c in range(max(column - _NEIGHBOURHOOD, 0), min(column + _NEIGHBOURHOOD + 1, width)):
                own = 1.0 if (r, c) == (row, column) else 0.25
                if own >= weight[r, c]:
                    values[:, r, c] = [u[k] - c - 0.5, v[k] - r - 0.5, *fixed]
                    weight[r, c] = own
                    if known:
                        velocity[:, r, c] = velocities[k] / _SPEED
    return Targets(heat=heat, mask=mask, values=values, weight=weight, velocity=velocity)


class _FalsePeaks(torch.autograd.Function):
    """The sum of w · p² · −log(1 − p) over probabilities p = sigmoid(logits), with its gradient at once.

    By automatic differentiation it takes a dozen passes over maps that are nearly all background.
    """

    @staticmethod
    def forward(ctx: Any, logits: torch.Tensor, w: torch.Tensor) -> torch.Tensor:
        """The sum."""
        logits = logits.float()
        p = torch.sigmoid(logits)
        least = functional.softplus(logits)
        share = p.square().mul_(w)
        ctx.save_for_backward((1.0 - p).mul_(2.0).mul_(least).add_(p).mul_(share))
        return (share * least).sum()

    @staticmethod
    def backward(ctx: Any, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        """Of the logits."""
        (slope,) = ctx.saved_tensors
        return grad * slope, None


def loss(maps: torch.Tensor, batch: Batch, extras: tuple[str, ...] = ()) -> tuple[torch.Tensor, dict[str, float]]:
    """The penalty-reduced focal loss of the heat maps (CornerNet, Law & Deng 2018), L1 of the boxes and their overlap.

    And L1 of the extras: of the overlap that the boxes really have, and of velocities where they are known.

    Args:
        maps: What the network said, folded: shape (n, (classes + regression + extras) · UNFOLD², H / 4, W / 4).
        batch: Of the same windows.
        extras: What the network says besides, of `network.EXTRAS`.

    Returns:
        The sum, and its parts as numbers.
    """
    inner, classes = UNFOLD**2, len(HEAD_CLASSES)
    rows = maps.permute(0, 2, 3, 1)
    logits = rows[..., : classes * inner]
    weights = _CLASS_WEIGHTS.to(maps.device)
    centres = logits.reshape(-1)[batch.peaks].float()
    kinds = batch.peaks % (classes * inner) // inner
    objects = max(len(batch.peaks), 1)
    false = _FalsePeaks.apply(logits, batch.calm * weights.repeat_interleave(inner))
    missed = (weights[kinds] * (1.0 - torch.sigmoid(centres)) ** 2 * functional.softplus(-centres)).sum()
    focal = (false + missed) / objects
    window, row, column, place = batch.where
    said = rows[window, row, column].view(len(place), -1, inner).float()
    said = said.gather(2, place[:, None, None].expand(-1, said.shape[1], 1))[:, :, 0]
    boxes, more = said[:, classes : classes + len(REGRESSION)], said[:, classes + len(REGRESSION) :]
    everything = batch.weight.sum().clamp(min=1.0)
    box = ((boxes - batch.values).abs() @ _WEIGHTS.to(boxes) * batch.weight).sum() / everything
    common = overlap(boxes, batch.values)
    apart = ((1.0 - common) * batch.weight).sum() / everything
    total = focal + 0.5 * box + _OVERLAP_WEIGHT * apart
    parts = {"heat": focal, "box": box, "apart": apart}
    for k, name in enumerate(extras):
        wanted = 2.0 * common.detach() - 1.0 if name == "iou" else batch.velocity[:, 0 if name == "vx" else 1]
        known = batch.weight * torch.isfinite(wanted)
        off = ((more[:, k] - torch.nan_to_num(wanted)).abs() * known).sum() / known.sum().clamp(min=1.0)
        total = total + 0.2 * off
        parts[name] = off
    return total, {name: float(part.detach()) for name, part in parts.items()}


def overlap(boxes: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """How far predicted boxes overlap the true ones, both of shape (n, regression, …), cells 0.5 m wide.

    The intersection over union of the two solids as if both had the true heading, times |cos| of the angle between
    their axes: exact where the headings agree, and cheap. It has a gradient to places and sizes, none to headings.
    """
    half = 0.5 * torch.atan2(values[:, 7], values[:, 6])
    c, s = torch.cos(half), torch.sin(half)
    dx, dy = (_CELL * (boxes[:, k] - values[:, k]) for k in (0, 1))
    apart = torch.stack([dx * c + dy * s, dy * c - dx * s, boxes[:, 2] - values[:, 2]], 1).abs()
    size, true = boxes[:, 3:6].clamp(-4.0, 4.0).exp(), values[:, 3:6].exp()
    common = (torch.minimum(0.5 * size + 0.5 * true - apart, torch.minimum(size, true))).clamp(min=0.0).prod(1)
    union = size.prod(1) + true.prod(1) - common
    turned = torch.atan2(boxes[:, 7].detach(), boxes[:, 6].detach()) - torch.atan2(values[:, 7], values[:, 6])
    return common / union.clamp(min=1e-6) * torch.cos(0.5 * turned).abs()
