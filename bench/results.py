"""What a run of the benchmarks has measured: results by contender, and ours paired with each peer."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import ConfigError

__all__ = [
    "Pair",
    "Result",
    "merge_measured",
    "read_figures",
    "read_measured",
    "read_pairs",
    "read_results",
    "stolen_share",
]

_OURS, _PLAN, _ONE_THREAD = "warploom", "warploom plan", "warploom, 1 thread"


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
    """`warploom`, `warploom plan`, `warploom, 1 thread`, or a peer."""
    device: str
    """Where it computed."""
    threads: int
    """How many CPU threads it might use."""
    busy_cores: float | None
    """How many cores it kept busy, by the processor's time; None where that was not measured."""
    seconds: float
    """Median of its time; of its own timer where it has one."""
    self_timed: bool
    """Whether the time is of its own timer."""
    accuracy: str
    """How right its result was, in words."""
    goal: float | None
    """Share of this peer's time that ours is to take; None where there is no goal."""
    how: str
    """What the kernel was asked for."""

    @property
    def is_ours(self) -> bool:
        """Whether it is no peer."""
        return self.who in (_OURS, _PLAN, _ONE_THREAD)

    @property
    def cores(self) -> str:
        """How many cores it took, for people."""
        return str(self.threads) if self.busy_cores is None else f"{self.busy_cores:.1f}"


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Ours on a device beside one peer, or alone."""

    function: Result | None
    """The whole call."""
    plan: Result | None
    """The preallocated launch."""
    one_thread: Result | None
    """The whole call with one CPU thread."""
    peer: Result | None
    """Whom it stands beside."""

    @property
    def ours(self) -> Result:
        """The function, or the plan where there is no function."""
        return self.function or self.plan  # pyright: ignore[reportReturnType]

    @property
    def ratio(self) -> float | None:
        """Our time over the peer's."""
        return None if self.peer is None else self.ours.seconds / self.peer.seconds

    @property
    def goal(self) -> float | None:
        """What the ratio is to be at most: goals are those of one CPU beside itself."""
        return self.peer.goal if self.peer is not None and self.ours.device == "cpu" else None

    @property
    def is_reached(self) -> bool | None:
        """Whether the goal is reached; None where there is none."""
        return None if self.ratio is None or self.goal is None else self.ratio <= self.goal

    @property
    def accuracy(self) -> str:
        """How right both were."""
        texts = (self.function.accuracy if self.function else "", self.peer.accuracy if self.peer else "")
        return "; theirs: ".join(text for text in texts if text)


def read_measured(path: Path) -> dict[str, Any]:
    """Reads the JSON of a run.

    Raises:
        ConfigError: It cannot be read, or is none that `pytest bench` or `warploom bench` wrote.
    """
    try:
        measured = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    if not isinstance(measured, dict) or not {"benchmarks", "warploom"} <= measured.keys():
        raise ConfigError(
            f"{path}: has no keys 'benchmarks' and 'warploom'; it must come from `warploom bench` or "
            "`pytest bench --benchmark-json`"
        )
    return measured


def merge_measured(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Several runs on one machine as one: what each measured and skipped, one after the other.

    Args:
        runs: As `read_measured` gives them, at least one; machine, date and commit are those of the first.
    """
    skipped = {name: reason for run in runs for name, reason in run["warploom"].get("skipped", {}).items()}
    spent: Counter[str] = Counter()
    for run in runs:
        spent.update(run["warploom"].get("processor_time", {}))
    return {
        **runs[0],
        "benchmarks": [entry for run in runs for entry in run["benchmarks"]],
        "warploom": {**runs[0]["warploom"], "skipped": skipped, "processor_time": dict(spent)},
    }


def stolen_share(measured: dict[str, Any]) -> float | None:
    """Which part of the time for which a virtual machine's processors had work they were not given; None: not known."""
    spent = measured["warploom"].get("processor_time", {})
    return spent["stolen_s"] / spent["wanted_s"] if spent.get("wanted_s") else None


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
                busy_cores=info.get("busy_cores"),
                seconds=entry["stats"]["median"] if own is None else own,
                self_timed=own is not None,
                accuracy=info["accuracy"],
                goal=info.get("goal"),
                how=info.get("how", ""),
            )
        )
    return results


def read_figures(measured: dict[str, Any]) -> list[dict[str, Any]]:
    """What `contest.record_figure` took down, those first that have a goal."""
    figures = [figure for entry in measured["benchmarks"] for figure in entry["extra_info"].get("figures", ())]
    return sorted(figures, key=lambda figure: figure["goal"] is None)


def read_pairs(results: Iterable[Result]) -> Iterator[Pair]:
    """Ours beside each peer, kernel by kernel, and alone where a device has no peer beside it."""
    results = list(results)
    for kernel, on, size in dict.fromkeys((result.kernel, result.on, result.size) for result in results):
        here = [result for result in results if (result.kernel, result.on, result.size) == (kernel, on, size)]
        of_device = {
            who: {result.device: result for result in here if result.who == who} for who in (_OURS, _PLAN, _ONE_THREAD)
        }
        peers = [result for result in here if not result.is_ours]
        for device in dict.fromkeys((*of_device[_OURS], *of_device[_PLAN])):
            function, plan, one_thread = (of_device[who].get(device) for who in (_OURS, _PLAN, _ONE_THREAD))
            for peer in peers or [None]:
                yield Pair(function=function, plan=plan, one_thread=one_thread, peer=peer)
