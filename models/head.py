"""The pillar centre head at work: points in, boxes with class and score out.

Pillars, network and decoding each have one buffer for life: our kernel writes the network's input, ONNX Runtime
writes its output, both where they lie, and our kernels turn the maps into boxes. Where the card has a second stage,
these are candidates, which it looks at again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..errors import ModelError
from ..kernels.arguments import whole
from ..kernels.box_refine import BoxRefine
from ..kernels.decode import CenterDecode
from ..kernels.device import resolve_device
from ..kernels.interop import borrow_points
from ..kernels.nms import RotatedNms
from ..kernels.pillar import PillarGrid, pillar_channels
from .card import HeadCard, default_card, load_card
from .classes import CLASSES
from .detections import Detections, checked_height, said_overflow
from .network import PRECISIONS, PROVIDERS, Network
from .second_stage import SecondStage

__all__ = ["PRECISIONS", "PROVIDERS", "DetectionHead"]

_log = logging.getLogger(__name__)


class _Slot:
    """The kernels and buffers of one cloud of a batch."""

    def __init__(self, card: HeadCard, capacity: int, device: str, refined: bool):
        decode = card.decode
        self.count = wp.zeros(1, dtype=wp.int32, device=device)
        self.pillars = PillarGrid(
            point_range=card.input.point_range,
            cell=card.input.cell,
            channels=card.input.channels,
            capacity=capacity,
            device=device,
        )
        self.decode = CenterDecode(
            shape=card.output.unfolded,
            classes=len(card.classes),
            unfold=card.output.unfold,
            origin=card.input.point_range[:2],
            cell=card.input.cell * decode.stride,
            capacity=decode.max_candidates,
            overlap_weight=decode.overlap_weight,
            device=device,
        )
        self.nms = RotatedNms(
            capacity=decode.max_candidates, threshold=decode.nms_iou, max_output=decode.max_objects, device=device
        )
        low, high = card.input.point_range[:2], card.input.point_range[3:5]
        self.refine = (
            BoxRefine(
                capacity=capacity,
                boxes=decode.max_objects,
                refined=tuple(name in decode.refine for name in card.classes),
                origin=low,
                size=(high[0] - low[0], high[1] - low[1]),
                device=device,
            )
            if refined and decode.refine
            else None
        )
        self.found = (self.decode.boxes, self.decode.scores, self.decode.classes_found)
        self.kept = self.nms
        self.dropped = [
            ("decode.max_candidates", decode.max_candidates, self.decode.dropped),
            ("decode.max_objects", decode.max_objects, self.nms.dropped),
        ]


class DetectionHead:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: A head's card (YAML), its ONNX file beside it, or the name of one that ships (`card.named_card`); None is
            the one of these for the device, see `default_card`.
        device: A Warp device, such as `cpu` or `cuda:0`; the kernels run there, and the network too where ONNX
            Runtime has a provider for it, else on the CPU, which is logged and said by `provider` and `fallback`.
        threads: CPU threads of the network.
        precision: What the network computes in on a GPU, one of `PRECISIONS`; fp16 needs ONNX Runtime's provider for
            TensorRT, and is tf32 without it, which is logged. A CPU computes in what the file says.
        providers: Where the network may run, some of `PROVIDERS`, the best first; None: what the device has, then the
            CPU. Without `cpu` among them there is no falling back on it.
        score_threshold: Least score of a detection; None is the card's.
        capacity: Most points of a cloud.
        batch: Clouds that `detect_batch` runs at once.
        candidates_only: Say what the first stage finds, neither seen by the second one nor refined.

    Attributes:
        provider: Where the network runs, one of `PROVIDERS`.
        fallback: Empty where that is the first choice; else what is missing.
        overflow: Objects that the last cloud had beyond the card's `max_candidates`, `max_objects` or `max_boxes`.

    Raises:
        ModelError: The card or its model is missing, not valid, or the two do not fit.
    """

    def __init__(
        self,
        card: str | Path | None = None,
        *,
        device: str = "cpu",
        threads: int = 2,
        precision: str = "fp32",
        providers: Sequence[str] | None = None,
        score_threshold: float | None = None,
        capacity: int = 1 << 18,
        batch: int = 1,
        candidates_only: bool = False,
    ):
        if score_threshold is not None and not 0.0 <= score_threshold <= 1.0:
            raise ValueError(f"score_threshold must be in [0, 1], not {score_threshold}")
        batch = whole(batch, "batch")
        if not 1 <= batch <= 127:
            raise ValueError(f"batch must be 1 to 127, not {batch}")
        self.device = resolve_device(device)
        self.card, model = load_card(card or default_card(self.device))
        self.score_threshold = self.card.decode.score_threshold if score_threshold is None else score_threshold
        self.batch = batch
        asked = self.card.input.channels
        if asked != tuple(name for name in pillar_channels() if name in asked):
            raise ModelError(
                f"{model}: the card's channels must be some of those that this version computes, in this order: "
                f"{', '.join(pillar_channels())}"
            )
        self._network = Network(
            model,
            {self.card.input.name: self.card.input.shape},
            {self.card.output.name: self.card.output.shape},
            device=self.device,
            threads=threads,
            precision=precision,
            providers=providers,
            batch=batch,
            classes=self.card.classes,
        )
        self.provider, self.fallback = self._network.provider, self._network.fallback
        self._slots = [_Slot(self.card, capacity, self.device, not candidates_only) for _ in range(batch)]
        self._second = None
        self._least = self.score_threshold
        if self.card.second is not None and not candidates_only:
            self._least = self.card.second.candidate_score
            self._second = SecondStage(
                self.card,
                model.parent,
                device=self.device,
                threads=threads,
                precision=precision,
                providers=providers,
                capacity=capacity,
                batch=batch,
            )
            for row, slot in enumerate(self._slots):
                look = self._second.look(row)
                slot.found = (look.rescore.boxes_out, look.rescore.scores, look.rescore.kinds)
                slot.kept = look.nms
                slot.dropped.append(("second.max_boxes", self.card.second.max_boxes, look.rescore.dropped))
                slot.dropped.append(("decode.max_objects", self.card.decode.max_objects, look.nms.dropped))
        self._maps = wp.zeros((batch, *self.card.output.shape[1:]), dtype=wp.float32, device=self.device)
        # One cloud's grid is read where our kernel draws it; those of several are gathered into one array.
        self._grids = (
            self._slots[0].pillars.grid
            if batch == 1
            else wp.zeros((batch, *self.card.input.shape[1:]), dtype=wp.float32, device=self.device)
        )
        self._network.bind_input(self.card.input.name, self._grids)
        self._network.bind_output(self.card.output.name, self._maps)
        self._class_indices = np.array([CLASSES.index(name) for name in self.card.classes], np.int32)
        self.overflow = 0

    def detect(self, xyz: wp.array, count: wp.array, *, sensor_height: float | wp.array) -> Detections:
        """The objects of a cloud.

        Args:
            xyz: Positions in the sensor's frame [m], z up, shape (n,), dtype vec3, on the head's device.
            count: Number of points, shape (1,), int32, on the same device.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.

        Returns:
            Boxes in the sensor's frame, best score first; velocities are NaN, as one scan does not show them. A box
            that holds the sensor is of the vehicle that carries it, or of the hole around it, and is left out.

        Raises:
            ValueError: A height that is not finite, where it is a number.
        """
        return self._detect([(xyz, count, checked_height(sensor_height))])[0]

    def detect_points(self, points: Any, sensor_height: float) -> Detections:
        """The objects of a cloud given as any array of points.

        Args:
            points: Shape (n, 3 or more), x y z in the sensor's frame [m]; any array family.
            sensor_height: Height of the sensor above the ground [m].

        Raises:
            TypeError: `points` is no array of a floating type.
            ValueError: It has not at least three columns, or the height is not finite.
        """
        return self.detect_batch([points], [sensor_height])[0]

    def detect_batch(self, clouds: Sequence[Any], sensor_heights: Sequence[float]) -> list[Detections]:
        """The objects of several clouds, which the network sees in one run.

        Args:
            clouds: At most `batch`, each of shape (n, 3 or more), any array family.
            sensor_heights: Height of each one's sensor above the ground [m].

        Raises:
            TypeError: A cloud is no array of a floating type.
            ValueError: More clouds than `batch`, none, or not as many heights; or a cloud that has not at least three
                columns, or a height that is not finite.
        """
        if not 1 <= len(clouds) <= self.batch or len(sensor_heights) != len(clouds):
            raise ValueError(
                f"clouds must be 1 to {self.batch}, each with a height, not {len(clouds)} and {len(sensor_heights)}"
            )
        given, owners = [], []
        for slot, points, height in zip(self._slots, clouds, sensor_heights, strict=False):
            borrowed = borrow_points(points)
            owners.append(borrowed)
            xyz = borrowed.xyz
            if borrowed.device != self.device:
                xyz = wp.clone(xyz.contiguous(), device=self.device)
            slot.count.fill_(len(borrowed))
            given.append((xyz, slot.count, checked_height(height)))
        return self._detect(given)

    def warm_up(self) -> None:
        """Runs once on an empty cloud, so that the first real one finds kernels compiled and buffers touched."""
        count = wp.zeros(1, dtype=wp.int32, device=self.device)
        nothing = wp.zeros(1, dtype=wp.vec3, device=self.device)
        self._detect([(nothing, count, 1.7)] * self.batch)

    def _detect(self, clouds: list[tuple[wp.array, wp.array, float | wp.array]]) -> list[Detections]:
        self._draw(clouds)
        self._network.run()
        self._find(clouds)
        self.overflow = 0
        return [self._read(slot) for slot, _ in zip(self._slots, clouds, strict=False)]

    def _draw(self, clouds: list[tuple[wp.array, wp.array, float | wp.array]]) -> None:
        for row, (slot, cloud) in enumerate(zip(self._slots, clouds, strict=False)):
            slot.pillars.launch(*cloud)
            if self.batch > 1:
                wp.copy(self._grids[row : row + 1], slot.pillars.grid)

    def _find(self, clouds: list[tuple[wp.array, wp.array, float | wp.array]]) -> None:
        for row, (slot, cloud) in enumerate(zip(self._slots, clouds, strict=False)):
            slot.decode.launch(self._maps[row : row + 1], self._least, cloud[2])
            slot.nms.launch(slot.decode.boxes, slot.decode.scores, slot.decode.count)
        if self._second is not None:
            self._second.launch(clouds, [(slot.decode, slot.nms) for slot in self._slots], self.score_threshold)
        for slot, cloud in zip(self._slots, clouds, strict=False):
            if slot.refine is not None:
                boxes, _, kinds = slot.found
                slot.refine.launch(cloud[0], cloud[1], boxes, kinds, slot.kept.keep, slot.kept.keep_count)

    def _read(self, slot: _Slot) -> Detections:
        kept = int(slot.kept.keep_count.numpy()[0])
        limits = [(name, allowed, int(count.numpy()[0])) for name, allowed, count in slot.dropped]
        if dropped := sum(beyond for _, _, beyond in limits):
            self.overflow += dropped
            _log.warning("%s: beyond the card's limits: %s", self.card.name, said_overflow(limits))
        if kept == 0:
            return Detections.empty()
        boxes, scores, kinds = (array.numpy() for array in slot.found)
        keep = slot.kept.keep.numpy()[:kept]
        keep = keep[~_holds_the_sensor(boxes[keep])]
        return Detections(
            boxes=boxes[keep],
            scores=scores[keep],
            classes=self._class_indices[kinds[keep]],
            velocities=np.full((len(keep), 2), np.nan, np.float32),
            background=np.zeros(len(keep), bool),
        )


def _holds_the_sensor(boxes: np.ndarray) -> np.ndarray:
    """Which boxes have the origin inside, seen from above; shape (k,), bool."""
    c, s = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    along, across = boxes[:, 0] * c + boxes[:, 1] * s, boxes[:, 1] * c - boxes[:, 0] * s
    return (2.0 * np.abs(along) < boxes[:, 3]) & (2.0 * np.abs(across) < boxes[:, 4])
