"""What a second stage learns from: candidates of the first on simulated scans, with their points and the truth.

The scans must be others than those that the first stage learned from: it is too sure of those.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

import numpy as np
import torch

from ...kernels.box_points import BOX_CHANNELS
from ...kernels.box_rescore import RESIDUALS
from ...kernels.iou import rotated_iou_bev
from ..detections import Detections
from .frames import TrainingFrame, labelled_boxes
from .network import HEAD_CLASSES

__all__ = ["Drawn", "Samples", "SecondAugmentation", "draw", "join", "samples_of"]

_STORED = 512
# What is kept of a candidate's surroundings [m]: more than is gathered, so that a box can be moved about in them.
_AROUND, _UNDER_BOTTOM, _OVER_TOP = 1.5, 0.4, 1.5
_FARTHEST = 2.5  # [m] from a candidate to the centre of an object that it may mean, where the two do not overlap
_FEWEST_POINTS = np.array([5, 4, 4, 3, 4])  # as in targets: an object with fewer is not asked for
_VEHICLE, _PEDESTRIAN, _CYCLIST, _, _BARRIER = range(len(HEAD_CLASSES))


@dataclass(frozen=True, kw_only=True)
class Samples:
    """n candidates."""

    points: np.ndarray
    """In the candidate's frame [m], shape (n, 512, 3), float16; rows after the first `stored` are of no meaning."""
    stored: np.ndarray
    """Shape (n,), int32."""
    found: np.ndarray
    """Points that there were, of which those stored are an even choice, shape (n,), int32."""
    boxes: np.ndarray
    """In the sensor's frame, shape (n, 7), float32."""
    scores: np.ndarray
    """Shape (n,), float32."""
    kinds: np.ndarray
    """Shape (n,), int64."""
    heights: np.ndarray
    """Of the sensor over the ground [m], shape (n,), float32."""
    truth: np.ndarray
    """The object that each may mean, in its frame: x y z l w h yaw, shape (n, 7), float32."""
    truth_kinds: np.ndarray
    """Its class, −1 where there is none, shape (n,), int64."""
    truth_seen: np.ndarray
    """Whether it has enough points to be asked for, shape (n,), bool."""

    def __len__(self) -> int:
        return len(self.stored)


def join(parts: Iterable[Samples]) -> Samples:
    """All of them as one."""
    parts = list(parts)
    return Samples(
        **{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Samples)}
    )


def samples_of(found: Detections, frame: TrainingFrame, rng: np.random.Generator) -> Samples:
    """The candidates that a first stage found in a scan, as samples.

    Args:
        found: Neither refined nor rescored.
        frame: The scan.
        rng: Which points are kept of a candidate with many.
    """
    boxes, n = found.boxes, len(found)
    truth_boxes = labelled_boxes(frame.boxes, frame.classes) if frame.tight else frame.boxes
    truth_boxes = np.asarray(truth_boxes, np.float32)
    known = frame.classes < len(HEAD_CLASSES)
    truth_boxes, kinds, points_in = truth_boxes[known], frame.classes[known], frame.points_in[known]
    meant = _meant(boxes, truth_boxes)
    points = np.zeros((n, _STORED, 3), np.float16)
    stored, counts = np.zeros(n, np.int32), np.zeros(n, np.int32)
    order = np.argsort(frame.xyz[:, 0], kind="stable")
    sorted_x = frame.xyz[order, 0]
    for k, box in enumerate(boxes):
        reach = 0.5 * np.hypot(box[3], box[4]) + 1.5 * _AROUND
        near = order[np.searchsorted(sorted_x, box[0] - reach) : np.searchsorted(sorted_x, box[0] + reach)]
        near = frame.xyz[near[np.abs(frame.xyz[near, 1] - box[1]) < reach]]
        local = _into(box, near)
        half = 0.5 * box[3:6]
        inside = (np.abs(local[:, :2]) <= half[:2] + _AROUND).all(1)
        local = local[inside & (local[:, 2] >= -half[2] - _UNDER_BOTTOM) & (local[:, 2] <= half[2] + _OVER_TOP)]
        counts[k] = len(local)
        if len(local) > _STORED:
            local = local[rng.permutation(len(local))[:_STORED]]
        stored[k] = len(local)
        points[k, : len(local)] = local
    truth, truth_kinds, seen = np.zeros((n, 7), np.float32), np.full(n, -1, np.int64), np.zeros(n, bool)
    for k in np.flatnonzero(meant >= 0):
        other = truth_boxes[meant[k]]
        truth[k] = [*_into(boxes[k], other[None, :3])[0], *other[3:6], other[6] - boxes[k, 6]]
        truth_kinds[k] = kinds[meant[k]]
        seen[k] = points_in[meant[k]] >= _FEWEST_POINTS[truth_kinds[k]]
    return Samples(
        points=points,
        stored=stored,
        found=counts,
        boxes=boxes.astype(np.float32),
        scores=found.scores.astype(np.float32),
        kinds=found.classes.astype(np.int64),
        heights=np.full(n, frame.sensor_height, np.float32),
        truth=truth,
        truth_kinds=truth_kinds,
        truth_seen=seen,
    )


