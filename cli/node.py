"""Commands that start a node and look into a running one."""

from __future__ import annotations

import contextlib
import functools
import inspect
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from .options import Settings

if TYPE_CHECKING:
    from rich.console import Console

    from ..components.launching import Launch

__all__ = ["commands"]

commands = typer.Typer()

_FIRST_PICTURE_S = 0.5
"""After which `top` shows its first picture, of the CPU time since it was called [s]."""

Node = Annotated[str | None, typer.Option("--node", help="Which node; by default the only one that runs.")]
AsJson = Annotated[bool, typer.Option("--json", help="As JSON.")]


@dataclass(frozen=True)
class Start:
    """The options of the commands that start a node."""

    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="A launch file: its path or its name.")] = None
    hw: Annotated[
        str | None, typer.Option("--hw", help="Find the launch file by its computing unit, such as hw50 …")
    ] = None
    lidar: Annotated[str | None, typer.Option("--lidar", help="… its LiDAR, such as pandar90 …")] = None
    camera: Annotated[str | None, typer.Option("--camera", help="… its cameras, such as 13 …")] = None
    radar: Annotated[str | None, typer.Option("--radar", help="… its radars, such as conti430.")] = None
    profile: Annotated[
        str | None,
        typer.Option("--profile", help="Hardware profile in place of the launch file's: a name or a path."),
    ] = None
    settings: Settings = None
    check: Annotated[
        bool, typer.Option("--check", help="Validate everything and look for the hardware; start nothing.")
    ] = False
    skip_check: Annotated[
        list[str] | None,
        typer.Option("--skip-check", metavar="NAME", help="Start though this preflight check fails."),
    ] = None
    as_json: AsJson = False

    @property
    def hardware(self) -> dict[str, str]:
        """By which the launch file is to be found."""
        names = ("hw", "lidar", "camera", "radar")
        return {name: value for name in names if (value := getattr(self, name)) is not None}


def _with_start_options(command: Callable[..., None]) -> Callable[..., None]:
    """Gives a command, whose first argument is a `Start`, the options of it after its own."""
    own = get_type_hints(command, include_extras=True)
    shared = get_type_hints(Start, include_extras=True)
    defaults = {one.name: one.default for one in inspect.signature(command).parameters.values()}

    @functools.wraps(command)
    def run(**values: Any) -> None:
        command(Start(**{name: values.pop(name) for name in shared}), **values)

    hints = {"file": shared["file"], **{name: own[name] for name in defaults if name != "start"}, **shared}
    run.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        inspect.Parameter(
            name,
            inspect.Parameter.KEYWORD_ONLY,
            default=getattr(Start, name) if name in shared else defaults[name],
            annotation=hint,
        )
        for name, hint in hints.items()
    )
    run.__annotations__ = hints
    return run


@commands.command()
@_with_start_options
def launch(
    start: Start,
    modules: Annotated[
        list[str] | None, typer.Option("-c", "--module", metavar="MODULE", help="A module file of a single process.")
    ] = None,
    process: Annotated[str | None, typer.Option("-p", "--process", help="The name of that process.")] = None,
) -> None:
    """Start a node and watch over its processes: of a launch file, of one found by its hardware, or a single one.

    Example: `warploom launch --hw hw50 --lidar pandar90 --camera 13 --radar conti430`

    Example: `warploom launch -c lidar.yaml -c perception.yaml -p compute3d_sched`
    """
    from ..components.launching import plan_launch

    if bool(start.file) + bool(modules) + bool(start.hardware) != 1:
        raise typer.BadParameter("say what to launch: a launch file, or -c and -p, or --hw, --lidar, --camera, --radar")
    if bool(modules) != bool(process):
        raise typer.BadParameter("-c and -p belong together: the modules of a process, and its name")
    planned = plan_launch(
        start.file,
        hardware=start.hardware,
        modules=modules or (),
        process=process,
        profile=start.profile,
        settings=start.settings or (),
    )
    _launch(planned, start)


@commands.command("start-all")
@_with_start_options
def start_all(start: Start) -> None:
    """Start every process of a node, and the monitors beside them.

    Example: `warploom start-all --hw hw50 --lidar pandar90 --camera 13 --radar conti430`
    """
    from ..components.launching import monitor_processes, plan_launch

    # A folder that was assembled for a node names it so to its `start_all`, which may be given options all the same.
    file = start.file or (None if start.hardware else os.environ.get("WARPLOOM_LAUNCH"))
    if bool(file) == bool(start.hardware):
        raise typer.BadParameter("say what to start: a launch file, or --hw, --lidar, --camera, --radar")
    planned = plan_launch(
        file,
        hardware=start.hardware,
        profile=start.profile,
        settings=start.settings or (),
        more=monitor_processes(),
    )
    _launch(planned, start)


def _launch(planned: Launch, start: Start) -> None:
    from ..components.launching import check_launch, run_launch
    from ..dag.launch.table import JsonLines, LiveTable

    findings = check_launch(planned, build=start.check)
    skipped = start.skip_check or ()
    missing = [finding for finding in findings if not finding.ok and finding.check not in skipped]
    for finding in findings if start.check else missing:
        typer.echo(str(finding), err=not start.check)
    if missing:
        names = ", ".join(dict.fromkeys(finding.check for finding in missing))
        typer.echo(f"warploom: nothing was started: preflight failed ({names})", err=True)
        raise typer.Exit(2)
    if start.check:
        for process, files in planned.plan.modules.items():
            typer.echo(f"ok       process {process}: {len(files)} modules")
        typer.echo(f"{planned.plan.file.path}: node {planned.plan.node!r} is good")
        return
    level = _level()
    if start.as_json or not sys.stdout.isatty():
        with contextlib.closing(JsonLines()) as lines:
            code = run_launch(planned, on_event=lines, log_level=level)
        raise typer.Exit(code)
    table = LiveTable()
    try:
        code = run_launch(planned, on_event=table, log_level=level, table=table)
    finally:
        table.close()
    raise typer.Exit(code)


