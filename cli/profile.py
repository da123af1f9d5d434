"""The command that looks at the machine and measures a profile on it."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from .options import Device, Settings

__all__ = ["commands"]

commands = typer.Typer()


@commands.command()
def profile(
    name: Annotated[
        str | None, typer.Argument(metavar="[PROFILE]", help="Measure this one, not the one that is proposed.")
    ] = None,
    seconds: Annotated[float, typer.Option(min=1.0, max=120.0, help="Length of the demo drive.")] = 5.0,
    measure: Annotated[bool, typer.Option(help="Whether to measure; else it only looks and proposes.")] = True,
    device: Device = None,
    settings: Settings = None,
    as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False,
) -> None:
    """Look at the machine, propose a hardware profile, and measure whether it keeps its budget, stage by stage.

    Example: `warploom profile --seconds 10`

    Example: `warploom profile cpu-min --set perception.cluster.radius=0.6 --json`
    """
    from rich.console import Console

    from ..components.machine import machine_lines
    from ..components.profile import load_profile
    from ..components.profiling import look, measure_profile, propose, verdict_lines

    if name is not None:  # a wrong name is told before the machine is looked at
        load_profile(name)
    progress = Console(stderr=True)
    with progress.status("looking at the machine"):
        machine = look()
    proposal = propose(machine)
    if not as_json:
        for line in machine_lines(machine):
            typer.echo(line)
        typer.echo(f"{'taichi':<12} {', '.join(machine['taichi']) or 'none'}")
        typer.echo(f"\nproposed: {proposal.profile}, because " + "; ".join(proposal.reasons))
        for other, when in proposal.others.items():
            typer.echo(f"possible: {other}, {when}")
    measured = None
    if measure:
        chosen = name or proposal.profile
        with progress.status(f"measuring {chosen} on {seconds:g} s of the demo drive"):
            measured = measure_profile(chosen, seconds=seconds, device=device, settings=settings or ())
    if as_json:
        told: dict[str, Any] = {
            "machine": machine,
            "proposal": {
                "profile": proposal.profile,
                "reasons": list(proposal.reasons),
                "others": dict(proposal.others),
            },
            "measurement": None if measured is None else measured.as_dict(),
        }
        typer.echo(json.dumps(told, indent=2, ensure_ascii=False))
        return
    if measured is not None:
        _print_table(measured)
        for line in verdict_lines(measured):
            typer.echo(line)


def _print_table(measured: Any) -> None:
    from rich.console import Console
    from rich.table import Table

    title = f"{measured.profile} on {measured.device}: {measured.frames} frames of {measured.points:,} points"
    table = Table(title=title, min_width=72)
    for column in ("stage", "run median", "p95", "wait median", "p95 [ms]"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    for stage, times in measured.stages.items():
        values = (times.run.median, times.run.p95, times.wait.median, times.wait.p95)
        table.add_row(stage, *(f"{value:.2f}" for value in values))
    table.add_section()
    if measured.total is not None:
        table.add_row("end to end", f"{measured.total.median:.2f}", f"{measured.total.p95:.2f}", "included", "")
    Console().print(table)
