"""From a trained network to the two files of a head: ONNX and card."""

from __future__ import annotations

import copy
import shutil
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ...errors import ModelError
from ..card import DecodeSpec, HeadCard, InputSpec, OutputSpec, file_sha256, load_card, save_card
from ..onnx_file import stamp
from .network import HEAD_CLASSES, REGRESSION, STRIDE, UNFOLD, PillarCenterNet

__all__ = ["CARDS", "export_head", "exported_shape", "exported_weights", "like"]

CARDS = (".yaml", ".yml")
"""Endings of cards."""

_OPSET = 17


def export_head(
    network: PillarCenterNet,
    folder: Path,
    *,
    name: str = "pillar_center",
    point_range: tuple[float, float, float, float, float, float] = (-60.0, -60.0, -2.0, 60.0, 60.0, 6.0),
    cell: float = 0.25,
    score_threshold: float = 0.3,
    overlap_weight: float = 0.0,
    training: dict[str, Any],
    measured: dict[str, Any] | None = None,
    description: str = "",
) -> Path:
    """Writes `name`.onnx (float32, batch norms folded, fixed shape, the classes in its metadata) and `name`.yaml.

    Args:
        network: In any state; exported in evaluation mode.
        folder: Where the two files go.
        name: Of the head and of its files.
        point_range: What the head is to see; the network is convolutional, so it may be other than in training.
        cell: As in training [m].
        score_threshold: What the card recommends.
        overlap_weight: Share of the thought overlap in a score, of a network that says it.
        training: What the card says of the training.
        measured: What the card says was measured.
        description: A sentence or two.

    Returns:
        The path of the card.
    """
    folder.mkdir(parents=True, exist_ok=True)
    columns, rows = (round((point_range[axis + 3] - point_range[axis]) / cell) for axis in (0, 1))
    network = copy.deepcopy(network).eval().to(memory_format=torch.contiguous_format)
    # The decoder reads the maps folded as they are: unfolding them takes one thread 5 ms, and is a copy.
    network.unfold = torch.nn.Identity()
    extras = _one_last_layer(network)
    regression, channels = (*REGRESSION, *extras), network.channels
    model = folder / f"{name}.onnx"
    with warnings.catch_warnings():
        # The TorchScript exporter is the one that folds batch norms into the convolutions.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            (torch.zeros(1, len(channels), rows, columns),),
            str(model),
            opset_version=_OPSET,
            input_names=["pillars"],
            output_names=["maps"],
            dynamo=False,
        )
    model.write_bytes(stamp(model.read_bytes(), classes=",".join(HEAD_CLASSES)))
    card = HeadCard(
        name=name,
        description=description,
        file=model.name,
        sha256=file_sha256(model),
        opset=_OPSET,
        input=InputSpec(
            name="pillars",
            shape=(1, len(channels), rows, columns),
            channels=channels,
            point_range=point_range,
            cell=cell,
        ),
        output=OutputSpec(
            name="maps",
            shape=(
                1,
                (len(HEAD_CLASSES) + len(regression)) * UNFOLD**2,
                rows // (STRIDE * UNFOLD),
                columns // (STRIDE * UNFOLD),
            ),
            unfold=UNFOLD,
            regression=regression,
        ),
        classes=HEAD_CLASSES,
        decode=DecodeSpec(
            stride=STRIDE,
            score_threshold=score_threshold,
            nms_iou=0.2,
            overlap_weight=overlap_weight,
            refine=("vehicle",),
            max_candidates=2048,
            max_objects=256,
        ),
        training=training,
        measured=measured or {},
        licence="Apache-2.0",
    )
    path = folder / f"{name}.yaml"
    save_card(path, card)
    return path


def _one_last_layer(network: PillarCenterNet) -> tuple[str, ...]:
    """Lets the last layer say the overlap too, if the network knows it; velocities, which one scan hardly shows, not.

    Returns:
        What it says after `REGRESSION`.
    """
    if network.extra is None or "iou" not in network.extras:
        return ()
    first = network.extras.index("iou") * UNFOLD**2
    old, more = network.head, network.extra
    head = nn.Conv2d(old.in_channels, old.out_channels + UNFOLD**2, 1)
    weights, further = old.state_dict(), more.state_dict()
    head.load_state_dict(
        {name: torch.cat([value, further[name][first : first + UNFOLD**2]]) for name, value in weights.items()}
    )
    network.head = head
    return ("iou",)


