"""Runs the benchmarks of the installed package, as `warploom bench` does."""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from ..errors import ConfigError, SinkError, WarploomError
from ..kernels.device import resolve_device
from .compare import SLOWER, compare_figures, compare_pairs, compare_times
from .report import number, score_row, share, skipped_lines, write_report
from .results import Pair, read_figures, read_measured, read_pairs, read_results

__all__ = ["BenchmarkError", "run_benchmarks"]

_FOLDER = Path(__file__).resolve().parent
_SETTINGS = """[pytest]
python_files = bench_*.py
python_functions = bench_*
markers =
    slow: takes more than half a minute
    cuda: needs a CUDA device
    real: needs real scans
"""
_LARGE = ("500k", "2M")
_DEVICES = ("cpu", "cuda:0")


class BenchmarkError(WarploomError):
    """A benchmark that could not be run to its end."""


def run_benchmarks(
    *, filters: Sequence[str] = (), device: str = "cpu", compare: Path | None = None, out: Path, quick: bool = False
) -> dict[str, Any]:
    """Times ours beside the peers that are installed, prints tables, and writes JSON, report and plots into a folder.

    Args:
        filters: Texts of which a benchmark's name is to have one; words of a text, apart by spaces, must all be in it,
            or be the topic of its file, such as `heads`.
            None takes all benchmarks.
        device: Where ours computes; the peers compute on the CPU.
        compare: The JSON of an earlier run, to stand beside this one.
        out: The folder for benchmark.json, benchmarks.md and its plots; made where there is none.
        quick: A few rounds of each, no large clouds, no long runs: for a first look.

    Returns:
        What was measured, as in benchmark.json.

    Raises:
        ConfigError: pytest-benchmark is not installed, no benchmark has such a name, or the earlier run cannot be read.
        DeviceError: There is no such device.
        SinkError: The folder cannot be made.
        BenchmarkError: Some benchmarks failed; the others are in the folder.
    """
    for module, package in (("pytest", "pytest"), ("pytest_benchmark", "pytest-benchmark")):
        if importlib.util.find_spec(module) is None:
            raise ConfigError(
                f"`warploom bench` needs {package}, which is not installed: pip install 'warploom[bench]'"
            )
    device = resolve_device(device)
    if device not in _DEVICES:
        raise ConfigError(
            f"--device {device}: the benchmarks compute on {' or '.join(_DEVICES)}; choose another GPU by "
            "CUDA_VISIBLE_DEVICES"
        )
    old = read_measured(compare) if compare is not None else None
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SinkError(f"{out}: the folder cannot be made: {error.strerror or error}") from error
    written = out / "benchmark.json"
    written.unlink(missing_ok=True)
    console = Console()
    failures = _measure(written, filters, device, quick)
    measured = read_measured(written)
    # The processor's flags and the host's name say nothing that the report needs.
    measured.pop("machine_info", None)
    written.write_text(json.dumps(measured, indent=1), encoding="utf-8")
    files = write_report(measured, out / "benchmarks.md")
    _print_pairs(console, list(read_pairs(read_results(measured))))
    _print_others(console, measured)
    if old is not None:
        _print_changes(console, old, measured)
    for line in skipped_lines(measured):
        console.print(f"not measured: {line}", style="dim", highlight=False, markup=False)
    console.print(f"written: {', '.join(str(path) for path in (written, *files))}", highlight=False)
    if failures:
        raise BenchmarkError("; ".join(failures))
    return measured


def _topic(item: Any) -> str:
    """What the file of a benchmark is about: `heads` of `bench_heads.py`."""
    return item.path.stem.removeprefix("bench_")


