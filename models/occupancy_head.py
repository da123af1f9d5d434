"""A fully convolutional head in three dimensions at work: points in, vehicles out.

After Li, 3D Fully Convolutional Network for Vehicle Detection in Point Cloud, IROS 2017: a grid of what is occupied
goes in; at each cell of a coarser one come out how sure the network is of a vehicle, and the corners of its box.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
import warp as wp
from pydantic import Field

from ..kernels.device import resolve_device
from ..kernels.interop import borrow_points
from .card import LidarCard, load_card
from .classes import class_index
from .detections import Detections, checked_height
from .network import Network

__all__ = ["OccupancyCard", "OccupancyHead", "boxes_of_corners"]

# Of the eight corners: which are in front, to the left, on top.
_FRONT = np.array([0, 1, 0, 0, 0, 1, 1, 1], bool)
_LEFT = np.array([0, 0, 1, 0, 1, 1, 0, 1], bool)
_TOP = np.array([0, 0, 0, 1, 1, 0, 1, 1], bool)


class OccupancyCard(LidarCard):
    """The card of such a head.

    Its network takes `occupied` (1, x, y, z) and gives `scores` (1, …) and `corners` (24, …).
    """

    kind: Literal["occupancy_corners"] = "occupancy_corners"
    point_range: tuple[float, float, float, float, float, float]
    """xmin ymin zmin xmax ymax zmax in the sensor's frame [m], upper bounds open."""
    cell: float = Field(gt=0)
    """[m]"""
    stride: int = Field(ge=1)
    """Cells along an edge of a cell of the output."""
    wedge: float | None = None
    """Only points with |y| < x − wedge are seen [m]; null: all."""
    sensor_height: float = 1.73
    """Above the ground, of the sensor that the network was trained with [m]: other heights are brought to it."""
    score_threshold: float = Field(ge=0, le=1)
    suppress_within: float = Field(gt=0)
    """Of two boxes whose centres are nearer than this from above, the better stays [m]."""

    @property
    def cells(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        low, high = self.point_range[:3], self.point_range[3:]
        x, y, z = (round((high[k] - low[k]) / self.cell) for k in range(3))
        return x, y, z

    @property
    def outputs(self) -> dict[str, tuple[int | None, ...]]:
        """Shapes of the network's outputs."""
        x, y, z = (-(-n // self.stride) for n in self.cells)
        return {"scores": (1, x, y, z), "corners": (24, x, y, z)}

    def contradiction(self) -> str:
        """What in it does not fit together."""
        if min(self.cells) < 1 or len(self.classes) != 1:
            return "point_range must have min < max, and there must be one class"
        return ""


def boxes_of_corners(corners: np.ndarray) -> np.ndarray:
    """The upright boxes nearest to eight corners each.

    Args:
        corners: Shape (k, 8, 3), in the order (−l −w 0) (+l −w 0) (−l +w 0) (−l −w h) (−l +w h) (+l +w 0) (+l −w h)
            (+l +w h).

    Returns:
        Shape (k, 7): x y z l w h yaw.
    """
    along = corners[:, _FRONT].mean(axis=1) - corners[:, ~_FRONT].mean(axis=1)
    across = corners[:, _LEFT].mean(axis=1) - corners[:, ~_LEFT].mean(axis=1)
    up = corners[:, _TOP].mean(axis=1) - corners[:, ~_TOP].mean(axis=1)
    sizes = [np.linalg.norm(each, axis=1) for each in (along, across, up)]
    yaw = np.arctan2(along[:, 1], along[:, 0])
    return np.column_stack([corners.mean(axis=1), *sizes, yaw])


class OccupancyHead:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: The card (YAML), its ONNX file beside it.
        device: As for `DetectionHead`, and so are the others.
        threads: CPU threads of the network.
        precision: What it computes in on a GPU.
        providers: Where it may run, the best first.
        score_threshold: Least score of a detection; None is the card's.
        capacity: Of no importance: clouds of any size do.

    Attributes:
        provider: Where the network runs.
        fallback: Empty where that is the first choice; else what is missing.
        overflow: Always 0.

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
        capacity: int = 1 << 18,
    ):
        if score_threshold is not None and not 0.0 <= score_threshold <= 1.0:
            raise ValueError(f"score_threshold must be in [0, 1], not {score_threshold}")
        self.card, model = load_card(card, OccupancyCard)
        self.device = resolve_device(device)
        self.score_threshold = self.card.score_threshold if score_threshold is None else score_threshold
        shape = (1, *self.card.cells)
        self._network = Network(
            model,
            {"occupied": shape},
            self.card.outputs,
            device=self.device,
            threads=threads,
            precision=precision,
            providers=providers,
            classes=self.card.classes,
        )
        self.provider, self.fallback = self._network.provider, self._network.fallback
        self._host = np.zeros(shape, np.float32)
        self._in = wp.array(self._host, dtype=wp.float32, device=self.device, copy=self.device != "cpu")
        self._network.bind_input("occupied", self._in)
        self._maps = {}
        for name, wanted in self.card.outputs.items():
            self._maps[name] = wp.zeros(tuple(n or 1 for n in wanted), dtype=wp.float32, device=self.device)
            self._network.bind_output(name, self._maps[name])
        self._class = class_index(self.card.classes[0])
        self.overflow = 0

    def detect(self, xyz: wp.array, count: wp.array, *, sensor_height: float | wp.array) -> Detections:
        """The vehicles of a cloud.

        Args:
            xyz: Positions in the sensor's frame [m], z up, shape (n,), dtype vec3.
            count: Number of points, shape (1,), int32.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
        """
        height = float(sensor_height.numpy()[0]) if isinstance(sensor_height, wp.array) else sensor_height
        return self.detect_points(xyz.numpy()[: int(count.numpy()[0])], height)

    def detect_points(self, points: Any, sensor_height: float) -> Detections:
        """The vehicles of a cloud given as an array.

        Args:
            points: Shape (n, 3 or more), x y z in the sensor's frame [m]; any array family.
            sensor_height: Height of the sensor above the ground [m].

        Returns:
            Boxes in the sensor's frame, best score first.

        Raises:
            TypeError: `points` is no array of a floating type.
            ValueError: It has not at least three columns, or the height is not finite.
        """
        lift = checked_height(sensor_height) - self.card.sensor_height
        self._occupy(borrow_points(points).xyz.numpy(), lift)
        if self.device != "cpu":
            self._in.assign(self._host)
        self._network.run()
        scores = self._maps["scores"].numpy()[0]
        sure = np.nonzero(scores >= self.score_threshold)
        if len(sure[0]) == 0:
            return Detections.empty()
        low = np.array(self.card.point_range[:3])
        places = np.stack(sure, axis=1) * (self.card.cell * self.card.stride) + low
        corners = self._maps["corners"].numpy()[(slice(None), *sure)].T.reshape(-1, 8, 3) + places[:, None]
        boxes, kept = boxes_of_corners(corners), []
        values = scores[sure]
        for k in np.argsort(-values, kind="stable"):
            apart = [np.hypot(*(boxes[k, :2] - boxes[other, :2])) for other in kept]
            if all(distance >= self.card.suppress_within for distance in apart):
                kept.append(int(k))
        boxes[:, 2] -= lift
        return Detections(
            boxes=boxes[kept].astype(np.float32),
            scores=values[kept].astype(np.float32),
            classes=np.full(len(kept), self._class, np.int32),
            velocities=np.full((len(kept), 2), np.nan, np.float32),
            background=np.zeros(len(kept), bool),
        )

    def warm_up(self) -> None:
        """Runs once on an empty cloud."""
        self.detect_points(np.zeros((0, 3), np.float32), self.card.sensor_height)

    def _occupy(self, xyz: np.ndarray, lift: float) -> None:
        """Marks the cells that hold a point."""
        # In double precision, as in training: many coordinates are on the edges of cells to the millimetre.
        xyz = xyz.astype(np.float64) + np.array([0.0, 0.0, lift])
        low, high = np.array(self.card.point_range).reshape(2, 3)
        with np.errstate(invalid="ignore"):
            inside = ((xyz >= low) & (xyz < high)).all(axis=1)
            if self.card.wedge is not None:
                inside &= np.abs(xyz[:, 1]) < xyz[:, 0] - self.card.wedge
        cells = ((xyz[inside] - low) / self.card.cell).astype(np.int64)
        cells = np.minimum(cells, np.array(self.card.cells) - 1)
        self._host.fill(0.0)
        self._host[0, cells[:, 0], cells[:, 1], cells[:, 2]] = 1.0
