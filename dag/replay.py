"""Replay: the components run again on what a recording says they were given, and must give the same bytes."""

from __future__ import annotations

import threading
from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

from ..datamesh import Entry
from ..datamesh.messages import encode
from ..datamesh.playback import Player
from ..datamesh.recording import EventKind, RecordedEvent, digest
from ..datamesh.recording_reader import Recording
from ..errors import ConfigError
from .component import DataProcessComponent
from .configuration import nearest
from .process import Process
from .run_log import RecordedRuns

__all__ = ["Difference", "Replay", "ReplayResult", "produced_topics"]

_SHOWN = 100
_DRAIN = 60.0  # [s]: a frame that takes longer than this has hung


class Difference(NamedTuple):
    """A commit that is not what was recorded."""

    topic: str
    epoch: int
    """Number of the epoch within the recording, from 0."""
    version: int
    """[ns]"""
    what: str
    """differs: another payload; missing: recorded and not made again; extra: made, and not recorded."""


@dataclass
class ReplayResult:
    """What a replay gave."""

    fed: Counter[str] = field(default_factory=Counter)
    """Commits of the recording that the components were given, by topic."""
    equal: Counter[str] = field(default_factory=Counter)
    """Commits that are what was recorded, by topic."""
    different: int = 0
    """Commits that are not."""
    differences: list[Difference] = field(default_factory=list)
    """The first hundred of them."""
    other_fields: tuple[str, ...] = ()
    """Topics whose messages have other fields than when the recording was made: what was recorded is compared as it is
    encoded today, with the defaults of fields that are new."""
    broken: str | None = None
    """Where the recording broke off."""
    hung: str | None = None
    """Which frame did not get through, so that the replay ended there."""

    @property
    def good(self) -> bool:
        """Whether every commit was compared, and is what was recorded."""
        return self.different == 0 and self.equal.total() > 0


def produced_topics(process: Process) -> set[str]:
    """The topics that the components of a process commit to."""
    return {output.topic for component in process.components.values() for output in component.outputs.values()}


class Replay:
    """Feeds the source topics of a recording to a process that was built `offline`, and compares what it commits."""

    def __init__(self, recording: Recording, process: Process) -> None:
        """Looks at what is in the recording.

        Args:
            recording: What was committed.
            process: The components, not started.

        Raises:
            ConfigError: A topic that the components need is not in the recording, or was recorded as hashes.
        """
        self._recording = recording
        self._process = process
        produced = produced_topics(process)
        made: list[tuple[str, int, int, bytes]] = []
        logged: list[RecordedEvent] = []
        sources: dict[str, tuple[int, bool]] = {}
        changed: dict[str, bool] = {}
        for event in recording:
            if event.kind is EventKind.COMMIT and event.payload is not None and event.topic not in changed:
                changed[event.topic] = _digest_today(event) != event.sha256
            if event.kind is EventKind.COMMIT and event.topic in produced:
                sha256 = _digest_today(event) if changed.get(event.topic) else event.sha256
                made.append((event.topic, event.epoch, event.version, sha256))
            elif event.kind is EventKind.LOG:
                logged.append(event)
            elif event.kind is EventKind.COMMIT:
                sources.setdefault(event.topic, (event.epoch, event.payload is not None))
        needed = {
            handle.topic: handle.optional
            for component in process.components.values()
            for handle in component.inputs.values()
            if handle.topic not in produced
        }
        for topic, optional in needed.items():
            if not (sources[topic][1] if topic in sources else optional):
                how = "was recorded as hashes alone" if topic in sources else "is not in it"
                raise ConfigError(
                    f"{recording.path}: the components read topic {topic!r}, which {how}; {nearest(topic, sources)}"
                )
        self._sources = [topic for topic in sources if topic in needed]
        first = sources[self._sources[0]][0] if self._sources else 0
        self._expected: dict[str, dict[tuple[int, int], list[bytes]]] = defaultdict(lambda: defaultdict(list))
        for topic, epoch, version, sha256 in made:
            self._expected[topic][epoch - first, version].append(sha256)
        self._runs = RecordedRuns()
        for event in logged:
            self._runs.add(event, first)
        self._newest = {topic: max(commits) for topic, commits in self._expected.items()}
        self._beyond: list[Difference] = []
        self._fed: set[tuple[int, int]] = set()
        self._result = ReplayResult(other_fields=tuple(sorted(topic for topic, other in changed.items() if other)))
        self._lock = threading.Lock()

    def run(self) -> ReplayResult:
        """Starts the process, feeds it, stops it, and gives the comparison.

        Raises:
            SourceError: The recording cannot be read any more.
        """
        mesh = self._process.mesh
        for topic in self._expected:
            mesh.window(topic).subscribe(partial(self._compare, topic), lambda *_: None)
        for topic in self._sources:
            mesh.window(topic).subscribe(lambda entry: self._fed.add((entry.epoch, entry.version)), lambda *_: None)
        drain = Drain(self._process, self._sources)
        if self._runs:
            self._runs.apply(self._process, {*self._sources, *produced_topics(self._process)})
        player = Player(
            self._recording,
            mesh,
            self._sources,
            rate=None,
            before_epoch=drain.wait,
            on_log=lambda event: self._runs.on_played(event, self._process),
        )
        self._process.start()
        try:
            player.play()
            drain.wait()
        except TimeoutError as error:
            self._result.hung = str(error)
        finally:
            self._process.stop()
        result = self._result
        result.fed = player.published
        result.broken = self._recording.broken
        last = max(self._fed, default=(-1, -1))
        for topic, commits in self._expected.items():
            for (epoch, version), hashes in commits.items():
                # At a break, data can be in the file of which the results are not, and the other way round.
                if result.broken is None or (epoch, version) <= last:
                    for _ in hashes:
                        self._differ(Difference(topic, epoch, version, "missing"))
        if result.broken is None:
            for difference in self._beyond:
                self._differ(difference)
        return result

    def _compare(self, topic: str, entry: Entry) -> None:
        made = digest(encode(entry.value))
        with self._lock:
            hashes = self._expected[topic].get((entry.epoch, entry.version))
            if not hashes and (entry.epoch, entry.version) > self._newest[topic]:
                self._beyond.append(Difference(topic, entry.epoch, entry.version, "extra"))
            elif not hashes:
                self._differ(Difference(topic, entry.epoch, entry.version, "extra"))
            elif hashes.pop(0) != made:
                self._differ(Difference(topic, entry.epoch, entry.version, "differs"))
            else:
                self._result.equal[topic] += 1

    def _differ(self, difference: Difference) -> None:
        self._result.different += 1
        if len(self._result.differences) < _SHOWN:
            self._result.differences.append(difference)