class _Selection:
    """A plugin of pytest: chooses the benchmarks, shows how far they are, and keeps what went wrong."""

    def __init__(self, filters: Sequence[str], device: str, quick: bool, progress: Progress) -> None:
        self._words = [text.lower().split() for text in filters]
        self._device = device
        self._quick = quick
        self._progress = progress
        self._task = progress.add_task("benchmarks", total=None)
        self.names: list[str] = []
        self.topics: list[str] = []
        self.selected = 0
        self.failures: list[str] = []
        self.skipped: dict[str, None] = {}

    def pytest_collection_modifyitems(self, config: Any, items: list[Any]) -> None:
        self.names = sorted({item.originalname.removeprefix("bench_") for item in items})
        self.topics = sorted({_topic(item) for item in items})
        keep = [item for item in items if self._wants(item)]
        config.hook.pytest_deselected(items=[item for item in items if item not in keep])
        items[:] = keep
        self.selected = len(items)
        self._progress.update(self._task, total=len(items))

    def _wants(self, item: Any) -> bool:
        name, topic = item.name.lower(), _topic(item)
        if self._words and not any(all(word in name or word == topic for word in words) for words in self._words):
            return False
        parameters = item.callspec.params if hasattr(item, "callspec") else {}
        contender = parameters.get("contender")
        if contender is not None and contender.is_ours and contender.device != self._device:
            return False
        if parameters.get("device", self._device) != self._device:
            return False
        large = any(isinstance(value, str) and value.endswith(_LARGE) for value in parameters.values())
        return not (self._quick and (large or item.get_closest_marker("slow") is not None))

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        name = nodeid.rpartition("::")[2].removeprefix("bench_")
        self._progress.update(self._task, description=name, refresh=True)

    def pytest_runtest_logreport(self, report: Any) -> None:
        if report.failed:
            lines = str(report.longrepr).strip().splitlines()
            name = report.nodeid.rpartition("::")[2]
            self.failures.append(f"{name} failed: {lines[-1].strip() if lines else 'for no reason that it gave'}")
        if report.skipped and isinstance(report.longrepr, tuple):
            self.skipped[report.longrepr[2].removeprefix("Skipped: ")] = None
        if report.when == "teardown":
            self._progress.advance(self._task)

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            lines = str(report.longrepr).strip().splitlines()
            reason = lines[-1].removeprefix("E").strip() if lines else "for no reason that it gave"
            self.failures.append(f"{report.nodeid} cannot be read: {reason}")


def _measure(written: Path, filters: Sequence[str], device: str, quick: bool) -> list[str]:
    """Runs pytest in this process; what went wrong."""
    import pytest

    seconds, rounds = ("0.1", "3") if quick else ("0.4", "5")
    said = io.StringIO()
    with tempfile.TemporaryDirectory() as folder, _progress() as progress:
        settings = Path(folder) / "pytest.ini"  # else pytest would take the settings of whoever called
        settings.write_text(_SETTINGS)
        selection = _Selection(filters, device, quick, progress)
        # Of the plugins that are installed only the one that is needed: others cost time, or want options.
        plugins = ("--disable-plugin-autoload", "-p", "pytest_benchmark.plugin", "-p", "no:cacheprovider")
        options = (*plugins, "-c", settings, "--rootdir", _FOLDER, "--import-mode=importlib", "-q")
        benchmark = ("only", f"max-time={seconds}", f"min-rounds={rounds}", f"json={written}", "warmup=off")
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            code = pytest.main(
                [str(_FOLDER), *map(str, options), *(f"--benchmark-{option}" for option in benchmark)],
                plugins=[selection],
            )
    if not selection.names and not selection.failures:
        raise BenchmarkError(f"pytest ended with {code!r}: {said.getvalue()[-2000:]}")
    if selection.selected == 0 and not selection.failures:
        raise ConfigError(
            f"no benchmark's name has {' or '.join(map(repr, filters))}; there are {', '.join(selection.names)}; "
            f"a topic takes all of its own: {', '.join(selection.topics)}"
        )
    if code == pytest.ExitCode.INTERRUPTED and not selection.failures:
        raise KeyboardInterrupt
    if not written.exists() and (selection.failures or selection.skipped):
        raise BenchmarkError("nothing was measured: " + "; ".join((*selection.failures, *selection.skipped)))
    if not written.exists() or code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
        raise BenchmarkError(f"pytest ended with {code!r}: {said.getvalue()[-2000:]}")
    return selection.failures


