"""Two runs of the benchmarks beside one another.

Machines are noisy, and two runs may be of two machines. The peers are the same code in both: how much their times on
the same input have changed is the machine's share, and what is left of the change of ours is ours.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median
from typing import Any

from .results import Pair, Result, read_figures, read_pairs, read_results

__all__ = [
    "SLOWER",
    "Change",
    "FigureChange",
    "PeerChange",
    "compare_figures",
    "compare_pairs",
    "compare_times",
]

_UNITS_OF_TIME = ("s", "ms", "µs")

SLOWER = 1.2
"""By what a time, less the machine's share, must have grown to be called slower."""


@dataclass(frozen=True, kw_only=True)
class Change:
    """How the time of one of ours has changed."""

    result: Result
    """The new one."""
    old_seconds: float
    """The old median."""
    machine: float
    """By what the times of the peers have changed: of those on the same input, of all where it has none, or 1."""

    @property
    def ratio(self) -> float:
        """New median over old."""
        return self.result.seconds / self.old_seconds

    @property
    def own(self) -> float:
        """The ratio less the machine's share."""
        return self.ratio / self.machine

    @property
    def is_slower(self) -> bool:
        """Whether ours has become slower by more than 20 %."""
        return self.own > SLOWER


@dataclass(frozen=True, kw_only=True)
class PeerChange:
    """How ours has changed beside one peer."""

    pair: Pair
    """The new one."""
    old_ratio: float
    """Our time over the peer's in the old run."""

    @property
    def ratio(self) -> float:
        """Our time over the peer's now."""
        return self.pair.ratio or 0.0


@dataclass(frozen=True, kw_only=True)
class FigureChange:
    """How a figure has changed: of these, less is better."""

    name: str
    """What it is."""
    unit: str
    """Of both."""
    old: float
    """In the old run."""
    new: float
    """In the new one."""
    machine: float
    """By what the times of all peers have changed; 1 where it is no time."""

    @property
    def own(self) -> float:
        """New over old, less the machine's share; infinite where it was zero or less."""
        return self.new / self.old / self.machine if self.old > 0 else float("inf") if self.new > 0 else 1.0

    @property
    def is_slower(self) -> bool:
        """Whether a time has grown by more than 20 %."""
        return self.unit in _UNITS_OF_TIME and self.own > SLOWER


def compare_times(old: dict[str, Any], new: dict[str, Any]) -> list[Change]:
    """The times of ours that are in both runs, functions and plans.

    Args:
        old: The JSON of a run, as `results.read_measured` reads it.
        new: That of another.
    """
    before = {_key(result): result for result in read_results(old)}
    after = read_results(new)
    by_input, everywhere = _drifts(old, new)
    return [
        Change(
            result=result,
            old_seconds=before[_key(result)].seconds,
            machine=_median_or_1(by_input.get((result.kernel, result.on), (everywhere,))),
        )
        for result in after
        if result.who.startswith("warploom") and _key(result) in before
    ]


def compare_figures(old: dict[str, Any], new: dict[str, Any]) -> list[FigureChange]:
    """The figures that are in both runs: of whole frames, of the start, of memory.

    Args:
        old: The JSON of a run, as `results.read_measured` reads it.
        new: That of another.
    """
    before = {figure["name"]: figure["value"] for figure in read_figures(old)}
    _, everywhere = _drifts(old, new)
    return [
        FigureChange(
            name=figure["name"],
            unit=figure["unit"],
            old=before[figure["name"]],
            new=figure["value"],
            machine=everywhere if figure["unit"] in _UNITS_OF_TIME else 1.0,
        )
        for figure in read_figures(new)
        if figure["name"] in before
    ]


def compare_pairs(old: dict[str, Any], new: dict[str, Any]) -> list[PeerChange]:
    """The ratios to peers that are in both runs.

    Args:
        old: The JSON of a run, as `results.read_measured` reads it.
        new: That of another.
    """
    before = {_pair_key(pair): pair.ratio for pair in read_pairs(read_results(old)) if pair.ratio is not None}
    return [
        PeerChange(pair=pair, old_ratio=before[_pair_key(pair)])
        for pair in read_pairs(read_results(new))
        if pair.ratio is not None and _pair_key(pair) in before
    ]


def _drifts(old: dict[str, Any], new: dict[str, Any]) -> tuple[dict[tuple[str, str], list[float]], float]:
    """New over old of the peers' times: by kernel and input, and the median of all."""
    before = {_key(result): result.seconds for result in read_results(old)}
    by_input: dict[tuple[str, str], list[float]] = {}
    for result in read_results(new):
        if not result.who.startswith("warploom") and _key(result) in before:
            by_input.setdefault((result.kernel, result.on), []).append(result.seconds / before[_key(result)])
    return by_input, _median_or_1(drift for drifts in by_input.values() for drift in drifts)


def _key(result: Result) -> tuple[str, ...]:
    return result.kernel, result.on, result.who, result.device


def _pair_key(pair: Pair) -> tuple[str, ...]:
    return pair.ours.kernel, pair.ours.on, pair.ours.device, pair.peer.who if pair.peer is not None else ""


def _median_or_1(values: Iterable[float]) -> float:
    values = list(values)
    return median(values) if values else 1.0
