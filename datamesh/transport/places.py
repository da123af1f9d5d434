"""Where the links of a node meet: a folder of its user's own, with a socket for each topic that is exported.

    <run folder>/links/<topic>.socket   listens while the producer lives
    <run folder>/links/<topic>.order    epoch and newest version of what was sent, for the producer's next life

Memory has no name (`slabs`), so these are all that a killed process leaves behind; `reap` removes them.
"""

from __future__ import annotations

import fcntl
import logging
import mmap
import os
import socket
import stat
import struct
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import quote, unquote

from ...errors import ConfigError

__all__ = [
    "OrderFile",
    "connect",
    "exported_topics",
    "keep_from_children",
    "listen",
    "peer_of",
    "reap",
    "run_folder",
    "unlisten",
]

_log = logging.getLogger(__name__)

_sockets: weakref.WeakSet[socket.socket] = weakref.WeakSet()


def keep_from_children(one: socket.socket) -> None:
    """Closes a socket in children that are forked, in whose hands it would outlive this process."""
    _sockets.add(one)


def _close_inherited() -> None:
    for one in list(_sockets):
        one.close()


os.register_at_fork(after_in_child=_close_inherited)

_ANSWER_S = 2.0
"""How long a process that listens may take to answer."""
_LOCK_S = 10.0
"""How long another process may bind or remove sockets, which takes milliseconds."""
_CREDENTIALS = struct.Struct("3i")
_ORDER = struct.Struct("<QQ")
_MAGIC = b"warploom"


