"""What a component leaves for its next life: values in a file of the node, for when its process is killed."""

from __future__ import annotations

import contextlib
import logging
import mmap
import os
import urllib.parse
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from ...datamesh.messages import Decoder, encode

__all__ = ["Handover"]

_log = logging.getLogger(__name__)


class Handover:
    """A file of one component, from one life of its process to the next.

    Where it cannot be written or read, the next life makes anew what it needs, as the first one did.
    """

    def __init__(self, folder: Path | None, name: str, origin: str) -> None:
        """Names it; nothing is opened.

        Args:
            folder: Of the process; None: it has none, and nothing is left.
            name: Of the component.
            origin: What the values are made of: they are only taken where the next life would make them of the same.
        """
        self._path = None if folder is None else folder / urllib.parse.quote(name, safe="")
        self._origin = origin

    def leave(self, values: Iterable[Any]) -> None:
        """Leaves values, each anything that `datamesh.messages.encode` takes, in the place of those left before."""
        if self._path is None:
            return
        part = self._path.with_name(f"{self._path.name}.part")
        try:
            self._path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
            with part.open("wb") as file:
                file.write(encode(self._origin))
                for value in values:
                    file.write(encode(value))
            part.replace(self._path)
        except (OSError, TypeError) as error:
            _log.warning("%s: nothing is left for a next life: %s", self._path, error)
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)

    def take(self) -> list[Any]:
        """What the life before has left; nothing where it left none, or what is made of something else, or damaged."""
        if self._path is None:
            return []
        try:
            with self._path.open("rb") as file:
                if not os.fstat(file.fileno()).st_size:
                    return []
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                    return self._read(data)
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            _log.warning("%s: what the life before has left cannot be taken: %s", self._path, error)
            return []

    def _read(self, data: mmap.mmap) -> list[Any]:
        values: list[Any] = []
        with memoryview(data) as view:
            decoder = Decoder(view)
            try:
                if decoder.value() == self._origin:
                    while decoder.position < len(view):
                        values.append(decoder.value())
            finally:
                decoder.data.release()  # type: ignore[union-attr]
        return values
