"""The reader's side: a topic of another process of the host in a window of this one.

Arrays are read-only views of the writer's memory. Once the last of a payload is gone, because the window has evicted it
and no snapshot shows it, the writer is told that it may use the slab again.
"""

from __future__ import annotations

import errno
import logging
import os
import select
import socket
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from ...errors import SourceError
from ..messages import decode
from ..policy import CommitPolicy, EqualVersion
from ..snapshot import Entry
from ..window import Window
from .config import SharedMemoryConfig
from .expecting import Aside, Expectation
from .places import connect, peer_of
from .slabs import Region
from .wire import (
    COMMIT,
    ENDS,
    LEAVES,
    MESSAGE,
    RELEASE,
    SETTLE,
    SOON,
    Event,
    new_event,
    pack_greeting,
    read_event,
    read_greeting,
    read_soon,
)

__all__ = ["Importer", "publish"]

_log = logging.getLogger(__name__)

# Members of enums take longer to look up than to compare.
_OVERWRITE, _INSERT_SORTED, _REPLACE = CommitPolicy.OVERWRITE, CommitPolicy.INSERT_SORTED, EqualVersion.REPLACE
_new_entry = partial(tuple.__new__, Entry)
_SOON = bytes((SOON,))
_AT_ONCE = int(socket.MSG_DONTWAIT | socket.MSG_NOSIGNAL)

_DONT_WAIT = int(socket.MSG_DONTWAIT)
_SHORT_NS = 100_000
"""A datum that comes so soon is there before its reader has gone through the last one [ns]."""
_LEAD_NS = 600_000
"""How long before a datum is due to wake by a timer, which takes its time, and to go through the last one [ns]."""
_NAP_NS = 300_000
"""What is shorter is not slept [ns]."""
_WARM_NS = 50_000
"""For how long what was gone through stays in the caches, while the writer fills them with its payload [ns]."""
_SELECTABLE = 1024
"""Descriptors from here on cannot be waited for with a time of less than a millisecond."""

_STOP_S = 5.0
"""How long a component whose backlog blocks may keep the thread that receives."""


class _Connection:
    """A connection to the writer, and its memory."""

    def __init__(self, one: socket.socket, region: Region, writer: str, scratch: Window[Any]) -> None:
        self.socket = one
        self.region = region
        self.writer = writer
        self._waiting: deque[bytes] = deque()
        self._scratch = scratch  # takes in rehearsals what the topic's window takes otherwise
        self._rehearsals = 0
        self.aside = Aside()
        self.busy = False
        """While a datum is being read, it is told afterwards which slabs are no longer needed."""

    def __del__(self) -> None:
        # Whose slabs are let go of one by one after the end of receiving, and with the last of them the socket.
        self.socket.close()

    def rehearse(self, event: Event, value: Any) -> None:
        """Commits to where nobody sees it."""
        self._rehearsals += 1
        again = new_event((*event[:2], 0, self._rehearsals, *event[4:7], True, *event[8:]))  # `_replace` takes longer
        publish(self._scratch, again, value)

    def forget_rehearsals(self) -> None:
        """Lets go of the last of them, which else kept the memory for as long as the garbage collector leaves it."""
        if self._rehearsals:
            self.rehearse(Event(COMMIT, 0, 0, 0, 0, 0), None)

    def end(self, *words: int) -> None:
        """Receives no more; the writer leaves alone what is held."""
        with suppress(OSError):
            one = b"".join(RELEASE.pack(word) for word in words)
            self.socket.send(one, _AT_ONCE)
            self.socket.shutdown(socket.SHUT_RD)

    def let_go(self, offset: int) -> None:
        """Notes that a slab is no longer needed."""
        # Called wherever the last array of a slab ends, in whatever thread: it takes no lock and never waits.
        self._waiting.append(RELEASE.pack(offset))
        if not self.busy:
            self.tell()

    def tell(self) -> None:
        """Tells the writer which slabs are no longer needed."""
        while self._waiting:
            try:
                one = self._waiting.popleft()
            except IndexError:  # another thread was faster
                return
            try:
                self.socket.send(one, _AT_ONCE)
            except OSError as error:
                if error.errno in (errno.EAGAIN, errno.ENOBUFS):  # the next one, or the next datum, tries again
                    self._waiting.append(one)
                return