def _level() -> str:
    import logging

    return logging.getLevelName(logging.getLogger().level).lower()


@commands.command()
def ps(node: Node = None, as_json: AsJson = False) -> None:
    """Tell what the processes of a running node do: state, restarts, memory, and what each component says of itself.

    Example: `warploom ps --node computing_node_hw50_pandar90_13_600`
    """
    from ..dag.launch.control import connect
    from ..dag.launch.table import component_table, process_table

    _, client = connect(node)
    with client:
        status = client.ask("ps")
    if as_json:
        typer.echo(json.dumps(status))
    else:
        _print(process_table(status, width=_console().width))
        _print(component_table(status))


@commands.command()
def top(
    node: Node = None,
    every: Annotated[float, typer.Option("--every", min=0.1, max=3600.0, help="Between two pictures [s].")] = 2.0,
    count: Annotated[int, typer.Option("--count", min=0, help="End after so many pictures; 0: never.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Show again and again what the processes of a running node use of the machine.

    Example: `warploom top --every 1`
    """
    from ..dag.launch.control import connect
    from ..dag.launch.table import usage_view

    _, client = connect(node)
    shown = 0
    with client, contextlib.ExitStack() as stack:
        show = _print
        if sys.stdout.isatty() and not as_json:
            from rich.live import Live

            live = stack.enter_context(Live(console=_console(), auto_refresh=False))
            show = functools.partial(live.update, refresh=True)
        before = client.ask("ps")
        while not count or shown < count:
            time.sleep(every if shown else min(every, _FIRST_PICTURE_S))
            status = client.ask("ps")
            cpu = _cpu_shares(before, status)
            before, shown = status, shown + 1
            if as_json:
                typer.echo(json.dumps({**status, "cpu_percent": cpu}))
            else:
                show(usage_view(status, cpu, _console().width))


def _cpu_shares(before: dict[str, Any], after: dict[str, Any]) -> dict[int, float]:
    """By process id, the share of a core that it used between two answers [%]."""
    passed = max(after["at"] - before["at"], 1e-3)
    was = {one.get("pid"): one.get("cpu_s", 0.0) for one in (*before["processes"], before["supervisor"])}
    shares = {}
    for one in (*after["processes"], after["supervisor"]):
        if one.get("pid") is not None:
            spent = one.get("cpu_s", 0.0) - was.get(one["pid"], 0.0)
            shares[one["pid"]] = round(100 * max(0.0, spent) / passed, 2)
    return shares


@commands.command()
def topics(node: Node = None, as_json: AsJson = False) -> None:
    """List the topics of a running node: type, who commits and who reads them, commits and rate.

    Example: `warploom topics`
    """
    from ..dag.launch.control import connect
    from ..dag.launch.table import topic_table

    _, client = connect(node)
    with client:
        answer = client.ask("topics")
    if as_json:
        typer.echo(json.dumps(answer))
    else:
        _print(topic_table(answer))


@commands.command()
def echo(
    topic: Annotated[str, typer.Argument(help="A topic of the node: see `warploom topics`.")],
    node: Node = None,
    count: Annotated[int, typer.Option("--count", min=0, help="End after so many; 0: when interrupted.")] = 0,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0.01, help="Fail when nothing comes for so long [s].")
    ] = None,
) -> None:
    """Print what is committed to a topic of a running node, a line of JSON for each commit; arrays by type and range.

    Example: `warploom echo perception/obstacles --count 3`
    """
    from ..dag.launch.listening import plain_value

    for number, entry in enumerate(_entries(topic, node, timeout), 1):
        record = {"version": entry.version, "epoch": entry.epoch, "value": plain_value(entry.value)}
        typer.echo(json.dumps(record, default=str))
        if number == count:
            break


@commands.command()
def hz(
    topic: Annotated[str, typer.Argument(help="A topic of the node: see `warploom topics`.")],
    node: Node = None,
    seconds: Annotated[float, typer.Option("--seconds", min=0.1, help="Between two lines [s].")] = 1.0,
    count: Annotated[int, typer.Option("--count", min=0, help="End after so many lines; 0: when interrupted.")] = 0,
    window: Annotated[int, typer.Option("--window", min=2, help="Commits that the figures are of.")] = 1000,
) -> None:
    """Tell how often a topic of a running node is committed to, and how evenly.

    Example: `warploom hz lidar/points --seconds 2`
    """
    from ..dag.launch.listening import RateMeter

    meter, shown, due = RateMeter(window), 0, time.monotonic() + seconds
    for entry in _entries(topic, node, min(seconds, 0.2), ends=False, past=False):
        if entry is not None:
            meter.add()
        if time.monotonic() >= due:
            due += seconds
            shown += 1
            typer.echo(json.dumps(meter.figures()))
            if shown == count:
                break


def _entries(topic: str, node: str | None, timeout: float | None, **how: bool) -> Any:
    """The commits to a topic, as `listen` gives them."""
    from ..dag.launch.control import connect
    from ..dag.launch.listening import listen
    from ..errors import WarploomError

    name, client = connect(node)
    with client:
        try:
            yield from listen(client, name, topic, f"listener-{os.getpid()}", timeout, **how)
        except TimeoutError as error:
            raise WarploomError(str(error)) from None


def _print(table: Any) -> None:
    _console().print(table)


def _console() -> Console:
    """The terminal, or room for the tables where what is printed goes elsewhere."""
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 160, markup=False, emoji=False)
