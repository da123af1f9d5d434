"""The command `warploom`."""

from __future__ import annotations

import logging
import sys
from pathlib import Path
from typing import Annotated

import typer

from .errors import ConfigError, DeviceError, ModelError, WarploomError

__all__ = ["app", "main"]

_log = logging.getLogger(__name__)

app = typer.Typer(
    name="warploom",
    help="Perception for vehicles and robots: from LiDAR points to tracked objects, on a GPU or a plain CPU.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)

Profile = Annotated[str, typer.Option("--profile", help="Hardware profile: a name, or the path of a YAML file.")]
Device = Annotated[str | None, typer.Option("--device", help="Compute device in place of the profile's: cpu, cuda:0 …")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change a setting by its dotted key, such as perception.cluster.radius=0.6."
    ),
]


@app.callback()
def _root(
    log_level: Annotated[str, typer.Option("--log-level", help="debug, info, warning or error.")] = "warning",
) -> None:
    level = logging.getLevelNamesMapping().get(log_level.upper())
    if level is None:
        raise typer.BadParameter(f"{log_level!r} is none of debug, info, warning, error", param_hint="--log-level")
    logging.basicConfig(level=level, format="%(asctime)s %(levelname)s %(name)s: %(message)s", stream=sys.stderr)


@app.command()
def demo(
    seconds: Annotated[float, typer.Option(min=0.1, max=600.0, help="Simulated time.")] = 10.0,
    seed: Annotated[int, typer.Option(min=0, help="Of the simulated street.")] = 7,
    out: Annotated[Path, typer.Option(help="Folder for the outputs.")] = Path("warploom-demo"),
    profile: Profile = "cpu",
    device: Device = None,
    settings: Settings = None,
) -> None:
    """Drive a simulated street and track what is on it, with the truth beside it.

    Example: `warploom demo --seconds 10 --seed 3`
    """
    from .components.running import run_to_folder

    source = f"sim:street?seed={seed}&duration={seconds}"
    run_to_folder(source, profile=profile, device=device, settings=settings or (), out=out, picture=True)


@app.command()
def run(
    source: Annotated[
        str, typer.Option("--source", help="kitti:DIR, sim:street?seed=7, or a scan or a folder of scans.")
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
) -> None:
    """Perceive the frames of a recording or of the simulator.

    Example: `warploom run --source kitti:scans/ --out out --set perception.cluster.radius=0.6`
    """
    from .components.running import run_to_folder

    run_to_folder(
        source,
        profile=profile,
        device=device,
        settings=settings or (),
        out=out,
        frames=frames,
        realtime=realtime,
        mcap=mcap,
    )


@app.command()
def info(
    file: Annotated[str | None, typer.Argument(help="A scan, a folder of scans, or a recording.")] = None,
) -> None:
    """Tell what a file holds; without one, the machine and the versions.

    Example: `warploom info scans/`
    """
    if file is None:
        from .components.machine import describe_machine, machine_lines

        lines = machine_lines(describe_machine())
    else:
        from .components.sources import describe, describe_lines

        lines = describe_lines(describe(file))
    for line in lines:
        typer.echo(line)


@app.command()
def check(
    file: Annotated[str, typer.Argument(help="A profile or a module: the path of a YAML file, or a name.")],
    settings: Settings = None,
) -> None:
    """Validate a profile or a module file, with all that it names, without running it.

    Example: `warploom check conf/modules/perception.yaml`
    """
    from .components.checking import check_file

    for line in check_file(file, settings or ()):
        typer.echo(line)


@app.command()
def graph(
    file: Annotated[str, typer.Argument(help="A module file, or the name of one.")] = "perception",
    form: Annotated[str, typer.Option("--format", help="text or mermaid.")] = "text",
) -> None:
    """Draw the components of a module file and the vertices of their graphs.

    Example: `warploom graph perception --format mermaid`
    """
    from .components.profile import CONF
    from .dag import draw_mermaid, draw_text, find_config, load_module

    drawers = {"text": draw_text, "mermaid": draw_mermaid}
    if form not in drawers:
        raise typer.BadParameter(f"{form!r} is neither text nor mermaid", param_hint="--format")
    typer.echo(drawers[form](load_module(find_config(file, "modules", CONF)).content))


def main() -> None:
    """Runs the command: exit code 0 when it is done, 2 for bad usage or configuration, 1 when it failed."""
    try:
        app()
    except (ConfigError, DeviceError, ModelError) as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(2)
    except WarploomError as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("warploom: interrupted", err=True)
        sys.exit(130)
