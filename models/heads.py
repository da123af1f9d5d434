"""Heads of every kind by their cards: points in, objects out; or an image in, boxes in it or masks of it out.

A LiDAR's head has `detect(xyz, count, sensor_height=…)` and `detect_points(points, sensor_height)`, a camera's
`detect(image)`; all have `warm_up()`, `card`, `provider` and `fallback`. A new kind is a card class with a `kind` of
its own, a head class, and a line below.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol

import warp as wp

from ..errors import ModelError
from .card import ModelCard, default_card, load_card, named_card, read_card_file
from .detections import Detections

__all__ = ["KINDS", "LidarHead", "card_kind", "check_head", "open_head", "read_card"]

KINDS = {
    "pillar_center": ("head", "DetectionHead", "card", "HeadCard"),
    "anchor_pillars": ("anchor_head", "AnchorHead", "anchor_card", "AnchorCard"),
    "occupancy_corners": ("occupancy_head", "OccupancyHead", "occupancy_head", "OccupancyCard"),
    "yolox": ("camera.detector", "ImageDetector", "camera.card", "ImageDetectorCard"),
    "fastestdet": ("camera.detector", "ImageDetector", "camera.card", "ImageDetectorCard"),
    "masks": ("camera.masks", "MaskHead", "camera.card", "MaskCard"),
}
"""By the kind on a card: module and class of the head, module and class of the card."""


class LidarHead(Protocol):
    """What all heads of LiDARs have in common."""

    card: Any
    device: str
    provider: str
    fallback: str
    overflow: int

    def detect(self, xyz: wp.array, count: wp.array, *, sensor_height: float | wp.array) -> Detections:
        """The objects of a cloud on the head's device."""
        ...

    def detect_points(self, points: Any, sensor_height: float) -> Detections:
        """The objects of a cloud given as any array of points."""
        ...

    def warm_up(self) -> None:
        """Runs once, so that the first real frame takes no longer than the others."""
        ...


def card_kind(path: str | Path) -> str:
    """The kind that a card says it is of; `pillar_center` where it says none.

    Raises:
        ModelError: It cannot be read, or is of no known kind.
    """
    content = read_card_file(named_card(path))
    kind = content.get("kind", "pillar_center") if isinstance(content, dict) else None
    if not isinstance(kind, str) or kind not in KINDS:
        raise ModelError(f"{path}: a card of the kind {kind!r}; there are: {', '.join(KINDS)}")
    return kind


def _named(module: str, name: str) -> Any:
    return getattr(importlib.import_module(f".{module}", __package__), name)


def read_card(path: str | Path) -> tuple[ModelCard, Path]:
    """A card of any kind with the path of its model, checked as `load_card` does.

    Raises:
        ModelError: The card or its model is missing, not valid, or the two do not fit.
    """
    _, _, module, name = KINDS[card_kind(path)]
    return load_card(path, _named(module, name))


def check_head(path: str | Path) -> tuple[ModelCard, Path]:
    """What `read_card` gives, of a head that was opened on the CPU to see whether card and model fit.

    Raises:
        ModelError: They do not, or one is missing or not valid.
    """
    checked = read_card(path)
    module, name, _, _ = KINDS[card_kind(path)]
    _named(module, name)(path)
    return checked


def open_head(card: str | Path | None = None, **options: Any) -> Any:
    """The head of a LiDAR's card, of whatever kind.

    Args:
        card: The YAML file; the name of a head that ships with warploom, `pillar_center` or `pillar_center_int8`; None
            is the one of these for the device.
        options: Of the head's class: device, threads, precision, providers, score_threshold, capacity.

    Raises:
        ModelError: The card or its model is missing, not valid, the two do not fit, or the head is a camera's.
    """
    path = card or default_card(str(options.get("device", "cpu")))
    kind = card_kind(path)
    module, name, _, _ = KINDS[kind]
    if module.startswith("camera."):
        read_card(path)
        raise ModelError(
            f"{path}: a head of the kind {kind} is for images; one for the points of a LiDAR is wanted here"
        )
    return _named(module, name)(path, **options)
