"""How the state of a node is shown."""

import io
import json
import threading

import pytest
from rich.console import Console

from warploom.dag.launch.table import (
    JsonLines,
    LiveTable,
    component_table,
    duration_text,
    event_text,
    process_table,
    topic_table,
    usage_view,
)

STATUS = {
    "node": "two",
    "processes": [
        {
            "name": "compute",
            "state": "running",
            "pid": 41,
            "uptime_s": 3725.0,
            "restarts": 2,
            "rss": 3 * 2**20,
            "fds": 9,
            "warnings": ["nice -5: not permitted"],
            "last_death": "was ended by SIGKILL",
            "components": [
                {"name": "gnss", "kind": "generic X", "idle_because": "no receiver", "state": {}, "losses": {}},
                {
                    "name": "radar",
                    "kind": "generic Y",
                    "idle_because": None,
                    "starting_because": "it warms up",
                    "state": {},
                    "losses": {},
                },
                {
                    "name": "lidar",
                    "kind": "Dag",
                    "idle_because": None,
                    "state": {"hz": 10},
                    "losses": {"backlog": 4},
                },
            ],
        },
        {
            "name": "gone",
            "state": "back off",
            "pid": None,
            "uptime_s": None,
            "restarts": 0,
            "warnings": [],
            "last_death": "",
            "components": [],
        },
    ],
}


def text(table):
    out = io.StringIO()
    Console(file=out, width=200).print(table)
    return out.getvalue()


def test_processes_are_shown_with_what_they_say():
    shown = text(process_table(STATUS, {41: 12.34}))
    for expected in ("compute", "running", "41", "1:02:05", "12.3", "3 MiB", "3 components, 1 of them idle", "nice -5"):
        assert expected in shown
    assert "last death: was ended by SIGKILL" in shown
    assert "1 of them not ready to serve yet" in shown
    assert "back off" in shown


@pytest.mark.parametrize("width", [56, 80, 200])
def test_a_narrow_terminal_shows_fewer_columns_and_none_of_them_cut(width):
    out = io.StringIO()
    Console(file=out, width=width).print(usage_view({**STATUS, "supervisor": {"pid": 7}}, {41: 12.34}, width))
    shown = out.getvalue()
    assert max(map(len, shown.splitlines())) <= width
    assert "…" not in shown
    for expected in ("compute", "running", "12.3", "3 components", "supervisor: process 7, 0.0 %"):
        assert expected in shown
    assert ("3 MiB" in shown) == (width == 200)


def test_components_say_why_they_are_idle_or_what_they_do():
    shown = text(component_table(STATUS))
    assert "idle: no receiver" in shown
    assert "starting: it warms up" in shown
    assert "hz 10, lost 4 (backlog)" in shown


def test_topics_are_shown():
    topics = [
        {"topic": "a", "producer": "p/c", "readers": ["q/d"], "type": "int", "commits": 7, "rate_hz": 9.96},
        {"topic": "b", "producer": None, "readers": []},
    ]
    shown = text(topic_table({"topics": topics}))
    assert "10.0" in shown
    assert "nobody" in shown


@pytest.mark.parametrize(("seconds", "expected"), [(None, "-"), (3.21, "3.2 s"), (60, "0:01:00"), (90061, "25:01:01")])
def test_durations(seconds, expected):
    assert duration_text(seconds) == expected


def test_an_event_is_a_line_to_read_or_of_json():
    event = {"event": "died", "process": "p", "time": 0, "node": "n", "reason": "was ended", "last_lines": ["oops"]}
    assert "p died: reason was ended\n           | oops" in event_text(event)
    out = io.StringIO()
    lines = JsonLines(out)
    lines(event)
    lines.close()
    assert json.loads(out.getvalue()) == event


def test_the_live_table_shows_processes_and_the_last_events():
    out = io.StringIO()
    table = LiveTable(Console(file=out, width=200, force_terminal=True))
    table({"event": "launching", "time": 0})  # before there is anything to show
    assert out.getvalue() == ""
    table.show(lambda: STATUS)
    for number in range(20):
        table({"event": "warning", "process": "compute", "time": 0, "message": f"warning {number}"})
    table({"event": "died", "process": "compute", "time": 0, "reason": "was ended by SIGKILL", "last_lines": ["oops"]})
    table.refresh()
    table.close()
    last = out.getvalue().rsplit("node two", 1)[1]
    assert "compute" in last
    assert "warning 19" in last
    assert "warning 12" not in last
    assert "| oops" in last


def test_brackets_are_shown_as_they_are(capfd):
    """They are no markup: `[/dev/video0]` would be an error, and `[m]` would vanish."""
    table = LiveTable()
    death = "RuntimeError: camera [/dev/video0] does not answer within 3 [m] :warning:"
    table.show(lambda: {**STATUS, "processes": [{**STATUS["processes"][0], "last_death": death}]})
    table.refresh()
    table.close()
    shown = "".join(capfd.readouterr().out.split())
    assert "[/dev/video0]" in shown
    assert "[m]:warning:" in shown


def test_a_node_of_which_no_process_is_known_yet_is_shown():
    out = io.StringIO()
    table = LiveTable(Console(file=out, width=80))
    table.show(lambda: {**STATUS, "processes": []})
    table({"event": "reaped", "time": 0, "removed": ["x.socket"]})
    table.close()
    assert "x.socket" in out.getvalue()


def test_a_reader_that_is_gone_does_not_break_the_supervisor():
    out = io.StringIO()
    lines = JsonLines(out)
    out.close()
    lines({"event": "up"})
    lines.close()


class Stalls(io.StringIO):
    """Takes nothing until it is let go on, as a terminal after Ctrl-S."""

    def __init__(self):
        super().__init__()
        self.begun, self.go_on = threading.Event(), threading.Event()

    def write(self, text):
        self.begun.set()
        assert self.go_on.wait(60)
        return super().write(text)


def test_a_reader_that_stalls_does_not_hold_up_the_supervisor_and_is_told_what_it_lost(monkeypatch):
    monkeypatch.setattr("warploom.dag.launch.table._EVENTS_WAITING", 5)
    out = Stalls()
    lines = JsonLines(out)
    lines({"event": "number", "number": 0})
    assert out.begun.wait(60)
    for number in range(1, 11):
        lines({"event": "number", "number": number})
    out.go_on.set()
    lines.close()
    told = [json.loads(line) for line in out.getvalue().splitlines()]
    assert [one["number"] for one in told if one["event"] == "number"] == [0, 6, 7, 8, 9, 10]
    assert told[1] == {"event": "lost", "events": 5}


def test_a_terminal_that_is_held_does_not_hold_up_the_supervisor(monkeypatch):
    monkeypatch.setattr("warploom.dag.launch.table._PATIENCE_S", 0.05)
    out = Stalls()
    out.go_on.set()
    table = LiveTable(Console(file=out, width=80, force_terminal=True))
    table.show(lambda: STATUS)
    out.go_on.clear()
    for number in range(100):
        table({"event": "warning", "time": 0, "message": f"warning {number}"})
    table.close()
    out.go_on.set()
