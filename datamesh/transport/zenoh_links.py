"""Topics between hosts, over zenoh: every commit is one message, its arrays in it.

The key of a topic is `warploom/<domain>/<topic>`. A message is the identity of the producer's life (16 bytes), then an
event as between processes of a host, without slabs. Its times are those of the machine's clock, by which the reader
puts them on its own: hosts are to be synchronised (PTP, NTP). Whoever joins later asks for the newest datum.
"""

from __future__ import annotations

import json
import logging
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote

from ...errors import ConfigError
from ..clock import Clock
from ..messages import decode, encode
from ..snapshot import Entry
from ..window import Window
from .config import ZenohConfig
from .importing import publish
from .places import OrderFile
from .wire import COMMIT, SETTLE, Event, pack_event, read_event

__all__ = ["ZenohExporter", "ZenohImporter", "ZenohSession"]

_log = logging.getLogger(__name__)

_LIFE = 16
_ROOM_S = 1e-3


class ZenohSession:
    """The connection of a process to the zenoh network."""

    def __init__(self, config: ZenohConfig, *, node: str) -> None:
        """Connects.

        Args:
            config: Where to, and sizes.
            node: Names the domain, unless the configuration does.

        Raises:
            ConfigError: zenoh is not installed, or cannot be started so.
        """
        try:
            import zenoh
        except ImportError as error:
            raise ConfigError("topics between hosts need zenoh: pip install 'warploom[net]'") from error
        settings = zenoh.Config()
        self.config = config
        self._domain = f"warploom/{quote(config.domain or node, safe='')}"
        try:
            settings.insert_json5("mode", json.dumps(config.mode))
            settings.insert_json5("connect/endpoints", json.dumps(config.connect))
            if config.listen:  # an empty list would be its choice to listen nowhere, so that nobody finds it
                settings.insert_json5("listen/endpoints", json.dumps(config.listen))
            settings.insert_json5("scouting/multicast/enabled", json.dumps(config.scouting))
            # On one host topics go by slabs, and its segments outlive a process that is killed.
            settings.insert_json5("transport/shared_memory/enabled", "false")
            self.session = zenoh.open(settings)
        except zenoh.ZError as error:
            raise ConfigError(
                f"zenoh cannot be started: {error}; connect {config.connect}, listen {config.listen}"
            ) from error

    def key(self, topic: str) -> str:
        """The key of a topic."""
        return f"{self._domain}/{quote(topic, safe='')}"

    def close(self) -> None:
        """Ends the connection, after what uses it has stopped."""
        self.session.close()


def _wall_offset(clock: Clock) -> int:
    """From the clock by which the mesh measures to the machine's [ns]."""
    return time.time_ns() - clock.monotonic_ns()


class ZenohExporter:
    """Sends one topic, in a thread of its own.

    Zenoh's queue holds two messages, or fragments of one. What it has no room for it drops and tells nobody; or it
    lets its caller wait, as the thread here does. Where its own queue is full, a commit waits for a millisecond, as of
    a burst there is room again at once; then the oldest is dropped, and counted.
    """

    def __init__(self, session: ZenohSession, window: Window[Any], order: OrderFile) -> None:
        """Begins to send.

        Args:
            session: The connection.
            window: Of the topic.
            order: Says under which epochs others see those of the window.
        """
        import zenoh

        self._window = window
        self._order = order
        self._queue = session.config.queue
        self._error = zenoh.ZError
        self._life = uuid.uuid4().bytes
        self._counts: Counter[str] = Counter()
        self._waiting: deque[Event] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._number = 0
        self._newest = b""
        key = session.key(window.topic)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = session.session.declare_publisher(key, express=True, congestion_control=block)
        # A reader that comes later asks for the newest, when it sees the sign of life.
        self._queryable = session.session.declare_queryable(key, self._answer) if session.config.history else None
        self._sign = session.session.liveliness().declare_token(f"{key}/{self._life.hex()}")
        self._thread = threading.Thread(target=self._run, name=f"export {window.topic}", daemon=True)
        self._thread.start()
        self._unsubscribe = window.subscribe(self._on_commit, self._on_settle)

    def _on_commit(self, entry: Entry) -> None:
        newest = self._window.snapshot(entry.epoch).versions[-1:] == (entry.version,)
        try:
            body = encode(entry.read(), lambda array: None)
        except TypeError as error:
            if not self._counts["not_encodable"]:
                _log.warning("%s: version %d is not sent: %s", self._window.topic, entry.version, error)
            self._counts["not_encodable"] += 1
            self._window.losses.count(self._window.topic, "link_not_encodable", entry.version)
            with self._changed:
                self._number += 1
            return
        wall = _wall_offset(self._window.clock)
        stamps = entry.received_ns + wall, entry.committed_ns + wall
        epoch = self._order.epoch(entry.epoch, entry.version)
        self._offer(Event(COMMIT, 0, epoch, entry.version, *stamps, entry.triggers, newest, body=body))
        self._counts["copied"] += 1
        self._counts["copied_bytes"] += len(body)

    def _on_settle(self, version: int, epoch: int) -> None:
        seen = self._order.settled(epoch, version)
        if seen is not None:
            self._offer(Event(SETTLE, 0, seen, version, 0, 0))

    def _offer(self, event: Event) -> None:
        with self._changed:
            if not self._changed.wait_for(lambda: len(self._waiting) < self._queue, _ROOM_S):
                self._lose(self._waiting.popleft())
            self._number += 1
            self._waiting.append(event._replace(number=self._number))
            self._changed.notify()

    def _lose(self, event: Event) -> None:
        """Of what is not sent; its reader notices by the number that is missing."""
        self._counts["slow"] += 1
        self._window.losses.count(self._window.topic, "link_slow", event.version)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if not self._waiting:
                    return
                event = self._waiting.popleft()
                self._changed.notify()
            data = self._life + pack_event(event)
            try:
                self._publisher.put(data)
            except self._error as error:  # the session has ended, or has no link left
                _log.error("%s: version %d is not sent: %s", self._window.topic, event.version, error)
                self._lose(event)
                continue
            if event.kind == COMMIT and event.newest:
                self._newest = data  # not before: a reader drops what comes after it with a lower number
            self._counts["sent"] += 1
            self._counts["sent_bytes"] += len(data)

    def _answer(self, query: Any) -> None:
        with query:
            if self._newest:
                query.reply(query.key_expr, self._newest)

    def counters(self) -> Mapping[str, int]:
        """What was sent, and whether anybody on another host reads it."""
        return {**self._counts, "remote_readers": int(self._publisher.matching_status.matching)}

    def stop(self) -> None:
        """Ends sending, after what waits has been sent, for which it takes five seconds at most."""
        self._unsubscribe()
        with self._changed:
            self._stopping = True
            self._changed.notify_all()
        self._thread.join(5.0)
        with self._changed:
            while self._waiting:
                self._lose(self._waiting.popleft())
        for one in (self._sign, self._queryable, self._publisher):
            if one is not None:
                one.undeclare()


