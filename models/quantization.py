"""A head in eight bits: smaller, and on a CPU that has instructions for it faster; how much less it finds is measured.

Static quantisation (Jacob et al., CVPR 2018) by ONNX Runtime: weights per channel, activations by the range that all
but one in a hundred thousand of them take on calibration frames: the few beyond would cost the others resolution. Needs
the onnx package (`pip install 'warploom[torch]'`).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from ..errors import ModelError
from ..kernels.pillar import PillarGrid
from .card import file_sha256, load_card, save_card
from .onnx_file import opset, stamp

__all__ = ["quantize_head"]

_SHARE = 99.999  # per cent


class _Inputs:
    """The network's inputs of the calibration frames, one after the other, as ONNX Runtime asks for them."""

    def __init__(self, name: str, grid: PillarGrid, frames: Iterable[tuple[np.ndarray, float]]):
        self._name, self._grid, self._frames = name, grid, iter(frames)

    def get_next(self) -> dict[str, np.ndarray] | None:
        """The next one, None when there are no more."""
        frame = next(self._frames, None)
        if frame is None:
            return None
        points, height = frame
        xyz = wp.array(np.ascontiguousarray(points[:, :3], np.float32), dtype=wp.vec3, device="cpu")
        self._grid.launch(xyz, wp.array([len(xyz)], dtype=wp.int32, device="cpu"), height)
        return {self._name: self._grid.grid.numpy().copy()}

    def __iter__(self) -> _Inputs:
        return self

    def __next__(self) -> dict[str, np.ndarray]:
        if (following := self.get_next()) is None:
            raise StopIteration
        return following


def quantize_head(
    card: str | Path,
    folder: str | Path,
    frames: Iterable[tuple[np.ndarray, float]],
    *,
    keep: tuple[str, ...] = ("head",),
    measured: dict[str, Any] | None = None,
) -> Path:
    """Writes `NAME_int8.onnx` and `NAME_int8.yaml` beside each other; a second stage goes with them as it is.

    Args:
        card: Of a pillar centre head.
        folder: Where the two files go.
        frames: To calibrate with: points, shape (n, 3 or more), and the sensor's height above the ground [m].
        keep: Layers with one of these in their name stay in floating point: the last one says sizes and places, which
            eight bits are too coarse for.
        measured: What the new card says was measured.

    Returns:
        The path of the new card.

    Raises:
        ModelError: The card or its model is missing or not valid, is in eight bits already, or the onnx package is not
            there.
    """
    try:
        import onnx
        from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError as error:
        raise ModelError(
            "to quantise a head takes onnx, which is not installed: pip install 'warploom[torch]'"
        ) from error
    old, model = load_card(card)
    if any(node.op_type == "DequantizeLinear" for node in onnx.load(str(model)).graph.node):
        raise ModelError(f"{model}: it is in eight bits already; take the card that it was made of")
    grid = PillarGrid(
        point_range=old.input.point_range,
        cell=old.input.cell,
        channels=old.input.channels,
        capacity=1 << 18,
        device="cpu",
    )
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{old.name}_int8.onnx"
    with tempfile.TemporaryDirectory() as scratch:
        prepared = Path(scratch) / "prepared.onnx"
        quant_pre_process(str(model), str(prepared))
        names = [node.name for node in onnx.load(str(prepared)).graph.node]
        quantize_static(
            str(prepared),
            str(target),
            _Inputs(old.input.name, grid, frames),  # pyright: ignore[reportArgumentType]
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            calibrate_method=CalibrationMethod.Percentile,
            extra_options={"CalibPercentile": _SHARE, "CalibTensorRangeSymmetric": False},
            nodes_to_exclude=[name for name in names if any(f"/{part}" in name for part in keep)],
        )
    target.write_bytes(stamp(target.read_bytes(), classes=",".join(old.classes)))
    new = old.model_copy(
        update={
            "name": f"{old.name}_int8",
            "description": f"{old.description} In eight bits.".strip(),
            "file": target.name,
            "sha256": file_sha256(target),
            "opset": opset(target.read_bytes()),
            "training": {**old.training, "quantised_from": old.sha256},
            "measured": measured or {},
        }
    )
    if old.second is not None and folder.resolve() != model.parent.resolve():
        shutil.copyfile(model.parent / old.second.file, folder / old.second.file)
    path = folder / f"{old.name}_int8.yaml"
    save_card(path, new)
    return path
