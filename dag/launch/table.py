"""How a node's state is shown: a live table on a terminal, lines of JSON otherwise."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, TextIO

if TYPE_CHECKING:
    from rich.console import Console, Group
    from rich.table import Table

__all__ = ["JsonLines", "LiveTable", "component_table", "process_table", "topic_table", "usage_view"]

_log = logging.getLogger(__name__)

_SHOWN_EVENTS = 8
_EVENTS_WAITING = 10_000
_PATIENCE_S = 2.0
"""How long a reader may take at the end."""
_QUIET = ("state",)
_COLUMNS = ("process", "state", "pid", "up", "restarts", "cpu %", "memory", "fds")
_LEFT_OUT_FIRST = ("fds", "memory", "up", "restarts", "pid")
_SAYS_WIDTH = 24
"""Characters that the last column of the processes is to have."""


class _Aside:
    """Does what may block in a thread of its own, in order: who stops reading must not stop who supervises."""

    def __init__(self, do: Callable[[Any], None]) -> None:
        self.lost = 0
        """What there was no room for."""
        self._do = do
        self._waiting: deque[Any] = deque()
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="shown", daemon=True)
        self._thread.start()

    def __call__(self, what: Any, most: int) -> None:
        """Hands something over, unless so many wait already: then the oldest of them is lost."""
        with self._changed:
            while len(self._waiting) >= most:
                self._waiting.popleft()
                self.lost += 1
            self._waiting.append(what)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    return
                what = self._waiting.popleft()
            try:
                self._do(what)
            except Exception:
                _log.exception("what happens cannot be shown")

    def close(self) -> None:
        """Waits until all is done, but not for long."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(_PATIENCE_S)


class JsonLines:
    """Writes every event as a line of JSON."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Names the stream; by default stdout, which is written to past its buffer, for that is flushed at exit."""
        self._stream = stream
        self._told_lost = 0
        self._aside = _Aside(self._write)

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Writes one, soon; where the reader is far behind, the oldest are lost, and that is told."""
        self._aside(json.dumps(event, default=str) + "\n", _EVENTS_WAITING)

    def _write(self, line: str) -> None:
        if (lost := self._aside.lost) > self._told_lost:
            line = json.dumps({"event": "lost", "events": lost - self._told_lost}) + "\n" + line
            self._told_lost = lost
        with contextlib.suppress(OSError, ValueError):  # a reader that has gone away is no reason to stop
            if self._stream is not None:
                self._stream.write(line)
                self._stream.flush()
                return
            data = line.encode()
            while data:
                data = data[os.write(1, data) :]

    def close(self) -> None:
        """Lets what waits be written, if it is read."""
        self._aside.close()


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
        if console is None:
            # Not through stdout, which is flushed at exit, and would wait for a terminal that is held (Ctrl-S).
            terminal = open(os.dup(1), "w", encoding="utf-8")  # noqa: SIM115 (it is open to the end)
            console = Console(file=terminal, markup=False, emoji=False)
        self._live = Live(console=console, auto_refresh=False, transient=False)
        self._aside: _Aside | None = None

    def show(self, status: Callable[[], Mapping[str, Any]]) -> None:
        """Begins to show a node, whose status the function gives as `ps` is answered."""
        self._status = status
        self._live.start()
        self._aside = _Aside(self._draw)

    def _draw(self, picture: Group | None) -> None:
        with contextlib.suppress(OSError):  # the terminal has gone
            if picture is None:
                self._live.stop()
            else:
                self._live.update(picture, refresh=True)

    def close(self) -> None:
        """Leaves the last picture on the terminal."""
        if self._aside is not None:
            self._aside(None, 2)
            self._aside.close()

    def __call__(self, event: Mapping[str, Any]) -> None:
        """Takes up an event."""
        if event["event"] not in _QUIET:
            self._events = [*self._events, event][-_SHOWN_EVENTS:]
        self.refresh()

    def refresh(self) -> None:
        """Draws once, soon; where drawing is slow, the newest picture alone."""
        if self._status is None or self._aside is None:
            return
        from rich.console import Group
        from rich.text import Text

        lines = [Text(event_text(event), style=_style(event)) for event in self._events]
        table = process_table(self._status(), width=self._live.console.width)
        self._aside(Group(table, *lines), 1)


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
