"""A detection head at work: points in, boxes with class and score out.

Pillars, network and decoding each have one buffer for life: our kernel writes the network's input, ONNX Runtime
writes its output, both where they lie, and our kernels turn the maps into boxes.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..errors import ModelError
from ..kernels.decode import CenterDecode
from ..kernels.device import resolve_device
from ..kernels.interop import borrow_points
from ..kernels.nms import RotatedNms
from ..kernels.pillar import PillarGrid, pillar_channels
from .card import DEFAULT_CARD, HeadCard, load_card
from .classes import CLASSES
from .detections import Detections

__all__ = ["PRECISIONS", "DetectionHead"]

_log = logging.getLogger(__name__)

PRECISIONS = ("fp32", "tf32", "fp16")
"""What a network on a GPU can compute in; on a CPU it is always fp32."""

_ON_CUDA = ("TensorrtExecutionProvider", "CUDAExecutionProvider")


class DetectionHead:
    """The network of one card, loaded and bound to its buffers.

    Args:
        card: A head's card (YAML), its ONNX file beside it; None is the head that ships with warploom.
        device: A Warp device, such as `cpu` or `cuda:0`; the kernels run there, and the network too where ONNX
            Runtime has a provider for it, else on the CPU, which is logged and said by `provider`.
        threads: CPU threads of the network.
        precision: What the network computes in on a GPU, one of `PRECISIONS`; fp16 needs ONNX Runtime's provider for
            TensorRT, and is tf32 without it, which is logged. A CPU computes in fp32.
        score_threshold: Least score of a detection; None is the card's.
        capacity: Most points of a cloud.

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
        score_threshold: float | None = None,
        capacity: int = 1 << 18,
    ):
        if score_threshold is not None and not 0.0 <= score_threshold <= 1.0:
            raise ValueError(f"score_threshold must be in [0, 1], not {score_threshold}")
        if threads < 1:
            raise ValueError(f"threads must be at least 1, not {threads}")
        if precision not in PRECISIONS:
            raise ValueError(f"precision must be one of {', '.join(PRECISIONS)}, not {precision!r}")
        self.card, model = load_card(card or DEFAULT_CARD)
        self.device = resolve_device(device)
        self.score_threshold = self.card.decode.score_threshold if score_threshold is None else score_threshold
        if self.card.input.channels != pillar_channels():
            raise ModelError(
                f"{model}: the card's channels are not those that this version computes: {', '.join(pillar_channels())}"
            )
        self._pillars = PillarGrid(
            point_range=self.card.input.point_range, cell=self.card.input.cell, capacity=capacity, device=self.device
        )
        self._session, self.provider = _session(model, self.card, self.device, threads, precision)
        self.fallback = ""
        self._count = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._bind()
        decode = self.card.decode
        self._decode = CenterDecode(
            shape=self.card.output.unfolded,
            classes=len(self.card.classes),
            unfold=self.card.output.unfold,
            origin=self.card.input.point_range[:2],
            cell=self.card.input.cell * decode.stride,
            capacity=decode.max_candidates,
            device=self.device,
        )
        self._nms = RotatedNms(
            capacity=decode.max_candidates,
            threshold=decode.nms_iou,
            max_output=decode.max_objects,
            device=self.device,
        )
        self._class_indices = np.array([CLASSES.index(name) for name in self.card.classes], np.int32)
        self.overflow = 0
        """Objects that the last frame had beyond the card's `max_candidates` or `max_objects`."""

    def _bind(self) -> None:
        """Binds the network to buffers of ours: the pillars' own where the network runs on the same device."""
        self._binding = self._session.io_binding()
        shared = self.device == "cpu" or self.provider in _ON_CUDA
        self._maps = wp.zeros(self.card.output.shape, dtype=wp.float32, device=self.device)
        host = None if shared else "cpu"
        self._network_in = (
            self._pillars.grid if shared else wp.zeros(self._pillars.shape, dtype=wp.float32, device=host)
        )
        self._network_out = self._maps if shared else wp.zeros(self._maps.shape, dtype=wp.float32, device=host)
        place = "cuda" if shared and self.device != "cpu" else "cpu"
        index = wp.get_device(self.device).ordinal if place == "cuda" else 0
        for bind, name, array in (
            (self._binding.bind_input, self.card.input.name, self._network_in),
            (self._binding.bind_output, self.card.output.name, self._network_out),
        ):
            bind(name, place, index, np.float32, tuple(array.shape), array.ptr)

    def detect(self, xyz: wp.array, count: wp.array, *, sensor_height: float | wp.array) -> Detections:
        """The objects of a cloud.

        Args:
            xyz: Positions in the sensor's frame [m], z up, shape (n,), dtype vec3, on the head's device.
            count: Number of points, shape (1,), int32, on the same device.
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.

        Returns:
            Boxes in the sensor's frame, best score first; velocities are NaN, as one scan does not show them.
        """
        self._pillars.launch(xyz, count, sensor_height)
        self._infer()
        self._decode.launch(self._maps, self.score_threshold, sensor_height)
        self._nms.launch(self._decode.boxes, self._decode.scores, self._decode.count)
        return self._detections()

    def detect_points(self, points: Any, sensor_height: float) -> Detections:
        """The objects of a cloud given as any array of points.

        Args:
            points: Shape (n, 3 or more), x y z in the sensor's frame [m]; any array family.
            sensor_height: Height of the sensor above the ground [m].
        """
        borrowed = borrow_points(points)
        xyz = borrowed.xyz
        if borrowed.device != self.device:
            xyz = wp.clone(xyz.contiguous(), device=self.device)
        self._count.fill_(len(borrowed))
        return self.detect(xyz, self._count, sensor_height=sensor_height)

    def warm_up(self) -> None:
        """Runs once on an empty cloud, so that the first real one finds kernels compiled and buffers touched."""
        self._count.zero_()
        self.detect(wp.zeros(1, dtype=wp.vec3, device=self.device), self._count, sensor_height=1.7)

    def _infer(self) -> None:
        if self._network_in is not self._pillars.grid:
            wp.copy(self._network_in, self._pillars.grid)
        if self.device != "cpu":
            wp.synchronize_device(self.device)
        self._session.run_with_iobinding(self._binding)
        if self._network_out is not self._maps:
            wp.copy(self._maps, self._network_out)

    def _detections(self) -> Detections:
        kept = int(self._nms.keep_count.numpy()[0])
        self.overflow = int(self._decode.dropped.numpy()[0]) + int(self._nms.dropped.numpy()[0])
        if self.overflow:
            _log.warning("%s: %d detections beyond the card's limits were dropped", self.card.name, self.overflow)
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


