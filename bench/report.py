"""The report: pytest-benchmark's JSON as Markdown, by `python -m warploom.bench.report benchmark.json --out FILE`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

__all__ = ["Result", "read_results", "render"]

_OURS, _PLAN = "warploom", "warploom plan"


@dataclass(frozen=True, kw_only=True)
class Result:
    """The time of one contender."""

    kernel: str
    """Which kernel."""
    on: str
    """What it was given."""
    size: int
    """How many points, boxes or rays."""
    who: str
    """`warploom`, `warploom plan`, or a peer."""
    device: str
    """Where it computed."""
    threads: int
    """How many threads it used."""
    seconds: float
    """Median of its time; of its own timer where it has one."""
    self_timed: bool
    """Whether the time is of its own timer."""
    accuracy: str
    """How right its result was, in words."""
    goal: float | None
    """Share of this peer's time that ours is to take; None where there is no goal."""


def read_results(measured: dict[str, Any]) -> list[Result]:
    """The contenders' times in the order in which they were taken."""
    results = []
    for entry in measured["benchmarks"]:
        info = entry["extra_info"]
        if "who" not in info:
            continue
        own = info.get("own_timer_s")
        results.append(
            Result(
                kernel=info["kernel"],
                on=info["on"],
                size=info["size"],
                who=info["who"],
                device=info["device"],
                threads=info["threads"],
                seconds=entry["stats"]["median"] if own is None else own,
                self_timed=own is not None,
                accuracy=info["accuracy"],
                goal=info.get("goal"),
            )
        )
    return results