@contextlib.contextmanager
def _progress() -> Iterator[Progress]:
    """A bar that is drawn between the benchmarks, so as not to be timed, past what pytest captures."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    shown = sys.stderr.isatty()
    with os.fdopen(os.dup(2), "w", encoding="utf-8") as beside:
        console = Console(file=beside, force_terminal=shown)
        with Progress(*columns, console=console, auto_refresh=False, disable=not shown) as progress:
            yield progress


# ---- tables


def _table(title: str, *columns: str) -> Table:
    """A table whose columns that end in a colon are of numbers."""
    table = Table(title=title, title_justify="left")
    for column in columns:
        table.add_column(column.rstrip(":"), justify="right" if column.endswith(":") else "left", overflow="fold")
    return table


def _print_pairs(console: Console, pairs: list[Pair]) -> None:
    if not pairs:
        return
    table = _table(
        "ours beside the peers", "kernel", "on", "ours [ms]:", "peer", "peer [ms]:", "ratio:", "goal:", "accuracy"
    )
    for pair in pairs:
        where = "" if pair.ours.device == "cpu" else f", {pair.ours.device}"
        ours = number(1e3 * pair.ours.seconds)
        if pair.peer is None or pair.ratio is None:
            table.add_row(pair.ours.kernel, pair.ours.on + where, ours, "", "", "", "", pair.accuracy)
            continue
        goal = "" if pair.goal is None else f"{'[green]' if pair.is_reached else '[red]not '}≤ {share(pair.goal)}"
        peer = pair.peer
        row = (pair.ours.kernel, pair.ours.on + where, ours, peer.who, number(1e3 * peer.seconds), share(pair.ratio))
        table.add_row(*row, goal, pair.accuracy)
    console.print(table)


def _print_others(console: Console, measured: dict[str, Any]) -> None:
    scores = [score for entry in measured["benchmarks"] for score in entry["extra_info"].get("scores", ())]
    if scores:
        table = _table("how right", "what", "on", "ours:", "peer", "theirs:", "difference:", "goal:", "reached", "how")
        for score in scores:
            table.add_row(*(cell.replace("**", "") for cell in score_row(score)))
        console.print(table)
    figures = read_figures(measured)
    if figures:
        table = _table("figures", "what", "measured:", "goal:", "how")
        for figure in figures:
            goal = "" if figure["goal"] is None else f"≤ {figure['goal']:g}"
            table.add_row(figure["name"], f"{number(figure['value'])} {figure['unit']}", goal, figure["note"])
        console.print(table)


def _print_changes(console: Console, old: dict[str, Any], new: dict[str, Any]) -> None:
    changes, beside, figures = compare_times(old, new), compare_pairs(old, new), compare_figures(old, new)
    if not changes and not figures:
        console.print("the earlier run has none of these benchmarks", style="yellow")
        return
    heads = ("old:", "new:", "new / old:", "machine:", "ours:", "")
    if changes:
        table = _table("since the earlier run [ms]", "kernel", "on", "who", *heads)
        for change in changes:
            result = change.result
            who = result.who if result.device == "cpu" else f"{result.who}, {result.device}"
            numbers = (number(1e3 * change.old_seconds), number(1e3 * result.seconds), f"{change.ratio:.2f}")
            mark = "[red]slower" if change.is_slower else ""
            table.add_row(result.kernel, result.on, who, *numbers, f"{change.machine:.2f}", f"{change.own:.2f}", mark)
        console.print(table)
    if beside:
        table = _table("ratios to the peers", "kernel", "on", "peer", "old:", "new:")
        for change in beside:
            ours, peer = change.pair.ours, change.pair.peer
            who = peer.who if peer is not None else ""
            table.add_row(ours.kernel, ours.on, who, share(change.old_ratio), share(change.ratio))
        console.print(table)
    if figures:
        table = _table("figures since the earlier run", "what", *heads)
        for change in figures:
            numbers = (f"{number(change.old)} {change.unit}", f"{number(change.new)} {change.unit}")
            ratio = f"{change.new / change.old:.2f}" if change.old > 0 else ""
            mark = "[red]slower" if change.is_slower else ""
            table.add_row(change.name, *numbers, ratio, f"{change.machine:.2f}", f"{change.own:.2f}", mark)
        console.print(table)
    both = (*changes, *figures)
    slower = sum(change.is_slower for change in both)
    console.print(
        f"{slower} of {len(both)} slower by more than {SLOWER - 1:.0%}, the machine's share (by the peers) left out",
        style="red" if slower else "green",
        highlight=False,
    )