class Importer:
    """Receives one topic, in a thread of its own, which looks for the producer as long as there is none."""

    def __init__(
        self,
        window: Window[Any],
        *,
        node: str,
        name: str,
        config: SharedMemoryConfig | None = None,
        blocks: bool = False,
        rehearsal: Callable[[], Window[Any]] = lambda: Window("rehearsal", 1),
    ) -> None:
        """Prepares; `start` begins.

        Args:
            window: Of the topic, in this process; nobody else commits to it.
            node: Whose process exports it.
            name: Of this process; the same in its next life.
            config: Sizes.
            blocks: Whether the producer waits where this process is not ready for more.
            rehearsal: Makes a window that takes what the topic's takes, to no effect, and goes a similar way with it.
        """
        self._config = config or SharedMemoryConfig()
        self._window = window
        self._node = node
        self._name = name
        self._blocks = blocks
        self._rehearsal = rehearsal
        self._counts: Counter[str] = Counter()
        self._stopping = threading.Event()
        self._connection: _Connection | None = None
        self._socket: socket.socket | None = None
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._complaint = ""

    def start(self) -> None:
        """Begins to look for the producer, and to receive."""
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name=f"import {self._window.topic}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends receiving. What was received stays."""
        self._stopping.set()
        with self._lock:
            if self._socket is not None:
                with suppress(OSError):
                    if self._connection is not None:
                        self._connection.end(LEAVES, ENDS)
                    else:
                        self._socket.shutdown(socket.SHUT_RDWR)
        if self._thread is not None:
            self._thread.join(_STOP_S)
            if self._thread.is_alive():
                _log.error("%s: who reads it hangs: the thread that receives it is left to itself", self._window.topic)
            self._thread = None

    def counters(self) -> Mapping[str, int]:
        """What was received, and what not."""
        return {**self._counts, "connected": int(self._connection is not None)}

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                connection = self._connect()
            except (OSError, ValueError, SourceError) as error:
                connection = None
                if str(error) != self._complaint:  # once, not at every try
                    _log.warning("%s: %s", self._window.topic, error)
                    self._complaint = str(error)
            if connection is None:
                self._stopping.wait(self._config.retry_ms / 1e3)
                continue
            self._complaint = ""
            self._counts["connections"] += 1
            gone = True
            try:
                gone = self._receive(connection)
            finally:
                with self._lock:
                    self._connection = self._socket = None
                    if gone:
                        connection.socket.close()
                connection.forget_rehearsals()
                del connection

    def _connect(self) -> _Connection | None:
        one = connect(self._node, self._window.topic)
        if one is None:
            return None
        with self._lock:
            if self._stopping.is_set():
                one.close()
                return None
            self._socket = one
        try:
            if peer_of(one)[1] != os.getuid():
                raise SourceError(
                    f"topic {self._window.topic!r} is exported by another user, whom this one must not trust"
                )
            hello = {
                "topic": self._window.topic,
                "reader": self._name,
                "capacity": 2 * self._window.capacity,  # of the epoch before too, until the new one has filled it
                "blocks": self._blocks,
            }
            one.send(pack_greeting(hello))
            data, fds, _, _ = socket.recv_fds(one, MESSAGE, 1, socket.MSG_CMSG_CLOEXEC)
            try:
                connection = self._welcomed(one, data, fds)
            finally:
                for fd in fds:
                    os.close(fd)
            one.settimeout(None)
            self._connection = connection
            return connection
        except BaseException as error:
            with self._lock:
                self._socket = None
                one.close()
            if self._stopping.is_set() or isinstance(error, ConnectionError):  # it is gone again
                return None
            if isinstance(error, TimeoutError):
                raise SourceError(f"the process that exports {self._window.topic!r} does not answer") from None
            raise

    def _welcomed(self, one: socket.socket, data: bytes, fds: list[int]) -> _Connection | None:
        if not data:  # it ended just now
            raise SourceError(f"the process that exports {self._window.topic!r} is gone again")
        welcome = read_greeting(data, ())
        if "refused" in welcome:
            raise SourceError(f"the process that exports {self._window.topic!r} refuses: {welcome['refused']}")
        welcome = read_greeting(data, (("writer", str), ("topic", str), ("memory", int)))
        if len(fds) != 1:
            raise SourceError(f"the process that exports {self._window.topic!r} sent no memory")
        return _Connection(one, Region(fds[0], welcome["memory"], writable=False), welcome["writer"], self._rehearsal())

    def _receive(self, connection: _Connection) -> bool:
        """Receives until the writer or this reader ends; tells whether it is the writer that is gone."""
        try:
            return self._receive_all(connection)
        finally:
            connection.aside.end()
            self._window.put_off(False)

    def _receive_all(self, connection: _Connection) -> bool:
        number, last, came = 0, b"", None
        window, receive, memory = self._window, connection.socket.recv, connection.region.size
        expectation = Expectation(round(self._config.spin_us * 1e3), self._config.spin_share)
        flags, more, aside = 0, False, connection.aside
        while True:
            try:
                if not flags and expectation.is_worth_it:
                    aside.begin()
                data = receive(MESSAGE, flags)
                while data[:1] == _SOON and not more:
                    if came is not None:  # the one before was abandoned
                        expectation.came(*came)
                    data, came = _expect(connection, data, expectation.allowed, last)
            except BlockingIOError:  # all that had come is in the window
                if more:
                    more = False
                    window.put_off(False)
                else:
                    flags = 0
                continue
            except OSError:
                data = b""
            aside.end()
            if not data:
                return not self._stopping.is_set()
            if flags and not more:  # it had come while a component ran in this thread: there may be more behind it
                more = True
                window.put_off(True)
            flags = _DONT_WAIT
            try:
                event = read_event(data, memory)
            except ValueError as error:
                # The numbers of what comes next cannot be trusted either: both ends begin anew.
                self._damaged(0, error)
                connection.end(ENDS)
                return False
            if event.kind == SOON:
                continue
            missing, number = event.number - number - 1, event.number
            if missing > 0:
                self._counts["missed"] += missing
                window.losses.count(window.topic, "link_missed", event.version, missing)
            if event.kind == SETTLE:
                window.settle(event.version, event.epoch)
            elif self._take(connection, event):
                last = data
            else:
                continue
            self._counts["received"] += 1
            self._counts["received_bytes"] += len(data)
            if came is not None:
                expectation.came(*came)
                came = None

    def _take(self, connection: _Connection, event: Event) -> bool:
        """Publishes a commit; tells whether it could be read."""
        connection.busy = True
        try:
            value = _value(connection.region, event, connection.let_go)
            publish(self._window, event, value)
            del value
        except ValueError as error:
            self._damaged(event.version, error)
            return False
        finally:
            connection.busy = False
            connection.tell()
        return True

    def _damaged(self, version: int, error: ValueError) -> None:
        if not self._counts["damaged"]:
            _log.error("%s: version %d cannot be read: %s", self._window.topic, version, error)
        self._counts["damaged"] += 1
        self._window.losses.count(self._window.topic, "link_damaged", version)


