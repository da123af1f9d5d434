"""Commands about the configuration files that can be named."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["commands"]

commands = typer.Typer()
conf = typer.Typer(help="The configuration files that can be named: list, show or copy them.", no_args_is_help=True)
commands.add_typer(conf, name="conf")

Name = Annotated[str, typer.Argument(help="Of a file, such as cpu, or with its kind: profiles/cpu.")]


@conf.command("list")
def list_files(
    kind: Annotated[str | None, typer.Argument(help="profiles, modules, launch or trackers; by default all.")] = None,
) -> None:
    """List the files in ./conf, $WARPLOOM_CONF and the package, with what each is for.

    Example: `warploom conf list profiles`
    """
    from ..components.configurations import named_files

    files = named_files()
    kinds = sorted({file.kind for file in files})
    if kind is not None and kind not in kinds:
        raise typer.BadParameter(f"{kind!r} is none of {', '.join(kinds)}", param_hint="KIND")
    shown = [file for file in files if kind in (None, file.kind)]
    width = max(len(f"{file.kind}/{file.name}") for file in shown)
    for file in shown:
        typer.echo(f"{f'{file.kind}/{file.name}':{width}}  {file.description()}".rstrip())


@conf.command()
def show(name: Name) -> None:
    """Print a file.

    Example: `warploom conf show cpu > mine.yaml`
    """
    from ..components.configurations import find_file

    typer.echo(find_file(name).path.read_text(encoding="utf-8"), nl=False)


@conf.command()
def copy(
    name: Name,
    to: Annotated[Path, typer.Option("--to", help="The conf folder to copy it into.")] = Path("conf"),
) -> None:
    """Copy a file into ./conf, where it is found before the package's.

    Example: `warploom conf copy modules/perception`
    """
    from ..components.configurations import copy_file

    typer.echo(str(copy_file(name, to)))
