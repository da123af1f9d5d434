"""Signs of life: what a child tells of itself, and how it is seen that it hangs."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from ..component import Component, DataProcessComponent, GenericComponent
from ..process import Process

__all__ = ["ProcessObserver", "beat_period"]


_DEPTH = 8


def beat_period(health_timeout_s: float | None) -> float:
    """How often a child gives a sign of life [s]: several times within the timeout, once a second at most."""
    return 1.0 if health_timeout_s is None else min(1.0, health_timeout_s / 4)


class ProcessObserver:
    """Looks at a process from within: what it is, what it does, and whether a part of it hangs."""

    def __init__(
        self,
        process: Process,
        *,
        hang_s: float | None,
        first_s: float = 0.0,
        counters: Callable[[], Mapping[str, Mapping[str, int]]] = dict,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Counts the commits of the process from now on.

        Args:
            process: Which one.
            hang_s: How long a component may be at one frame before it hangs [s]; None: for ever.
            first_s: The same of its first frame, for which kernels may have to be compiled, if that is longer [s].
            counters: Of its links to other processes, by topic.
            clock: By which that is measured [s].
        """
        self._process = process
        self._hang_s = hang_s
        self._first_s = first_s
        self._counters = counters
        self._clock = clock
        self._at_work: dict[tuple[str, str], tuple[int, float]] = {}
        self._commits: Counter[str] = Counter()
        self._seen: Counter[str] = Counter()
        self._seen_at = clock()
        for component in process.components.values():
            for output in component.outputs.values():
                self._count(output.topic)

    def _count(self, topic: str) -> None:
        commits = self._commits
        commits[topic] = 0

        def on_commit(_: Any) -> None:
            commits[topic] += 1

        self._process.mesh.window(topic).subscribe(on_commit, lambda version, epoch: None)

    def description(self) -> dict[str, Any]:
        """What does not change: the components, their topics and types."""
        from ..graph import type_name

        components = {}
        for name, component in self._process.components.items():
            components[name] = {
                "kind": _kind(component),
                "inputs": {h.topic: type_name(h.payload) for h in component.inputs.values()},
                "outputs": {h.topic: type_name(h.payload) for h in component.outputs.values()},
                "homes": {h.topic: getattr(h.payload, "__module__", None) for h in component.outputs.values()},
            }
        return components

    def beat(self) -> dict[str, Any]:
        """One sign of life, as plain values; `hanging` says which parts have been at one frame for too long."""
        now = self._clock()
        idle: dict[str, str] = {}
        starting: dict[str, str] = {}
        state: dict[str, dict[str, Any]] = {}
        for name, component in self._process.components.items():
            said = getattr(component, "instance", component)
            try:
                if reason := getattr(said, "idle_because", None):
                    idle[name] = str(reason)
                if reason := getattr(said, "starting_because", None):
                    starting[name] = str(reason)
                tell = getattr(said, "state", None)
                if callable(tell):
                    state[name] = _plain(dict(tell()))  # type: ignore[call-overload]
            except Exception as error:  # a part that cannot tell its state does not make the process sick
                state[name] = {"state failed": f"{type(error).__name__}: {error}"}
        commits = dict(self._commits)
        passed = max(now - self._seen_at, 1e-6)
        rates = {topic: round((n - self._seen[topic]) / passed, 2) for topic, n in commits.items()}
        self._seen, self._seen_at = Counter(commits), now
        return {
            "hanging": self._hanging(now),
            "commits": commits,
            "rates": rates,
            "losses": self._process.mesh.losses.as_dict(),
            "links": {topic: dict(counts) for topic, counts in self._counters().items()},
            "idle": idle,
            "starting": starting,
            "state": state,
        }

    def _hanging(self, now: float) -> list[str]:
        at_work: dict[tuple[str, str], tuple[int, float]] = {}
        for name, component in self._process.components.items():
            if isinstance(component, DataProcessComponent):
                for part, version in component.at_work().items():
                    before = self._at_work.get((name, part))
                    since = before[1] if before is not None and before[0] == version else now
                    at_work[name, part] = (version, since)
        self._at_work = at_work
        return [
            f"{name}.{part} at version {version} for {now - since:.1f} s"
            for (name, part), (version, since) in at_work.items()
            if now - since >= self._limit(self._process.components[name])
        ]

    def _limit(self, component: Component) -> float:
        if self._hang_s is None:
            return math.inf
        started = isinstance(component, DataProcessComponent) and component.has_run
        return self._hang_s if started else max(self._hang_s, self._first_s)


def _plain(value: Any, depth: int = 0) -> Any:
    """What a component says of itself as JSON takes it: keys are texts, and so is what it does not know."""
    if isinstance(value, (str, int, type(None))) or (isinstance(value, float) and math.isfinite(value)):
        return value
    if depth < _DEPTH and isinstance(value, Mapping):
        return {str(key): _plain(one, depth + 1) for key, one in value.items()}
    if depth < _DEPTH and isinstance(value, (list, tuple, set, frozenset)):
        return [_plain(one, depth + 1) for one in value]
    return str(value)


def _kind(component: Component) -> str:
    if isinstance(component, GenericComponent):
        kind = type(component.instance)
        return f"generic {kind.__name__}"
    return type(component).__name__
