"""The folder of a node at run time: its control socket, its lock, the plans and the logs of its processes."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
from pathlib import Path
from typing import BinaryIO

from ...datamesh.transport import run_folder
from ...errors import ConfigError

__all__ = ["RotatedLog", "RunFolder", "run_base", "running_nodes"]

_LOG_BYTES = 10_000_000
_LOGS = 5
_HANDOVER = "handover"
_SOCKET_BYTES = 100  # a path of a Unix socket has at most 107


def run_base() -> Path:
    """Where the folders of nodes lie: `$WARPLOOM_RUN`, `$XDG_RUNTIME_DIR/warploom`, or `/tmp/warploom-<uid>`."""
    own, runtime = os.environ.get("WARPLOOM_RUN"), os.environ.get("XDG_RUNTIME_DIR")
    return (
        Path(own).absolute()
        if own
        else Path(runtime or "/tmp") / ("warploom" if runtime else f"warploom-{os.getuid()}")
    )


def running_nodes() -> list[str]:
    """The names of the nodes of this user whose supervisor runs."""
    base = run_base()
    return sorted(path.name for path in base.glob("*") if path.is_dir() and RunFolder(path.name).owner() is not None)


class RunFolder:
    """The folder of one node, readable by its owner alone."""

    def __init__(self, node: str) -> None:
        """Names it; nothing is made yet."""
        self.node = node
        self.path = run_base() / node
        self.control = self.path / "control.sock"
        self._lock: BinaryIO | None = None

    def open(self) -> None:
        """Makes the folder and takes its lock: one supervisor per node.

        Raises:
            ConfigError: The node runs already, or the folder cannot be made, or somebody else owns it.
        """
        if len(os.fsencode(self.control)) > _SOCKET_BYTES:
            raise ConfigError(
                f"{self.control}: the path of a socket has at most {_SOCKET_BYTES} bytes: set WARPLOOM_RUN"
            )
        self._make()
        try:
            lock = (self.path / "lock").open("a+b")
        except OSError as error:
            raise self._unusable(error) from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.seek(0)
            pid = lock.read().decode(errors="replace").strip()
            lock.close()
            raise ConfigError(
                f"node {self.node!r} runs already (process {pid}): stop it first, or give this one another name"
            ) from None
        try:
            lock.truncate(0)
            lock.write(str(os.getpid()).encode())
            lock.flush()
        except OSError as error:
            with contextlib.suppress(OSError):  # what could not be written is tried again as it is closed
                lock.close()
            raise self._unusable(error) from error
        self._lock = lock
        self.control.unlink(missing_ok=True)
        self._end_handover()

    def _make(self) -> None:
        made = run_folder(self.node)  # where the links of the node meet, too
        try:
            for folder in (made / "log", made / "plan"):
                folder.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise self._unusable(error) from error

    def _unusable(self, error: OSError) -> ConfigError:
        why = error.strerror or error
        return ConfigError(f"{self.path}: cannot be written: {why}; make room there, or set WARPLOOM_RUN to another")

    def close(self) -> None:
        """Removes the socket and gives the lock back; the logs stay."""
        self.control.unlink(missing_ok=True)
        for plan in (self.path / "plan").glob("*.json"):
            plan.unlink(missing_ok=True)
        self._end_handover()
        if self._lock is not None:
            with contextlib.suppress(OSError):
                self._lock.truncate(0)
            self._lock.close()
            self._lock = None

    def handover(self, process: str) -> Path:
        """Where a process leaves what its next life goes on with; it makes the folder itself."""
        return self.path / _HANDOVER / process

    def _end_handover(self) -> None:
        """Removes what the processes have left: what comes after a supervisor's end may be another node."""
        shutil.rmtree(self.path / _HANDOVER, ignore_errors=True)

    def owner(self) -> int | None:
        """The process that holds the lock; None: nobody does."""
        try:
            with (self.path / "lock").open("rb") as lock:
                try:
                    fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
                except OSError:
                    text = lock.read().decode(errors="replace").strip()
                    return int(text) if text.isdecimal() else 0
        except OSError:
            pass
        return None

    def log(self, process: str) -> Path:
        """Where a process's output goes."""
        return self.path / "log" / f"{process}.log"

    def plan(self, process: str) -> Path:
        """Where a process reads what it is to run."""
        return self.path / "plan" / f"{process}.json"

    def write_plan(self, process: str, text: str) -> None:
        """Leaves there what a process is to run.

        Raises:
            ConfigError: It cannot be written, as on a full disk.
        """
        try:
            self.plan(process).parent.mkdir(mode=0o700, exist_ok=True)
            self.plan(process).write_text(text, encoding="utf-8")
        except OSError as error:
            raise self._unusable(error) from error


class RotatedLog:
    """A file that what a process prints is added to; at 10 MB a new one begins, and five old ones are kept."""

    def __init__(self, path: Path, limit: int = _LOG_BYTES, kept: int = _LOGS) -> None:
        """Opens it, at its end.

        Args:
            path: The file.
            limit: Its size at which a new one begins [bytes].
            kept: How many old ones there are, at most.
        """
        self.path = path
        self.lost = 0
        """Bytes that could not be written."""
        self._limit = limit
        self._kept = kept
        self._file: BinaryIO | None = None

    def write(self, data: bytes) -> None:
        """Adds to it. A disk that is full costs what is written, counted in `lost`, and nothing else."""
        try:
            if self._file is None:
                self._file = self.path.open("ab", buffering=0)
            elif self._file.tell() + len(data) > self._limit:
                self._rotate()
            assert self._file is not None
            self._file.write(data)
        except OSError:
            self.lost += len(data)

    def _rotate(self) -> None:
        self.close()
        for number in range(self._kept, 0, -1):
            older = self.path.with_name(f"{self.path.name}.{number - 1}") if number > 1 else self.path
            if older.exists():
                older.replace(self.path.with_name(f"{self.path.name}.{number}"))
        self._file = self.path.open("ab", buffering=0)

    def close(self) -> None:
        """Closes the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