def run_folder(node: str) -> Path:
    """The folder of a node's runtime files; made where there is none, for its user alone.

    `$WARPLOOM_RUN/<node>`, else `$XDG_RUNTIME_DIR/warploom/<node>`, else `/tmp/warploom-<uid>/<node>`.

    Raises:
        ConfigError: It cannot be made, or belongs to somebody else; or the name is none of a folder.
    """
    if not node or node in (".", "..") or "/" in node or "\0" in node:
        raise ConfigError(f"{node!r} cannot be the name of a node: it becomes the name of a folder")
    own, runtime = os.environ.get("WARPLOOM_RUN"), os.environ.get("XDG_RUNTIME_DIR")
    base = (
        Path(own).absolute() if own else Path(runtime or "/tmp", "warploom" if runtime else f"warploom-{os.getuid()}")
    )
    folder = base / node
    try:
        for one in (base, folder):
            one.mkdir(mode=0o700, parents=True, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be made: {error.strerror or error}; set WARPLOOM_RUN") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or base.stat().st_uid != os.getuid():
        raise ConfigError(f"{folder}: is not a folder of this user alone; set WARPLOOM_RUN to another")
    return folder


def _links(node: str) -> Path:
    folder = run_folder(node) / "links"
    folder.mkdir(mode=0o700, exist_ok=True)
    return folder


def _path(node: str, topic: str, kind: str) -> Path:
    name = quote(topic, safe="/").replace("/", "+")  # a + of the topic is quoted
    if not topic or len(name) > 80:  # with "/proc/self/fd/999/" and ".socket" it is an address
        raise ConfigError(f"topic {topic!r} cannot be exported: its name becomes that of a file of 1 to 80 bytes")
    return _links(node) / f"{name}.{kind}"


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Keeps others from binding and removing sockets. The kernel ends it with the process.

    Raises:
        TimeoutError: Another process has done so for long.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    end = time.monotonic() + _LOCK_S
    try:
        while True:
            try:
                fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    raise TimeoutError(f"{folder}: is locked by another process, which hangs") from None
                time.sleep(0.002)
        try:
            yield
        finally:
            fcntl.flock(fd, fcntl.LOCK_UN)  # closing it would leave it to children that were forked meanwhile
    finally:
        os.close(fd)


@contextmanager
def _address(path: Path) -> Iterator[str]:
    """The address of a socket; a long path by way of its folder, as addresses have at most 107 bytes."""
    if len(os.fsencode(path)) <= 100:
        yield os.fspath(path)
        return
    fd = os.open(path.parent, os.O_PATH | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{fd}/{path.name}"
    finally:
        os.close(fd)


def connect(node: str, topic: str) -> socket.socket | None:
    """A connection to who exports a topic; None where nobody does.

    Raises:
        OSError: Somebody does, and does not answer.
    """
    return _connected(_path(node, topic, "socket"))


def _connected(path: Path) -> socket.socket | None:
    """A connection; None where no process listens. Raises OSError where one does, and does not answer."""
    one = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    keep_from_children(one)
    one.settimeout(_ANSWER_S)
    try:
        with _address(path) as address:
            one.connect(address)
    except (FileNotFoundError, ConnectionRefusedError):
        one.close()
        return None
    except BaseException:
        one.close()
        raise
    return one


def listen(node: str, topic: str) -> socket.socket:
    """The socket at which readers of a topic connect. It takes the place of one whose process is dead.

    Raises:
        ConfigError: A process that lives exports the topic, or hangs while it begins to export one.
    """
    path = _path(node, topic, "socket")
    try:
        with _locked(path.parent):
            return _bound(path, f"topic {topic!r} of node {node!r}")
    except TimeoutError as error:
        raise ConfigError(str(error)) from error


def _bound(path: Path, topic: str) -> socket.socket:
    try:
        other = _connected(path)
    except OSError as error:
        raise ConfigError(f"{topic} is exported already, by a process that hangs") from error
    if other is not None:
        pid = peer_of(other)[0]
        other.close()
        raise ConfigError(f"{topic} is exported already, by process {pid}")
    one = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    keep_from_children(one)
    try:
        path.unlink(missing_ok=True)
        with _address(path) as address:
            one.bind(address)
        one.listen(64)
        one.setblocking(False)
    except BaseException:
        one.close()
        raise
    return one


def unlisten(node: str, topic: str) -> None:
    """Removes the socket's file."""
    with suppress(FileNotFoundError):
        _path(node, topic, "socket").unlink()


def peer_of(connection: socket.socket) -> tuple[int, int]:
    """Process and user at the other end, as the kernel says."""
    raw = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    pid, user, _ = _CREDENTIALS.unpack(raw)
    return pid, user


def exported_topics(node: str) -> list[str]:
    """The topics that a live process exports, sorted."""
    return sorted(unquote(path.stem.replace("+", "/")) for path in _links(node).glob("*.socket") if _is_alive(path))


def _is_alive(path: Path) -> bool:
    try:
        one = _connected(path)
    except OSError:
        return True
    if one is not None:
        one.close()
    return one is not None


def reap(node: str, *, orders: bool = True) -> list[str]:
    """Removes what dead processes of a node left behind, and names what it removed.

    Sockets whose process is gone; and where no process of the node exports anything any more, the orders of its topics.
    Memory needs no reaping: it has no name, and goes with the last process that maps it.

    Args:
        node: Which one.
        orders: Whether the orders may go. Before a process of a node that runs is started again they must stay: it is
            to go on where it was, or in a new epoch.

    Raises:
        TimeoutError: Another process of the node hangs while it begins to export.
    """
    folder = _links(node)
    with _locked(folder):  # what is dead is removed, and not what has taken its place
        sockets = sorted(folder.glob("*.socket"))
        removed = [path for path in sockets if not _is_alive(path)]
        if orders and len(removed) == len(sockets):
            removed += sorted(folder.glob("*.order"))
        for path in removed:
            path.unlink(missing_ok=True)
    return [os.fspath(path) for path in removed]


class OrderFile:
    """What a topic's order had reached, in a file that the kernel keeps when the process that writes it is killed.

    A producer that comes back goes on in the same epoch where its versions go on, so that what it commits still fits
    the data of others; where they begin anew, and would be out of order, a new epoch begins.
    """

    def __init__(self, node: str, topic: str) -> None:
        """Reads what the life before has left."""
        path = _path(node, topic, "order")
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            size = len(_MAGIC) + _ORDER.size
            if os.fstat(fd).st_size != size:
                os.ftruncate(fd, 0)
            try:
                os.posix_fallocate(fd, 0, size)  # a hole that no disk has room for would end the process by SIGBUS
                self._map = mmap.mmap(fd, size)
            except OSError as error:
                _log.warning("%s: %s; the order of %r is forgotten if this process dies", path, error.strerror, topic)
                self._map = mmap.mmap(-1, size)
        finally:
            os.close(fd)
        known = self._map[: len(_MAGIC)] == _MAGIC
        self._before: tuple[int, int] | None = _ORDER.unpack_from(self._map, len(_MAGIC)) if known else None
        self._offset: int | None = None
        self._reached = (-1, -1)

    def epoch(self, epoch: int, version: int) -> int:
        """The epoch under which others see an epoch of this process's window, and notes the version there."""
        if self._offset is None:
            self._offset = self._decide(epoch, version)
        epoch += self._offset
        if (epoch, version) > self._reached:
            if self._reached[0] < 0:
                self._map[: len(_MAGIC)] = _MAGIC
            self._reached = (epoch, version)
            _ORDER.pack_into(self._map, len(_MAGIC), epoch, version)
        return epoch

    def settled(self, epoch: int, version: int) -> int | None:
        """The same for a settled version; None where the life before had reached it, and it is no news."""
        if self._offset is not None:
            return epoch + self._offset
        return epoch if self._before is None or (epoch, version) > self._before else None

    def _decide(self, epoch: int, version: int) -> int:
        if self._before is None or (epoch, version) > self._before:
            return 0
        before, newest = self._before
        return before - epoch if version > newest else before + 1 - epoch

    def close(self) -> None:
        """Lets go of the file."""
        self._map.close()