def _value(region: Region, event: Event, let_go: Callable[[int], None]) -> Any:
    """The payload of a commit: arrays are views of the writer's memory.

    Raises:
        ValueError: It is damaged, or of a type that is not registered.
    """
    lease, memories = region.lease, []
    for offset, size in event.slabs:  # a comprehension would be one more call
        memories.append(lease(offset, size, offset, let_go))
    body = memories[-1][: event.body_size].tobytes() if event.body_size else event.body
    return decode(body, memories)


def _expect(connection: _Connection, word: bytes, allowed: int, last: bytes) -> tuple[bytes, tuple[int, bool]]:
    """Receives what was announced just now, and is ready for it when it comes.

    After a pause, what it takes is no longer in the processor's caches, and a core that sleeps takes long to wake: so
    it sleeps until shortly before the datum is due, goes through the last one once more, and stays awake from there,
    going through it again now and then.

    Args:
        connection: Where it comes.
        word: The announcement.
        allowed: For how long to stay awake [ns].
        last: The last commit.

    Returns:
        The message, and for how long it stayed awake, and whether in vain, as `Expectation.came` takes it.
    """
    now = time.perf_counter_ns
    one = connection.socket
    receive = one.recv
    core, soon, late = read_soon(word)
    if allowed <= 0:
        if soon - now() >= _SHORT_NS and last:
            _rehearse(connection, last)
        return receive(MESSAGE), (0, False)
    aside = connection.aside
    aside.avoid(core)
    nap = soon - now() - _LEAD_NS
    if nap > _NAP_NS and one.fileno() < _SELECTABLE:
        select.select((one,), (), (), nap / 1e9)
    aside.end()  # it is not woken by a socket from here on, and when the datum is there every call counts
    if last:
        _rehearse(connection, last)
    here = awake = now()
    again, until = here + _WARM_NS, min(late, here + allowed)
    while here < until:
        try:
            data = receive(MESSAGE, _DONT_WAIT)
        except BlockingIOError:
            if (here := now()) > again and last:
                _rehearse(connection, last)
                here, begun = now(), here
                again = here + max(_WARM_NS, 2 * (here - begun))  # a datum may come meanwhile: at most a third of it
            continue
        return data, (here - awake, False)
    return receive(MESSAGE), (here - awake, here > awake)


def _rehearse(connection: _Connection, data: bytes) -> None:
    """Does with the last commit what is to be done with the next, to no effect."""
    event = read_event(data, connection.region.size)
    if not event.body_size:
        try:
            connection.rehearse(event, _value(connection.region, event, _let_go_of_nothing))
        except ValueError:  # the memory holds something else by now
            return


def _let_go_of_nothing(offset: int) -> None:
    """In place of telling the writer."""


def publish(window: Window[Any], event: Event, value: Any) -> None:
    """Commits what another process has committed, to the same effect.

    Args:
        window: Of the topic.
        event: The commit there.
        value: Its payload.
    """
    _, _, epoch, version, received, committed, triggers, newest, _, _, _ = event
    entry = _new_entry((version, value, received, committed, epoch, triggers, None, None))
    if newest:
        window.commit(_OVERWRITE, entry, _REPLACE)
        return
    there = window.find(version, epoch)
    if there is None or there.committed_ns != committed:  # else it is sent again, after the connection was lost
        window.commit(_INSERT_SORTED, entry, _REPLACE, triggers)
