"""Commands about detection heads: how good one is, and where heads come from."""

from __future__ import annotations

import contextlib
import functools
import importlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from .measuring import evaluation
from .options import Device, Profile

__all__ = ["commands"]

commands = typer.Typer()

_CARD_HELP = "A head's card, or the name of one that ships: pillar_center, pillar_center_int8"


@contextlib.contextmanager
def _torch_to(purpose: str) -> Iterator[None]:
    """Says what to install where a library of the extra `torch` is missing."""
    from ..errors import ConfigError

    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"to {purpose} takes {error.name or 'torch'}, which is not installed: pip install 'warploom[torch]'"
        ) from error


def _make_folder(out: Path) -> None:
    """Makes the folder for the outputs, before hours of work end without a place to go."""
    from ..errors import SinkError

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SinkError(f"{out}: the folder cannot be made: {error.strerror or error}") from error


@evaluation.command("detection")
def eval_detection(
    data: Annotated[
        list[str],
        typer.Option(
            "--data",
            metavar="URI",
            help="kitti:DIR?sequence=0000&every=5, sim:street?seed=3, sim:scenes?seeds=500-529, nuscenes:DIR, "
            "range:DIR?labels=semantic_kitti; may be repeated.",
        ),
    ],
    profile: Profile = "cpu",
    device: Device = None,
    head: Annotated[Path | None, typer.Option("--head", help=f"{_CARD_HELP}; in place of the profile's.")] = None,
    detections: Annotated[
        Path | None, typer.Option("--detections", help="Score this folder of KITTI result files instead.")
    ] = None,
    scores: Annotated[
        list[float] | None,
        typer.Option("--score", help="Count from this score, by default the card's; more than one: the first leads."),
    ] = None,
    reviewed: Annotated[
        Path | None,
        typer.Option("--reviewed", help="YAML list of {frame: …, at: [x, y]}: real vehicles without a label."),
    ] = None,
    pictures: Annotated[int, typer.Option(min=0, help="Most scans, and most false vehicles, to draw.")] = 60,
    out: Annotated[Path, typer.Option(help="Folder for summary.json and report.html.")] = Path("warploom-eval"),
) -> None:
    """Measure a detection head: KITTI's and nuScenes' average precision, recall, false ones, errors of boxes.

    Example: `warploom eval detection --data "kitti:kitti_object" --data "sim:scenes?seeds=500-529" --out head`
    """
    from ..components.evaluation.detection import LEAST_SCORE, evaluate_detection, lines_of, write_summary
    from ..components.evaluation.detection_report import write_report
    from ..components.evaluation.detection_reviews import Review

    for value in scores or ():
        if not 0 <= value <= 1:
            raise typer.BadParameter(f"must be from 0 to 1, not {value:g}", param_hint="--score")
    review = Review.read(reviewed) if reviewed is not None else None
    _make_folder(out)
    if detections is None:
        from pydantic import ValidationError

        from ..components.perception.detection import DetectionConfig
        from ..components.profile import execution_context, load_profile
        from ..models.heads import open_head

        file = load_profile(profile)
        named = file.content.settings.get("perception.detect.providers")
        try:
            providers = DetectionConfig(providers=named).providers
        except ValidationError as error:
            raise file.error(["settings", "perception.detect.providers"], error.errors()[0]["msg"]) from None
        context = execution_context(file, device or file.content.device)
        judged = open_head(
            head or context.detector,
            device=context.device,
            threads=context.inference_threads,
            precision=context.precision,
            providers=providers,
            score_threshold=LEAST_SCORE,
            capacity=context.capacity,
        )
    else:
        if not scores:
            raise typer.BadParameter("result files have no card: give --score", param_hint="--score")
        judged = detections
    result = evaluate_detection(
        data, judged, score=scores[0] if scores else None, also=scores[1:] if scores else (), review=review
    )
    write_summary(result, out)
    page = write_report(result, out, pictures=pictures)
    for line in lines_of(result):
        typer.echo(line)
    typer.echo(f"{page}")


heads = typer.Typer(help="Detection heads: train, import, look at, quantise.", no_args_is_help=True)
commands.add_typer(heads, name="head")


_IMPORTERS = {  # kind: its module, which has a function `import_KIND`
    "pointpillars": "pointpillars",
    "fcn3d": "fcn3d",
    "yolox": "image_detectors",
    "fastestdet": "image_detectors",
    "twinlitenet": "twinlitenet",
}


