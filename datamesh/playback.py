"""Plays a recording into a mesh: at its own pace or any other, from any place, again and again, step by step."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable

from .handle import Output
from .mesh import DataMesh
from .policy import CommitPolicy, EqualVersion
from .recording import EventKind, RecordedEvent
from .recording_reader import Recording

__all__ = ["Player"]

_PUBLISHED = (EventKind.COMMIT, EventKind.SETTLE)

_log = logging.getLogger(__name__)


class Player:
    """Publishes the commits and settled versions of a recording, in their order.

    Time is that of the versions: with `rate=2` ten seconds between two versions take five. Where the recording enters a
    new epoch, and each time it starts over, so do the topics, after `before_epoch` has been called: whoever owns the
    mesh waits there until nothing of the old epoch is on its way any more, as what comes later would be discarded.
    """

    def __init__(
        self,
        recording: Recording,
        mesh: DataMesh,
        topics: Iterable[str],
        *,
        rate: float | None = 1.0,
        seek: float = 0.0,
        beginning: int | None = None,
        loops: int | None = 1,
        before_epoch: Callable[[], None] = lambda: None,
        on_event: Callable[[RecordedEvent], bool] = lambda event: True,
        on_log: Callable[[RecordedEvent], None] = lambda event: None,
    ) -> None:
        """Prepares, without publishing anything.

        Args:
            recording: What to play.
            mesh: Where to.
            topics: Which of its topics.
            rate: Speed, > 0; None: as fast as the mesh takes it.
            seek: Where to begin [s], ≥ 0, after `beginning`, each time anew; later epochs are played whole.
            beginning: The version from which `seek` counts [ns]; None: the lowest of these topics in the first epoch.
            loops: How often to play it; None: until `stop`.
            before_epoch: Called before each new epoch.
            on_event: Called before each event is published; False ends the playing, so a caller can step.
            on_log: Called for each entry of a log beside the data, in its place among the events.

        Raises:
            ValueError: A number makes no sense.
        """
        if rate is not None and not rate > 0:
            raise ValueError(f"rate must be above 0, not {rate}")
        if not seek >= 0:
            raise ValueError(f"seek must be at least 0 s, not {seek}")
        if loops is not None and loops < 1:
            raise ValueError(f"loops must be at least 1, not {loops}")
        self._recording = recording
        self._mesh = mesh
        self._rate = rate
        self._seek_ns = round(seek * 1e9)
        self._beginning = beginning
        self._loops = loops
        self._before_epoch = before_epoch
        self._on_event = on_event
        self._on_log = on_log
        self._stopping = threading.Event()
        self._epoch = 0
        self._outputs: dict[str, Output] = {}
        for topic in topics:
            self._outputs[topic] = Output()
            self._outputs[topic].bind(topic, mesh.window(topic))
        self.published: Counter[str] = Counter()
        """Commits published, by topic."""
        self.skipped: Counter[str] = Counter()
        """Commits that cannot be, as the recording keeps their hash alone or they cannot be decoded."""

    def stop(self) -> None:
        """Ends the playing, from any thread."""
        self._stopping.set()

    def play(self) -> None:
        """Publishes, and returns at the end of the last loop.

        Raises:
            SourceError: The recording cannot be read any more.
        """
        done = 0
        if self._seek_ns and self._beginning is None:
            self._beginning = self._lowest()
        while (self._loops is None or done < self._loops) and not self._stopping.is_set():
            published = self.published.total()
            self._once(self._epoch + 1 if done else 0)
            done += 1
            if self.published.total() == published:  # a recording without events would loop for ever
                return

    def _lowest(self) -> int:
        """The lowest version of the first epoch: what is committed first need not have it."""
        orders = [(e.epoch, e.version) for e in self._recording if e.topic in self._outputs and e.kind in _PUBLISHED]
        return min(orders, default=(0, 0))[1]

    def _once(self, offset: int) -> None:
        """Plays it once; its first epoch becomes the epoch `offset` of the mesh."""
        base: int | None = None
        first = (self._beginning or 0) + self._seek_ns
        origin, start = 0, 0.0
        newest: dict[str, tuple[int, int]] = {}
        for event in self._recording:
            if event.kind is EventKind.LOG:
                self._on_log(event)
            if event.topic not in self._outputs or event.kind not in _PUBLISHED:
                continue
            if base is None:
                base = event.epoch
            if self._seek_ns and event.epoch == base and event.version < first:
                continue
            epoch = offset + max(0, event.epoch - base)
            if not newest or epoch > self._epoch:
                if epoch > self._epoch:
                    self._before_epoch()
                self._epoch, origin, start = epoch, event.version, time.perf_counter()
            if self._rate is not None:
                due = start + (event.version - origin) / 1e9 / self._rate
                self._stopping.wait(max(0.0, due - time.perf_counter()))
            if self._stopping.is_set() or not self._on_event(event):
                self._stopping.set()
                return
            order = (epoch, event.version)
            self._publish(event, epoch, order < newest.get(event.topic, order))
            newest[event.topic] = max(order, newest.get(event.topic, order))

    def _publish(self, event: RecordedEvent, epoch: int, late: bool) -> None:
        output = self._outputs[event.topic]
        if event.kind is EventKind.SETTLE:
            output.settle(event.version, epoch)
            return
        try:
            value = event.value
        except (ValueError, LookupError) as error:
            if not self.skipped[event.topic]:
                _log.warning("%s: %s at %d is skipped: %s", self._recording.path, event.topic, event.version, error)
            self.skipped[event.topic] += 1
            return
        policy = CommitPolicy.INSERT_SORTED if late else CommitPolicy.DISCARD_OUT_OF_ORDER
        with output.allocate_change() as change:
            change.set_version(event.version, epoch=epoch)
            change.value = value
            output.commit(policy, change, equal=EqualVersion.REPLACE)
        self.published[event.topic] += 1
