"""`python -m warploom.models.training.averaging`: one head of several trainings that began with the same weights.

Networks fine-tuned from one checkpoint with different seeds lie in one valley, and the mean of their weights does at
least as well as each by itself at the cost of one (model soups, Wortsman et al., ICML 2022). A share of the checkpoint
that they began with keeps what it knew of scenes that they saw less of (Wortsman et al., CVPR 2022).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import torch
import typer

from .loop import averaged_weights, read_checkpoint
from .network import PillarCenterNet

__all__ = ["average_networks"]


def average_networks(
    checkpoints: Sequence[Path], network: PillarCenterNet, shares: Sequence[float] | None = None
) -> PillarCenterNet:
    """Gives a network the mean of the weights of several checkpoints, of which each is a running average already.

    Args:
        checkpoints: `checkpoint.pt` of trainings of networks of the same shape.
        network: Of that shape; it is changed.
        shares: How much each counts, relative to the others; None: all the same.

    Raises:
        ValueError: No checkpoint given, or shares that are not one positive number each.
    """
    if not checkpoints:
        raise ValueError("checkpoints must be one or more, not none")
    if shares is not None and (len(shares) != len(checkpoints) or not all(0 < share < math.inf for share in shares)):
        raise ValueError(f"shares must be {len(checkpoints)} positive numbers, one a checkpoint, not {list(shares)}")
    weights = torch.tensor(shares or [1.0] * len(checkpoints), dtype=torch.float64)
    weights /= weights.sum()
    states = [averaged_weights(read_checkpoint(path)) for path in checkpoints]
    mean = {
        name: torch.tensordot(weights, torch.stack([state[name].double() for state in states]), 1).to(first.dtype)
        if first.is_floating_point()
        else first
        for name, first in states[0].items()
    }
    network.load_state_dict(mean)
    return network.eval()


def main(
    checkpoints: Annotated[list[Path], typer.Argument(help="checkpoint.pt of each training.")],
    out: Annotated[Path, typer.Option(help="Folder for the head's ONNX and YAML.")],
    share: Annotated[
        list[float] | None, typer.Option(help="How much each counts, in their order; by default all the same.")
    ] = None,
    stem: Annotated[int, typer.Option(help="As in training.")] = 24,
    blocks: Annotated[int, typer.Option(help="As in training.")] = 1,
    lean: Annotated[bool, typer.Option("--lean", help="As in training.")] = False,
    extra: Annotated[list[str] | None, typer.Option(help="As in training.")] = None,
    score: Annotated[float, typer.Option(help="The threshold that the card recommends.")] = 0.3,
    overlap_weight: Annotated[float, typer.Option(help="Share of the thought overlap in a score.")] = 0.0,
) -> None:
    """Writes the head whose weights are the mean of those of several trainings."""
    from ...kernels.pillar import pillar_channels
    from .export import export_head
    from .network import LEAN_CHANNELS

    network = PillarCenterNet(
        (stem, 48, 128), (1, blocks), LEAN_CHANNELS if lean else pillar_channels(), tuple(extra or ())
    )
    card = export_head(
        average_networks(checkpoints, network, share),
        out,
        score_threshold=score,
        overlap_weight=overlap_weight,
        training={"mean_of": [str(path.parent.name) for path in checkpoints]},
    )
    typer.echo(card)


if __name__ == "__main__":
    typer.run(main)
