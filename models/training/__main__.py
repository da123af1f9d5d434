"""`python -m warploom.models.training`: trains a head on the simulator and writes its two files."""

from __future__ import annotations

import logging
import os
from pathlib import Path
from typing import Annotated

import typer

# Threads that wait by spinning slow two that share a core tenfold; OpenMP reads this when torch is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def main(
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint, and at the end the head's ONNX and YAML.")],
    seed: Annotated[int, typer.Option(help="Of weights, draws and variations.")] = 0,
    minutes: Annotated[float | None, typer.Option(help="Train this long; without --iterations 40.")] = None,
    iterations: Annotated[int | None, typer.Option(help="Train this far instead: reproducible to the bit.")] = None,
    frames: Annotated[int, typer.Option(help="Simulated scans to learn from.")] = 2000,
    views: Annotated[int, typer.Option(help="Scans of each simulated street: more cost less time a scan.")] = 1,
    stem: Annotated[int, typer.Option(help="Channels of the network at 0.5 m.")] = 24,
    blocks: Annotated[int, typer.Option(help="Residual blocks of the network at 2 m.")] = 1,
    lean: Annotated[bool, typer.Option("--lean", help="Look at 16 of the 20 pillar channels.")] = False,
    extra: Annotated[
        list[str] | None, typer.Option(help="Also learn iou, vx or vy; vx and vy are not exported.")
    ] = None,
    frames_folder: Annotated[Path | None, typer.Option(help="Where to keep them; found again next time.")] = None,
    start_from: Annotated[
        Path | None,
        typer.Option(
            help="Begin with the weights of this checkpoint, or of a head's card, whose network it then is; "
            "pillar_center is the head that ships."
        ),
    ] = None,
    labelled: Annotated[
        Path | None, typer.Option(help="Learn from the scans of this folder too: `warploom head train` writes them.")
    ] = None,
    labelled_share: Annotated[float, typer.Option(help="Share of the windows that are of those.")] = 0.5,
    learning_rate: Annotated[float, typer.Option(help="The highest of the cycle.")] = 3e-3,
    final_share: Annotated[float, typer.Option(help="What is left of it at the end.")] = 0.002,
    frozen: Annotated[
        bool,
        typer.Option(
            "--frozen",
            help="Batch norms keep the statistics of --start-from: the network's part of a step takes half as long.",
        ),
    ] = False,
    fresh: Annotated[
        int | None, typer.Option(help="New windows in a batch of four; the others are known ones, turned.")
    ] = None,
    threads: Annotated[int, typer.Option(help="CPU threads of the network.")] = 1,
    loader: Annotated[bool, typer.Option("--loader", help="Let a process beside draw the batches.")] = False,
    workers: Annotated[int, typer.Option(help="Processes that simulate.")] = 1,
    workers_nice: Annotated[int, typer.Option(help="How far those stand back for other processes.")] = 10,
) -> None:
    """Trains a pillar centre head on simulated scenes, and on labelled scans; interrupted, the same command goes on."""
    from ...kernels.pillar import pillar_channels
    from ..card import DEFAULT_CARD, named_card
    from .export import CARDS, export_head, exported_shape, like
    from .loop import TrainingConfig, described, train
    from .network import LEAN_CHANNELS

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    if minutes is None and iterations is None:
        minutes = 40.0
    shape = {
        "width": (stem, 48, 128),
        "depth": (1, blocks),
        "channels": LEAN_CHANNELS if lean else pillar_channels(),
        "extras": tuple(extra or ()),
    }
    if start_from is not None:
        start_from = named_card(start_from)
        if not start_from.is_file():
            raise typer.BadParameter(
                f"{start_from} is not there; expected a checkpoint.pt or a card, or {DEFAULT_CARD.stem}, the head that "
                "ships",
                param_hint="--start-from",
            )
    card = start_from if start_from is not None and start_from.suffix in CARDS else None
    if card is not None:
        shape = exported_shape(card)
    try:
        config = TrainingConfig(
            out=out,
            seed=seed,
            minutes=minutes,
            iterations=iterations,
            frames=frames,
            views=views,
            frames_folder=frames_folder,
            start_from=start_from,
            learning_rate=learning_rate,
            final_share=final_share,
            frozen=frozen,
            fresh=fresh,
            threads=threads,
            loaders=int(loader),
            workers=workers,
            workers_nice=workers_nice,
            labelled=labelled,
            labelled_share=labelled_share,
            **shape,
        )
    except ValueError as error:
        raise typer.BadParameter(str(error)) from None
    result = train(config)
    made = export_head(result.network, out, training=described(config, result))
    if card is not None:
        like(card, made)
    logging.getLogger(__name__).info("%d iterations in %.1f minutes: %s", result.iterations, result.minutes, made)


if __name__ == "__main__":
    typer.run(main)
