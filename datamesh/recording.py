"""Recordings of the mesh: whatever was committed to any topics, in an MCAP file.

A channel is a topic, its encoding `warploom`. A message is a commit, a settled version or a loss: its publish time is
the version, its log time the wall clock at the commit, and its data a header of 64 bytes (kind, epoch, reception and
commit by the process's clock, SHA-256 of the payload) before the payload as `datamesh.messages` encodes it. The schema
of a channel names the payload's type and its fields.
"""

from __future__ import annotations

import hashlib
import logging
import os
import queue
import struct
import threading
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ..errors import SinkError
from .clock import Clock, SystemClock
from .counters import LossCounters
from .mesh import DataMesh
from .messages import decode, encode, message_type
from .snapshot import Entry

__all__ = ["ENCODING", "GAPS", "HEADER", "LOSSES", "READS", "RUNS", "EventKind", "RecordedEvent", "Recorder", "digest"]

ENCODING = "warploom"
"""Of channels and of messages."""
HEADER = struct.Struct("<B7xQqq32s")
"""Kind, epoch, received_ns, committed_ns, SHA-256 of the payload."""
LOSSES = "warploom/losses"
"""The topic of what was lost: a tuple of place and reason."""
RUNS = "warploom/runs"
"""The topic of triggers that components took: the component, and the versions that triggered, by input."""
GAPS = "warploom/gaps"
"""The topic of what a recording does not continue: a topic, the epoch and version up to which the file before holds it,
the version from which this one does, and the name of the file before."""
READS = "warploom/reads"
"""The topic of what sync vertices read: the vertex, and by input epoch and version, or how the wait ended without; None
where the vertex was left out."""

_QUEUE = 64  # commits that may wait for the writer; they hold the payloads, which are in the windows anyway

_log = logging.getLogger(__name__)


class EventKind(IntEnum):
    """What one message of a recording is."""

    COMMIT = 0
    SETTLE = 1
    """There will be nothing at this version."""
    LOSS = 2
    LOG = 3
    """An entry of a log beside the data."""


@dataclass(frozen=True, slots=True)
class RecordedEvent:
    """One message of a recording."""

    topic: str
    kind: EventKind
    epoch: int
    version: int
    """[ns]"""
    received_ns: int
    """By the recording process's clock: when the sensor's data was received."""
    committed_ns: int
    """By the same clock: when it was committed."""
    sha256: bytes
    """Of the payload as it is encoded."""
    payload: bytes | None
    """The encoded value; None where the recording keeps its hash alone."""

    @property
    def value(self) -> Any:
        """The payload, decoded.

        Raises:
            ValueError: It is damaged, or of a type that is not registered.
            LookupError: The recording keeps its hash alone.
        """
        if self.payload is None:
            raise LookupError(f"{self.topic!r} was recorded as hashes: its values are not in the recording")
        return decode(self.payload)


def digest(payload: bytes) -> bytes:
    """The hash of an encoded payload, 32 bytes."""
    return hashlib.sha256(payload).digest()