@heads.command("import")
def import_head(
    kind: Annotated[str, typer.Argument(help="pointpillars, fcn3d, yolox, fastestdet or twinlitenet.")],
    checkpoint: Annotated[Path, typer.Argument(help="What was downloaded: .pth, .npz or .onnx.")],
    out: Annotated[Path, typer.Option(help="Folder for the ONNX file and the card.")] = Path("heads"),
    config: Annotated[
        Path | None, typer.Option("--config", help="For pointpillars: what differs from KITTI's configuration, YAML.")
    ] = None,
) -> None:
    """Make a head (ONNX file and card) of a well-known checkpoint.

    Example: `warploom head import pointpillars pointpillar_7728.pth --out heads`, then `models: {detector: …}` in a
    profile, or `warploom eval detection --head heads/pointpillars.yaml …`
    """
    if kind not in _IMPORTERS:
        raise typer.BadParameter(f"no importer {kind!r}; there are: {', '.join(_IMPORTERS)}", param_hint="KIND")
    if config is not None and kind != "pointpillars":
        raise typer.BadParameter("only pointpillars takes a configuration", param_hint="--config")
    _make_folder(out)
    with _torch_to("import a head"):
        module = importlib.import_module(f"..models.importers.{_IMPORTERS[kind]}", __package__)
        importer = getattr(module, f"import_{kind}")
        if config is not None:
            importer = functools.partial(importer, spec=module.PointPillarsSpec.read_file(config))
        card = importer(checkpoint, out)
    typer.echo(f"{card}")


def _run_training(arguments: list[str]) -> None:
    from ..models.training.__main__ import main

    training = typer.Typer(add_completion=False)
    training.command()(main)
    training(arguments, prog_name="warploom head train", standalone_mode=False)


def _list_all(wanted: bool) -> None:
    if wanted:
        _run_training(["--help"])
        raise typer.Exit


@heads.command("train", context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def train(
    context: typer.Context,
    out: Annotated[Path, typer.Option(help="Folder for the checkpoint, and at the end the head's ONNX and YAML.")],
    data: Annotated[
        list[str] | None,
        typer.Option(
            "--data",
            metavar="URI",
            help="Labelled scans to learn from as well, as of `warploom eval detection`: kitti:DIR, "
            "kitti:DIR?sequence=0000, nuscenes:DIR; may be repeated.",
        ),
    ] = None,
    everything: Annotated[
        bool,
        typer.Option(
            "--all", is_eager=True, callback=_list_all, help="List the further options, those of the training."
        ),
    ] = False,
) -> None:
    """Train a head on simulated scenes, or go on with one on labelled scans of your own.

    Example: `warploom head train --data kitti:my_drives --start-from pillar_center --frozen --learning-rate 3e-4
    --frames 200 --minutes 20 --out my_head` goes on with the head that ships. All options of
    `python -m warploom.models.training` may follow: `--all` lists them.
    """
    _make_folder(out)
    arguments = ["--out", str(out), *context.args]
    with _torch_to("train"):
        if data:
            from ..components.labelled_scans import write_labelled_scans

            for uri in data:
                typer.echo(f"{uri}: {write_labelled_scans(uri, out / 'labelled')} labelled scans")
            arguments += ["--labelled", str(out / "labelled")]
        _run_training(arguments)


@heads.command("show")
def show_head(
    card: Annotated[Path | None, typer.Argument(help=f"{_CARD_HELP}; by default the first.")] = None,
) -> None:
    """Check a card and its model, and tell what it says.

    Example: `warploom head show heads/pointpillars.yaml`
    """
    import yaml

    from ..models.card import DEFAULT_CARD
    from ..models.heads import check_head

    read, model = check_head(card or DEFAULT_CARD)
    typer.echo(yaml.safe_dump(read.model_dump(mode="json"), sort_keys=False, allow_unicode=True, width=100).rstrip())
    typer.echo(f"# {model}: {model.stat().st_size / 1e6:.1f} MB, as the card says")


@heads.command("quantize")
def quantize(
    card: Annotated[Path | None, typer.Argument(help=f"{_CARD_HELP}; by default the first.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for the ONNX file and the card.")] = Path("heads"),
    frames: Annotated[int, typer.Option(min=1, help="Simulated scenes to calibrate with.")] = 12,
) -> None:
    """Write a variant of a head in eight bits, calibrated on simulated scenes; measure it with `warploom eval`.

    Example: `warploom head quantize --out heads`
    """
    from ..components.evaluation.detection_frames import evaluation_frames
    from ..models.card import DEFAULT_CARD
    from ..models.quantization import quantize_head

    scenes = evaluation_frames(f"sim:scenes?seeds=600-{599 + frames}")
    path = quantize_head(card or DEFAULT_CARD, out, ((scene.points, scene.sensor_height) for scene in scenes))
    typer.echo(f"{path}")
