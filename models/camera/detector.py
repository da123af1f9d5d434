"""Detectors in images: YOLOX and FastestDet, as their authors' ONNX files have them.

An image goes in as OpenCV reads it; boxes come out in its pixels. YOLOX (Ge et al., 2021) gives its grids undecoded:
centre and log size of a box at each cell of three strides, how sure it is of any object, and of each class. FastestDet
(dog-qiuqiu, 2022) has one grid; its score is object^0.6 · class^0.4.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

from ...kernels.device import resolve_device
from ...kernels.nms import rotated_nms
from ..card import load_card
from ..detections import said_overflow
from ..network import Network
from .card import ImageDetectorCard
from .images import checked_image, fit_image

__all__ = ["ImageDetections", "ImageDetector"]

_log = logging.getLogger(__name__)

_APART = 1e5  # pixels between boxes of classes that are suppressed each by itself


@dataclass(frozen=True, eq=False, kw_only=True)
class ImageDetections:
    """The k objects found in one image, best score first."""

    boxes: np.ndarray
    """Left, top, right, bottom [pixels of the image], cut at its edges, shape (k, 4), float32."""
    scores: np.ndarray
    """In [0, 1], shape (k,), float32."""
    labels: np.ndarray
    """Indices into `names`, shape (k,), int32."""
    names: tuple[str, ...]
    """The card's classes."""

    def __len__(self) -> int:
        return len(self.boxes)


class ImageDetector:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: The card (YAML), its ONNX file beside it.
        device: A Warp device: where the network runs if there is a provider for it.
        threads: CPU threads of the network.
        precision: What it computes in on a GPU.
        providers: Where it may run, the best first.
        score_threshold: Least score of a detection; None is the card's.

    Attributes:
        provider: Where the network runs.
        fallback: Empty where that is the first choice; else what is missing.
        overflow: Objects that the last image had beyond the card's `max_objects`.

    Raises:
        ModelError: The card or its model is missing, not valid, or the two do not fit.
    """

    def __init__(
        self,
        card: str | Path,
        *,
        device: str = "cpu",
        threads: int = 2,
        precision: str = "fp32",
        providers: Sequence[str] | None = None,
        score_threshold: float | None = None,
    ):
        if score_threshold is not None and not 0.0 <= score_threshold <= 1.0:
            raise ValueError(f"score_threshold must be in [0, 1], not {score_threshold}")
        self.card, model = load_card(card, ImageDetectorCard)
        self.device = resolve_device(device)
        self.score_threshold = self.card.read.score_threshold if score_threshold is None else score_threshold
        spec, output = self.card.input, self.card.output
        self._network = Network(
            model,
            {spec.name: spec.shape},
            {output.name: output.shape},
            device=self.device,
            threads=threads,
            precision=precision,
            providers=providers,
            classes=self.card.classes,
        )
        self.provider, self.fallback = self._network.provider, self._network.fallback
        self._host = np.zeros(spec.shape, np.float32)
        self._in = wp.array(self._host, dtype=wp.float32, device=self.device, copy=self.device != "cpu")
        self._out = wp.zeros(output.shape, dtype=wp.float32, device=self.device)
        self._network.bind_input(spec.name, self._in)
        self._network.bind_output(output.name, self._out)
        self._cells = _cells(self.card)
        self.overflow = 0

    def detect(self, image: np.ndarray) -> ImageDetections:
        """The objects in an image.

        Args:
            image: Shape (height, width, 3), uint8, BGR as OpenCV reads it.
        """
        image = checked_image(image)
        scales = fit_image(image, self.card.input, self._host)
        if self.device != "cpu":
            self._in.assign(self._host)
        self._network.run()
        boxes, scores, labels = (_yolox if self.card.kind == "yolox" else _fastestdet)(
            self._out.numpy()[0], self._cells, self.score_threshold
        )
        self.overflow = 0
        if len(boxes):
            boxes, scores, labels = self._suppress(boxes, scores, labels)
            edges = np.array([image.shape[1], image.shape[0]] * 2, np.float32)
            boxes = np.clip(boxes / np.array(scales * 2), 0.0, edges)
        return ImageDetections(
            boxes=boxes.astype(np.float32),
            scores=scores.astype(np.float32),
            labels=labels.astype(np.int32),
            names=self.card.classes,
        )

    def warm_up(self) -> None:
        """Runs once on a grey image."""
        self.detect(np.full((*self.card.input.shape[2:], 3), 114, np.uint8))

    def _suppress(
        self, boxes: np.ndarray, scores: np.ndarray, labels: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Of boxes that overlap too much, the best."""
        read = self.card.read
        flat = np.zeros((len(boxes), 7), np.float32)
        flat[:, :2] = 0.5 * (boxes[:, :2] + boxes[:, 2:])
        flat[:, 3:5] = boxes[:, 2:] - boxes[:, :2]
        flat[:, 5] = 1.0
        if read.each_class:
            flat[:, 0] += labels * _APART
        keep = rotated_nms(flat, scores.astype(np.float32), read.nms_iou)
        self.overflow = max(0, len(keep) - read.max_objects)
        if self.overflow:
            limit = ("read.max_objects", read.max_objects, self.overflow)
            _log.warning("%s: beyond the card's limits: %s", self.card.name, said_overflow([limit]))
        keep = keep[: read.max_objects]
        return boxes[keep], scores[keep], labels[keep]


def _cells(card: ImageDetectorCard) -> np.ndarray:
    """Column, row and stride of every cell in the order of the output, shape (cells, 3)."""
    height, width = card.input.shape[2:]
    parts = []
    for stride in card.read.strides:
        row, column = np.mgrid[: height // stride, : width // stride]
        parts.append(np.stack([column.ravel(), row.ravel(), np.full(row.size, stride)], axis=1))
    return np.concatenate(parts).astype(np.float32)


def _yolox(raw: np.ndarray, cells: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes in the input's pixels, scores and labels of what is sure enough, from (cells, 5 + classes)."""
    labels = raw[:, 5:].argmax(axis=1)
    scores = raw[:, 4] * raw[np.arange(len(raw)), 5 + labels]
    sure = np.flatnonzero(scores >= least)
    raw, stride = raw[sure], cells[sure, 2:]
    centre = (raw[:, :2] + cells[sure, :2]) * stride
    half = 0.5 * np.exp(np.clip(raw[:, 2:4], -20.0, 20.0)) * stride
    return np.concatenate([centre - half, centre + half], axis=1), scores[sure], labels[sure]


def _fastestdet(raw: np.ndarray, cells: np.ndarray, least: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same from (5 + classes, rows, columns)."""
    rows, columns = raw.shape[1:]
    table = raw.reshape(len(raw), -1).T
    labels = table[:, 5:].argmax(axis=1)
    scores = np.maximum(table[:, 0], 0.0) ** 0.6 * np.maximum(table[np.arange(len(table)), 5 + labels], 0.0) ** 0.4
    sure = np.flatnonzero(scores >= least)
    table, stride = table[sure], cells[sure, 2:]
    centre = (cells[sure, :2] + np.tanh(table[:, 1:3])) * stride
    size = np.array([columns, rows], np.float32) * stride
    half = 0.5 * size / (1.0 + np.exp(-table[:, 3:5]))
    return np.concatenate([centre - half, centre + half], axis=1), scores[sure], labels[sure]
