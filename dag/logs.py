"""Logging of a process: the standard library's, to the terminal and to a rotated file, repeats limited."""

from __future__ import annotations

import logging
import logging.handlers
import os
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from ..errors import ConfigError

__all__ = ["RepeatLimit", "component_logger", "start_logging", "stop_logging"]

_FORMAT = "%(asctime)s %(levelname)s %(name)s: %(message)s"
_FILE_FORMAT = "%(asctime)s %(levelname)s %(process)d %(threadName)s %(name)s: %(message)s"
_FILE_BYTES = 10_000_000
_FILES = 5
_REMEMBERED = 1024
_NAME = "warploom"  # of our handlers


def component_logger(name: str) -> logging.Logger:
    """The logger of a component: `warploom.component.NAME`; that of a vertex, `component.vertex`, lies below it."""
    return logging.getLogger(f"warploom.component.{name}")


class RepeatLimit(logging.Filter):
    """Lets through so many records of one kind in a period, and says of the next how many were left out.

    Records are of one kind if they come from one logger with one level and one text, whatever the numbers in it.
    """

    def __init__(self, most: int = 5, seconds: float = 10.0, clock: Callable[[], float] = time.monotonic) -> None:
        """Makes the filter, to be added to a handler.

        Args:
            most: Records of a kind that pass in a period.
            seconds: Length of the period.
            clock: By which it is measured.
        """
        super().__init__()
        self._most = most
        self._seconds = seconds
        self._clock = clock
        self._lock = threading.Lock()
        self._kinds: dict[tuple, list[float]] = {}
        """Kind → when its period began, records in it."""

    def filter(self, record: logging.LogRecord) -> bool | logging.LogRecord:
        """Decides; a record that comes after others were left out says so."""
        texts = tuple(one for one in record.args if isinstance(one, str)) if isinstance(record.args, tuple) else ()
        kind = (record.name, record.levelno, str(record.msg), texts)
        now = self._clock()
        with self._lock:
            start, count = self._kinds.pop(kind, (now, 0))
            left_out = 0
            if now - start >= self._seconds:
                left_out, start, count = max(0, int(count) - self._most), now, 0
            self._kinds[kind] = [start, count + 1]
            if len(self._kinds) > _REMEMBERED:
                del self._kinds[next(iter(self._kinds))]
        if count >= self._most:
            return False
        if left_out:
            # A copy: other handlers have counts of their own.
            record = logging.makeLogRecord(record.__dict__)
            record.msg, record.args = f"{record.getMessage()} ({left_out} more of this kind since)", ()
        return record


def start_logging(
    level: str = "warning", folder: str | os.PathLike | None = None, process: str | None = None
) -> Path | None:
    """Sends what is logged to stderr, and into a file where there is a folder; takes back what an earlier call set up.

    Args:
        level: debug, info, warning or error.
        folder: Where the file lies; it is rotated at 10 MB, and five old ones are kept.
        process: Name of the process and so of the file; by default `warploom-` and the number of the process.

    Returns:
        The file.

    Raises:
        ValueError: There is no such level.
        ConfigError: The file cannot be opened.
    """
    number = logging.getLevelNamesMapping().get(level.upper())
    if number is None or level.lower() not in ("debug", "info", "warning", "error"):
        raise ValueError(f"{level!r} is none of debug, info, warning, error")
    root = logging.getLogger()
    stop_logging()
    handlers: list[logging.Handler] = [logging.StreamHandler(sys.stderr)]
    handlers[0].setFormatter(logging.Formatter(_FORMAT))
    path = None
    if folder is not None:
        path = Path(folder) / f"{process or f'warploom-{os.getpid()}'}.log"
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            file = logging.handlers.RotatingFileHandler(
                path, maxBytes=_FILE_BYTES, backupCount=_FILES, encoding="utf-8"
            )
        except OSError as error:
            raise ConfigError(f"{path}: the log cannot be written: {error.strerror or error}") from error
        file.setFormatter(logging.Formatter(_FILE_FORMAT))
        handlers.append(file)
    for handler in handlers:
        handler.set_name(_NAME)
        handler.addFilter(RepeatLimit())
        root.addHandler(handler)
    root.setLevel(number)
    return path


def stop_logging() -> None:
    """Takes back what `start_logging` set up, and closes its file."""
    root = logging.getLogger()
    for handler in [one for one in root.handlers if one.get_name() == _NAME]:
        root.removeHandler(handler)
        handler.close()
