"""How a node's state is shown: a live table on a terminal, lines of JSON otherwise."""

from __future__ import annotations

import contextlib
import json
import sys
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Table

__all__ = ["JsonLines", "LiveTable", "component_table", "process_table", "topic_table", "usage_view"]

_SHOWN_EVENTS = 8
_QUIET = ("state",)
_COLUMNS = ("process", "state", "pid", "up", "restarts", "cpu %", "memory", "fds")
_LEFT_OUT_FIRST = ("fds", "memory", "up", "restarts", "pid")
_SAYS_WIDTH = 24
"""Characters that the last column of the processes is to have."""


class JsonLines:
    """Writes every event as a line of JSON."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Names the stream; by default stdout."""
        self._stream = sys.stdout if stream is None else stream

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Writes one; a reader that has gone away is no reason to stop."""
        try:
            self._stream.write(json.dumps(event, default=str) + "\n")
            self._stream.flush()
        except (OSError, ValueError):
            pass


class LiveTable:
    """Shows the processes and the last events on a terminal, anew at each event and whenever it is refreshed."""

    def __init__(self, console: Console | None = None) -> None:
        """Prepares.

        Args:
            console: Where it is drawn; by default the terminal.
        """
        from rich.console import Console
        from rich.live import Live

        self._status: Callable[[], Mapping[str, Any]] | None = None
        self._events: list[Mapping[str, Any]] = []
        self._live = Live(console=console or Console(markup=False, emoji=False), auto_refresh=False, transient=False)

    def show(self, status: Callable[[], Mapping[str, Any]]) -> None:
        """Begins to show a node, whose status the function gives as `ps` is answered."""
        self._status = status
        self._live.start()

    def close(self) -> None:
        """Leaves the last picture on the terminal."""
        with contextlib.suppress(OSError):  # the terminal has gone
            self._live.stop()

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Takes up an event."""
        if event["event"] not in _QUIET:
            self._events = [*self._events, event][-_SHOWN_EVENTS:]
        self.refresh()

    def refresh(self) -> None:
        """Draws once."""
        if self._status is None:
            return
        from rich.console import Group
        from rich.text import Text

        lines = [Text(event_text(event), style=_style(event)) for event in self._events]
        table = process_table(self._status(), width=self._live.console.width)
        self._live.update(Group(table, *lines), refresh=True)


def event_text(event: Mapping[str, Any]) -> str:
    """An event as a line to read."""
    at = time.strftime("%H:%M:%S", time.localtime(event.get("time", 0)))
    hidden = ("time", "node", "event", "process", "last_lines")
    said = ", ".join(f"{key} {value}" for key, value in event.items() if key not in hidden and value not in ("", None))
    lines = [f"{at} {event.get('process', '')} {event['event']}{': ' if said else ''}{said}".replace("  ", " ")]
    lines += [f"           | {line}" for line in event.get("last_lines", ())]
    return "\n".join(lines)


def _style(event: Mapping[str, Any]) -> str:
    return {
        "died": "red",
        "hangs": "red",
        "warning": "yellow",
        "up": "green",
        "serving": "green",
        "ending": "bold",
    }.get(event["event"], "")


def process_table(status: Mapping[str, Any], cpu: Mapping[int, float] | None = None, width: int | None = None) -> Table:
    """The processes of a node.

    Args:
        status: As `ps` is answered.
        cpu: Share of a core by process id, where it was measured [%].
        width: Of the terminal, in characters: on a narrow one columns are left out; None: it has room for all.
    """
    from rich.table import Table

    rows = [_process_row(process, cpu) for process in status["processes"]]
    names = [name for name in _COLUMNS if name != "cpu %" or cpu is not None]
    widths = {name: 3 + max(len(name), *(len(row[name]) for row in rows), 0) for name in names}
    for name in _LEFT_OUT_FIRST:
        if width is None or sum(widths[one] for one in names) + _SAYS_WIDTH <= width:
            break
        names.remove(name)
    table = Table(title=f"node {status['node']}", title_justify="left")
    for name in names:
        table.add_column(name, justify="left" if name in ("process", "state") else "right", no_wrap=True)
    table.add_column("says", overflow="fold")
    for process, row in zip(status["processes"], rows, strict=True):
        style = "" if process["state"] == "running" else "yellow"
        table.add_row(*(row[name] for name in names), row["says"], style=style)
    return table


def _process_row(process: Mapping[str, Any], cpu: Mapping[int, float] | None) -> dict[str, str]:
    idle, starting = (
        sum(bool(component.get(why)) for component in process["components"])
        for why in ("idle_because", "starting_because")
    )
    says = [f"{len(process['components'])} components" + (f", {idle} of them idle" if idle else "")]
    says += [f"{starting} of them not ready to serve yet"] if starting else []
    says += process["warnings"]
    if process.get("log_lost"):
        says.append(f"log: {process['log_lost']} bytes could not be written")
    if process["last_death"]:
        says.append(f"last death: {process['last_death']}")
    return {
        "process": process["name"],
        "state": process["state"],
        "pid": str(process["pid"] or "-"),
        "up": duration_text(process["uptime_s"]),
        "restarts": str(process["restarts"]),
        "cpu %": "-" if cpu is None else f"{cpu.get(process['pid'], 0.0):.1f}",
        "memory": f"{process['rss'] / 2**20:.0f} MiB" if "rss" in process else "-",
        "fds": str(process.get("fds", "-")),
        "says": "\n".join(says),
    }


def usage_view(status: Mapping[str, Any], cpu: Mapping[int, float], width: int | None = None) -> Group:
    """The processes of a node and its supervisor, with the share of a core that each uses, as `process_table`."""
    from rich.console import Group
    from rich.text import Text

    pid = status["supervisor"]["pid"]
    return Group(process_table(status, cpu, width), Text(f"supervisor: process {pid}, {cpu.get(pid, 0.0):.1f} %"))


def component_table(status: Mapping[str, Any]) -> Table:
    """What the components of a node say of themselves: that they are idle and why, or what they do."""
    from rich.table import Table

    table = Table(title="components", title_justify="left")
    for name in ("process", "component", "kind", "says"):
        table.add_column(name, overflow="fold")
    for process in status["processes"]:
        for component in process["components"]:
            says = [f"{key} {value}" for key, value in component["state"].items()]
            if component["idle_because"]:
                says.insert(0, f"idle: {component['idle_because']}")
            if component.get("starting_because"):
                says.insert(0, f"starting: {component['starting_because']}")
            says += [f"lost {count} ({reason})" for reason, count in component["losses"].items()]
            style = "dim" if component["idle_because"] else ""
            table.add_row(process["name"], component["name"], str(component["kind"]), ", ".join(says), style=style)
    return table


def topic_table(topics: Mapping[str, Any]) -> Table:
    """The topics of a node, as `topics` is answered."""
    from rich.table import Table

    table = Table(title="topics", title_justify="left")
    for name in ("topic", "type", "producer", "commits", "Hz", "readers"):
        table.add_column(name, justify="right" if name in ("commits", "Hz") else "left", overflow="fold")
    for topic in topics["topics"]:
        table.add_row(
            topic["topic"],
            str(topic.get("type", "-")),
            str(topic["producer"] or "nobody"),
            str(topic.get("commits", "-")),
            f"{topic.get('rate_hz', 0.0):.1f}",
            ", ".join(topic["readers"]) or "-",
        )
    return table


def duration_text(seconds: float | None) -> str:
    """A time span as a short text."""
    if seconds is None:
        return "-"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(int(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02d}:{rest:02d}"