def _digest_today(event: RecordedEvent) -> bytes:
    """Of the payload as it would be recorded today; as it was where it cannot be decoded."""
    try:
        return digest(encode(event.value))
    except (ValueError, LookupError):
        return event.sha256


class Drain:
    """Waits until nothing of what was fed is on its way any more: all that it triggers was committed or settled."""

    def __init__(self, process: Process, sources: Iterable[str]) -> None:
        """Watches the outputs of a process that was not started.

        Args:
            process: The components.
            sources: The topics that are fed.
        """
        self._mesh = process.mesh
        self._changed = threading.Condition()
        self._fed: dict[str, int] = {}
        self._reached = {source: _triggered_by(process, source) for source in sources}
        self._told: dict[str, set[int]] = {topic: set() for topics in self._reached.values() for topic in topics}
        for source in self._reached:
            self._mesh.window(source).subscribe(
                lambda entry, topic=source: self._feed(topic, entry.version),
                lambda version, _, topic=source: self._feed(topic, version),
            )
        for topic in self._told:
            self._mesh.window(topic).subscribe(
                lambda entry, topic=topic: self._tell(topic, entry.version),
                lambda version, _, topic=topic: self._tell(topic, version),
            )

    def _feed(self, topic: str, version: int) -> None:
        with self._changed:
            self._fed[topic] = version

    def _tell(self, topic: str, version: int) -> None:
        with self._changed:
            self._told[topic].add(version)
            self._changed.notify_all()

    def _through(self) -> bool:
        return all(
            version in self._told[topic] for source, version in self._fed.items() for topic in self._reached[source]
        )

    def wait(self) -> None:
        """Waits, and forgets what was fed so far.

        Raises:
            TimeoutError: A frame hangs.
        """
        with self._changed:
            if not self._changed.wait_for(self._through, _DRAIN):
                late = [t for s, v in self._fed.items() for t in self._reached[s] if v not in self._told[t]]
                raise TimeoutError(f"the latest frame was given to {late} {_DRAIN:.0f} s ago, and is not through")
            self._fed.clear()
            for told in self._told.values():
                told.clear()


def _triggered_by(process: Process, topic: str) -> list[str]:
    """The topics that are committed or settled at each version of a topic, through any number of components."""
    reached: dict[str, None] = {}
    waiting = [topic]
    while waiting:
        at = waiting.pop()
        for component in process.components.values():
            if not isinstance(component, DataProcessComponent):
                continue
            # Several inputs that trigger together do so at the versions of the first.
            names = component.trigger_inputs[:1] if component.triggers_together else component.trigger_inputs
            if at in [component.inputs[name].topic for name in names]:
                topics = [output.topic for output in component.outputs.values() if output.topic not in reached]
                reached.update(dict.fromkeys(topics))
                waiting += topics
    return list(reached)
