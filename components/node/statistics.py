"""Statistics of a process's topics: rates, latencies, losses."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ...dag import DataProcessComponent, Trigger
from ...dag.metrics import Metrics
from ...datamesh import CommitPolicy, DataMesh, Output, Status
from ...datamesh.messages import message

__all__ = ["StatisticsReporter", "TopicStatistics", "TopicsReport"]


@message("warploom.TopicStatistics")
@dataclass(frozen=True, kw_only=True)
class TopicStatistics:
    """What happened on one topic."""

    topic: str
    rate_hz: float
    """Commits a second since the report before."""
    commits: int
    """Since the start."""
    settled: int
    """Versions without a datum, since the start."""
    latency_p50_ms: float | None
    """From the reception of the sensor's data to the commit, half of the time [ms]."""
    latency_p99_ms: float | None
    """The same, 99 % of the time [ms]."""
    lost: int
    """All losses at the topic itself, since the start."""


@message("warploom.TopicsReport")
@dataclass(frozen=True, kw_only=True)
class TopicsReport:
    """What happened in a process."""

    topics: tuple[TopicStatistics, ...]
    losses: Mapping[str, Mapping[str, int]]
    """Since the start, by place and reason: topics, components and vertices."""


class StatisticsReporter(DataProcessComponent):
    """Commits a report once in a period."""

    report: Output[TopicsReport]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._mesh: DataMesh | None = None
        self._metrics = Metrics()
        self._before: dict[str, int] = {}
        self._before_ns = 0
        self._latest: TopicsReport | None = None

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Keeps the mesh whose topics it watches."""
        super().bind(mesh, topics)
        self._mesh = mesh

    def start(self) -> None:
        """Begins to count."""
        self._watch()
        self._before_ns = self.clock.monotonic_ns()
        super().start()

    def _watch(self) -> None:
        """Watches the topics that are new."""
        assert self._mesh is not None
        new = [topic for topic in self._mesh.topics() if topic not in self._metrics.latency]
        self._metrics.watch(self._mesh, new)

    def process(self, trigger: Trigger) -> Status:
        """Makes and commits a report."""
        self._watch()
        now = self.clock.monotonic_ns()
        seconds = max(1e-9, (now - self._before_ns) / 1e9)
        commits, settled = dict(self._metrics.commits), dict(self._metrics.settled)
        losses = self.losses.as_dict()
        rows = []
        for topic, latency in sorted(self._metrics.latency.items()):
            count = commits.get(topic, 0)
            rows.append(
                TopicStatistics(
                    topic=topic,
                    rate_hz=round((count - self._before.get(topic, 0)) / seconds, 3),
                    commits=count,
                    settled=settled.get(topic, 0),
                    latency_p50_ms=round(latency.quantile(0.5), 4) if count else None,
                    latency_p99_ms=round(latency.quantile(0.99), 4) if count else None,
                    lost=sum(losses.get(topic, {}).values()),
                )
            )
        self._before, self._before_ns = commits, now
        self._latest = TopicsReport(topics=tuple(rows), losses=losses)
        with self.report.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = self._latest
            return self.report.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def state(self) -> Mapping[str, str | float | int]:
        """Topics, their commits, and all losses."""
        latest = self._latest
        if latest is None:
            return {}
        return {
            "topics": len(latest.topics),
            "commits": sum(row.commits for row in latest.topics),
            "losses": sum(count for reasons in latest.losses.values() for count in reasons.values()),
        }
