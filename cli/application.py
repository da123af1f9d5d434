"""The command `warploom` as such: its help, and what holds for every command."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

__all__ = ["app", "ends_in_order"]

app = typer.Typer(
    name="warploom",
    help="Perception for vehicles and robots: from LiDAR points to tracked objects, on a GPU or a plain CPU.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
)


class _Ended(KeyboardInterrupt):
    pass


@contextmanager
def ends_in_order() -> Iterator[None]:
    """Lets SIGTERM and SIGHUP end a command as Ctrl-C does, so that what it writes is finished.

    A service manager sends them, or a terminal that closes. One that is ignored stays so.
    """

    def end(number: int, _: object) -> None:
        raise _Ended(number)

    before = {one: signal.getsignal(one) for one in (signal.SIGTERM, signal.SIGHUP)}
    ours = [one for one, handler in before.items() if handler is signal.SIG_DFL]
    for one in ours:
        signal.signal(one, end)
    try:
        yield
    except _Ended as ended:
        typer.echo(f"warploom: ended by {signal.Signals(ended.args[0]).name}", err=True)
        raise typer.Exit(128 + ended.args[0]) from None
    finally:
        for one in ours:
            signal.signal(one, signal.SIG_DFL)


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
