"""Commands that perceive: the demo, and a run on a recording or the simulator."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .application import ends_in_order
from .options import Device, MetricsPort, Profile, Settings, TraceFile

__all__ = ["commands"]

commands = typer.Typer()


@commands.command()
def demo(
    seconds: Annotated[float, typer.Option(min=0.1, max=600.0, help="Simulated time.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated street.")] = 7,
    out: Annotated[Path, typer.Option(help="Folder for the outputs.")] = Path("warploom-demo"),
    profile: Profile = "cpu",
    device: Device = None,
    settings: Settings = None,
    trace: TraceFile = None,
    metrics_port: MetricsPort = None,
) -> None:
    """Drive a simulated street and track what is on it, with the truth beside it.

    Example: `warploom demo --seconds 10 --seed 3`
    """
    from ..components.running import run_to_folder

    source = f"sim:street?seed={seed}&duration={seconds}"
    with ends_in_order():
        run_to_folder(
            source,
            profile=profile,
            device=device,
            settings=settings or (),
            out=out,
            picture=True,
            trace=trace,
            metrics_port=metrics_port,
        )


@commands.command()
def run(
    source: Annotated[
        str, typer.Option("--source", help="kitti:DIR, sim:street?seed=7, mcap:FILE, or a scan or a folder of scans.")
    ],
    profile: Profile = "cpu",
    frames: Annotated[int | None, typer.Option(min=1, help="Stop after this many frames.")] = None,
    out: Annotated[Path, typer.Option(help="Folder for objects.jsonl, report.json and run.mcap.")] = Path(
        "warploom-out"
    ),
    device: Device = None,
    settings: Settings = None,
    realtime: Annotated[
        bool, typer.Option("--realtime", help="Feed frames at their own pace; late ones are dropped.")
    ] = False,
    mcap: Annotated[bool, typer.Option(help="Write run.mcap.")] = True,
    trace: TraceFile = None,
    metrics_port: MetricsPort = None,
    check: Annotated[
        bool, typer.Option("--check", help="Look whether data are written to after their commit, and count them.")
    ] = False,
) -> None:
    """Perceive the frames of a recording or of the simulator.

    Example: `warploom run --source kitti:scans/ --out out --set perception.cluster.radius=0.6`
    """
    from ..components.running import run_to_folder

    with ends_in_order():
        run_to_folder(
            source,
            profile=profile,
            device=device,
            settings=[*(settings or ()), *(["profile.check=true"] if check else [])],
            out=out,
            frames=frames,
            realtime=realtime,
            mcap=mcap,
            trace=trace,
            metrics_port=metrics_port,
        )
