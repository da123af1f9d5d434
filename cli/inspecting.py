"""Commands that look at a file, and at the machine."""

from __future__ import annotations

from typing import Annotated

import typer

from .options import Settings

__all__ = ["commands"]

commands = typer.Typer()


@commands.command()
def info(
    file: Annotated[str | None, typer.Argument(help="A scan, a folder of scans, or a recording.")] = None,
) -> None:
    """Tell what a file holds; without one, the machine and the versions.

    Example: `warploom info scans/`
    """
    if file is None:
        from ..components.machine import describe_machine, machine_lines

        lines = machine_lines(describe_machine())
    else:
        from ..components.sources import describe, describe_lines

        lines = describe_lines(describe(file))
    for line in lines:
        typer.echo(line)


@commands.command()
def check(
    file: Annotated[
        str, typer.Argument(help="A profile, a module or a launch file: the path of a YAML file, or a name.")
    ],
    settings: Settings = None,
) -> None:
    """Validate a profile, a module or a launch file, with all that it names, without running it.

    Example: `warploom check conf/modules/perception.yaml`
    """
    from ..components.checking import check_file

    for line in check_file(file, settings or ()):
        typer.echo(line)


@commands.command()
def graph(
    file: Annotated[
        str, typer.Argument(help="A module, a profile or a launch file: a YAML file, or a name.")
    ] = "perception",
    form: Annotated[str, typer.Option("--format", help="text, mermaid or svg.")] = "text",
    settings: Settings = None,
) -> None:
    """Draw the components of a module, or all those of a profile or a launch file, and the vertices of their graphs.

    Example: `warploom graph perception --format svg > perception.svg`
    """
    from ..components.checking import FORMATS, draw_file

    if form not in FORMATS:
        raise typer.BadParameter(f"{form!r} is neither text nor mermaid nor svg", param_hint="--format")
    typer.echo(draw_file(file, form, settings or ()).rstrip())