class ZenohImporter:
    """Receives one topic, in a thread of its own."""

    def __init__(self, session: ZenohSession, window: Window[Any]) -> None:
        """Begins to receive.

        Args:
            session: The connection.
            window: Of the topic; nobody else commits to it.
        """
        self._session = session
        self._window = window
        self._key = session.key(window.topic)
        self._counts: Counter[str] = Counter()
        self._alive: set[str] = set()
        self._waiting: deque[bytes] = deque()
        self._changed = threading.Condition()
        self._stopping = False
        self._numbers: dict[bytes, int] = {}
        self._began_ns = time.time_ns()
        self._thread = threading.Thread(target=self._run, name=f"import {window.topic}", daemon=True)
        self._thread.start()
        self._subscriber = session.session.declare_subscriber(self._key, self._on_sample)
        liveliness = session.session.liveliness()
        self._signs = liveliness.declare_subscriber(f"{self._key}/*", self._on_sign, history=True)

    def _on_sample(self, sample: Any) -> None:
        self._offer(sample.payload.to_bytes())

    def _on_sign(self, sample: Any) -> None:
        """A producer has begun or ended."""
        import zenoh

        key = str(sample.key_expr)
        if sample.kind == zenoh.SampleKind.PUT:
            self._counts["connections"] += 1
            self._alive.add(key)
            if self._session.config.history:
                self._session.session.get(self._key, self._on_reply)
        else:
            self._alive.discard(key)

    def _on_reply(self, reply: Any) -> None:
        if reply.ok is not None:
            self._offer(reply.ok.payload.to_bytes())

    def _offer(self, data: bytes) -> None:
        with self._changed:
            if len(self._waiting) >= self._session.config.queue:
                self._waiting.popleft()
                self._counts["slow"] += 1  # and counted as missed by its number, when the next is read
            self._waiting.append(data)
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._stopping)
                if self._stopping:
                    return
                data = self._waiting.popleft()
            try:
                self._read(data)
            except ValueError as error:
                if not self._counts["damaged"]:
                    _log.error("%s: a message cannot be read: %s", self._window.topic, error)
                self._counts["damaged"] += 1
                self._window.losses.count(self._window.topic, "link_damaged")

    def _read(self, data: bytes) -> None:
        life, event = data[:_LIFE], read_event(data[_LIFE:], 0)
        last = self._numbers.pop(life, None)
        self._numbers[life] = event.number if last is None else max(last, event.number)
        if len(self._numbers) > 16:
            del self._numbers[next(iter(self._numbers))]
        if last is not None and event.number <= last:
            return  # the newest, which was asked for, and came by itself too
        if last is not None and event.number > last + 1:
            missing = event.number - last - 1
            self._counts["missed"] += missing
            self._window.losses.count(self._window.topic, "link_missed", event.version, missing)
        if event.kind == SETTLE:
            self._window.settle(event.version, event.epoch)
        else:
            value = decode(event.body)
            wall = _wall_offset(self._window.clock)
            now = self._window.clock.monotonic_ns()
            # What was committed before this process began may have been worked on by its life before.
            triggers = event.triggers and event.committed_ns >= self._began_ns
            received, committed = (min(now, stamp - wall) for stamp in (event.received_ns, event.committed_ns))
            event = event._replace(received_ns=received, committed_ns=committed, triggers=triggers)
            publish(self._window, event, value)
        self._counts["received"] += 1
        self._counts["received_bytes"] += len(data)

    def counters(self) -> Mapping[str, int]:
        """What was received, and what not."""
        return {**self._counts, "connected": len(self._alive)}

    def stop(self) -> None:
        """Ends receiving. What was received stays."""
        self._signs.undeclare()
        self._subscriber.undeclare()
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(5.0)
