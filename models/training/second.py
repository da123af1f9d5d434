"""`python -m warploom.models.training.second`: gives a head a second stage, learnt from its own candidates.

The first stage finds candidates in simulated scans that it was not trained on; the second learns which of them are
objects, of which class, and where their boxes should be.
"""

from __future__ import annotations

import logging
import math
import shutil
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import typer
from torch.nn import functional

from ..card import HeadCard, SecondSpec, file_sha256, load_card, save_card
from ..head import DetectionHead
from ..onnx_file import stamp
from .frames import load_frame
from .loop import make_views
from .network import HEAD_CLASSES
from .second_network import SecondNet
from .second_samples import Drawn, Samples, SecondAugmentation, draw, join, overlap, samples_of

__all__ = ["SecondConfig", "candidates_in", "export_second", "second_loss", "train_second"]

_log = logging.getLogger(__name__)

FIRST_SEED = 2_000_000
"""Simulator seeds from here on are for second stages: a first stage must not know the scans."""

_OPSET = 17
_LEAST_SCORE = 0.1  # of a candidate to learn from
_STEADY = 0.998  # decay of the running average of the weights, which is what is exported
# A metre of a person's place counts as much as several of a bus, so residuals are parts of a box's size.
_RESIDUAL_WEIGHTS = torch.tensor([5.0, 5.0, 2.0, 2.0, 2.0, 2.0, 2.0])
_OVERLAP_WEIGHT = 1.0


@dataclass(frozen=True, kw_only=True)
class SecondConfig:
    """All that the weights depend on, beside the samples."""

    seed: int = 0
    iterations: int = 6000
    batch: int = 256
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    class_weights: tuple[float, ...] = (1.0, 1.0, 1.5, 1.5, 1.0, 1.0)
    """Of nothing and of the classes."""
    augmentation: SecondAugmentation = field(default_factory=SecondAugmentation)


def candidates_in(head: DetectionHead, paths: Sequence[Path], seed: int = 0) -> Samples:
    """The candidates of a first stage in scans of frame files.

    Args:
        head: With `candidates_only`, and a score threshold as low as there is to learn from.
        paths: See `frames.save_frame`.
        seed: Which points are kept of a candidate with many.
    """
    rng = np.random.default_rng(seed)
    parts = []
    for path in paths:
        frame = load_frame(path)
        parts.append(samples_of(head.detect_points(frame.xyz, frame.sensor_height), frame, rng))
    return join(parts)


def second_loss(said: torch.Tensor, drawn: Drawn, class_weights: torch.Tensor) -> dict[str, torch.Tensor]:
    """What the network is to make small, by parts."""
    classes = len(HEAD_CLASSES)
    logits, quality, residuals = said[:, : classes + 1], said[:, classes + 1], said[:, classes + 2 :]
    parts = {"kind": functional.cross_entropy(logits, drawn.kinds, class_weights, ignore_index=-1)}
    boxed = drawn.boxed
    weight = 1.0 / boxed.sum().clamp(min=1)
    parts["box"] = ((residuals - drawn.residuals)[boxed].abs() * _RESIDUAL_WEIGHTS).sum() * weight
    sizes, given = drawn.sizes[boxed], residuals[boxed]
    diagonal = torch.hypot(sizes[:, 0], sizes[:, 1])[:, None]
    moved = torch.cat(
        [given[:, :2] * diagonal, given[:, 2:3] * sizes[:, 2:], sizes * given[:, 3:6].clamp(-1, 1).exp()], 1
    )
    # In the truth's frame, as if the two headed alike, which they nearly do.
    off = drawn.residuals[boxed][:, 6]
    apart = drawn.truth[boxed][:, :2] - moved[:, :2]
    c, s = torch.cos(off), torch.sin(off)
    truth = torch.cat(
        [torch.stack([apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s], 1),
         drawn.truth[boxed][:, 2:6]],
        1,
    )  # fmt: skip
    share = overlap(torch.cat([torch.zeros_like(moved[:, :3]), moved[:, 3:]], 1), truth)
    parts["overlap"] = _OVERLAP_WEIGHT * (1.0 - share).sum() * weight
    wanted = share.detach()
    parts["quality"] = functional.binary_cross_entropy_with_logits(quality[boxed], wanted, reduction="sum") * weight
    return parts


