"""A PointPillars head with anchors at work: points in, boxes with class and score out.

Our kernels make the pillars and read the boxes; between them ONNX Runtime runs the network on the arrays as they lie.
After Lang et al., PointPillars, CVPR 2019, as OpenPCDet and mmdetection3d have it.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..kernels.anchor_decode import AnchorDecode
from ..kernels.device import resolve_device
from ..kernels.interop import borrow_points
from ..kernels.nms import RotatedNms
from ..kernels.voxel import Voxelize
from .anchor_card import AnchorCard
from .card import load_card
from .classes import CLASSES
from .detections import Detections, checked_height, said_overflow
from .network import Network

__all__ = ["AnchorHead"]

_log = logging.getLogger(__name__)


class AnchorHead:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: The card (YAML), its ONNX file beside it.
        device: As for `DetectionHead`, and so are the others.
        threads: CPU threads of the network.
        precision: What it computes in on a GPU.
        providers: Where it may run, the best first.
        score_threshold: Least score of a detection; None is the card's.
        capacity: Most points of a cloud.

    Attributes:
        provider: Where the network runs.
        fallback: Empty where that is the first choice; else what is missing.
        overflow: Pillars and objects that the last cloud had beyond the card's limits.

    Raises:
        ModelError: The card or its model is missing, not valid, or the two do not fit.
    """

    needs_intensity: bool
    """Whether `detect` wants the fourth column."""

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
        self.card, model = load_card(card, AnchorCard)
        self.device = device = resolve_device(device)
        spec, read = self.card.pillars, self.card.read
        self.score_threshold = read.score_threshold if score_threshold is None else score_threshold
        self.needs_intensity = spec.features == 4
        self._network = Network(
            model,
            self.card.inputs,
            self.card.outputs,
            device=device,
            threads=threads,
            precision=precision,
            providers=providers,
            classes=self.card.classes,
        )
        self.provider, self.fallback = self._network.provider, self._network.fallback
        self._voxelize = Voxelize(
            voxel_size=spec.pillar,
            point_range=spec.point_range,
            columns=spec.features,
            max_points=spec.max_points,
            max_voxels=spec.max_pillars,
            capacity=capacity,
            device=device,
        )
        self._count = wp.zeros(1, dtype=wp.int32, device=device)
        self._height = wp.zeros(1, dtype=wp.float32, device=device)
        self._maps = {
            name: wp.zeros(tuple(int(n or 0) for n in shape), dtype=wp.float32, device=device)
            for name, shape in self.card.outputs.items()
        }
        for name, array in self._maps.items():
            self._network.bind_output(name, array)
        self._network.bind_input("pillars", self._voxelize.voxel_count)
        self._network.bind_input("sensor_height", self._height)
        self._bind_pillars(spec.max_pillars)
        low, high = spec.point_range[:3], spec.point_range[3:]
        rows, columns = self.card.shape
        spans = ((high[0] - low[0], columns), (high[1] - low[1], rows))
        steps = tuple(span / (count - 1) if read.at_corners else span / count for span, count in spans)
        self._decode = AnchorDecode(
            anchors=tuple(
                (*anchor.size, anchor.bottom + 0.5 * anchor.size[2], yaw)
                for anchor in self.card.anchors
                for yaw in anchor.yaws
            ),
            classes=len(self.card.classes),
            shape=self.card.shape,
            first=(low[0], low[1]) if read.at_corners else (low[0] + 0.5 * steps[0], low[1] + 0.5 * steps[1]),
            step=(steps[0], steps[1]),
            capacity=read.max_candidates,
            each_class=read.each_class,
            direction_offset=read.direction_offset,
            direction_limit=read.direction_limit,
            trained_height=spec.sensor_height,
            device=device,
        )
        self._nms = RotatedNms(
            capacity=read.max_candidates, threshold=read.nms_iou, max_output=read.max_objects, device=device
        )
        self._class_indices = np.array([CLASSES.index(name) for name in self.card.classes], np.int32)
        self.overflow = 0

    def _bind_pillars(self, count: int) -> None:
        """Binds so many pillars; what lies beyond those there are, the network leaves out itself."""
        grid = self._voxelize
        self._network.bind_input("points", grid.features[:count])
        self._network.bind_input("counts", grid.counts[:count])
        self._network.bind_input("cells", grid.coords[:count])

    def detect(
        self,
        xyz: wp.array,
        count: wp.array,
        *,
        sensor_height: float | wp.array,
        intensity: wp.array | None = None,
    ) -> Detections:
        """The objects of a cloud.

        Args:
            xyz: Positions in the sensor's frame [m], z up, shape (n,), dtype vec3, on the head's device.
            count: Number of points, shape (1,), int32, on the same device.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
            intensity: In [0, 1], shape (n,), float32; None: 0 everywhere, with which a network that was trained on it
                finds less.

        Returns:
            Boxes in the sensor's frame, best score first; velocities are NaN, as one scan does not show them.

        Raises:
            ValueError: A height that is not finite, where it is a number.
        """
        height = checked_height(sensor_height)
        if isinstance(height, wp.array):
            wp.copy(self._height, height)
        else:
            self._height.fill_(height)
        extra = None
        if self.needs_intensity:
            extra = intensity
            if extra is None:
                extra = wp.zeros(xyz.shape[0], dtype=wp.float32, device=self.device)
        self._voxelize.launch(xyz, count, extra)
        if self.device == "cpu":
            # Elsewhere the host does not know how many there are, and all are computed.
            self._bind_pillars(max(1, int(self._voxelize.voxel_count.numpy()[0])))
        self._network.run()
        self._decode.launch(
            self._maps["scores"],
            self._maps["residuals"],
            self._maps["directions"],
            self.score_threshold,
            self._height,
        )
        boxes = self._decode.apart if self.card.read.each_class else self._decode.boxes
        self._nms.launch(boxes, self._decode.scores, self._decode.count)
        return self._read()

    def detect_points(self, points: Any, sensor_height: float) -> Detections:
        """The objects of a cloud given as any array of points.

        Args:
            points: Shape (n, 3 or more), x y z in the sensor's frame [m], and intensity in [0, 1] as the fourth column;
                any array family.
            sensor_height: Height of the sensor above the ground [m].

        Raises:
            TypeError: `points` is no array of a floating type.
            ValueError: It has not at least three columns, or the height is not finite.
        """
        borrowed = borrow_points(points)
        xyz, intensity = borrowed.xyz, borrowed.intensity
        if borrowed.device != self.device:
            xyz = wp.clone(xyz.contiguous(), device=self.device)
            intensity = None if intensity is None else wp.clone(intensity.contiguous(), device=self.device)
        self._count.fill_(len(borrowed))
        return self.detect(xyz, self._count, sensor_height=sensor_height, intensity=intensity)

    def warm_up(self) -> None:
        """Runs once on an empty cloud, so that the first real one finds kernels compiled and buffers touched."""
        self._count.zero_()
        nothing = wp.zeros(1, dtype=wp.vec3, device=self.device)
        self.detect(nothing, self._count, sensor_height=self.card.pillars.sensor_height)

    def _read(self) -> Detections:
        kept = int(self._nms.keep_count.numpy()[0])
        pillars, read = self.card.pillars, self.card.read
        limits = (
            ("pillars.max_pillars", pillars.max_pillars, int(self._voxelize.dropped.numpy()[1])),
            ("read.max_candidates", read.max_candidates, int(self._decode.dropped.numpy()[0])),
            ("read.max_objects", read.max_objects, int(self._nms.dropped.numpy()[0])),
        )
        self.overflow = sum(beyond for _, _, beyond in limits)
        if self.overflow:
            _log.warning("%s: beyond the card's limits: %s", self.card.name, said_overflow(limits))
        if kept == 0:
            return Detections.empty()
        keep = self._nms.keep.numpy()[:kept]
        return Detections(
            boxes=self._decode.boxes.numpy()[keep],
            scores=self._decode.scores.numpy()[keep],
            classes=self._class_indices[self._decode.classes_found.numpy()[keep]],
            velocities=np.full((kept, 2), np.nan, np.float32),
            background=np.zeros(kept, bool),
        )
