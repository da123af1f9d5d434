"""Counters and histograms of a run: commits, losses, runs of vertices, waits, latency of topics, pauses."""

from __future__ import annotations

import math
import threading
import weakref
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from typing import Any

from ..datamesh import DataMesh, Entry, LossCounters, Status
from .engine import VertexTiming
from .garbage import GarbagePause, on_pause

__all__ = ["Histogram", "Metrics"]

_GROWTH = math.log(1.04)
_SMALLEST = 1e-3  # [ms]: whatever is below falls into the first bucket
_PAUSES = 4096  # passes of the collector that may wait to be taken up: minutes of them
_BOUNDS = (0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 25.0, 50.0, 100.0, 250.0, 500.0, 1000.0, 2500.0)
"""Upper bounds of the buckets that a Prometheus server is given [ms]."""


class Histogram:
    """A distribution of times in buckets each 4 % wider than the last: any number of values in constant memory."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._buckets: dict[int, int] = {}
        self.count = 0
        self.total = 0.0
        self.max = 0.0

    def observe(self, value: float) -> None:
        """Adds a value [ms]; below zero counts as zero."""
        bucket = 0 if value <= _SMALLEST else 1 + int(math.log(value / _SMALLEST) / _GROWTH)
        with self._lock:
            self._buckets[bucket] = self._buckets.get(bucket, 0) + 1
            self.count += 1
            self.total += value
            if value > self.max:
                self.max = value

    def quantile(self, q: float) -> float:
        """The value that a share `q` of all does not exceed, within 2 %; NaN without any.

        Raises:
            ValueError: `q` is not between 0 and 1.
        """
        if not 0.0 <= q <= 1.0:
            raise ValueError(f"q must be between 0 and 1, not {q}")
        with self._lock:
            wanted, seen = q * self.count, 0
            for bucket in sorted(self._buckets):
                seen += self._buckets[bucket]
                if seen >= wanted:
                    return min(self.max, _SMALLEST * math.exp((bucket - 0.5) * _GROWTH)) if bucket else _SMALLEST
        return math.nan

    def below(self, bound: float) -> int:
        """How many values are at most `bound`, to within a bucket."""
        last = 0 if bound <= _SMALLEST else 1 + int(math.log(bound / _SMALLEST) / _GROWTH)
        with self._lock:
            return sum(count for bucket, count in self._buckets.items() if bucket <= last)

    def as_dict(self) -> dict[str, float | int]:
        """Count, mean, p50, p90, p99 and max [ms]."""
        if not self.count:
            return {"count": 0}
        quantiles = {f"p{q}": round(self.quantile(q / 100), 4) for q in (50, 90, 99)}
        return {"count": self.count, "mean": round(self.total / self.count, 4), **quantiles, "max": round(self.max, 4)}


class Metrics:
    """Collects them; safe to use from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._losses = LossCounters()
        self.commits: Counter[str] = Counter()
        """By topic."""
        self.settled: Counter[str] = Counter()
        """Versions without a datum, by topic."""
        self._runs: Counter[tuple[str, str, Status]] = Counter()
        self._vertices: dict[tuple[str, str], tuple[Histogram, Histogram]] = {}
        self.latency: dict[str, Histogram] = {}
        """From when the sensor's data was received to the commit, by topic: waits included [ms]."""
        self.wait: dict[str, Histogram] = {}
        """In the queue, by vertex [ms]."""
        self.run: dict[str, Histogram] = {}
        """In the processor, by vertex [ms]."""
        self.pauses: dict[int, Histogram] = {generation: Histogram() for generation in range(3)}
        """Of all threads while the garbage collector passed, by its generation [ms]."""
        # A pass comes in the midst of anything, also of what holds a lock: it only leaves its pause here.
        self._paused: deque[GarbagePause] = deque(maxlen=_PAUSES)
        self._ends_pauses: weakref.finalize[..., Metrics] | None = None

    def watch(self, mesh: DataMesh, topics: Iterable[str]) -> None:
        """Counts the commits of some topics and takes their latency; the losses of the mesh; the collector's pauses."""
        self._losses = mesh.losses
        if self._ends_pauses is None:
            self._ends_pauses = weakref.finalize(self, on_pause(self._paused.append))
        for topic in topics:
            self.latency[topic] = Histogram()
            mesh.window(topic).subscribe(partial(self._on_commit, topic), partial(self._on_settle, topic))

    def _on_commit(self, topic: str, entry: Entry) -> None:
        with self._lock:
            self.commits[topic] += 1
        self.latency[topic].observe((entry.committed_ns - entry.received_ns) / 1e6)

    def _on_settle(self, topic: str, version: int, epoch: int) -> None:
        with self._lock:
            self.settled[topic] += 1

    def on_timing(self, timing: VertexTiming) -> None:
        """Takes up the run of a vertex."""
        component, vertex, _, ready, start, end, status = timing[:7]
        histograms = self._vertices.get((component, vertex)) or self._add(component, vertex)
        with self._lock:
            self._runs[component, vertex, status] += 1
        histograms[0].observe((start - ready) / 1e6)
        histograms[1].observe((end - start) / 1e6)
        if self._paused:
            self._take_pauses()

    def _take_pauses(self) -> None:
        with suppress(IndexError):  # empty: another thread may take them as well
            while True:
                pause = self._paused.popleft()
                self.pauses[pause.generation].observe(pause.ms)

    def _add(self, component: str, vertex: str) -> tuple[Histogram, Histogram]:
        with self._lock:
            name = f"{component}.{vertex}"
            if name not in self.run:
                self.wait[name], self.run[name] = Histogram(), Histogram()
            self._vertices[component, vertex] = self.wait[name], self.run[name]
            return self._vertices[component, vertex]

    def runs(self) -> list[tuple[str, str, int]]:
        """How many runs of each vertex ended how: the vertex as `component.vertex`, the status, the count."""
        with self._lock:
            counts = dict(self._runs)
        named = ((f"{c}.{vertex}", status.name.lower(), count) for (c, vertex, status), count in counts.items())
        return sorted(named)

    def as_dict(self) -> dict[str, Any]:
        """All of it as plain values."""
        self._take_pauses()
        runs: dict[str, dict[str, int]] = {}
        for vertex, status, count in self.runs():
            runs.setdefault(vertex, {})[status] = count
        with self._lock:
            vertices = sorted(self.run)
            counts = {"commits": dict(sorted(self.commits.items())), "settled": dict(sorted(self.settled.items()))}
        return {
            **counts,
            "losses": self._losses.as_dict(),
            "latency_ms": {topic: histogram.as_dict() for topic, histogram in sorted(self.latency.items())},
            "runs": runs,
            "wait_ms": {vertex: self.wait[vertex].as_dict() for vertex in vertices},
            "run_ms": {vertex: self.run[vertex].as_dict() for vertex in vertices},
            "gc_pause_ms": {f"generation {number}": pauses.as_dict() for number, pauses in self.pauses.items()},
        }

    def prometheus(self) -> str:
        """All of it in Prometheus' text format."""
        self._take_pauses()
        with self._lock:
            commits = sorted(self.commits.items())
            latency, wait, run = (sorted(some.items()) for some in (self.latency, self.wait, self.run))
        lines = ["# TYPE warploom_commits_total counter"]
        lines += [_line("warploom_commits_total", {"topic": topic}, count) for topic, count in commits]
        lines.append("# TYPE warploom_losses_total counter")
        for place, reasons in self._losses.as_dict().items():
            lines += [_line("warploom_losses_total", {"place": place, "reason": r}, n) for r, n in reasons.items()]
        lines.append("# TYPE warploom_vertex_runs_total counter")
        lines += [
            _line("warploom_vertex_runs_total", {"vertex": vertex, "status": status}, n)
            for vertex, status, n in self.runs()
        ]
        lines += _histogram("warploom_latency_milliseconds", "topic", latency)
        lines += _histogram("warploom_vertex_wait_milliseconds", "vertex", wait)
        lines += _histogram("warploom_vertex_run_milliseconds", "vertex", run)
        pauses = [(str(generation), histogram) for generation, histogram in self.pauses.items()]
        lines += _histogram("warploom_gc_pause_milliseconds", "generation", pauses)
        return "\n".join(lines) + "\n"


def _histogram(name: str, label: str, histograms: list[tuple[str, Histogram]]) -> list[str]:
    lines = [f"# TYPE {name} histogram"]
    for key, histogram in histograms:
        lines += [_line(f"{name}_bucket", {label: key, "le": f"{b:g}"}, histogram.below(b)) for b in _BOUNDS]
        lines.append(_line(f"{name}_bucket", {label: key, "le": "+Inf"}, histogram.count))
        lines.append(_line(f"{name}_sum", {label: key}, histogram.total))
        lines.append(_line(f"{name}_count", {label: key}, histogram.count))
    return lines


def _line(name: str, labels: dict[str, str], value: float) -> str:
    escaped = {key: text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n") for key, text in labels.items()}
    said = ",".join(f'{key}="{text}"' for key, text in escaped.items())
    return f"{name}{{{said}}} {value:.10g}"
