"""The command `warploom` as such: its help, and what holds for every command."""

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app"]

app = typer.Typer(
    name="warploom",
    help="Perception for vehicles and robots: from LiDAR points to tracked objects, on a GPU or a plain CPU.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


@app.callback()
def _root(
    log_level: Annotated[str, typer.Option("--log-level", help="debug, info, warning or error.")] = "warning",
    log_dir: Annotated[
        Path | None,
        typer.Option("--log-dir", envvar="WARPLOOM_LOG_DIR", help="Folder for a log file of this process, rotated."),
    ] = None,
) -> None:
    from ..dag.logs import start_logging

    try:
        start_logging(log_level, log_dir)
    except ValueError as error:
        raise typer.BadParameter(str(error), param_hint="--log-level") from error
