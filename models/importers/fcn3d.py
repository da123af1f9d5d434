"""The 3D FCN vehicle detector of a TensorFlow checkpoint, as arrays in an `.npz`: a worked example of an importer.

What its author's graph does: four layers of convolution with bias, rectifier, batch norm; TensorFlow's SAME padding,
which puts the smaller half first; two convolutions without bias for the scores of vehicle and background and for the
corners, relative to the cell.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch  # noqa: TID253 (nothing but an import loads this module)
from torch import nn  # noqa: TID253
from torch.nn import functional  # noqa: TID253

from ...errors import ModelError
from ..occupancy_head import OccupancyCard
from .checkpoint import shape_error, write_head

__all__ = ["import_fcn3d"]

_LAYERS = ((5, 2, 1, 16), (5, 2, 16, 32), (3, 2, 32, 64), (3, 1, 64, 64))  # size, stride, channels in and out
_EPS = 1e-5
_RANGE = (0.0, -40.0, -2.5, 80.0, 40.0, 1.5)


def _read(path: Path) -> dict[str, np.ndarray]:
    """The arrays, each of its shape and finite."""
    wanted = {"objectness.weights": (3, 3, 3, 64, 2), "cordinate.weights": (3, 3, 3, 64, 24)}
    for k, (size, _, inputs, outputs) in enumerate(_LAYERS, 1):
        wanted[f"layer{k}.weights"] = (size, size, size, inputs, outputs)
        wanted |= {f"layer{k}.{name}": (outputs,) for name in ("bias", "pop_mean", "pop_var", "gamma", "beta")}
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name].astype(np.float32) for name in stored.files if name in wanted}
    except FileNotFoundError as error:
        raise ModelError(f"{path}: no such checkpoint") from error
    except Exception as error:  # zip, zlib and NumPy each have errors of their own
        raise ModelError(f"{path}: it is no archive of plain arrays: {error}") from error
    if missing := sorted(set(wanted) - set(arrays)):
        raise ModelError(f"{path}: this is not the 3D FCN vehicle detector: it lacks {', '.join(missing[:4])}")
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise shape_error(path, name, arrays[name].shape, shape)
        if not np.isfinite(arrays[name]).all():
            raise ModelError(f"{path}: {name} has numbers that are not finite")
    return arrays


class _Fcn3d(nn.Module):
    """Occupied cells (1, x, y, z) to scores (1, …) and corners (24, …)."""

    def __init__(self, arrays: dict[str, np.ndarray]):
        super().__init__()
        for name, value in arrays.items():
            tensor = torch.from_numpy(value)
            # TensorFlow's weights are x y z in out.
            self.register_buffer(name.replace(".", "_"), tensor.permute(4, 3, 0, 1, 2) if tensor.ndim == 5 else tensor)

    def _convolve(self, x, name: str, stride: int, bias=None):
        weight = self.get_buffer(f"{name}_weights")
        pads: list[int] = []
        for size, kernel in zip(reversed(x.shape[2:]), reversed(weight.shape[2:]), strict=True):
            total = max((-(-int(size) // stride) - 1) * stride + int(kernel) - int(size), 0)
            pads += [total // 2, total - total // 2]
        return functional.conv3d(functional.pad(x, pads), weight, bias, stride)

    def forward(self, occupied):
        x = occupied[None]
        for k, (_, stride, _, _) in enumerate(_LAYERS, 1):
            part = {
                name: self.get_buffer(f"layer{k}_{name}") for name in ("bias", "pop_mean", "pop_var", "gamma", "beta")
            }
            x = torch.relu(self._convolve(x, f"layer{k}", stride, part["bias"]))
            x = functional.batch_norm(
                x, part["pop_mean"], part["pop_var"], part["gamma"], part["beta"], False, 0.0, _EPS
            )
        scores = torch.softmax(self._convolve(x, "objectness", 1), dim=1)[:, 0]
        return scores, self._convolve(x, "cordinate", 1)[0]


def import_fcn3d(
    checkpoint: str | Path, folder: str | Path, *, name: str = "fcn3d_vehicle", licence: str = "MIT"
) -> Path:
    """Makes a head of the checkpoint: `NAME.onnx` and `NAME.yaml`.

    Args:
        checkpoint: The arrays of the checkpoint, `.npz`.
        folder: Where the two files go.
        name: Of the head.
        licence: Of the weights.

    Returns:
        The path of the card, which `OccupancyHead` takes.

    Raises:
        ModelError: The file cannot be read, or is of another network.
    """
    network = _Fcn3d(_read(Path(checkpoint))).eval()
    fields = {
        "name": name,
        "description": "3D FCN vehicle detector, trained by its author on KITTI's training frames.",
        "classes": ("vehicle",),
        "point_range": _RANGE,
        "cell": 0.1,
        "stride": 8,
        "wedge": 0.27,
        "score_threshold": 0.9,
        "suppress_within": 1.5,
        "training": {"imported_from": Path(checkpoint).name, "data": "KITTI object, training frames"},
        "measured": {},
        "licence": licence,
    }
    shape = OccupancyCard(**fields, file="x", sha256="0" * 64, opset=17).cells
    example = {"occupied": np.zeros((1, *shape), np.float32)}
    return write_head(network, example, ("scores", "corners"), Path(folder), OccupancyCard, fields)
