"""Commands about detection heads: how good one is."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .measuring import evaluation
from .options import Device, Profile

__all__ = ["commands"]

commands = typer.Typer()


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
    head: Annotated[Path | None, typer.Option("--head", help="A head's card, in place of the profile's.")] = None,
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

    review = Review.read(reviewed) if reviewed is not None else None
    if detections is None:
        from ..components.profile import execution_context, load_profile
        from ..models.head import DetectionHead

        file = load_profile(profile)
        context = execution_context(file, device or file.content.device)
        judged = DetectionHead(
            head or context.detector,
            device=context.device,
            threads=context.inference_threads,
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
