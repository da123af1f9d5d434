"""The report: pytest-benchmark's JSON as Markdown and plots.

`python -m warploom.bench.report benchmark.json --out NAME.md` writes that, and NAME-ratios.svg and NAME-cost.svg
beside it; several JSON files, of one machine, become one report.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from ..errors import ConfigError
from .plots import draw_cost, draw_ratios
from .results import Pair, Result, merge_measured, read_figures, read_measured, read_pairs, read_results, stolen_share

__all__ = ["number", "render", "score_row", "share", "skipped_lines", "write_report"]


def write_report(measured: dict[str, Any], out: Path) -> list[Path]:
    """Writes the report as Markdown and its plots as SVG beside it.

    Args:
        measured: What pytest-benchmark wrote, with what `bench/conftest.py` adds to it.
        out: The Markdown file; its folder is made where there is none.

    Returns:
        The files that were written.

    Raises:
        KeyError: It is no such JSON.
    """
    pairs = list(read_pairs(read_results(measured)))
    drawn = {"ratios": draw_ratios(pairs), "cost": draw_cost(read_results(measured))}
    plots = {name: out.with_name(f"{out.stem}-{name}.svg") for name, drawing in drawn.items() if drawing}
    text = render(measured, {name: path.name for name, path in plots.items()})
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    for name, path in plots.items():
        path.write_text(drawn[name], encoding="utf-8")
    return [out, *plots.values()]


def render(measured: dict[str, Any], plots: dict[str, str] | None = None) -> str:
    """The whole report as Markdown.

    Args:
        measured: What pytest-benchmark wrote, with what `bench/conftest.py` adds to it.
        plots: Of `ratios` and `cost` those that there are, and where.

    Raises:
        KeyError: It is no such JSON.
    """
    plots = plots or {}
    results = read_results(measured)
    pairs = list(read_pairs(results))
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`; `warploom bench` does the same for an installed package. Figures move with the "
        "machine: compare those of one run.",
        "",
        *_machine(measured),
        *_goals(pairs, plots),
        *_scores(measured),
        *_figures(measured),
        *_cost(plots),
        *_stages(measured),
        *_kernels(results, pairs, measured),
        *_first_calls(measured),
        *_skipped(measured),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> Iterator[str]:
    """A Markdown table; a head that ends in a colon is of numbers."""
    head = list(head)
    yield "| " + " | ".join(name.rstrip(":") for name in head) + " |"
    yield "|" + "|".join("---:" if name.endswith(":") else "---" for name in head) + "|"
    for row in rows:
        yield "| " + " | ".join(text.replace("|", "\\|") for text in row) + " |"
    yield ""


def _machine(measured: dict[str, Any]) -> Iterator[str]:
    said = measured["warploom"]["machine"]
    memory = f", {said['memory_gib']} GiB" if said.get("memory_gib") else ""
    devices = ", ".join(device for device in said["devices"] if device != "cpu") or "none"
    yield f"- machine: {said['processor']}, {said['cores']} cores{memory}, {said['system']}; GPU: {devices}"
    stolen = stolen_share(measured)
    if stolen is not None and stolen >= 0.005:
        yield f"- stolen: of the processor time that was wanted here meanwhile, the host gave {stolen:.0%} to others"
    yield f"- date: {measured['datetime'][:10]}"
    commit = measured.get("commit_info") or {}
    if commit.get("id", "unversioned") != "unversioned":
        yield f"- commit: {commit['id'][:12]}{' and changes' if commit.get('dirty') else ''}"
    yield "- versions: Python " + ", ".join([said["python"], *(f"{n} {v}" for n, v in said["versions"].items())])
    yield ""


def _goals(pairs: list[Pair], plots: dict[str, str]) -> Iterator[str]:
    """The summary: each kernel that has a goal."""
    with_goal = [pair for pair in pairs if pair.goal is not None]
    if not with_goal:
        return
    reached = sum(bool(pair.is_reached) for pair in with_goal)
    yield from (
        "## Goals",
        "",
        f"The whole call, NumPy in and NumPy out, beside the named peer on the same input in the same run. Reached: "
        f"{reached} of {len(with_goal)}.",
        "",
    )
    yield from _table(
        ("kernel", "on", "size:", "ours [ms]:", "peer", "peer [ms]:", "ratio:", "goal:", "reached", "accuracy"),
        (
            (
                pair.ours.kernel,
                pair.ours.on,
                f"{pair.ours.size:,}",
                _milliseconds(pair.ours),
                pair.peer.who,
                _milliseconds(pair.peer) + (" †" if pair.peer.self_timed else ""),
                share(pair.ratio),
                f"≤ {share(pair.goal)}",
                _yes(bool(pair.is_reached)),
                pair.accuracy,
            )
            for pair in with_goal
            if pair.peer is not None and pair.ratio is not None and pair.goal is not None
        ),
    )
    if "ratios" in plots:
        yield from (f"![Our time over the goal's, by kernel and peer]({plots['ratios']})", "")


def _of_all(measured: dict[str, Any], key: str) -> Iterator[tuple[dict[str, Any], Any]]:
    for entry in measured["benchmarks"]:
        if key in entry["extra_info"]:
            yield entry["extra_info"], entry["extra_info"][key]


def _scores(measured: dict[str, Any]) -> Iterator[str]:
    scores = [score for _, some in _of_all(measured, "scores") for score in some]
    if not scores:
        return
    yield from ("## How right", "", "Ours and the peer on the same scans in the same run.", "")
    yield from _table(
        ("what", "on", "ours:", "peer", "theirs:", "difference:", "goal:", "reached", "how"),
        (score_row(score) for score in scores),
    )


def score_row(score: dict[str, Any]) -> tuple[str, ...]:
    """What, on what, ours, the peer, theirs, the difference, its goal, whether that is reached, and how."""
    digits = 2 if score["unit"] == "%" else 3

    def said(value: float) -> str:
        return f"{value:.{digits}f} {score['unit']}"

    theirs, gain = score["theirs"], score["gain"]
    if theirs is None:
        return (score["name"], score["on"], said(score["ours"]), "", "", "", "", "", score["note"])
    difference = score["ours"] - theirs
    better = -difference if score["lower_is_better"] else difference
    sign = "≤ −" if score["lower_is_better"] else "≥ "
    return (
        score["name"],
        score["on"],
        said(score["ours"]),
        score["peer"],
        said(theirs),
        f"{difference:+.{digits}f}",
        "" if gain is None else f"{sign}{gain:g}",
        "" if gain is None else _yes(better >= gain),
        score["note"],
    )


def _figures(measured: dict[str, Any]) -> Iterator[str]:
    figures = read_figures(measured)
    if not figures:
        return
    yield from ("## The frame and the start", "")
    yield from _table(
        ("what", "measured:", "goal:", "reached", "how"),
        (
            (
                figure["name"],
                f"{number(figure['value'])} {figure['unit']}",
                "" if figure["goal"] is None else f"≤ {figure['goal']:g} {figure['unit']}",
                "" if figure["goal"] is None else _yes(figure["value"] <= figure["goal"]),
                figure["note"],
            )
            for figure in figures
        ),
    )


def _cost(plots: dict[str, str]) -> Iterator[str]:
    if "cost" in plots:
        yield from (
            "## How cost grows",
            "",
            "The whole call on the simulated street: a twelfth of a sweep, a sweep, four, seventeen.",
            "",
            f"![Time against points, by kernel]({plots['cost']})",
            "",
        )


def _stages(measured: dict[str, Any]) -> Iterator[str]:
    for info, stages in _of_all(measured, "stages"):
        yield from (f"### Stages of a frame: {info['on']}", "")
        yield from _table(
            ("stage", "own work, median [ms]:", "wait for its turn, median [ms]:"),
            ((name, number(row["run_ms"]), number(row["wait_ms"])) for name, row in stages.items()),
        )


def _kernels(results: list[Result], pairs: list[Pair], measured: dict[str, Any]) -> Iterator[str]:
    if not results:
        return
    threads = measured["warploom"]["machine"].get("threads", 1)
    yield from (
        "## Kernels beside their peers",
        "",
        "Medians. *Function* is the whole call: NumPy in and NumPy out on the CPU, arrays of the device elsewhere; "
        "*plan* is the preallocated launch alone; *1 thread* is the function with one CPU thread, where else it may "
        f"use {threads} (`WARPLOOM_THREADS`). *Cores* is how many a call kept busy: the processor's time over the "
        "clock's. The ratio is our function's time, or the plan's where there is no function, over the peer's. A peer "
        "gets its input in the type it likes, converted before the clock starts; † marks a time of the peer's own "
        "timer, which leaves its bindings out.",
        "",
    )
    for kernel in dict.fromkeys(result.kernel for result in results):
        yield from (f"### {kernel}", "")
        for how in dict.fromkeys(result.how for result in results if result.kernel == kernel and result.how):
            yield from (f"{how[0].upper()}{how[1:]}.", "")
        own = [pair for pair in pairs if pair.ours.kernel == kernel]
        if any(pair.one_thread for pair in own):
            head = ("function [ms]:", "plan [ms]:", "1 thread [ms]:", "cores:")
        else:
            head = ("function [ms]:", "plan [ms]:", "cores:")
        head = ("on", "size:", "device", *head, "peer", "peer [ms]:", "cores:", "ratio:", "goal:", "reached",
                "accuracy")  # fmt: skip
        yield from _table(head, (_row_of(pair, "1 thread [ms]:" in head) for pair in own))


def _row_of(pair: Pair, with_one_thread: bool) -> tuple[str, ...]:
    ours, peer, goal = pair.ours, pair.peer, pair.goal
    one_thread = (_milliseconds(pair.one_thread),) if with_one_thread else ()
    first = (ours.on, f"{ours.size:,}", ours.device, _milliseconds(pair.function), _milliseconds(pair.plan))
    first = (*first, *one_thread, ours.cores if ours.device == "cpu" else "")
    if peer is None or pair.ratio is None:
        return (*first, "", "", "", "", "", "", pair.accuracy)
    return (
        *first,
        peer.who,
        _milliseconds(peer) + (" †" if peer.self_timed else ""),
        peer.cores,
        share(pair.ratio),
        "" if goal is None else f"≤ {share(goal)}",
        "" if goal is None else _yes(bool(pair.is_reached)),
        pair.accuracy,
    )


def _first_calls(measured: dict[str, Any]) -> Iterator[str]:
    tables = list(_of_all(measured, "first_calls"))
    if not tables:
        return
    yield from ("## First calls", "", "In a new process, in this order: the first bears the imports.", "")
    for info, calls in tables:
        yield from (f"### On {info['on']}", "")
        yield from _table(
            ("function", "empty kernel cache [s]:", "from the cache [s]:", "second call [ms]:"),
            (
                (name, number(row["cold_s"]), number(row["warm_s"]), number(1e3 * row["second_s"]))
                for name, row in calls.items()
            ),
        )


def skipped_lines(measured: dict[str, Any]) -> list[str]:
    """What was not measured, by reason."""
    reasons: dict[str, list[str]] = {}
    for name, reason in measured["warploom"]["skipped"].items():
        reasons.setdefault(reason, []).append(name)
    return [
        f"{reason}: {', '.join(f'`{name}`' for name in names[:3])}"
        f"{f' and {len(names) - 3} more' if len(names) > 3 else ''}"
        for reason, names in reasons.items()
    ]


def _skipped(measured: dict[str, Any]) -> Iterator[str]:
    if lines := skipped_lines(measured):
        yield from ("## Not measured", "", *(f"- {line}" for line in lines))


def _milliseconds(result: Result | None) -> str:
    return "" if result is None else number(result.seconds * 1e3)


def number(value: float) -> str:
    """Three digits that count, without powers of ten."""
    for limit, digits in ((0.095, 4), (0.995, 3), (9.95, 2), (99.5, 1)):
        if abs(value) < limit:
            return f"{value:.{digits}f}"
    return f"{value:,.0f}"


def share(ratio: float) -> str:
    """A ratio below one as a fraction: 1/4.2."""
    return f"1/{1 / ratio:.1f}".removesuffix(".0") if ratio < 1 else f"{ratio:.2f}"


def _yes(reached: bool) -> str:
    return "yes" if reached else "**no**"


def main() -> None:
    """Reads the JSON and writes the report."""
    parser = argparse.ArgumentParser(prog="python -m warploom.bench.report")
    parser.add_argument("json", type=Path, nargs="+", help="what pytest-benchmark wrote")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks.md"), help="the Markdown file")
    given = parser.parse_args()
    try:
        written = write_report(merge_measured([read_measured(path) for path in given.json]), given.out)
    except ConfigError as error:
        sys.exit(str(error))
    except KeyError as error:
        sys.exit(
            f"{', '.join(map(str, given.json))}: has no key {error}; it must come from `pytest bench --benchmark-json`"
        )
    sys.stdout.write(f"{', '.join(str(path) for path in written)} written\n")


if __name__ == "__main__":
    main()
