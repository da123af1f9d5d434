"""The card of a PointPillars head with anchors: how points become pillars, where anchors stand, how boxes are read."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .card import MOST_BOXES, CardPart, LidarCard

__all__ = ["AnchorCard", "AnchorSpec", "PillarSpec", "ReadSpec"]


class PillarSpec(CardPart):
    """How points become pillars: the first points of each in the order of the cloud, zero-padded."""

    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax in the sensor's frame [m], upper bounds open."""
    pillar: tuple[float, float, float]
    """Edges along x y z [m]."""
    max_points: int = Field(32, ge=1, le=1024)
    """That a pillar keeps."""
    max_pillars: int = Field(40_000, ge=1, le=1 << 20)
    features: Literal[3, 4] = 4
    """Columns of a point: x y z, and intensity in [0, 1]."""
    sensor_height: float = 1.73
    """Above the ground, of the sensor that the network was trained with [m]: other heights are brought to it."""

    @property
    def cells(self) -> tuple[int, int]:
        """Columns along x and rows along y of the grid."""
        low, high = self.point_range[:3], self.point_range[3:]
        columns, rows = (round((high[k] - low[k]) / self.pillar[k]) for k in (0, 1))
        return columns, rows


class AnchorSpec(CardPart):
    """The anchors of one class."""

    size: tuple[float, float, float]
    """Length width height [m]."""
    bottom: float
    """z of the bottom in the sensor's frame [m]."""
    yaws: tuple[float, ...] = (0.0, 1.5707963)
    """[rad]"""


class ReadSpec(CardPart):
    """From maps to boxes."""

    stride: int = Field(2, ge=1)
    """Pillars along an edge of a cell of the maps."""
    at_corners: bool = True
    """Whether anchors stand from edge to edge of the range, as the two frameworks have it, or at the cells' centres."""
    direction_offset: float = 0.78539
    direction_limit: float = 0.0
    score_threshold: float = Field(0.1, ge=0, le=1)
    nms_iou: float = Field(0.01, gt=0, le=1)
    each_class: bool = False
    """Whether classes are suppressed each by itself, and an anchor may be of several (mmdetection3d's way)."""
    max_candidates: int = Field(4096, ge=1, le=MOST_BOXES)
    max_objects: int = Field(500, ge=1, le=MOST_BOXES)


class AnchorCard(LidarCard):
    """The card of a PointPillars head, see `models.anchor_head`.

    The network takes `points` (pillars, max_points, features), `counts` (pillars,), `cells` (pillars, 3: z y x),
    `pillars` (1,) and `sensor_height` (1,), and gives `scores`, `residuals` and `directions`.
    """

    kind: Literal["anchor_pillars"] = "anchor_pillars"
    pillars: PillarSpec
    anchors: tuple[AnchorSpec, ...]
    """Of each class, in their order."""
    read: ReadSpec

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the maps."""
        columns, rows = self.pillars.cells
        return rows // self.read.stride, columns // self.read.stride

    @property
    def anchor_count(self) -> int:
        """At each cell."""
        return sum(len(anchor.yaws) for anchor in self.anchors)

    @property
    def inputs(self) -> dict[str, tuple[int | None, ...]]:
        """Shapes of the network's inputs; None: as many pillars as there are."""
        return {
            "points": (None, self.pillars.max_points, self.pillars.features),
            "counts": (None,),
            "cells": (None, 3),
            "pillars": (1,),
            "sensor_height": (1,),
        }

    @property
    def outputs(self) -> dict[str, tuple[int | None, ...]]:
        """Shapes of the network's outputs."""
        count = self.anchor_count
        return {
            "scores": (1, count * len(self.classes), *self.shape),
            "residuals": (1, count * 7, *self.shape),
            "directions": (1, count * 2, *self.shape),
        }

    def contradiction(self) -> str:
        """What in it does not fit together."""
        if len(self.anchors) != len(self.classes):
            return f"anchors are of {len(self.anchors)} classes, but there are {len(self.classes)}: name each"
        if not all(anchor.yaws and min(anchor.size) > 0 for anchor in self.anchors):
            return "anchors must each have a size above 0 and one yaw or more"
        low, high = self.pillars.point_range[:3], self.pillars.point_range[3:]
        if not all(a < b for a, b in zip(low, high, strict=True)) or min(self.pillars.pillar) <= 0:
            return "pillars.point_range must have min < max, and pillars.pillar must be > 0"
        if min(self.shape) < 1 or any(n % self.read.stride for n in self.pillars.cells):
            return f"read.stride {self.read.stride} does not divide the grid of {self.pillars.cells}"
        return ""
