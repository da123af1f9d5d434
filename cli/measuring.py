"""Commands that measure: speed, and accuracy on data sets."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["commands"]

commands = typer.Typer()


evaluation = typer.Typer(help="Measure what is found on data sets.", no_args_is_help=True)
commands.add_typer(evaluation, name="eval")


@commands.command()
def bench(
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="TEXT", help="Only benchmarks with this in their name; may be repeated."),
    ] = None,
    device: Annotated[str, typer.Option("--device", help="Where ours computes: cpu, cuda:0 …")] = "cpu",
    compare: Annotated[
        Path | None, typer.Option("--compare", metavar="OLD.json", help="An earlier run's benchmark.json.")
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder for benchmark.json, benchmarks.md and its plots.")] = Path(
        "warploom-bench"
    ),
    quick: Annotated[bool, typer.Option("--quick", help="Few rounds, no large clouds, no long runs.")] = False,
) -> None:
    """Time the kernels beside those peers that are installed.

    Example: `warploom bench --filter voxelize --filter "cluster 120k" --compare old/benchmark.json`
    """
    from ..bench.run import run_benchmarks

    run_benchmarks(filters=filters or (), device=device, compare=compare, out=out, quick=quick)


@evaluation.command("tracking")
def eval_tracking(
    data: Annotated[Path, typer.Option("--data", help="KITTI's tracking set: label_02/, calib/, oxts/.")],
    detections: Annotated[
        Path,
        typer.Option("--detections", help="Folder of SSSS.txt with the detections of a type, or its name in DATA."),
    ],
    sequences: Annotated[
        str, typer.Option("--sequences", help="Such as 0001,0012; by default all with labels and detections.")
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for result files, summary.json and recall.png.")] = Path(
        "warploom-eval"
    ),
    tracker: Annotated[
        str, typer.Option("--tracker", help="The tracker's settings: a YAML file, or a name in conf/trackers.")
    ] = "pointrcnn",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change one by its dotted key, such as vehicle.coast=2.0."),
    ] = None,
) -> None:
    """Track detections on KITTI's tracking set, and score the tracks: sAMOTA, MOTA and HOTA.

    Example: `warploom eval tracking --data kitti_tracking --detections pointrcnn_Car --out car`
    """
    from ..components.evaluation.tracking import evaluate_tracking, lines_of
    from ..components.perception.tracker_settings import load_tracker

    config = load_tracker(tracker, settings or ())
    names = [name for name in sequences.split(",") if name]
    for line in lines_of(evaluate_tracking(data, detections, out, sequences=names, config=config)):
        typer.echo(line)
