"""Reads recordings of the mesh, also those that break off."""

from __future__ import annotations

import heapq
import os
import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import SourceError
from .recording import ENCODING, HEADER, EventKind, RecordedEvent

if TYPE_CHECKING:
    from mcap.records import Channel, Message

__all__ = ["Recording"]

_LARGEST = 1 << 30
"""Bytes of one record or chunk [B]: what claims more is damaged."""
_MAGIC = b"\x89MCAP0\r\n"
_MAGIC_BYTES = len(_MAGIC)
_RECORD = struct.Struct("<BQ")
"""How a record of MCAP begins: its opcode, and the length of the rest."""
_CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x04, 0x05, 0x06, 0x0F
_MESSAGE_HEADER = struct.Struct("<H12xQB7xQ")
"""Of a message of ours: channel, publish time (the version), kind, epoch."""
_OUT_OF_ORDER = 16
"""By how many messages the file's order may differ from the order of commits: what a commit leads to can be told to the
recorder before the commit itself."""


class Recording:
    """A recording made by `Recorder`: iterating gives its events in the order in which they happened.

    Within a topic that is the exact order of its commits; between topics a cause comes before its effects. A recording
    that was cut off, or never closed, is read up to the break; `broken` then says where that was.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        """Reads what is said of the recording.

        Raises:
            SourceError: There is no such file, or it is no recording of the mesh.
        """
        self.path = Path(path)
        self.metadata: dict[str, str] = {}
        """What was said of it when it was made."""
        self.attachments: dict[str, bytes] = {}
        self.broken: str | None = None
        """Why the latest reading ended before the end of the recording; None where it did not."""
        try:
            self.size = self.path.stat().st_size
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be read: {error.strerror or error}") from None
        ours = False
        for record in self._records():
            kind = type(record).__name__
            if kind == "Header":
                ours = record.profile == "warploom"
            elif kind == "Metadata" and record.name == "warploom":
                self.metadata = dict(record.metadata)
            elif kind == "Attachment":
                self.attachments[record.name] = record.data
            elif kind in ("Message", "Channel", "DataEnd"):
                break
        if not ours:
            what = self.broken or "it was written by something else"
            raise SourceError(f"{self.path}: is no recording that `warploom record` made: {what}")

    def _records(self) -> Iterator[Any]:
        """The records in the order of the file, up to its end or its break."""
        from mcap.exceptions import McapError
        from mcap.records import Chunk
        from mcap.stream_reader import StreamReader, breakup_chunk

        self.broken = None
        try:
            with self.path.open("rb") as file:
                for record in StreamReader(file, emit_chunks=True, record_size_limit=_LARGEST).records:
                    if not isinstance(record, Chunk):
                        yield record
                    elif record.uncompressed_size > _LARGEST:
                        raise ValueError(f"a chunk claims {record.uncompressed_size} bytes")
                    else:
                        yield from breakup_chunk(record, validate_crc=True)
        except GeneratorExit:
            raise
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be read: {error.strerror or error}") from None
        except Exception as error:  # whatever the reader meets in a damaged file
            known = isinstance(error, (McapError, EOFError))
            what = type(error).__name__ if known and not str(error) else f"{type(error).__name__}: {error}"
            self.broken = f"the file breaks off or is damaged ({what})"

    def __iter__(self) -> Iterator[RecordedEvent]:
        """The events, in the order of their commits.

        Raises:
            SourceError: The file cannot be read any more.
        """
        channels: dict[int, Channel] = {}
        waiting: list[tuple[int, int, RecordedEvent]] = []
        newest: dict[str, int] = {}
        number = 0
        for record in self._records():
            kind = type(record).__name__
            if kind == "Channel":
                channels[record.id] = record
            elif kind == "Message" and record.channel_id in channels:
                event = self._event(channels[record.channel_id], record)
                if event is None:
                    continue
                number += 1
                stamp = newest[event.topic] = max(record.log_time, newest.get(event.topic, 0))
                heapq.heappush(waiting, (stamp, number, event))
                if len(waiting) > _OUT_OF_ORDER:
                    yield heapq.heappop(waiting)[2]
            elif kind == "DataEnd":
                break
        while waiting:
            yield heapq.heappop(waiting)[2]

    @property
    def closed(self) -> bool:
        """Whether its recorder came to the end; otherwise it was killed, or is at work."""
        try:
            with self.path.open("rb") as file:
                file.seek(-_MAGIC_BYTES, os.SEEK_END)
                return self.size > 2 * _MAGIC_BYTES and file.read() == _MAGIC
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be read: {error.strerror or error}") from None

    def ends(self) -> dict[str, tuple[int, int]]:
        """By topic, epoch and version of the newest commit; payloads are passed over, so that this takes no time.

        Raises:
            SourceError: The file cannot be read any more.
        """
        from mcap.data_stream import ReadDataStream
        from mcap.records import Channel

        topics: dict[int, str] = {}
        ends: dict[str, tuple[int, int]] = {}
        try:
            with self.path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                at = _MAGIC_BYTES
                while at + _RECORD.size <= size:
                    file.seek(at)
                    opcode, length = _RECORD.unpack(file.read(_RECORD.size))
                    at += _RECORD.size + length
                    if at > size or opcode == _DATA_END:
                        break
                    if opcode == _CHUNK:  # what is collected and compressed has to be read
                        return self._ends_of_chunks()
                    if opcode == _CHANNEL:
                        channel = Channel.read(ReadDataStream(BytesIO(file.read(length))))
                        if channel.message_encoding == ENCODING:
                            topics[channel.id] = channel.topic
                    elif opcode == _MESSAGE and length >= _MESSAGE_HEADER.size:
                        number, version, kind, epoch = _MESSAGE_HEADER.unpack(file.read(_MESSAGE_HEADER.size))
                        if number in topics and kind == EventKind.COMMIT:
                            topic = topics[number]
                            ends[topic] = max(ends.get(topic, (epoch, version)), (epoch, version))
        except OSError as error:
            raise SourceError(f"{self.path}: cannot be read: {error.strerror or error}") from None
        return ends

    def _ends_of_chunks(self) -> dict[str, tuple[int, int]]:
        ends: dict[str, tuple[int, int]] = {}
        for event in self:
            if event.kind is EventKind.COMMIT:
                ends[event.topic] = max(ends.get(event.topic, (0, 0)), (event.epoch, event.version))
        return ends

    def _event(self, channel: Channel, message: Message) -> RecordedEvent | None:
        if channel.message_encoding != ENCODING or len(message.data) < HEADER.size:
            return None
        number, epoch, received, committed, sha256 = HEADER.unpack_from(message.data)
        try:
            kind = EventKind(number)
        except ValueError:  # of a later version, which says more
            return None
        kept = channel.metadata.get("kept") != "sha256"
        payload = message.data[HEADER.size :] if kept and kind is not EventKind.SETTLE else None
        return RecordedEvent(channel.topic, kind, epoch, message.publish_time, received, committed, sha256, payload)
