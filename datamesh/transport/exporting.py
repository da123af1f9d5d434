"""The writer's side: a topic of this process for readers in other processes of the host.

A commit is encoded once, its arrays by reference into slabs, and told to each reader as one message of its own socket.
Payloads that were built in slabs are not copied; the others are, and counted. Nothing waits for a reader, unless its
backlog blocks its producer: what does not fit into its queue is dropped, and counted. A reader that dies, however, is
noticed by the end of its socket, which the kernel closes, and what it held is free again.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from ..messages import encode
from ..snapshot import Entry
from ..window import Window
from .config import SharedMemoryConfig
from .expecting import Durations, current_core
from .keeping import Absent
from .places import OrderFile, keep_from_children, listen, peer_of, unlisten
from .placing import NoRoom, Placing
from .readers import Reader
from .service import ExportService
from .slabs import Lease, Slab, SlabArena, SlabPool, Usage
from .wire import (
    COMMIT,
    ENDS,
    INLINE,
    LEAVES,
    MESSAGE,
    NEWEST,
    NEWEST_TRIGGERS,
    RELEASE,
    SETTLE,
    Event,
    new_event,
    pack_commit,
    pack_event,
    pack_greeting,
    pack_soon,
    read_greeting,
    set_number,
)

__all__ = ["Exporter"]

_log = logging.getLogger(__name__)

_ndarray = np.ndarray
_COUNTING_S = 0.1
_COLD_NS = 800_000
"""After a pause of this length a processor's caches hold other things than what receives a datum [ns]."""
_NAMES = 256
"""Of how many readers it is known what they were sent, for when they come back."""