def render(measured: dict[str, Any]) -> str:
    """The whole report as Markdown.

    Args:
        measured: What pytest-benchmark wrote, with what `bench/conftest.py` adds to it.

    Raises:
        KeyError: It is no such JSON.
    """
    lines = [
        "# Benchmarks",
        "",
        "Written by `make bench`: `python -m pytest bench --benchmark-only --benchmark-json=benchmark.json`, then "
        "`python -m warploom.bench.report benchmark.json --out docs/benchmarks.md`. Figures move with the machine: "
        "compare those of one run.",
        "",
        *_machine(measured),
        *_figures(measured),
        *_stages(measured),
        *_kernels(read_results(measured)),
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
    yield f"- date: {measured['datetime'][:10]}"
    commit = measured.get("commit_info") or {}
    if commit.get("id"):
        yield f"- commit: {commit['id'][:12]}{' and changes' if commit.get('dirty') else ''}"
    yield "- versions: Python " + ", ".join([said["python"], *(f"{n} {v}" for n, v in said["versions"].items())])
    yield ""


def _of_all(measured: dict[str, Any], key: str) -> Iterator[tuple[dict[str, Any], Any]]:
    for entry in measured["benchmarks"]:
        if key in entry["extra_info"]:
            yield entry["extra_info"], entry["extra_info"][key]


def _figures(measured: dict[str, Any]) -> Iterator[str]:
    figures = [figure for _, some in _of_all(measured, "figures") for figure in some]
    if not figures:
        return
    yield from ("## The main job", "")
    yield from _table(
        ("what", "measured:", "goal:", "reached", "how"),
        (
            (
                figure["name"],
                f"{_number(figure['value'])} {figure['unit']}",
                "" if figure["goal"] is None else f"≤ {figure['goal']:g} {figure['unit']}",
                "" if figure["goal"] is None else _yes(figure["value"] <= figure["goal"]),
                figure["note"],
            )
            for figure in figures
        ),
    )


def _stages(measured: dict[str, Any]) -> Iterator[str]:
    for info, stages in _of_all(measured, "stages"):
        yield from (f"### Stages of a frame: {info['on']}", "")
        yield from _table(
            ("stage", "own work, median [ms]:", "wait for its turn, median [ms]:"),
            ((name, _number(row["run_ms"]), _number(row["wait_ms"])) for name, row in stages.items()),
        )


def _kernels(results: list[Result]) -> Iterator[str]:
    if not results:
        return
    yield from (
        "## Kernels beside their peers",
        "",
        "Medians. *Function* is the whole call: NumPy in and NumPy out on the CPU, arrays of the device elsewhere; "
        "*plan* is the preallocated launch alone. Ours uses one CPU thread. The ratio is our function's time, or the "
        "plan's where there is no function, over the peer's. A peer gets its input in the type it likes, converted "
        "before the clock starts; † marks a time of the peer's own timer, which leaves its bindings out.",
        "",
    )
    kernels = dict.fromkeys(result.kernel for result in results)
    for kernel in kernels:
        own = [result for result in results if result.kernel == kernel]
        yield from (f"### {kernel}", "")
        head = ("on", "size:", "device", "function [ms]:", "plan [ms]:", "peer", "threads:", "peer [ms]:", "ratio:",
                "goal:", "reached", "accuracy")  # fmt: skip
        yield from _table(head, _rows_of(own))


def _rows_of(results: list[Result]) -> Iterator[tuple[str, ...]]:
    """A row for each peer, and one for each device that has none beside it."""
    for on, size in dict.fromkeys((result.on, result.size) for result in results):
        here = [result for result in results if (result.on, result.size) == (on, size)]
        ours = {result.device: result for result in here if result.who == _OURS}
        plans = {result.device: result for result in here if result.who == _PLAN}
        peers = [result for result in here if result.who not in (_OURS, _PLAN)]
        for device in dict.fromkeys((*ours, *plans)):
            function, plan = ours.get(device), plans.get(device)
            own = function or plan
            first = (on, f"{size:,}", device, _milliseconds(function), _milliseconds(plan))
            own_accuracy = function.accuracy if function else ""
            if not peers:
                yield (*first, "", "", "", "", "", "", own_accuracy)
            for peer in peers:
                ratio = own.seconds / peer.seconds
                goal = peer.goal if device == "cpu" else None
                accuracy = "; theirs: ".join(text for text in (own_accuracy, peer.accuracy) if text)
                yield (
                    *first,
                    peer.who,
                    str(peer.threads),
                    _milliseconds(peer) + (" †" if peer.self_timed else ""),
                    _share(ratio),
                    "" if goal is None else f"≤ {_share(goal)}",
                    "" if goal is None else _yes(ratio <= goal),
                    accuracy,
                )


def _first_calls(measured: dict[str, Any]) -> Iterator[str]:
    for _, calls in _of_all(measured, "first_calls"):
        yield from ("## First calls", "", "In a new process, in this order: the first bears the imports.", "")
        yield from _table(
            ("function", "empty kernel cache [s]:", "from the cache [s]:", "second call [ms]:"),
            (
                (name, _number(row["cold_s"]), _number(row["warm_s"]), _number(1e3 * row["second_s"]))
                for name, row in calls.items()
            ),
        )


def _skipped(measured: dict[str, Any]) -> Iterator[str]:
    skipped = measured["warploom"]["skipped"]
    if skipped:
        reasons: dict[str, list[str]] = {}
        for name, reason in skipped.items():
            reasons.setdefault(reason, []).append(name)
        yield from ("## Not measured", "")
        for reason, names in reasons.items():
            some = ", ".join(f"`{name}`" for name in names[:3])
            yield f"- {reason}: {some}{f' and {len(names) - 3} more' if len(names) > 3 else ''}"


def _milliseconds(result: Result | None) -> str:
    return "" if result is None else _number(result.seconds * 1e3)


def _number(value: float) -> str:
    """Three digits that count, without powers of ten."""
    for limit, digits in ((0.095, 4), (0.995, 3), (9.95, 2), (99.5, 1)):
        if abs(value) < limit:
            return f"{value:.{digits}f}"
    return f"{value:,.0f}"


def _share(ratio: float) -> str:
    return f"1/{1 / ratio:.1f}".removesuffix(".0") if ratio < 1 else f"{ratio:.2f}"


def _yes(reached: bool) -> str:
    return "yes" if reached else "**no**"


def main() -> None:
    """Reads the JSON and writes the report."""
    parser = argparse.ArgumentParser(prog="python -m warploom.bench.report")
    parser.add_argument("json", type=Path, help="what pytest-benchmark wrote")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks.md"), help="the Markdown file")
    given = parser.parse_args()
    try:
        text = render(json.loads(given.json.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        sys.exit(f"{given.json}: cannot be read: {error}")
    except KeyError as error:
        sys.exit(f"{given.json}: has no key {error}; it must come from `pytest bench --benchmark-json`")
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(text, encoding="utf-8")
    sys.stdout.write(f"{given.out} written\n")


if __name__ == "__main__":
    main()
