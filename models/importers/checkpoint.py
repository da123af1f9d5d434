"""Reading checkpoints that came from elsewhere, and writing the two files of a head."""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import ModelError
from ..card import ModelCard, file_sha256, save_card
from ..onnx_file import stamp

if TYPE_CHECKING:
    import torch

__all__ = ["OPSET", "load_tensors", "read_state_dict", "shape_error", "write_head"]

OPSET = 17

_WRAPPERS = ("state_dict", "model_state", "model", "ema_state", "net")


def read_state_dict(path: str | Path) -> dict[str, torch.Tensor]:
    """The tensors of a checkpoint by name, without the prefixes that data-parallel training leaves.

    Args:
        path: What `torch.save` wrote: a state dict, or a checkpoint that has one under `state_dict`, `model_state`
            or `model`.

    Raises:
        ModelError: It cannot be read, holds more than tensors and plain values (which could run code), or no tensors.
    """
    import torch

    path = Path(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise ModelError(f"{path}: no such checkpoint") from error
    except Exception as error:  # pickle, zip and torch each have errors of their own
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise ModelError(
            f"{path}: it is no checkpoint of plain tensors: {reason}; save its state dict alone: "
            "torch.save(model.state_dict(), …)"
        ) from error
    for name in _WRAPPERS:
        if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
            content = content[name]
    tensors = {}
    for name, value in content.items() if isinstance(content, Mapping) else ():
        if isinstance(value, torch.Tensor) and isinstance(name, str):
            tensors[re.sub(r"^(module\.|model\.)*", "", name)] = value
    if not tensors:
        raise ModelError(f"{path}: there is no state dict in it")
    return tensors


def load_tensors(network: torch.nn.Module, tensors: Mapping[str, torch.Tensor], path: str | Path, what: str) -> None:
    """Fills a network, whose every tensor must be there in its shape.

    Raises:
        ModelError: Some are missing, left over, of other shapes, or not finite.
    """
    import torch

    own = network.state_dict()
    counts = {name for name in {*own, *tensors} if name.endswith("num_batches_tracked")}
    missing = sorted(set(own) - set(tensors) - counts)
    surplus = sorted(set(tensors) - set(own) - counts)
    if missing or surplus:
        said = [f"{verb} {', '.join(names[:4])}{' …' if len(names) > 4 else ''}"
                for verb, names in (("lacks", missing), ("has besides", surplus)) if names]  # fmt: skip
        raise ModelError(f"{path}: this is not {what}: it {' and '.join(said)}")
    for name, value in own.items():
        if name in counts:
            continue
        if tensors[name].shape != value.shape:
            raise shape_error(path, name, tensors[name].shape, value.shape)
        if not bool(torch.isfinite(tensors[name].float()).all()):
            raise ModelError(f"{path}: {name} has numbers that are not finite")
    # How many batches were seen is of no use; frameworks leave it out, or have it in shapes of their own.
    network.load_state_dict(own | {name: tensors[name] for name in own if name not in counts})
    network.eval()


def shape_error(path: str | Path, name: str, found: Sequence[int], wanted: Sequence[int]) -> ModelError:
    """What to say of a tensor of the wrong shape."""
    return ModelError(f"{path}: {name} has shape {tuple(found)}, but {tuple(wanted)} follows from the rest")


def write_head(
    network: torch.nn.Module,
    example: Mapping[str, np.ndarray],
    outputs: Sequence[str],
    folder: Path,
    card: type[ModelCard],
    fields: dict[str, Any],
    *,
    free: Mapping[str, Mapping[int, str]] | None = None,
) -> Path:
    """Exports a network to `NAME.onnx` and writes `NAME.yaml`.

    Args:
        network: In evaluation mode; its arguments are the inputs in order.
        example: An array of each input.
        outputs: Names of the outputs.
        folder: Made where it is not there.
        card: Kind of the card.
        fields: Of the card, but for file, sha256 and opset.
        free: Axes of inputs that may be of any length, by name.

    Returns:
        The path of the card.
    """
    import torch

    folder.mkdir(parents=True, exist_ok=True)
    model = folder / f"{fields['name']}.onnx"
    # The exporter runs the network once; threads that spin for each other take long where the cores are busy.
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # the TorchScript exporter folds batch norms into convolutions
        torch.onnx.export(
            network,
            tuple(torch.from_numpy(value) for value in example.values()),
            str(model),
            opset_version=OPSET,
            input_names=list(example),
            output_names=list(outputs),
            dynamic_axes={name: dict(axes) for name, axes in (free or {}).items()},
            dynamo=False,
        )
    torch.set_num_threads(threads)
    model.write_bytes(stamp(model.read_bytes(), classes=",".join(fields["classes"])))
    path = folder / f"{fields['name']}.yaml"
    written = card(**fields, file=model.name, sha256=file_sha256(model), opset=OPSET)
    if contradiction := written.contradiction():
        raise ModelError(f"{path}: {contradiction}")
    save_card(path, written)
    return path
