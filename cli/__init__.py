"""The command `warploom`."""

from __future__ import annotations

import errno
import os
import sys

import typer

from ..errors import ConfigError, DeviceError, ModelError, WarploomError
from . import configuring, detecting, inspecting, measuring, node, profile, recording, running
from .application import app

__all__ = ["app", "main"]

# In the order in which the help lists them.
for _part in (running, node, inspecting, configuring, recording, measuring, profile, detecting):
    app.add_typer(_part.commands)


def main() -> None:
    """Runs the command: exit code 0 when it is done, 2 for bad usage or configuration, 1 when it failed."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by whoever started this
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115 (to the end)
    try:
        app()
    except (ConfigError, DeviceError, ModelError) as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(2)
    except WarploomError as error:
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(1)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        typer.echo(f"warploom: {error}", err=True)
        sys.exit(1)
    except KeyboardInterrupt:
        typer.echo("warploom: interrupted", err=True)
        sys.exit(130)
