"""The control plane of a node: requests and answers as lines of JSON over its Unix socket.

    → {"id": 1, "request": "ps"}
    ← {"id": 1, "ok": true, "result": {…}}
    ← {"id": 2, "ok": false, "error": "no process 'lidra'; did you mean 'lidar'? …", "asked_wrong": true}

After `{"request": "watch"}` every event follows as a line `{"event": …}`, until the connection is closed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import select
import socket
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any

from ...errors import ConfigError, WarploomError
from ..configuration import nearest
from .channel import LINE_BYTES, pack_line
from .run_folder import RunFolder, run_base, running_nodes

__all__ = ["Answers", "ControlClient", "ControlServer", "connect"]

_REQUEST_BYTES = 65_536
_BEHIND_BYTES = 1_000_000
"""What may wait for a client that does not read, before it is cut off."""

Answers = Mapping[str, Callable[[Mapping[str, Any]], Awaitable[Any]]]


class ControlServer:
    """Answers requests; in the event loop of the supervisor."""

    def __init__(self, path: Path, answers: Answers) -> None:
        """Names the socket.

        Args:
            path: Where it lies.
            answers: What there is to ask, by name; each takes the request and gives plain values, or raises
                WarploomError, ConnectionError or TimeoutError, which is told to who asked.
        """
        self._path = path
        self._answers = answers
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.StreamWriter] = set()
        self._watching: set[asyncio.StreamWriter] = set()

    async def open(self) -> None:
        """Listens.

        Raises:
            ConfigError: The socket cannot be made.
        """
        before = os.umask(0o177)
        try:
            self._server = await asyncio.start_unix_server(self._serve, self._path, limit=_REQUEST_BYTES)
        except OSError as error:
            raise ConfigError(f"{self._path}: the control socket cannot be made: {error.strerror or error}") from error
        finally:
            os.umask(before)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._clients.add(writer)
        try:
            while line := await reader.readline():
                answer = await self._answer(line, writer)
                writer.write(pack_line(answer))
                await writer.drain()
        except (OSError, ValueError, asyncio.LimitOverrunError):
            pass  # a client that went away, or that sends no lines
        finally:
            self._clients.discard(writer)
            self._watching.discard(writer)
            writer.close()

    async def _answer(self, line: bytes, writer: asyncio.StreamWriter) -> dict[str, Any]:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError) as error:
            return {"id": None, "ok": False, "error": f"not a line of JSON: {error}"}
        if not isinstance(request, dict) or not isinstance(request.get("request"), str):
            return {"id": None, "ok": False, "error": 'expected an object with a key "request"'}
        number, name = request.get("id"), request["request"]
        if name == "watch":
            self._watching.add(writer)
            return {"id": number, "ok": True, "result": {}}
        if name not in self._answers:
            return {
                "id": number,
                "ok": False,
                "error": f"no request {name!r}; {nearest(name, (*self._answers, 'watch'))}",
            }
        try:
            return {"id": number, "ok": True, "result": await self._answers[name](request)}
        except TimeoutError:
            return {"id": number, "ok": False, "error": "the process gave no answer in time"}
        except ConfigError as error:
            return {"id": number, "ok": False, "error": str(error), "asked_wrong": True}
        except (WarploomError, ConnectionError) as error:
            return {"id": number, "ok": False, "error": str(error)}

    def tell(self, event: Mapping[str, Any]) -> None:
        """Sends an event to all who watch; who does not read is cut off."""
        for writer in tuple(self._watching):
            if writer.is_closing() or writer.transport.get_write_buffer_size() > _BEHIND_BYTES:
                self._watching.discard(writer)
                writer.transport.abort()
            else:
                writer.write(pack_line(event))

    async def close(self) -> None:
        """Listens no more, and ends all connections."""
        if self._server is None:
            return
        self._server.close()
        for writer in tuple(self._clients):
            with contextlib.suppress(OSError):
                writer.close()
        # From Python 3.12 on this waits for the connections too; they are closed.
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(self._server.wait_closed(), 1.0)


class ControlClient:
    """Asks the supervisor of a node; for commands and tools."""

    def __init__(self, path: Path, timeout_s: float = 10.0) -> None:
        """Connects.

        Args:
            path: The control socket.
            timeout_s: How long an answer may take [s].

        Raises:
            ConfigError: Nobody listens there.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise ConfigError(f"{path}: no supervisor answers there: {error.strerror or error}") from error
        self._lines = self._socket.makefile("rb")
        self._number = 0

    def ask(self, request: str, **arguments: Any) -> Any:
        """One request and its answer.

        Raises:
            ConfigError: There is nothing of the name that was asked for.
            WarploomError: It failed, or nobody answers any more.
        """
        self._number += 1
        try:
            self._socket.sendall(pack_line({"id": self._number, "request": request, **arguments}))
            while line := self._lines.readline(LINE_BYTES):
                answer = json.loads(line)
                if "event" in answer:
                    continue
                if not answer.get("ok"):
                    kind = ConfigError if answer.get("asked_wrong") else WarploomError
                    raise kind(str(answer.get("error")))
                return answer.get("result")
        except (BrokenPipeError, ConnectionResetError):
            pass
        except (OSError, ValueError) as error:
            raise WarploomError(f"the supervisor does not answer: {error}") from error
        raise WarploomError("the supervisor has ended")

    @property
    def ended(self) -> bool:
        """Whether the supervisor has gone away."""
        try:
            readable, _, _ = select.select([self._socket], [], [], 0.0)
            return bool(readable) and not self._socket.recv(1, socket.MSG_PEEK)
        except OSError:
            return True

    def close(self) -> None:
        """Ends the connection."""
        self._lines.close()
        self._socket.close()

    def __enter__(self) -> ControlClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def connect(node: str | None = None) -> tuple[str, ControlClient]:
    """The node that is meant, and a connection to it.

    Args:
        node: Its name; None: the only one that runs.

    Raises:
        ConfigError: It does not run, or there are several; the message says which do.
    """
    base = run_base()
    if base.exists() and not os.access(base, os.R_OK | os.X_OK):
        raise ConfigError(f"{base}: is not readable for this user: ask as the user who runs the node, or as root")
    running = running_nodes()
    if node is None:
        if len(running) != 1:
            if running:
                raise ConfigError(f"several nodes run: {', '.join(running)}; say which with --node")
            raise ConfigError(
                f"no node runs: none is in {base}, where $WARPLOOM_RUN or $XDG_RUNTIME_DIR says; "
                "`warploom launch` starts one"
            )
        node = running[0]
    elif node not in running:
        raise ConfigError(f"node {node!r} does not run; {nearest(node, running)}")
    return node, ControlClient(RunFolder(node).control)
