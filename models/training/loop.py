"""The training loop: frames made by processes of their own, one network, a checkpoint that training resumes from."""

from __future__ import annotations

import logging
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from torch.utils.data import DataLoader, IterableDataset

from ...errors import ConfigError, ModelError
from ...kernels.pillar import PillarGrid, pillar_channels
from .bowing import bowed
from .export import CARDS, exported_weights
from .frames import (
    Augmentation,
    TrainingFrame,
    augment,
    labelled_boxes,
    load_frame,
    save_frame,
    simulate_frame,
    simulate_views,
)
from .network import STRIDE, PillarCenterNet
from .targets import draw_targets, loss
from .windows import Window, Windows, window_of

__all__ = ["TrainingConfig", "TrainingResult", "make_frames", "read_checkpoint", "train"]

_log = logging.getLogger(__name__)

_FIRST_TRAINING_SEED = 1_000_000
"""Simulator seeds from here on are for training; evaluation uses lower ones."""


@dataclass(frozen=True, kw_only=True)
class TrainingConfig:
    """All that a training depends on. With `iterations` given, the weights follow from it and the seed alone."""

    out: Path
    """Folder for the checkpoint and the log."""
    seed: int = 0
    minutes: float | None = None
    """Stop after this long; frames are drawn while more are being made."""
    iterations: int | None = None
    """Stop after so many steps; all frames are made first. Exactly one of the two is given."""
    frames: int = 2000
    """Simulated scans."""
    views: int = 1
    """Scans of each simulated street: more cost less time a scan, and are less unlike each other."""
    frames_folder: Path | None = None
    """Where they are kept, and found again by the next training; None is `out`/frames."""
    batch: int = 4
    fresh: int | None = None
    """How many windows of a batch are new; the others were learnt from before, and are turned. None: all."""
    kept: int = 4000
    """How many windows are kept to be learnt from again."""
    frozen: bool = False
    """Batch norms keep the statistics they have, so that the network takes half as long; for `start_from`."""
    window: float = 40.0
    """Half the edge of the square learnt from [m], a multiple of 8 cells."""
    cell: float = 0.25
    width: tuple[int, int, int] = (24, 48, 128)
    depth: tuple[int, int] = (1, 1)
    channels: tuple[str, ...] = pillar_channels()
    """What the network looks at, of these; `network.LEAN_CHANNELS` are 16 of them."""
    extras: tuple[str, ...] = ()
    """What a further branch learns, of `network.EXTRAS`."""
    learning_rate: float = 3e-3
    final_share: float = 0.002
    """What is left of the learning rate at the end."""
    weight_decay: float = 0.01
    average: float = 0.998
    """Decay of the running average of the weights, which is what is exported."""
    threads: int = 1
    loaders: int = 0
    """1: a process beside this one draws the batches; the same batches."""
    workers: int = 1
    """Processes that make frames."""
    workers_nice: int = 10
    """How far those stand back for other processes."""
    save_every: float = 120.0
    """Time between two checkpoints [s]: what a training that is killed does again at most."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    start_from: Path | None = None
    """Checkpoint of another training, or card of a head in floating point, whose weights this one begins with, on a
    learning rate cycle of its own."""
    labelled: Path | None = None
    """Folder of labelled scans to learn from as well, as `save_frame` writes them."""
    labelled_share: float = 0.5
    """Share of the windows that are drawn from them."""

    def __post_init__(self):
        if (self.minutes is None) == (self.iterations is None):
            raise ValueError("give either minutes or iterations, not both and not neither")
        cells = 2.0 * self.window / self.cell
        for name, least in (("seed", 0), ("batch", 1), ("kept", 1), ("threads", 1), ("workers", 0), ("iterations", 1)):
            value = getattr(self, name)
            if value is not None and value < least:
                raise ValueError(f"{name} must be at least {least}, not {value}")
        for name in ("minutes", "learning_rate", "final_share"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"{name} must be a number above 0, not {value}")
        if self.fresh is not None and not 1 <= self.fresh <= self.batch:
            raise ValueError(f"fresh must be from 1 to the batch, {self.batch}, not {self.fresh}")
        if self.loaders not in (0, 1):
            raise ValueError(f"loaders must be 0 or 1, not {self.loaders}")
        if not 0 <= self.labelled_share <= 1:
            raise ValueError(f"labelled_share must be 0 to 1, not {self.labelled_share}")
        if self.frames < 1 and (self.labelled is None or self.labelled_share < 1):
            raise ValueError(f"frames must be at least 1, not {self.frames}, unless all windows are of labelled scans")
        if self.views < 1:
            raise ValueError(f"views must be at least 1, not {self.views}")
        if cells != round(cells) or round(cells) % (4 * STRIDE):
            raise ValueError(f"2 · window / cell must be a multiple of {4 * STRIDE}, not {cells}")
        with torch.device("meta"):  # without memory: whether there can be such a network
            PillarCenterNet(self.width, self.depth, self.channels, self.extras)

    @property
    def folder(self) -> Path:
        """Where the frames are."""
        return self.frames_folder or self.out / "frames"

    def frame_path(self, number: int) -> Path:
        """The file of a scan, by its number from 0."""
        if self.views == 1:
            return self.folder / f"{_FIRST_TRAINING_SEED + number}.npz"
        street, view = divmod(number, self.views)
        return self.folder / f"{_FIRST_TRAINING_SEED + street}-{view}of{self.views}.npz"


@dataclass(frozen=True, kw_only=True)
class TrainingResult:
    """The trained network and what is to be said of its training."""

    network: PillarCenterNet
    iterations: int
    minutes: float
    frames: int
    losses: dict[str, float]


def make_frames(
    folder: Path, seeds: range, simulate: Callable[[int], TrainingFrame] = simulate_frame, nice: int = 0
) -> None:
    """Simulates the scenes of these seeds that are not in the folder yet."""
    if nice:
        os.nice(nice)
    folder.mkdir(parents=True, exist_ok=True)
    parent = multiprocessing.parent_process()
    for seed in seeds:
        if parent is not None and not parent.is_alive():
            return  # an interrupted training leaves no simulator behind
        path = folder / f"{seed}.npz"
        if not path.exists():
            save_frame(path, simulate(seed))


def make_views(folder: Path, seeds: range, views: int, nice: int = 0) -> None:
    """Simulates the streets of these seeds, so many scans of each, that are not all in the folder yet."""
    if nice:
        os.nice(nice)
    folder.mkdir(parents=True, exist_ok=True)
    parent = multiprocessing.parent_process()
    for seed in seeds:
        if parent is not None and not parent.is_alive():
            return
        paths = [folder / f"{seed}-{view}of{views}.npz" for view in range(views)]
        if not all(path.exists() for path in paths):
            for path, frame in zip(paths, simulate_views(seed, views), strict=True):
                save_frame(path, frame)


def _sample(frame: TrainingFrame, grid: PillarGrid, config: TrainingConfig, rng: np.random.Generator) -> Window:
    """One variation of a frame."""
    if frame.tight:
        frame = replace(frame, boxes=labelled_boxes(frame.boxes, frame.classes))
    varied = augment(bowed(frame, rng), rng, config.augmentation)
    xyz = np.ascontiguousarray(varied.xyz)[: grid.capacity]
    points = wp.array(ptr=xyz.ctypes.data, dtype=wp.vec3, shape=(len(xyz),), device="cpu")
    grid.launch(points, wp.array([len(xyz)], dtype=wp.int32, device="cpu"), varied.sensor_height)
    edge = round(2.0 * config.window / config.cell) // STRIDE
    targets = draw_targets(
        varied.boxes,
        varied.classes,
        varied.points_in,
        (-config.window, -config.window),
        config.cell * STRIDE,
        (edge, edge),
        ground=-varied.sensor_height,
        velocities=varied.velocities,
    )
    return window_of(grid.grid.numpy()[0], config.channels, targets)


class _Fresh(IterableDataset):
    """The new windows of each iteration, without end; those of i depend on the seed, i and the frames there are.

    A process beside the one that trains may draw them.
    """

    def __init__(self, config: TrainingConfig, start: int):
        self._config, self._start = config, start

    def __iter__(self) -> Iterator[list[Window]]:
        """From the first iteration on."""
        config, window = self._config, self._config.window
        grid = PillarGrid(
            point_range=(-window, -window, -2.0, window, window, 6.0), cell=config.cell, channels=config.channels,
            capacity=1 << 18, device="cpu",
        )  # fmt: skip
        look = _frames_there(config)
        labelled = _labelled(config)
        iteration = self._start
        while True:
            rng = np.random.default_rng([config.seed, iteration])
            there = look()
            samples = []
            for choice in rng.integers(max(len(there), 1), size=config.fresh or config.batch):
                real = labelled and rng.random() < config.labelled_share
                path = labelled[rng.integers(len(labelled))] if real else there[choice]
                samples.append(_sample(load_frame(path), grid, config, rng))
            yield samples
            iteration += 1


def _labelled(config: TrainingConfig) -> list[Path]:
    """The files of labelled scans.

    Raises:
        ConfigError: There are none in the folder.
    """
    if config.labelled is None:
        return []
    found = sorted(path for path in config.labelled.glob("*.npz") if not path.name.endswith(".partial.npz"))
    if not found:
        raise ConfigError(f"{config.labelled}: no scans (.npz) here; `warploom head train --data` writes them")
    return found


def _stand_back(_: int) -> None:
    torch.set_num_threads(1)


def _fresh(config: TrainingConfig, start: int) -> Iterator[list[Window]]:
    if config.loaders == 0:
        return iter(_Fresh(config, start))
    return iter(
        DataLoader(
            _Fresh(config, start), batch_size=None, num_workers=1, prefetch_factor=4, worker_init_fn=_stand_back,
            multiprocessing_context="spawn",
        )
    )  # fmt: skip


def _rate(progress: float, peak: float, final_share: float) -> float:
    """One cycle: a short warm-up, then a cosine down to the share that is left."""
    if progress < 0.05:
        return peak * (0.1 + 0.9 * progress / 0.05)
    left = 0.5 * (1.0 + math.cos(math.pi * (progress - 0.05) / 0.95))
    return peak * (final_share + (1.0 - final_share) * left)


def _running_average(decay: float) -> Callable[[torch.Tensor, torch.Tensor, int], torch.Tensor]:
    """An exponential average that forgets the first steps sooner."""

    def average(kept: torch.Tensor, new: torch.Tensor, steps: int | torch.Tensor) -> torch.Tensor:
        if not kept.is_floating_point():
            return new
        return torch.lerp(kept, new, 1.0 - min(decay, (1.0 + int(steps)) / (10.0 + int(steps))))

    return average


def read_checkpoint(path: Path) -> dict[str, Any]:
    """What a training has saved.

    Raises:
        ModelError: It cannot be read, or is of something else.
    """
    try:
        state = torch.load(path, weights_only=True)
    except OSError as error:
        raise ModelError(f"{path}: cannot read the checkpoint: {error.strerror or error}") from error
    except Exception as error:  # pickle, zip and torch each have errors of their own
        reason = str(error).partition("\n")[0]
        raise ModelError(f"{path}: the checkpoint is damaged, or none of a training: {reason}") from error
    if not isinstance(state, dict) or "averaged" not in state:
        raise ModelError(f"{path}: not a checkpoint of a training; expected the checkpoint.pt that one left")
    return state


def averaged_weights(checkpoint: dict[str, Any]) -> dict[str, torch.Tensor]:
    """The running average of a checkpoint's weights, named as the network's are."""
    prefix = "module."
    return {name[len(prefix) :]: value for name, value in checkpoint["averaged"].items() if name.startswith(prefix)}


def _start_workers(config: TrainingConfig) -> list[multiprocessing.Process]:
    context = multiprocessing.get_context("spawn")
    streets = -(-config.frames // config.views)
    seeds = range(_FIRST_TRAINING_SEED, _FIRST_TRAINING_SEED + streets)
    started = []
    for k in range(config.workers):
        mine = seeds[k :: config.workers]
        process = context.Process(
            target=make_frames if config.views == 1 else make_views,
            args=(config.folder, mine) if config.views == 1 else (config.folder, mine, config.views),
            kwargs={"nice": config.workers_nice},
            daemon=True,
        )
        process.start()
        started.append(process)
    return started


def _frames_there(config: TrainingConfig) -> Callable[..., list[Path]]:
    """A function that lists the frames there are, looking again every few seconds until all are."""
    known: list[Path] = []
    looked = -np.inf

    def look(now: bool = False) -> list[Path]:
        nonlocal known, looked
        if len(known) < config.frames and (now or time.monotonic() - looked > 5.0):
            known = [path for path in map(config.frame_path, range(config.frames)) if path.exists()]
            looked = time.monotonic()
        return known

    return look


def train(config: TrainingConfig) -> TrainingResult:
    """Trains a head on simulated scenes; interrupted, the same call goes on from the last checkpoint.

    With `iterations` given, what comes out is then the same to the bit as if it had not been interrupted.

    Raises:
        ConfigError: There are no labelled scans in their folder.
        ModelError: A checkpoint is damaged, or that in `out` is of another network.
        RuntimeError: No frames come: the processes that make them have ended.
    """
    torch.set_num_threads(config.threads)
    torch.manual_seed(config.seed)
    config.out.mkdir(parents=True, exist_ok=True)
    network = PillarCenterNet(config.width, config.depth, config.channels, config.extras).to(
        memory_format=torch.channels_last
    )
    _labelled(config)  # what is not there is said before anything is simulated
    averaged = torch.optim.swa_utils.AveragedModel(network, avg_fn=_running_average(config.average), use_buffers=True)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay, fused=True
    )
    checkpoint = config.out / "checkpoint.pt"
    iteration, spent = 0, 0.0
    if checkpoint.exists():
        state = read_checkpoint(checkpoint)
        try:
            network.load_state_dict(state["network"])
        except RuntimeError as error:
            raise ModelError(
                f"{checkpoint}: of a training of another network; go on with the options that it began with, or train "
                "into another folder"
            ) from error
        averaged.load_state_dict(state["averaged"])
        optimiser.load_state_dict(state["optimiser"])
        iteration, spent = state["iteration"], state["minutes"]
        _log.info("resuming from iteration %d, minute %.1f", iteration, spent)
    elif config.start_from is not None and config.start_from.suffix in CARDS:
        network.begin_with(exported_weights(config.start_from, network))
        _log.info("starting from the head of %s", config.start_from)
    elif config.start_from is not None:
        state = read_checkpoint(config.start_from)
        network.begin_with(averaged_weights(state))
        _log.info("starting from %s at its iteration %d", config.start_from, state["iteration"])

    workers = _start_workers(config)
    there = _frames_there(config)
    wanted = config.frames if config.iterations is not None else min(64, config.frames)
    while len(there()) < wanted:
        if not any(worker.is_alive() for worker in workers) and len(there(now=True)) < wanted:
            raise RuntimeError(f"the simulator ended with {len(there())} of {wanted} frames in {config.folder}")
        time.sleep(0.5)

    began = time.monotonic() - 60.0 * spent
    running: dict[str, float] = {}

    def save() -> None:
        partial = checkpoint.with_suffix(".partial")
        torch.save(
            {
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimiser": optimiser.state_dict(),
                "iteration": iteration,
                "minutes": (time.monotonic() - began) / 60.0,
            },
            partial,
        )
        os.replace(partial, checkpoint)

    network.train()
    last_saved = time.monotonic()
    # A training that goes on draws the windows again that were known before: they follow from the seed.
    fresh = config.fresh or config.batch
    first = max(0, iteration - math.ceil(config.kept / fresh)) if fresh < config.batch else iteration
    windows = Windows(config.kept, before=first * fresh)
    for number, new in enumerate(_fresh(config, first), first):
        if number < iteration:
            windows.keep(new)
            continue
        minutes = (time.monotonic() - began) / 60.0
        progress = iteration / config.iterations if config.iterations else minutes / float(config.minutes or 1.0)
        if progress >= 1.0:
            break
        for group in optimiser.param_groups:
            group["lr"] = _rate(progress, config.learning_rate, config.final_share)
        batch = windows.batch(new, config.batch, np.random.default_rng([config.seed, iteration, 1]))
        if config.frozen:
            maps = network.folded_maps(batch.pillars, frozen=True)
        else:
            with torch.autocast("cpu", dtype=torch.bfloat16):
                maps = network.folded_maps(batch.pillars)
        total, parts = loss(maps, batch, config.extras)
        optimiser.zero_grad(set_to_none=True)
        total.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 10.0)
        optimiser.step()
        averaged.update_parameters(network)
        iteration += 1
        for name, value in parts.items():
            running[name] = 0.98 * running.get(name, value) + 0.02 * value
        if iteration % 50 == 0:
            losses = ", ".join(f"{name} {value:.3f}" for name, value in running.items())
            left = (1.0 - progress) * minutes / progress if progress else float("nan")
            _log.info(
                "minute %.1f, %.1f left, iteration %d, %d frames: %s", minutes, left, iteration, len(there()), losses
            )
        if time.monotonic() - last_saved > config.save_every:
            save()
            last_saved = time.monotonic()
    save()
    for worker in workers:
        worker.terminate()
        worker.join()
    return TrainingResult(
        network=averaged.module.eval(),
        iterations=iteration,
        minutes=(time.monotonic() - began) / 60.0,
        frames=len(there()),
        losses=running,
    )


def described(config: TrainingConfig, result: TrainingResult) -> dict[str, object]:
    """What a card says of a training."""
    names = ("batch", "fresh", "kept", "frozen", "window", "cell", "width", "depth", "views")
    names += ("learning_rate", "final_share", "weight_decay", "average")
    recipe = {name: getattr(config, name) for name in names} | {"augmentation": asdict(config.augmentation)}
    if config.channels != pillar_channels():
        recipe["channels"] = list(config.channels)
    if config.extras:
        recipe["extras"] = list(config.extras)
    data = "scenes of warploom's simulator alone"
    if labelled := len(_labelled(config)):
        data = f"{labelled} labelled scans of one's own"
        if config.labelled_share < 1:
            data += " and scenes of warploom's simulator"
        recipe["labelled_share"] = config.labelled_share
    return {
        "data": data,
        "seed": config.seed,
        "frames": result.frames,
        "iterations": result.iterations,
        "minutes": round(result.minutes, 1),
        "recipe": recipe,
    }