def _providers(available: list[str], gpu: int | None, precision: str) -> list[str | tuple[str, dict[str, Any]]]:
    """What ONNX Runtime is to run a network on, the best first, with options."""
    if gpu is None:
        return ["CPUExecutionProvider"]
    providers: list[str | tuple[str, dict[str, Any]]] = []
    if precision == "fp16":
        if "TensorrtExecutionProvider" in available:
            providers.append(("TensorrtExecutionProvider", {"device_id": gpu, "trt_fp16_enable": True}))
        elif "CUDAExecutionProvider" in available:
            _log.warning("ONNX Runtime has no TensorRT provider here, which fp16 needs: the network computes in tf32")
    if "CUDAExecutionProvider" in available:
        providers.append(("CUDAExecutionProvider", {"device_id": gpu, "use_tf32": int(precision != "fp32")}))
    return [*providers, "CPUExecutionProvider"]


def _session(model: Path, card: HeadCard, device: str, threads: int, precision: str) -> tuple[Any, str]:
    """An ONNX Runtime session whose model was checked against its card, and the provider it runs on."""
    import onnxruntime as ort

    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # A thread that waits by spinning takes a core from the stages that run beside the head.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.log_severity_level = 3
    gpu = None if device == "cpu" else wp.get_device(device).ordinal
    settings = _providers(ort.get_available_providers(), gpu, precision)
    try:
        session = ort.InferenceSession(str(model), options, providers=settings)
    except Exception as error:  # ONNX Runtime has a family of exceptions of its own, not all of them public
        raise ModelError(f"{model}: ONNX Runtime cannot load it: {error}") from error
    provider = session.get_providers()[0]
    if device != "cpu" and provider == "CPUExecutionProvider":
        _log.warning("ONNX Runtime has no CUDA provider here; the network of %s runs on the CPU", card.name)
    for kind, spec, nodes in (
        ("input", card.input, session.get_inputs()),
        ("output", card.output, session.get_outputs()),
    ):
        found = [(node.name, tuple(node.shape), node.type) for node in nodes]
        wanted = [(spec.name, tuple(spec.shape), "tensor(float)")]
        if found != wanted:
            raise ModelError(f"{model}: its {kind} is {found}, but the card says {wanted}")
    return session, provider
