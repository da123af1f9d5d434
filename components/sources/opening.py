"""From a URI to a source: `sim:street?seed=7`, `kitti:DIR?sequence=0001`, `scan.pcd`."""

from __future__ import annotations

import difflib
import math
import os
import pathlib
import re
import urllib.parse
from collections.abc import Callable, Iterable

from ...errors import ConfigError
from .kitti import KittiSource
from .scan_files import ScanFileSource
from .source import Source

__all__ = ["SCHEMES", "open_source", "read"]

SCHEMES = ("sim", "kitti", "mcap", "file")
"""What can stand before the colon of a source's URI; a path alone is a file or a folder of scans."""

_FORMS = "sim:street?seed=7, kitti:DIR?sequence=0001, mcap:FILE, or the path of a scan or a folder of scans"


def open_source(uri: str | os.PathLike, *, device: str | None = None) -> Source:
    """Opens a source of frames by its URI.

    - `sim:SCENARIO` — the simulator; keys scenario, seed, duration [s], rate [Hz], lidar, mounting_height [m],
      turning (1, the default: sweeps take their time, as real ones do; 0: they are of an instant), rain [mm/h] and
      sensors (all, or lidar alone).
    - `kitti:DIR` — a folder of the KITTI family (`KittiSource` lists the layouts); key sequence.
    - `mcap:FILE` — a recording that `warploom record` made; key topic, by default `lidar/points`.
    - `PATH` or `file:PATH` — a scan (`.bin`, `.pcd.bin`, `.npy`, `.pcd`, `.ply`) or a folder of them.

    A version is the recorded stamp, else from the folder's time file, else the index × 100 ms.

    Args:
        uri: As above; a `pathlib.Path` is a path.
        device: Where a source that computes does so; None: the CPU.

    Raises:
        ConfigError: The scheme, or a key after the `?`, is unknown, or a value is not of its type.
        SourceError: There is nothing there, or it is no recording of a known kind.
    """
    if isinstance(uri, os.PathLike):
        return ScanFileSource(pathlib.Path(uri))
    if not isinstance(uri, str):
        raise TypeError(f"uri is {type(uri).__name__}; expected a string such as {_FORMS}, or a path")
    if not uri:
        raise ConfigError(f"the source's URI is empty; expected {_FORMS}")
    scheme, place, keys = _split(uri)
    if scheme == "sim":
        types: dict[str, Callable] = {"seed": int, "duration": _number, "rate": _number, "lidar": str}
        types |= {"scenario": str, "turning": int, "mounting_height": _number, "rain": _number}
        types |= {"sensors": str}
        options = _options(uri, keys, types)
        from .simulator import SimulatorSource

        try:
            return SimulatorSource(place or "street", device=device, **options)
        except ValueError as error:
            raise ConfigError(f"{uri}: {error}") from None
    if scheme == "kitti":
        if not place:
            raise ConfigError(f"{uri}: no folder after kitti:; write kitti:DIR or kitti:DIR?sequence=0001")
        return KittiSource(place, **_options(uri, keys, {"sequence": str}))
    if scheme == "mcap":
        if not place:
            raise ConfigError(f"{uri}: no file after mcap:; write mcap:FILE")
        from .recording import RecordingSource

        return RecordingSource(place, **_options(uri, keys, {"topic": str}))
    _options(uri, keys, {})
    return ScanFileSource(place)


def read(path: str | os.PathLike) -> Source:
    """Reads a recording: an iterator of `SensorFrame`.

    Frames that cannot be read are skipped, and told in the source's `skipped`.

    Args:
        path: A scan, a folder of scans, or any URI of `open_source`.

    Raises:
        ConfigError: The URI makes no sense.
        SourceError: There is nothing there, or it is no recording of a known kind; on iterating: the only scan, or
            all of them, cannot be read.
    """
    return open_source(path)


def _split(uri: str) -> tuple[str, str, list[tuple[str, str]]]:
    """Scheme (`file` for a path alone), what it names, and the keys after the `?`."""
    # One letter before a colon is a drive of Windows; a path that exists is a path, whatever is in its name.
    match = re.match(r"([A-Za-z][A-Za-z0-9+.-]+):(.*)", uri, re.DOTALL)
    if match is None or pathlib.Path(uri).exists():
        return "file", uri, []
    scheme, rest = match[1].lower(), match[2]
    if scheme not in SCHEMES:
        raise ConfigError(
            f"{uri}: unknown scheme {match[1]!r}{_nearest(scheme, SCHEMES)}; known: {', '.join(SCHEMES)}; "
            f"expected {_FORMS}"
        )
    place, _, query = rest.partition("?")
    if scheme == "file" and place.startswith("//"):
        place = urllib.parse.unquote(urllib.parse.urlsplit(f"file:{place}").path)
    return scheme, place, urllib.parse.parse_qsl(query, keep_blank_values=True)


def _options(uri: str, keys: Iterable[tuple[str, str]], types: dict[str, Callable]) -> dict[str, object]:
    """The keys after the `?`, each as its type."""
    options: dict[str, object] = {}
    for key, text in keys:
        if key not in types:
            known = ", ".join(types) or "none"
            raise ConfigError(f"{uri}: unknown key {key!r}{_nearest(key, types)}; keys of this source: {known}")
        if key in options:
            raise ConfigError(f"{uri}: the key {key!r} is there twice")
        try:
            options[key] = types[key](text)
        except ValueError:
            kind = "a whole number" if types[key] is int else "a number"
            raise ConfigError(f"{uri}: {key} is {text!r}; expected {kind}") from None
    return options


def _number(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError
    return value


def _nearest(word: str, known: Iterable[str]) -> str:
    match = difflib.get_close_matches(word, list(known), n=1)
    return f" (did you mean {match[0]!r}?)" if match else ""
