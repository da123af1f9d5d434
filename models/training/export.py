"""From a trained network to the two files of a head: ONNX and card."""

from __future__ import annotations

import copy
import warnings
from pathlib import Path
from typing import Any

import torch
from torch import nn

from ..card import DecodeSpec, HeadCard, InputSpec, OutputSpec, file_sha256, save_card
from ..onnx_file import stamp
from .network import HEAD_CLASSES, REGRESSION, STRIDE, UNFOLD, PillarCenterNet

__all__ = ["export_head"]

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
