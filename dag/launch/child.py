"""A process of a node, from within: builds, says that it is ready, runs when told, gives signs of life, stops cleanly.

What it sends are lines of JSON with a key `report`: `building`, `ready`, `running`, `beat`, `stopped`, `failed`,
`answer`. What it is sent has a key `do`: `start`, `stop`, `export`.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import logging
import os
import queue
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from ...errors import WarploomError
from .channel import Channel
from .schema import ProcessSpec

if TYPE_CHECKING:
    from ..process import Process
    from .health import ProcessObserver

__all__ = ["CONFIGURATION", "Child", "ProcessLinks", "die_with", "end_at_once", "show_name"]

CONFIGURATION = 2
"""The exit code of a process whose configuration is bad: to start it again would not help."""

_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
_WATCHDOG_EXTRA_S = 5.0

_log = logging.getLogger(__name__)


class ProcessLinks(Protocol):
    """What connects a process with the others of its node; see `linking.Links`."""

    def start(self) -> None:
        """Connects."""
        ...

    def stop_imports(self) -> None:
        """Receives no more; what has arrived is in the mesh."""
        ...

    def stop(self) -> None:
        """Disconnects, with nothing left behind."""
        ...

    def export(self, topic: str) -> None:
        """Makes a topic readable for other processes, from now on."""
        ...

    def counters(self) -> Mapping[str, Mapping[str, int]]:
        """What was sent, received and lost, by topic."""
        ...


def die_with(parent: int) -> None:
    """Lets this process be told to stop when its parent is gone, however that ended.

    Args:
        parent: The parent's process id; a parent that is gone already ends this process here.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent:
        os._exit(0)


def show_name(name: str) -> None:
    """Sets the name that the system shows for this process: its first 15 bytes."""
    if sys.platform == "linux":
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_NAME, name.encode()[:15] + b"\0", 0, 0, 0)


def end_at_once(code: int) -> NoReturn:
    """Ends this process with what it has told written, and waits for none of its threads.

    A thread that hangs in native code would keep the interpreter from its end: one that is not a daemon, one that
    never gives the interpreter back, or one that a library waits for as it is unloaded. The components have been
    stopped by now: what they record is closed.
    """
    logging.shutdown()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError, AttributeError):  # closed, or nobody reads it
            stream.flush()
    os._exit(code)


class Child:
    """Runs one process under its supervisor."""

    def __init__(self, channel: Channel, spec: ProcessSpec) -> None:
        """Begins to listen; the signals of this process are its own from here on.

        Args:
            channel: To the supervisor.
            spec: The process, as the launch file says.
        """
        self._channel = channel
        self._spec = spec
        self._orders: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._links: ProcessLinks | None = None
        self._building = False
        self._beating = threading.Event()
        # An interrupt on the terminal is the supervisor's affair: it stops all processes in their order.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, self._terminate)
        # In C, so that it also answers where Python does not come to its turn.
        faulthandler.register(signal.SIGUSR1, all_threads=True)
        channel.receive(self._obey, lambda: self._orders.put("stop"))

    def _terminate(self, *_: object) -> None:
        if self._building:  # nothing runs yet: there is nothing to stop, and to build may take long
            raise SystemExit(0)
        self._orders.put("stop")

    def _obey(self, order: dict[str, Any]) -> None:
        if order.get("do") == "export":
            self._channel.send({"report": "answer", "id": order.get("id"), **self._export(order.get("topic", ""))})
        else:
            self._orders.put(str(order.get("do")))

    def _export(self, topic: str) -> dict[str, Any]:
        if self._links is None:
            return {"error": "the process is not running yet"}
        try:
            self._links.export(topic)
        except Exception as error:
            _log.exception("topic %s cannot be exported", topic)
            return {"error": f"{type(error).__name__}: {error}"}
        return {"ok": True}

    def run(self, build: Callable[[], tuple[Process, ProcessLinks, Sequence[str]]]) -> int:
        """Builds the process, runs it from the order to start to the order to stop.

        Args:
            build: Makes the process and its links, neither started, and names the topics that it exports.

        Returns:
            The exit code: 0 after a stop, `CONFIGURATION` where what was to be built is wrong, 1 where it broke.
        """
        self._channel.send({"report": "building"})
        try:
            self._building = True
            process, links, exports = build()
            self._building = False
        except SystemExit:
            return 0
        except WarploomError as error:
            self._channel.send({"report": "failed", "error": str(error)})
            return CONFIGURATION
        except BaseException as error:
            traceback.print_exc()
            self._channel.send({"report": "broke", "error": f"{type(error).__name__}: {error}"})
            return 1
        from .health import ProcessObserver, beat_period

        observer = ProcessObserver(
            process,
            hang_s=self._spec.health_timeout_s,
            first_s=self._spec.start_timeout_s,
            counters=links.counters,
        )
        self._channel.send({"report": "ready", "components": observer.description()})
        if self._orders.get() != "start":
            return 0
        try:
            for topic in exports:  # nothing that the process commits is missed
                links.export(topic)
            process.start()
            links.start()  # the imports: what comes finds who reads it
        except BaseException as error:
            traceback.print_exc()
            self._channel.send({"report": "broke", "error": f"{type(error).__name__}: {error}"})
            with contextlib.suppress(Exception):
                process.stop()
                links.stop()
            return 1
        self._links = links
        self._channel.send({"report": "running", **_told(observer)})
        beats = threading.Thread(
            target=self._beat, args=(observer, beat_period(self._spec.health_timeout_s)), daemon=True
        )
        beats.name = "signs of life"
        beats.start()
        while self._orders.get() != "stop":
            pass
        self._stop(process, links)
        self._channel.send({"report": "stopped", **_told(observer)})
        return 0

    def _beat(self, observer: Any, period_s: float) -> None:
        while not self._beating.wait(period_s):
            self._guard(self._spec.health_timeout_s)
            if not self._channel.send({"report": "beat", **_told(observer)}):
                return

    def _guard(self, seconds: float | None) -> None:
        """Ends this process if it hangs from here on: where even its supervisor is gone, nobody else would."""
        if seconds is not None:
            faulthandler.dump_traceback_later(seconds + self._spec.stop_timeout_s + _WATCHDOG_EXTRA_S, exit=True)

    def _stop(self, process: Process, links: ProcessLinks) -> None:
        """Stops the components, which flush what they record; what hangs in it does not keep the process."""
        self._beating.set()
        faulthandler.dump_traceback_later(self._spec.stop_timeout_s + _WATCHDOG_EXTRA_S, exit=True)
        links.stop_imports()
        process.stop()
        links.stop()


def _told(observer: ProcessObserver) -> dict[str, Any]:
    """A sign of life; what cannot be told does not make the process sick."""
    try:
        return observer.beat()
    except Exception:
        _log.exception("the state of the process cannot be told")
        return {"hanging": []}