def _into(box: np.ndarray, xyz: np.ndarray) -> np.ndarray:
    """Places in a box's frame."""
    apart = xyz - box[:3]
    c, s = np.cos(box[6]), np.sin(box[6])
    return np.stack([apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s, apart[:, 2]], 1)


def _meant(boxes: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Of each box the object that it overlaps most, or else the nearest; −1: none."""
    if not len(boxes) or not len(truth):
        return np.full(len(boxes), -1)
    overlap = np.asarray(rotated_iou_bev(np.ascontiguousarray(boxes, np.float32), np.ascontiguousarray(truth)))
    away = np.hypot(boxes[:, None, 0] - truth[None, :, 0], boxes[:, None, 1] - truth[None, :, 1])
    best = np.where(overlap.max(1) > 0, overlap.argmax(1), away.argmin(1))
    return np.where((overlap.max(1) > 0) | (away.min(1) < _FARTHEST), best, -1)


@dataclass(frozen=True, kw_only=True)
class SecondAugmentation:
    """How a candidate is varied each time it is drawn."""

    move: float = 0.06
    """Standard deviation of its place, of its length and width."""
    lift: float = 0.06
    """Of its height [m]."""
    scale: float = 0.05
    """Of the logarithms of its sizes."""
    turn: float = 0.04
    """Of its heading [rad]."""
    ground: float = 0.08
    """Of the height of the ground [m]."""
    noise: float = 0.02
    """Of the points [m]."""
    thin: float = 0.4
    """Share of the candidates that lose a part of their points, up to 75 %."""
    cut: float = 0.3
    """Share of the candidates that lose the points on one side of a plane through them: no part is always seen."""
    alone: float = 0.1
    """Share of the candidates that lose the points around the box."""
    bend: float = 0.4
    """Standard deviation of the logit of the score."""
    mistaken: float = 0.15
    """Share of the people and riders that come in the other's box: real ones are taken for each other far more often
    than simulated ones, so that a second stage learns to believe the first one's class and size."""
    broad: float = 0.3
    """Share of the people who are stretched, by up to half as much again, with their points: bags, strides, arms."""


@dataclass(frozen=True, kw_only=True)
class Drawn:
    """A batch: what the network takes and what it should say."""

    points: torch.Tensor
    described: torch.Tensor
    kinds: torch.Tensor
    """0 for nothing, 1 and on for the classes, −1 where no answer is wrong; shape (n,), int64."""
    boxed: torch.Tensor
    """Whether there is a box to learn, shape (n,), bool."""
    residuals: torch.Tensor
    """Shape (n, 7)."""
    sizes: torch.Tensor
    """Of the candidates' boxes, shape (n, 3) [m]."""
    truth: torch.Tensor
    """In the candidate's frame, shape (n, 7)."""


def draw(
    samples: Samples,
    which: np.ndarray,
    generator: torch.Generator,
    options: SecondAugmentation | None,
    *,
    most: int = 128,
    around: float = 0.75,
    over_bottom: float = 0.1,
    over_top: float = 1.0,
) -> Drawn:
    """Draws a batch.

    Args:
        samples: All there are.
        which: Indices into them.
        generator: Of all that is random.
        options: How they are varied; None: not at all, but for which of many points are taken.
        most: As of `kernels.box_points.BoxPoints`; so are the others.
        around: See there.
        over_bottom: See there.
        over_top: See there.
    """
    points = torch.from_numpy(samples.points[which]).float()
    stored = torch.from_numpy(samples.stored[which])
    found = torch.from_numpy(samples.found[which])
    boxes = torch.from_numpy(samples.boxes[which])
    scores = torch.from_numpy(samples.scores[which])
    kinds = torch.from_numpy(samples.kinds[which])
    heights = torch.from_numpy(samples.heights[which])
    truth = torch.from_numpy(samples.truth[which])
    truth_kinds = torch.from_numpy(samples.truth_kinds[which])
    seen = torch.from_numpy(samples.truth_seen[which])
    n = len(which)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(shape, generator=generator)

    sizes, yaw, centre = boxes[:, 3:6].clone(), boxes[:, 6].clone(), boxes[:, :3].clone()
    walks, rides = truth_kinds == _PEDESTRIAN, truth_kinds == _CYCLIST
    there = torch.arange(points.shape[1]) < stored[:, None]
    ground = torch.zeros(n)
    if options is not None:
        keep = torch.where(uniform(n) < options.thin, 0.25 + 0.75 * uniform(n), torch.ones(n))
        there &= uniform(n, points.shape[1]) < keep[:, None]
        points = points + options.noise * normal(*points.shape)
        stretch = torch.where(
            (walks & (uniform(n) < options.broad))[:, None], 1.0 + 0.5 * uniform(n, 2), torch.ones(n, 2)
        )
        points = torch.cat([points[..., :2] * stretch[:, None], points[..., 2:]], -1)
        across = (torch.sin(truth[:, 6]).abs() > 0.7)[:, None]
        truth = torch.cat(
            [
                truth[:, :2] * stretch,
                truth[:, 2:3],
                truth[:, 3:5] * torch.where(across, stretch.flip(1), stretch),
                truth[:, 5:],
            ],
            1,
        )
        mistaken = uniform(n) < options.mistaken
        as_rider, as_walker = mistaken & walks, mistaken & rides
        drawn_sizes = torch.stack([1.4 + 0.5 * uniform(n), 0.6 + 0.3 * uniform(n)], 1)
        sizes[:, :2] = torch.where(as_rider[:, None], drawn_sizes, sizes[:, :2])
        drawn_sizes = torch.stack([0.7 + 0.5 * uniform(n), 0.6 + 0.3 * uniform(n)], 1)
        sizes[:, :2] = torch.where(as_walker[:, None], drawn_sizes, sizes[:, :2])
        kinds = torch.where(as_rider, _CYCLIST, torch.where(as_walker, _PEDESTRIAN, kinds))
        shift = torch.cat([options.move * sizes[:, :2] * normal(n, 2), options.lift * normal(n, 1)], 1)
        turn = options.turn * normal(n)
        sizes = sizes * torch.exp(options.scale * normal(n, 3))
        c, s = torch.cos(yaw), torch.sin(yaw)
        centre = centre + torch.stack(
            [shift[:, 0] * c - shift[:, 1] * s, shift[:, 0] * s + shift[:, 1] * c, shift[:, 2]], 1
        )
        yaw = yaw + turn
        points = _turned(points - shift[:, None], turn[:, None])
        truth = torch.cat([_turned(truth[:, :3] - shift, turn), truth[:, 3:6], truth[:, 6:] - turn[:, None]], 1)
        ground = options.ground * normal(n)
        scores = torch.sigmoid(torch.logit(scores, eps=1e-4) + options.bend * normal(n))
    half = 0.5 * sizes[:, None]
    inside = there & (points[..., :2].abs() <= half[..., :2] + around).all(-1)
    inside &= (points[..., 2] >= over_bottom - half[..., 2]) & (points[..., 2] <= half[..., 2] + over_top)
    if options is not None:
        towards = normal(n, 1, 3) / half
        lost = (points * towards).sum(-1) > (0.2 + 0.8 * uniform(n, 1)) * (towards * half).norm(dim=-1)
        inside &= ~lost | (uniform(n) >= options.cut)[:, None]
        near = (points.abs() <= half + 0.1).all(-1)
        inside &= near | (uniform(n) >= options.alone)[:, None]
    total = inside.sum(1) * found.clamp(min=1) / stored.clamp(min=1)
    keys = torch.where(inside, uniform(*inside.shape), torch.tensor(-1.0))
    taken = keys.topk(most, dim=1).indices
    valid = inside.gather(1, taken)[..., None].float()
    points = points.gather(1, taken[..., None].expand(-1, -1, 3))
    level = centre[:, 2] + heights + ground
    faces = torch.stack([half - points, half + points], -1).flatten(-2)
    gathered = torch.cat([points, faces, points[..., 2:] + level[:, None, None], torch.ones_like(valid)], -1) * valid
    away = torch.hypot(centre[:, 0], centre[:, 1]).clamp(min=0.1)
    c, s = torch.cos(yaw), torch.sin(yaw)
    across = (centre[:, 0] * s - centre[:, 1] * c) / away
    described = torch.stack(
        [*sizes.clamp(min=0.1).log().unbind(1), away.log(), torch.log1p(total), level - 0.5 * sizes[:, 2],
         -(centre[:, 0] * c + centre[:, 1] * s) / away, across, scores],
        1,
    )  # fmt: skip
    if options is not None:
        mirrored = uniform(n) < 0.5
        sign = torch.where(mirrored, -1.0, 1.0)
        gathered[..., 1] *= sign[:, None]
        gathered[..., 5:7] = torch.where(mirrored[:, None, None], gathered[..., 5:7].flip(-1), gathered[..., 5:7])
        described[:, 7] *= sign
        truth = torch.stack([truth[:, 0], truth[:, 1] * sign, *truth[:, 2:6].unbind(1), truth[:, 6] * sign], 1)
    described = torch.cat([described, torch.nn.functional.one_hot(kinds, len(HEAD_CLASSES)).float()], 1)
    assert described.shape[1] == len(BOX_CHANNELS) + len(HEAD_CLASSES)
    return Drawn(
        points=gathered,
        described=described,
        sizes=sizes,
        truth=truth,
        **_wanted(sizes, truth, truth_kinds, seen),
    )


def _turned(xyz: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Places in a frame that is turned by an angle."""
    c, s = torch.cos(angle), torch.sin(angle)
    x, y, z = xyz.unbind(-1)
    return torch.stack([x * c + y * s, y * c - x * s, z], -1)


def overlap(boxes: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Intersection over union from above of boxes that head alike, x y z l w h …, shape (n,)."""
    common = torch.ones(len(boxes))
    for axis in (0, 1):
        high = torch.minimum(boxes[:, axis] + 0.5 * boxes[:, 3 + axis], truth[:, axis] + 0.5 * truth[:, 3 + axis])
        low = torch.maximum(boxes[:, axis] - 0.5 * boxes[:, 3 + axis], truth[:, axis] - 0.5 * truth[:, 3 + axis])
        common = common * (high - low).clamp(min=0.0)
    area = boxes[:, 3] * boxes[:, 4] + truth[:, 3] * truth[:, 4] - common
    return common / area.clamp(min=1e-3)


def _wanted(
    sizes: torch.Tensor, truth: torch.Tensor, truth_kinds: torch.Tensor, seen: torch.Tensor
) -> dict[str, torch.Tensor]:
    """What should be said of candidates at the origin of their frames."""
    n = len(sizes)
    boxes = torch.cat([torch.zeros(n, 3), sizes], 1)
    turned = torch.remainder(truth[:, 6] + 0.5 * torch.pi, torch.pi) - 0.5 * torch.pi
    crossed = turned.abs() > 0.25 * torch.pi
    # A truth that lies across has its length along the candidate's width.
    upright = torch.cat([truth[:, :3], torch.where(crossed[:, None], truth[:, [4, 3, 5]], truth[:, 3:6])], 1)
    share, away = overlap(boxes, upright), torch.hypot(truth[:, 0], truth[:, 1])
    real, long = truth_kinds >= 0, (truth_kinds == _VEHICLE) | (truth_kinds == _BARRIER)
    enough = torch.where(truth_kinds == _VEHICLE, 0.45, 0.3)
    positive = real & torch.where(long, share >= enough, (away < 0.5) & (share >= 0.12))
    negative = ~real | torch.where(long, share < 0.45 * enough, (share < 0.05) | (away > 1.0))
    kinds = torch.where(positive & seen, truth_kinds + 1, torch.where(negative, 0, -1))
    diagonal = torch.hypot(sizes[:, 0], sizes[:, 1])
    residuals = torch.cat(
        [truth[:, :2] / diagonal[:, None], truth[:, 2:3] / sizes[:, 2:3],
         (truth[:, 3:6].clamp(min=0.05) / sizes).log(), turned[:, None]],
        1,
    )  # fmt: skip
    assert residuals.shape[1] == len(RESIDUALS)
    boxed = real & ~crossed & (share > 0.15) & (residuals.abs() < 0.9).all(1)
    return {"kinds": kinds, "boxed": boxed, "residuals": residuals}