def train_second(samples: Samples, config: SecondConfig, network: SecondNet | None = None) -> SecondNet:
    """Trains a second stage; the weights follow from the samples and the seed alone, on one thread."""
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    rng = np.random.default_rng(config.seed)
    network = network or SecondNet(len(HEAD_CLASSES))
    network.train()
    average = {name: value.detach().clone() for name, value in network.state_dict().items()}
    optimiser = torch.optim.AdamW(network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    weights = torch.tensor(config.class_weights)
    order = np.empty(0, np.int64)
    sums: dict[str, float] = {}
    warming = min(200, 1 + config.iterations // 10)
    for step in range(config.iterations):
        if len(order) < config.batch:
            order = np.concatenate([order, rng.permutation(len(samples))])
        which, order = order[: config.batch], order[config.batch :]
        warm = min(1.0, (step + 1) / warming)
        rate = config.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * step / config.iterations)))
        for group in optimiser.param_groups:
            group["lr"] = rate
        drawn = draw(samples, which, generator, config.augmentation)
        parts = second_loss(network(drawn.points, drawn.described), drawn, weights)
        optimiser.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        optimiser.step()
        steady = min(_STEADY, (step + 1) / (step + 10))
        for name, value in network.state_dict().items():
            average[name].lerp_(value, 1.0 - steady)
        for name, value in parts.items():
            sums[name] = sums.get(name, 0.0) + value.item()
        if (step + 1) % 500 == 0:
            _log.info("%d: %s", step + 1, "  ".join(f"{name} {value / 500:.4f}" for name, value in sums.items()))
            sums = {}
    network.load_state_dict(average)
    return network.eval()


def export_second(
    network: SecondNet, card: Path, folder: Path, *, spec: dict[str, object] | None = None, training: dict[str, object]
) -> Path:
    """Writes the second stage beside a copy of the first and one card for both.

    Args:
        network: In any state; exported in evaluation mode.
        card: Of the first stage.
        folder: Where the files go.
        spec: Fields of `card.SecondSpec` other than its defaults.
        training: What the card says of the training.

    Returns:
        The path of the card.
    """
    old, model = load_card(card)
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / "pillar_center_second.onnx"
    most = SecondSpec.model_fields["points_of_box"].default
    points, boxes = torch.zeros(2, most, 11), torch.zeros(2, 9 + len(HEAD_CLASSES))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network.folded(), (points, boxes), str(target), opset_version=_OPSET, dynamo=False,
            input_names=["points", "boxes"], output_names=["said"],
            dynamic_axes={name: {0: "candidates"} for name in ("points", "boxes", "said")},
        )  # fmt: skip
    target.write_bytes(stamp(target.read_bytes(), classes=",".join(old.classes)))
    if (folder / model.name).resolve() != model.resolve():
        shutil.copyfile(model, folder / model.name)
    second = SecondSpec(file=target.name, sha256=file_sha256(target), opset=_OPSET, **(spec or {}))  # pyright: ignore[reportArgumentType]
    new: HeadCard = old.model_copy(update={"second": second, "training": {**old.training, "second": training}})
    path = folder / card.name
    save_card(path, new)
    return path


def main(
    head: Annotated[Path, typer.Option(help="Card of the first stage.")],
    out: Annotated[Path, typer.Option(help="Folder for the files of the head with its second stage.")],
    seed: Annotated[int, typer.Option(help="Of weights, draws and variations.")] = 0,
    iterations: Annotated[int, typer.Option(help="Steps of 256 candidates.")] = 6000,
    frames: Annotated[int, typer.Option(help="Simulated scans to learn from, five of each street.")] = 2000,
    frames_folder: Annotated[
        Path | None, typer.Option(help="Where they are kept, and found again; by default in --out.")
    ] = None,
    learning_rate: Annotated[float, typer.Option(help="The highest of the cycle.")] = 2e-3,
    threads: Annotated[int, typer.Option(help="CPU threads; the weights follow from the seed on any one number.")] = 1,
) -> None:
    """Trains the second stage of a head on its candidates in simulated scans that it has not seen."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(threads)
    config = SecondConfig(seed=seed, iterations=iterations, learning_rate=learning_rate)
    folder, views = frames_folder or out / "frames", 5
    make_views(folder, range(FIRST_SEED, FIRST_SEED - (-frames // views)), views)
    first = DetectionHead(head, candidates_only=True, score_threshold=_LEAST_SCORE, threads=threads)
    samples = candidates_in(first, sorted(folder.glob("*.npz"))[:frames], seed)
    _log.info("%d candidates in %d scans", len(samples), frames)
    network = train_second(samples, config)
    said = {"frames": frames, "candidates": len(samples), **asdict(config)}
    _log.info("%s", export_second(network, head, out, training=said))


if __name__ == "__main__":
    typer.run(main)
