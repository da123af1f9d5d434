"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

__all__ = ["Device", "MetricsPort", "Profile", "Settings", "TraceFile"]

Profile = Annotated[str, typer.Option("--profile", help="Hardware profile: a name, or the path of a YAML file.")]
Device = Annotated[str | None, typer.Option("--device", help="Compute device in place of the profile's: cpu, cuda:0 …")]
Settings = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Change a setting by its dotted key, such as perception.cluster.radius=0.6."
    ),
]

TraceFile = Annotated[
    Path | None, typer.Option("--trace", metavar="FILE", help="Write a trace of the run, for ui.perfetto.dev.")
]
MetricsPort = Annotated[
    int | None,
    typer.Option("--metrics-port", min=0, max=65535, help="Answer Prometheus on this port of 127.0.0.1; 0: any."),
]