class Exporter:
    """Sends one topic."""

    def __init__(
        self,
        window: Window[Any],
        service: ExportService,
        *,
        node: str,
        name: str,
        config: SharedMemoryConfig | None = None,
    ) -> None:
        """Begins to export; payloads of the window can be built in shared memory from here on.

        Args:
            window: Of the topic.
            service: Lets readers in.
            node: Whose processes read it.
            name: Of this process, for messages.
            config: Sizes.

        Raises:
            ConfigError: Another process exports the topic.
        """
        self._config = config or SharedMemoryConfig()
        self._window = window
        self._service = service
        self._node = node
        self._name = name
        self._counts: Counter[str] = Counter()
        self._lock = threading.RLock()
        self._readers: list[Reader] = []
        self._ended: list[Reader] = []  # of which some still hold what they were sent
        self._reached: dict[str, tuple[int, int]] = {}
        self._stopped = False
        self._built = self._copied = Usage()
        self._begun_ns = self._told_ns = 0
        self._durations = Durations()
        self._due_ns = (0, 0)
        self._newest = self._newest_of(window)
        self._form: Any = None
        self._body = b""
        self._absent = Absent(self._config, self._on_lost)
        self._behind: list[Reader] = []
        self._listener = listen(node, window.topic)
        try:
            self.order = OrderFile(node, window.topic)
            """Under which epochs others see those of the window."""
            self._pool = SlabPool(self._config.memory_bytes)
            self._region = self._pool.region
        except BaseException:
            unlisten(node, window.topic)
            self._listener.close()
            raise
        window.arena = self._arena
        window.on_begin = self._on_begin
        self._unsubscribe = window.subscribe(self._on_commit, self._on_settle)
        service.watch(self._listener, select.EPOLLIN, self._accept)

    def counters(self) -> Mapping[str, int]:
        """What was sent, copied and dropped so far, and how many read."""
        if self._lock.acquire(timeout=_COUNTING_S):  # held for long where a commit waits for a reader that blocks
            try:
                self._collect_all()
                self._absent.tidy()
                self._pool.collect()
            finally:
                self._lock.release()
        counts = {"commits": 0, "sent": 0, "copied": 0, **self._counts}
        return {**counts, "readers": len(self._readers), "slabs": self._pool.used, "kept": len(self._absent)}

    def stop(self) -> None:
        """Ends the export. What readers hold stays theirs."""
        self._stopped = True
        self._window.arena = self._window.on_begin = None
        self._unsubscribe()
        with self._lock:
            unlisten(self._node, self._window.topic)
            self._listener.close()
            for reader in (*self._readers, *self._ended):
                self._drop(reader)
            self._pool.close()
            self.order.close()

    @staticmethod
    def _newest_of(window: Window[Any]) -> tuple[int, int]:
        snapshot = window.snapshot()
        return snapshot.epoch, snapshot.versions[-1] if len(snapshot) else -1

    def _on_begin(self) -> None:
        self._begun_ns = now = time.perf_counter_ns()
        if self._config.announce and now - self._told_ns > _COLD_NS:
            self._announce(now)

    # Memory

    def _arena(self) -> SlabArena:
        arena = SlabArena(self._lease, self._built.size, partial(self._count, "no_memory"))
        self._built = arena.used
        return arena

    def _announce(self, begun_ns: int) -> None:
        """Wakes the readers while a datum is built, for them to be ready when it comes."""
        soon, late = self._due_ns
        message = pack_soon(current_core(), begun_ns + soon, begun_ns + late)
        for reader in tuple(self._readers):
            if reader.kept is None and not reader.is_full:
                with suppress(OSError):  # it is gone, or has enough to read
                    reader.send(message)

    def _lease(self, size: int) -> Lease | None:
        with self._lock:
            if self._stopped:
                return None
            self._collect_all()
            slab = self._pool.take(size)
            while slab is None and self._absent.make_room():
                slab = self._pool.take(size)
            return None if slab is None else self._pool.lease(slab)

    def _count(self, what: str) -> None:
        with self._lock:
            self._counts[what] += 1

    # Commits

    def _on_commit(self, entry: Entry) -> None:
        version, value, received, committed, epoch, triggers, completion, _ = entry
        with self._lock:
            if self._stopped:
                return
            order = (epoch, version)
            epoch = self.order.epoch(epoch, version)
            if (
                type(value) is _ndarray
                and type(base := value.base) is Lease
                and type(slab := base.key) is Slab
                and slab.region is self._region
                and completion is None
                and order > self._newest
                and not self._behind
                and not self._absent.readers
            ):
                # An array that lies in a slab: what `_tell` does, without a call of what has left the caches since.
                self._newest = order
                offset = base.begin - slab.offset
                form = value.dtype, value.shape, offset
                if form != self._form:
                    self._form, self._body = form, encode(value, partial(_in_first_slab, offset))
                flags = NEWEST_TRIGGERS if triggers else NEWEST
                for reader in tuple(self._readers):
                    number = reader.number + 1
                    head = pack_commit(
                        COMMIT, flags, 1, 0, number, epoch, version, received, committed, slab.offset, slab.size
                    )
                    try:
                        if reader.held >= reader.most:
                            raise BlockingIOError
                        reader.send(head + self._body)
                    except OSError:
                        self._tell(entry, epoch, True, [reader])
                        continue
                    reader.number = number
                    self._counts["sent"] += 1
                    self._counts["sent_bytes"] += len(head) + len(self._body)
                    reader.holds((slab,))
                    reader.has_sent(entry, epoch, True)
                self._has_told()
                return
            newest = order > self._newest or self._window.snapshot().versions[-1] == version
            if newest:
                self._newest = order
            if self._absent.readers:
                self._absent.add(entry, self._size)
            readers = self._readers
            if self._behind:
                readers = [reader for reader in readers if reader.kept is None]
                self._put_behind(entry)
            if readers:
                self._tell(entry, epoch, newest, readers)
            self._has_told()

    def _has_told(self) -> None:
        """Books a commit, once its readers know of it."""
        self._counts["commits"] += 1
        self._told_ns = now = time.perf_counter_ns()
        if self._begun_ns:
            self._due_ns = self._durations.add(now - self._begun_ns)
            self._begun_ns = 0

    def _on_settle(self, version: int, epoch: int) -> None:
        with self._lock:
            if self._stopped:
                return
            seen = self.order.settled(epoch, version)
            if seen is not None:
                message = pack_event(Event(SETTLE, 0, seen, version, 0, 0))
                for reader in tuple(self._readers):
                    self._send(reader, message, version)

    def _tell(self, entry: Entry, epoch: int, newest: bool, readers: list[Reader]) -> None:
        """Sends a datum to readers."""
        encoded = self._encode(entry, epoch, newest, readers)
        if encoded is None:
            return
        message, slabs, leases = encoded
        for reader in tuple(readers):
            if self._send(reader, message, entry.version, slabs):
                reader.has_sent(entry, epoch, bool(slabs))
        del leases  # until here they hold the slabs that were copied to

    def _lose(self, reason: str, version: int, readers: list[Reader]) -> None:
        for reader in readers:
            reader.number += 1
        self._counts[reason] += len(readers)
        self._window.losses.count(self._window.topic, f"link_{reason}", version, len(readers))

    def _encode(
        self, entry: Entry, epoch: int, newest: bool, readers: list[Reader]
    ) -> tuple[bytearray, list[Slab], tuple[Lease, ...]] | None:
        """A datum as a message, the slabs that it is in, and what holds those that were taken for it.

        None where it has no form as a message, or there is no room to copy it to, which is counted for the readers.
        """
        version, value, received, committed, _, triggers, completion, _ = entry
        placing = Placing(self._pool, self._lease, self._copied.size)
        size = 0
        try:
            if completion is not None:  # on the host: what a device still writes is waited for
                value = entry.read()
            body = encode(value, placing)
            if len(body) > INLINE:
                one = placing.take(len(body))
                one.bytes()[: len(body)] = np.frombuffer(body, np.uint8)
                placing.slabs.append(one.key)
                size, body = len(body), b""
        except NoRoom:
            self._lose("no_memory", version, readers)
            return None
        except (TypeError, ValueError) as error:
            if not self._counts["not_encodable"]:
                _log.warning("%s: version %d is not sent: %s", self._window.topic, version, error)
            self._lose("not_encodable", version, readers)
            return None
        if placing.copies is not None:
            self._counts["copied"] += 1
            self._counts["copied_bytes"] += placing.copied_bytes
            self._copied = placing.copies.used
        slabs = placing.slabs
        places: tuple[tuple[int, int], ...] = ()
        for slab in slabs:
            places += ((slab.offset, slab.size),)
        event = new_event((COMMIT, 0, epoch, version, received, committed, triggers, newest, places, body, size))
        return pack_event(event), slabs, placing.leases

    # Readers

    def _accept(self) -> None:
        with suppress(OSError):  # it is gone again, or the export has ended
            connection, _ = self._listener.accept()
            keep_from_children(connection)
            connection.setblocking(False)
            if peer_of(connection)[1] != os.getuid():
                connection.close()
                return
            self._service.watch(connection, select.EPOLLIN | select.EPOLLRDHUP, lambda: self._greet(connection))

    def _greet(self, connection: socket.socket) -> None:
        """Lets a reader in that has said hello."""
        try:
            data = connection.recv(MESSAGE)
            if not data:
                connection.close()
                return
            wanted = (("topic", str), ("reader", str), ("capacity", int), ("blocks", bool))
            hello = read_greeting(data, wanted)
            if hello["topic"] != self._window.topic:
                raise ValueError(f"it wants topic {hello['topic']!r} here, where {self._window.topic!r} is")
        except BlockingIOError:
            return
        except (OSError, ValueError) as error:
            _log.warning("%s: a reader is turned away: %s", self._window.topic, error)
            with suppress(OSError):
                connection.send(pack_greeting({"refused": str(error)}))
            connection.close()
            return
        most = max(1, min(hello["capacity"], 1 << 16)) + self._config.queue
        reader = Reader(connection, hello["reader"], most, hello["blocks"])
        with self._lock:
            if self._stopped:
                connection.close()
                return
            welcome = {"writer": self._name, "topic": self._window.topic, "memory": self._pool.region.size}
            try:
                socket.send_fds(connection, [pack_greeting(welcome)], [self._pool.fd])
            except OSError:
                connection.close()
                return
            self._counts["connections"] += 1
            for other in tuple(self._readers):
                if other.name == reader.name:  # if it is its life before, it is to be noticed first
                    self._collect(other)
            self._service.watch(connection, select.EPOLLRDHUP, lambda: self._serve(reader))
            self._readers.append(reader)
            reader.kept = self._absent.returns(reader.name)
            if reader.kept is None:
                self._send_history(reader)
            else:
                self._behind.append(reader)
                self._reached.pop(reader.name, None)
                self._catch_up(reader)

    def _send_history(self, reader: Reader) -> None:
        """Sends what a new reader has missed; it triggers, unless it was sent to the reader's life before."""
        snapshot = self._window.snapshot()
        reached = self._reached.pop(reader.name, (-1, -1))
        for index in range(max(0, len(snapshot) - self._config.history), len(snapshot)):
            entry = snapshot.entry(index)
            epoch = self.order.epoch(entry.epoch, entry.version)
            triggers = entry.triggers and (epoch, entry.version) > reached
            self._tell(entry._replace(triggers=triggers), epoch, False, [reader])
        reader.reached = max(reader.reached, reached)

    def _serve(self, reader: Reader) -> None:
        with self._lock:
            self._collect(reader)
            if reader.kept is not None:
                self._catch_up(reader)

    # Readers that were away

    @property
    def _size(self) -> int:
        """What a payload takes, as far as that is known [B]."""
        return max(self._built.size, self._copied.size)

    def _on_lost(self, entry: Entry) -> None:
        self._counts["away"] += 1
        self._window.losses.count(self._window.topic, "link_away", entry.version)

    def _keep_for(self, reader: Reader) -> None:
        """From here on data are kept for a reader that was killed, beginning with what it may not have read."""
        entries = {(entry.epoch, entry.version): (entry, True) for entry in reader.flight}
        for entry, sent in reader.kept.entries if reader.kept is not None else ():
            entries.setdefault((entry.epoch, entry.version), (entry, sent))
        snapshot = self._window.snapshot()
        for index in range(len(snapshot)):
            entry = snapshot.entry(index)
            sent = (self.order.epoch(entry.epoch, entry.version), entry.version) <= reader.reached
            entries.setdefault((entry.epoch, entry.version), (entry, sent))
        self._absent.leaves(reader.name, [entries[order] for order in sorted(entries)])

    def _put_behind(self, entry: Entry) -> None:
        """A commit comes after what readers that catch up are still to be sent."""
        for reader in tuple(self._behind):
            if reader.kept is None:  # it has ended meanwhile
                continue
            most = len(reader.kept.entries) + 1 if reader.blocks else self._absent.most(self._size)
            for lost in reader.kept.add(entry, most):
                self._on_lost(lost)
            self._catch_up(reader)

    def _catch_up(self, reader: Reader) -> None:
        """Sends what was kept for a reader, as far as there is room; one that blocks its producer is waited for."""
        while (kept := reader.kept) is not None and kept.entries:
            if reader.is_full:
                self._collect(reader)
            if reader.ended:
                return
            if not reader.is_full and self._send_kept(reader, *kept.entries[0]):
                kept.entries.popleft()
            elif reader.ended:
                return
            elif reader.blocks and not self._stopped:
                reader.wait(full=reader.is_full)
            else:
                wanted = select.EPOLLOUT if not reader.is_full else 0
                self._service.watch(
                    reader.socket, select.EPOLLIN | select.EPOLLRDHUP | wanted, lambda: self._serve(reader)
                )
                return
        if reader in self._behind:
            self._behind.remove(reader)
            reader.kept = None
            self._service.watch(reader.socket, select.EPOLLRDHUP, lambda: self._serve(reader))

    def _send_kept(self, reader: Reader, entry: Entry, sent: bool) -> bool:
        """Sends a datum again, or late; tells whether it is done with."""
        epoch = self.order.epoch(entry.epoch, entry.version)
        entry = entry._replace(triggers=entry.triggers and not sent)
        encoded = self._encode(entry, epoch, False, [reader])
        if encoded is None:
            return True
        message, slabs, _leases = encoded
        set_number(message, reader.number + 1)
        if not self._try_send(reader, message, slabs):
            return False
        reader.number += 1
        reader.has_sent(entry, epoch, bool(slabs))
        return True

    # Messages

    def _send(self, reader: Reader, message: bytearray, version: int, slabs: Sequence[Slab] = ()) -> bool:
        """Sends an event, if the reader has room; one that blocks its producer is waited for. Tells whether it did."""
        reader.number = number = reader.number + 1
        set_number(message, number)
        while not self._try_send(reader, message, slabs):
            if reader.ended:
                return False
            if not reader.blocks or self._stopped:
                self._counts["slow"] += 1
                self._window.losses.count(self._window.topic, "link_slow", version)
                return False
            reader.wait(full=bool(slabs) and reader.is_full)
        return True

    def _try_send(self, reader: Reader, message: bytearray, slabs: Sequence[Slab]) -> bool:
        if slabs and reader.held >= reader.most:
            self._collect(reader)
            if reader.is_full:
                return False
        try:
            reader.send(message)
        except BlockingIOError:
            self._collect(reader)
            return False
        except OSError:
            self._collect(reader)  # it may have said that it still holds what it has
            if not reader.ended:
                self._drop(reader)
            return False
        self._counts["sent"] += 1
        self._counts["sent_bytes"] += len(message)
        reader.holds(slabs)
        return True

    def _collect_all(self) -> None:
        for reader in (*self._readers, *self._ended):
            self._collect(reader)

    def _collect(self, reader: Reader) -> None:
        """Takes back the slabs that a reader has let go of; all of them where it is gone."""
        while True:
            try:
                data = reader.socket.recv(MESSAGE)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._drop(reader)
                return
            for (offset,) in RELEASE.iter_unpack(data[: len(data) // RELEASE.size * RELEASE.size]):
                if reader.lets_go(offset):  # what it does not hold, it cannot let go of
                    self._pool.release(self._pool.at(offset))
                elif offset == LEAVES:
                    reader.leaves = True
                elif offset == ENDS and not reader.ended:
                    self._end(reader)
                    self._service.watch(reader.socket, select.EPOLLRDHUP, lambda: self._serve(reader))

    def _end(self, reader: Reader) -> None:
        """Sends a reader no more; what it holds stays as it is until it lets go of it."""
        self._readers.remove(reader)
        self._ended.append(reader)
        reader.ended = True
        if not reader.leaves and not self._stopped:
            self._keep_for(reader)
        reader.flight.clear()  # who waits for its socket may know it for longer
        reader.kept = None
        if reader in self._behind:
            self._behind.remove(reader)
        self._reached[reader.name] = max(reader.reached, self._reached.pop(reader.name, reader.reached))
        if len(self._reached) > _NAMES:
            del self._reached[next(iter(self._reached))]
        self._counts["disconnections"] += 1

    def _drop(self, reader: Reader) -> None:
        """Forgets a reader that is gone, and takes back what it held."""
        if reader in self._readers:
            self._end(reader)
        if reader not in self._ended:
            return
        self._ended.remove(reader)
        reader.socket.close()
        for offset in reader.slabs():
            reader.lets_go(offset)
            self._pool.release(self._pool.at(offset))


def _in_first_slab(offset: int, array: np.ndarray) -> tuple[int, int]:
    """Where the one array of a payload lies, as `encode` asks."""
    return 0, offset
