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
        typer.Option(
            "--filter",
            metavar="TEXT",
            help="Only benchmarks with this in their name, or of this topic; may be repeated.",
        ),
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
    data: Annotated[
        str,
        typer.Option(
            "--data", help="KITTI's tracking set: label_02/, calib/, oxts/; or drives, such as sim:occlusion?seeds=1-8."
        ),
    ],
    detections: Annotated[
        Path | None,
        typer.Option(
            "--detections",
            help="Folder of SSSS.txt with the detections of a type, or its name in DATA; "
            "without it the profile's own head and clusters find the objects in the scans; "
            "truth: of a drive, the true boxes of what can be seen.",
        ),
    ] = None,
    sequences: Annotated[
        str, typer.Option("--sequences", help="Such as 0001,0012; by default all with labels and detections, or scans.")
    ] = "",
    out: Annotated[Path, typer.Option(help="Folder for result files, summary.json and plots over recall.")] = Path(
        "warploom-eval"
    ),
    tracker: Annotated[
        str,
        typer.Option("--tracker", help="For detections: the tracker's settings, a file or a name in conf/trackers."),
    ] = "pointrcnn",
    profile: Annotated[str, typer.Option("--profile", help="For scans: the profile whose pipeline runs.")] = "cpu",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Change a setting of the tracker, or of the profile's modules."
        ),
    ] = None,
) -> None:
    """Track objects and score the tracks: sAMOTA, MOTA, HOTA; on a drive of the simulator velocities and ids as well.

    Example: `warploom eval tracking --data kitti_tracking --detections pointrcnn_Car --out car`

    Example: `warploom eval tracking --data kitti_tracking --sequences 0000`

    Example: `warploom eval tracking --data "sim:occlusion?seeds=1-8&duration=7" --detections truth`
    """
    from ..components.evaluation import tracking, tracking_objects
    from ..components.perception.tracker_settings import load_tracker

    names = [name for name in sequences.split(",") if name]
    if ":" in data and not Path(data).exists():
        if detections is not None and str(detections) != "truth":
            raise typer.BadParameter("of a drive it is truth, or left out", param_hint="--detections")
        result = tracking_objects.evaluate_drives(
            data, out, profile=profile, settings=settings or (), true_detections=detections is not None
        )
        lines = tracking_objects.lines_of_drives(result)
    elif detections is None:
        found = tracking_objects.evaluate_scans(Path(data), names, out, profile=profile, settings=settings or ())
        lines = [line for result in found for line in tracking.lines_of(result)]
    else:
        config = load_tracker(tracker, settings or ())
        lines = tracking.lines_of(
            tracking.evaluate_tracking(Path(data), detections, out, sequences=names, config=config)
        )
    for line in lines:
        typer.echo(line)
    typer.echo(f"outputs in {out}/")


@evaluation.command("fusion")
def eval_fusion(
    data: Annotated[
        str, typer.Option("--data", help="Drives that know the truth, cameras and radars: sim:street?seeds=1-4.")
    ],
    out: Annotated[Path, typer.Option(help="Folder for summary.json.")] = Path("warploom-eval"),
    profile: Annotated[str, typer.Option("--profile", help="The profile whose pipeline runs.")] = "cpu",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting of the profile's modules.")
    ] = None,
) -> None:
    """What cameras and radars add to the LiDAR: recall by distance, velocities from birth on, existence, classes.

    Example: `warploom eval fusion --data "sim:street?seeds=1-4&duration=6" --out fusion`
    """
    from ..components.evaluation.fusion import evaluate_fusion, lines_of_gains

    for line in lines_of_gains(evaluate_fusion(data, out, profile=profile, settings=settings or ())):
        typer.echo(line)
    typer.echo(f"outputs in {out}/")