class _File:
    """What the MCAP writer writes into: unbuffered, every byte or an OSError."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb", buffering=0)
        self._position = 0

    def write(self, data: bytes) -> int:
        rest = memoryview(data)
        while rest:
            rest = rest[self._file.write(rest) :]
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        pass

    def close(self) -> None:
        self._file.close()


@dataclass(frozen=True, slots=True)
class _Event:
    """What waits for the writer; the payload is not encoded yet."""

    topic: str
    kind: EventKind
    epoch: int
    version: int
    received_ns: int
    committed_ns: int
    value: Any


class Recorder:
    """Records topics of a mesh on a thread of its own.

    A payload is encoded on that thread: a commit costs one entry in a queue. With `when_full="block"` a commit waits
    while 64 are in the queue, so that nothing is lost; with `"drop"` it is left out. A disk that is full or gone stops
    the recording and nothing else: what comes after is counted in `dropped` and in the mesh's losses, by reason
    (`queue_full`, `disk`, `not_encodable`), and `failure` says what happened. What is on the disk can be read.
    """

    def __init__(
        self,
        path: str | os.PathLike,
        *,
        compression: str = "lz4",
        when_full: str = "block",
        metadata: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        digest_only: Iterable[str] = (),
        write_through: bool = False,
    ) -> None:
        """Creates the file, and its folder where there is none; a file of that name is replaced.

        Args:
            path: The file.
            compression: lz4, zstd (smaller, slower) or none.
            when_full: block or drop.
            metadata: What is said of the recording, as the MCAP record `warploom`.
            attachments: Files kept in the recording, such as the modules that ran, by name.
            digest_only: Topics of which only the hashes are kept: enough to verify a replay.
            write_through: Every event is given to the system as soon as its turn comes, and not collected in chunks: a
                process that is killed loses what waits in the queue and no more. Nothing is compressed then.

        Raises:
            ValueError: compression or when_full is none of these.
            SinkError: The file cannot be created.
        """
        if compression not in ("lz4", "zstd", "none"):
            raise ValueError(f"compression is {compression!r}; expected lz4, zstd or none")
        if when_full not in ("block", "drop"):
            raise ValueError(f"when_full is {when_full!r}; expected block or drop")
        self.path = Path(path)
        self.written = 0
        """Commits that are in the file."""
        self.dropped: Counter[str] = Counter()
        """Commits that are not, by reason."""
        self.failure: str | None = None
        """Why the recording broke off; None while it has not."""
        self._digest_only = frozenset(digest_only)
        self._when_full = when_full
        self._losses = LossCounters()
        # Without a lock in Python: to put something into it costs a commit next to nothing.
        self._queue: queue.SimpleQueue[_Event | None] = queue.SimpleQueue()
        self._room = threading.Condition()
        self._waiting = 0
        self._channels: dict[str, int] = {}
        self._closing = threading.Event()
        self._clock: Clock = SystemClock()
        self._wall_ns = 0
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = _File(self.path)
            self._open(compression, metadata or {}, attachments or {}, write_through)
        except OSError as error:
            raise SinkError(f"{self.path}: cannot be created: {error.strerror or error}") from None
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()

    def _open(
        self, compression: str, metadata: Mapping[str, str], attachments: Mapping[str, bytes], write_through: bool
    ) -> None:
        from mcap.writer import CompressionType, Writer

        kind = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}[compression]
        self._writer = Writer(self._file, compression=kind, use_chunking=not write_through)  # type: ignore[arg-type]
        self._writer.start(profile="warploom", library="warploom")
        self._writer.add_metadata("warploom", dict(metadata))
        for name, data in attachments.items():
            self._writer.add_attachment(0, 0, name, "text/yaml", data)

    def watch(self, mesh: DataMesh, topics: Iterable[str]) -> None:
        """Records some topics of a mesh from now on, and what the mesh loses."""
        self._losses, self._clock = mesh.losses, mesh.clock
        self._wall_ns = time.time_ns() - mesh.clock.monotonic_ns()
        mesh.losses.on_loss(self._on_loss)
        for topic in topics:
            mesh.window(topic).subscribe(partial(self._on_commit, topic), partial(self._on_settle, topic))

    def log(self, topic: str, epoch: int, version: int, value: Any) -> None:
        """Adds an entry to a log beside the data; `value` is of what `datamesh.messages` encodes."""
        self._offer(_Event(topic, EventKind.LOG, epoch, version, 0, self._clock.monotonic_ns(), value))

    def _on_commit(self, topic: str, entry: Entry) -> None:
        stamps = entry.received_ns, entry.committed_ns
        self._offer(_Event(topic, EventKind.COMMIT, entry.epoch, entry.version, *stamps, entry.value))

    def _on_settle(self, topic: str, version: int, epoch: int) -> None:
        self._offer(_Event(topic, EventKind.SETTLE, epoch, version, 0, self._clock.monotonic_ns(), None))

    def _on_loss(self, place: str, reason: str, version: int) -> None:
        # What the recorder itself loses is in its own counters: recording it would lose it again.
        if not place.startswith("recorder "):
            self._offer(_Event(LOSSES, EventKind.LOSS, 0, version, 0, self._clock.monotonic_ns(), (place, reason)))

    def _offer(self, event: _Event) -> None:
        if self._closing.is_set():
            return
        if self.failure is not None:
            self._drop(event, "disk")
            return
        if self._queue.qsize() >= _QUEUE:
            if self._when_full == "drop":
                self._drop(event, "queue_full")
                return
            with self._room:
                self._waiting += 1
                self._room.wait_for(lambda: self._queue.qsize() < _QUEUE)
                self._waiting -= 1
        self._queue.put(event)

    def _drop(self, event: _Event, reason: str) -> None:
        if event.kind is EventKind.COMMIT:
            self.dropped[reason] += 1
            self._losses.count(f"recorder {event.topic}", reason, event.version)

    def _run(self) -> None:
        while (event := self._queue.get()) is not None:
            if self._waiting:
                with self._room:
                    self._room.notify_all()
            if self.failure is not None:  # the queue is still emptied, so that nobody waits for room in it
                self._drop(event, "disk")
                continue
            try:
                self._write(event)
            except OSError as error:
                self._fail(error)
                self._drop(event, "disk")
            except (TypeError, ValueError) as error:
                if not self.dropped["not_encodable"]:
                    _log.warning("%s: %s at %d is left out: %s", self.path, event.topic, event.version, error)
                self._drop(event, "not_encodable")

    def _fail(self, error: OSError) -> None:
        self.failure = error.strerror or str(error)
        _log.error("%s: the recording broke off: %s; what is in it can be read", self.path, self.failure)

    def _write(self, event: _Event) -> None:
        commit = event.kind is not EventKind.SETTLE
        payload = encode(event.value) if commit else b""
        header = HEADER.pack(event.kind, event.epoch, event.received_ns, event.committed_ns, digest(payload))
        channel = self._channel(event)
        data = header if event.topic in self._digest_only else header + payload
        self._writer.add_message(channel, event.committed_ns + self._wall_ns, data, event.version, self.written)
        if event.kind is EventKind.COMMIT:
            self.written += 1

    def _channel(self, event: _Event) -> int:
        """The channel of a topic; made by its first event, which for a schema must be a commit."""
        # A topic that was only settled so far has no type: it has a channel of its own until the first commit.
        key = event.topic if event.kind is not EventKind.SETTLE else f"{event.topic} settled"
        if key not in self._channels:
            schema = 0
            if event.kind is not EventKind.SETTLE:
                kind = message_type(type(event.value))
                name = type(event.value).__qualname__ if kind is None else kind.name
                text = "{}" if kind is None else kind.schema()
                schema = self._writer.register_schema(name, ENCODING, text.encode())
            kept = "sha256" if event.topic in self._digest_only else "all"
            self._channels[key] = self._writer.register_channel(event.topic, ENCODING, schema, {"kept": kept})
        return self._channels[key]

    def close(self) -> None:
        """Writes what waits and the file's summary. Twice is no harm; a failure is in `failure`, and not raised."""
        if self._closing.is_set():
            return
        self._closing.set()
        self._queue.put(None)
        self._thread.join()
        try:
            if self.failure is None:
                counts = {"commits": str(self.written), **{f"dropped.{k}": str(n) for k, n in self.dropped.items()}}
                self._writer.add_metadata("warploom.end", counts)
                self._writer.finish()
        except OSError as error:
            self._fail(error)
        finally:
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