def _convolutions(network: PillarCenterNet) -> list[tuple[str, nn.Module]]:
    """The layers of a network in the order in which the exported one has its convolutions, but for the last."""
    layers: list[tuple[str, nn.Module]] = [("stem", network.stem)]
    for name in ("down1", "down2"):
        first, *blocks = getattr(network, name)
        layers.append((f"{name}.0", first))
        for number, block in enumerate(blocks, 1):
            layers += [(f"{name}.{number}.{part}", getattr(block, part)) for part in ("first", "second")]
    return [*layers, ("lateral", network.lateral), ("merge", network.merge)]


def _tensors(card: HeadCard, model: Path) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """Weight and bias of each convolution of an exported network, in their order."""
    import onnx
    from onnx import numpy_helper

    graph = onnx.load(str(model)).graph
    values = {one.name: torch.from_numpy(numpy_helper.to_array(one).copy()) for one in graph.initializer}
    nodes = [node for node in graph.node if node.op_type == "Conv"]
    if not nodes or not all(len(node.input) == 3 and set(node.input[1:]) <= values.keys() for node in nodes):
        raise ModelError(
            f"{model}: its weights are not those of a pillar head in floating point, from which a training could "
            "begin; one in eight bits has its like in floating point beside it"
        )
    return [(values[node.input[1]], values[node.input[2]]) for node in nodes]


def exported_shape(path: Path) -> dict[str, Any]:
    """What a network must be made with to take over an exported head's weights: arguments of `PillarCenterNet`.

    Args:
        path: Of the head's card.

    Raises:
        ModelError: The card or its model is not valid, or the head is none that this training could have made.
    """
    card, model = load_card(path)
    assert isinstance(card, HeadCard)
    layers = _tensors(card, model)
    outputs = [len(weight) for weight, _ in layers]
    if len(outputs) < 6 or tuple(card.classes) != HEAD_CLASSES:
        raise ModelError(f"{path}: not a head of this training: {len(outputs)} convolutions, {', '.join(card.classes)}")
    fine, middle, coarse = outputs[0], outputs[1], max(outputs[1:-1])
    at = next((number for number, one in enumerate(outputs) if number > 1 and one == coarse), len(outputs))
    depth = (at - 2) // 2, (len(outputs) - 4 - at) // 2
    shape = {
        "width": (fine, middle, coarse),
        "depth": depth,
        "channels": tuple(card.input.channels),
        "extras": tuple(card.output.regression[len(REGRESSION) :]),
    }
    wanted = [module[0].weight.shape for _, module in _convolutions(PillarCenterNet(**shape))]
    if [weight.shape for weight, _ in layers[:-1]] != wanted:
        raise ModelError(f"{path}: its convolutions are not those of a head of this training")
    return shape


def exported_weights(path: Path, network: PillarCenterNet) -> dict[str, torch.Tensor]:
    """The weights of an exported head as a network has them: batch norms are in the convolutions, and do nothing.

    Args:
        path: Of the head's card.
        network: Made as `exported_shape` says.

    Raises:
        ModelError: The head is another.
    """
    card, model = load_card(path)
    assert isinstance(card, HeadCard)
    layers, state = _tensors(card, model), network.state_dict()
    mine = _convolutions(network)
    outputs = sum(one.out_channels for one in (network.head, network.extra) if isinstance(one, nn.Conv2d))
    if [weight.shape for weight, _ in layers[:-1]] != [module[0].weight.shape for _, module in mine] or (
        len(layers[-1][1]) != outputs
    ):
        raise ModelError(f"{path}: the network that is to begin with it has another shape; see exported_shape")
    for (name, module), (weight, bias) in zip(mine, layers, strict=False):
        state[f"{name}.0.weight"] = weight
        state[f"{name}.1.weight"] = torch.ones_like(bias)
        state[f"{name}.1.bias"] = bias
        state[f"{name}.1.running_mean"] = torch.zeros_like(bias)
        state[f"{name}.1.running_var"] = torch.ones_like(bias) - module[1].eps
    (weight, bias), split = layers[-1], network.head.out_channels
    state["head.weight"], state["head.bias"] = weight[:split], bias[:split]
    if network.extra is not None:
        state["extra.weight"], state["extra.bias"] = weight[split:], bias[split:]
    return state


def like(before: Path, made: Path) -> None:
    """Gives a new head what the one that it began with has beside its network: how it is read, and a second stage.

    Args:
        before: Card of the head that the training began with.
        made: Card of the new one, which is written anew.
    """
    (old, model), (new, _) = load_card(before), load_card(made)
    assert isinstance(old, HeadCard)
    if old.second is not None:
        shutil.copyfile(model.parent / old.second.file, made.parent / old.second.file)
    save_card(made, new.model_copy(update={"decode": old.decode, "second": old.second}))
