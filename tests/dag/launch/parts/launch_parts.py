"""Components for the tests of the launcher; none needs Warp."""

import atexit
import os
import threading
import time

import numpy as np

from warploom.dag import DataProcessComponent
from warploom.dag.processor import ProcessorConfig
from warploom.datamesh import CommitPolicy, Input, Output, Status


class TickerConfig(ProcessorConfig):
    size: int = 16
    hang_after: int = 0
    journal: str = ""
    counts: bool = False  # versions count from 1 in each life, and are no times


class Ticker(DataProcessComponent):
    """Commits an array at every tick; its first number counts on from life to life if it has a journal."""

    Config = TickerConfig
    out: Output[np.ndarray]

    def init(self, config):
        self._config = config
        self._count = 0

    def process(self, trigger):
        self._count += 1
        if self._config.hang_after and self._count > self._config.hang_after:
            threading.Event().wait()
        with self.out.allocate_change() as change:
            change.set_version(self._count if self._config.counts else trigger.version)
            change.value = np.full(self._config.size, self._count, np.int64)
            self.out.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        if self._config.journal:
            note(self._config.journal, trigger.version)
        return Status.OK


class DoublerConfig(ProcessorConfig):
    journal: str = ""
    slow_s: float = 0.0


class Doubler(DataProcessComponent):
    """Gives on what it takes, doubled."""

    Config = DoublerConfig
    sent: Input[np.ndarray]
    out: Output[np.ndarray]

    def init(self, config):
        self._config = config

    def process(self, trigger):
        if self._config.slow_s:
            time.sleep(self._config.slow_s)
        with self.sent.access(trigger.epoch) as snapshot:
            value = snapshot[snapshot.version_index(trigger.version)]
        with self.out.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = value * 2
            self.out.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
        if self._config.journal:
            note(self._config.journal, trigger.version)
        return Status.OK


class WriterConfig(ProcessorConfig):
    path: str


class Writer(DataProcessComponent):
    """Writes the version of all that it takes into a file, unbuffered."""

    Config = WriterConfig
    sent: Input[np.ndarray]

    def init(self, config):
        self._path = config.path

    def process(self, trigger):
        note(self._path, trigger.version)
        return Status.OK


def note(path, version):
    fd = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
    try:
        os.write(fd, b"%d\n" % version)
    finally:
        os.close(fd)


class Plain:
    """A plain class that says what it does, and notes its start and stop."""

    def __init__(self, path="", idle="", starting="", start_fails=False, dies="", ignores_stop=False):
        self._path, self._start_fails, self._dies, self._ignores_stop = path, start_fails, dies, ignores_stop
        self.idle_because, self.starting_because = idle or None, starting or None
        if dies == "build":
            os._exit(9)
        if dies == "stubborn build":
            time.sleep(60)

    def state(self):
        return {"answer": 42}

    def _note(self, what):
        if self._path:
            with open(self._path, "a", encoding="utf-8") as file:
                file.write(f"{what} {os.getpid()}\n")

    def start(self):
        self._note("start")
        if self._start_fails:
            raise RuntimeError("the sensor does not answer")
        if self._dies == "start":
            print("about to die", flush=True)
            os._exit(7)
        if self._dies == "later":
            threading.Timer(0.3, lambda: os._exit(7)).start()
        if self._dies == "holding the interpreter":
            threading.Timer(0.3, hold_the_interpreter).start()
        if self._dies == "daemon in native code":
            threading.Thread(target=in_native_code, daemon=True).start()
        if self._dies == "thread in native code":
            threading.Thread(target=in_native_code).start()
        if self._dies == "library that waits as it ends":
            atexit.register(in_native_code)

    def stop(self):
        if self._ignores_stop:
            time.sleep(60)
        self._note("stop")


def in_native_code():
    """Is for a minute where no signal and no flag reaches it; the interpreter is given back."""
    import ctypes

    begin = time.monotonic()
    while time.monotonic() < begin + 60:
        ctypes.CDLL(None).sleep(60)


def hold_the_interpreter():
    """Hangs as C code does that never gives the interpreter back."""
    import ctypes

    ctypes.PyDLL(None).sleep(600)
