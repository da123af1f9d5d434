"""Scans in files: KITTI and nuScenes binaries, NumPy arrays, PCD and PLY."""

from __future__ import annotations

import io
import itertools
import pathlib
import re
import warnings
from collections.abc import Callable

import numpy as np

from ...errors import SourceError
from ..messages import SensorFrame
from .pcd import decode_pcd
from .ply import decode_ply
from .scan import Scan
from .source import FRAME_PERIOD, FrameListSource

__all__ = [
    "SUFFIXES",
    "ScanFileSource",
    "natural_key",
    "read_scan",
    "read_times",
    "scan_files",
    "versions_for",
]

LATEST = 10**9 << 32
"""Stamps are before 2106 [ns]: recordings keep the seconds in 32 bits."""


def _decode_bin(data: bytes, where: object) -> Scan:
    """KITTI: rows of x y z reflectance."""
    return Scan(points=_rows(data, 4, where), format="KITTI binary", fields=("x", "y", "z", "intensity"))


def _decode_nuscenes(data: bytes, where: object) -> Scan:
    """nuScenes: rows of x y z intensity ring, in a frame with x to the right and y forward, turned on reading."""
    rows = _rows(data, 5, where)
    points = np.column_stack([rows[:, 1], -rows[:, 0], rows[:, 2], rows[:, 3] / np.float32(255)])
    ring = rows[:, 4]
    usable = bool(np.isfinite(ring).all()) and (not len(ring) or (ring.min() >= 0 and ring.max() < 65536))
    fields = ("x", "y", "z", "intensity", "ring")
    return Scan(points=points, ring=ring.astype(np.uint16) if usable else None, format="nuScenes binary", fields=fields)


def _rows(data: bytes, columns: int, where: object) -> np.ndarray:
    size = 4 * columns
    if len(data) % size:
        raise SourceError(
            f"{where}: truncated, or of another kind: {len(data)} bytes are not rows of {columns} float32 "
            f"({size} bytes); {len(data) % size} bytes are left over"
        )
    return np.frombuffer(data, "<f4").reshape(-1, columns).astype(np.float32)


def _decode_npy(data: bytes, where: object) -> Scan:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            array = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:  # whatever NumPy's parser meets in a damaged file
        raise SourceError(f"{where}: not a NumPy array, or truncated: {error}") from None
    expected = "expected a float array of shape (n, 3) or (n, 4): x y z and intensity"
    if not isinstance(array, np.ndarray):
        raise SourceError(f"{where}: an archive of arrays; {expected}")
    if array.ndim != 2 or array.shape[1] not in (3, 4) or array.dtype.kind != "f":
        raise SourceError(f"{where}: an array of shape {array.shape} and type {array.dtype}; {expected}")
    points = np.zeros((len(array), 4), np.float32)
    with np.errstate(over="ignore"):
        points[:, : array.shape[1]] = array
    return Scan(
        points=points, format=f"NumPy array, {array.dtype}", fields=("x", "y", "z", "intensity")[: array.shape[1]]
    )


_DECODERS: dict[str, Callable[[bytes, object], Scan]] = {
    ".pcd.bin": _decode_nuscenes,
    ".bin": _decode_bin,
    ".npy": _decode_npy,
    ".pcd": decode_pcd,
    ".ply": decode_ply,
}

SUFFIXES = tuple(_DECODERS)
"""Endings of the files that hold one scan each."""


def read_scan(path: str | pathlib.Path) -> Scan:
    """Reads one scan; its kind is told by the ending of its name. A file without a byte is an empty `.bin` scan.

    Raises:
        SourceError: It is missing, of an unknown kind, truncated or damaged.
    """
    path = pathlib.Path(path)
    decode = next((_DECODERS[suffix] for suffix in SUFFIXES if path.name.lower().endswith(suffix)), None)
    if decode is None:
        raise SourceError(f"{path}: not a scan of a known kind; known endings: {', '.join(SUFFIXES)}")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from None
    return decode(data, path)


def natural_key(path: pathlib.Path) -> list[tuple[int, int | str]]:
    """Sorts names with numbers as people do: 2 before 10."""
    parts = re.split(r"(\d+)", path.name)
    return [(0, int(part)) if index % 2 else (1, part) for index, part in enumerate(parts)]


def scan_files(folder: pathlib.Path, suffixes: tuple[str, ...] = SUFFIXES) -> list[pathlib.Path]:
    """The scans of a folder, naturally sorted; files whose name starts with a dot are left out."""
    try:
        found = [path for path in folder.iterdir() if path.name.lower().endswith(suffixes) and path.name[0] != "."]
    except OSError as error:
        raise SourceError(f"{folder}: cannot be read: {error.strerror or error}") from None
    return sorted((path for path in found if path.is_file()), key=natural_key)


def read_times(path: pathlib.Path) -> list[int]:
    """The stamps of a time file [ns], a line each: seconds, or date and time of UTC with up to nine decimals.

    Raises:
        SourceError: A line is neither.
    """
    try:
        lines = path.read_text("utf-8").split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise SourceError(f"{path}: cannot be read: {error}") from None
    stamps = []
    for number, line in enumerate(lines, 1):
        text = line.strip()
        if not text:
            continue
        try:
            date = re.fullmatch(r"(\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)(?:\.(\d{1,9}))?", text)
            if date:
                seconds = int(np.datetime64(f"{date[1]}T{date[2]}", "s").astype(np.int64))
                stamp = seconds * 10**9 + int((date[3] or "").ljust(9, "0"))
            else:
                stamp = round(float(text) * 1e9)
        except (ValueError, OverflowError):
            stamp = -1
        if not 0 <= stamp < LATEST:
            what = "is neither seconds nor a date and time (2011-09-26 13:02:25.96) from 1970 to 2106"
            raise SourceError(f"{path}, line {number}: {text[:40]!r} {what}")
        stamps.append(stamp)
    return stamps


def versions_for(paths: list[pathlib.Path], times: pathlib.Path | None) -> list[int]:
    """The version of each scan [ns]: from a time file, else stamps in the names, else the index × 100 ms.

    A time file has a line a scan; where it has more lines, a scan's number in its name is that of its line, from 0. A
    name ends in a stamp when its last digits are 19 (nanoseconds) or 16 (microseconds), in all the files.

    Raises:
        SourceError: The time file has no line for a scan.
    """
    numbers = [re.findall(r"\d+", path.name.split(".")[0]) for path in paths]
    if times is not None:
        stamps = read_times(times)
        if len(stamps) == len(paths):
            return stamps
        lines = [int(found[-1]) if found else len(stamps) for found in numbers]
        if max(lines, default=0) < len(stamps):
            return [stamps[line] for line in lines]
        raise SourceError(
            f"{times}: {len(stamps)} lines for {len(paths)} scans, of which one has the number {max(lines)}"
        )
    for digits, scale in ((19, 1), (16, 1000)):
        if all(found and len(found[-1]) == digits for found in numbers):
            stamps = [int(found[-1]) * scale for found in numbers]
            if stamps[-1] < LATEST and all(earlier < later for earlier, later in itertools.pairwise(stamps)):
                return stamps
    return [index * FRAME_PERIOD for index in range(len(paths))]


class ScanFileSource(FrameListSource):
    """A scan file, or a folder of them in the natural order of their names."""

    def __init__(self, path: str | pathlib.Path):
        """Looks at the folder; the scans are read when their turn comes.

        Raises:
            SourceError: The path is missing, is no scan, or is a folder without one.
        """
        path = pathlib.Path(path).expanduser()
        times = None
        if path.is_dir():
            self.paths = scan_files(path)
            if not self.paths:
                raise SourceError(f"{path}: no scans in this folder; known endings: {', '.join(SUFFIXES)}")
            times = next((path / name for name in ("times.txt", "timestamps.txt") if (path / name).is_file()), None)
        elif path.exists():
            self.paths = [path]
            if not path.name.lower().endswith(SUFFIXES):
                raise SourceError(f"{path}: not a scan of a known kind; known endings: {', '.join(SUFFIXES)}")
        else:
            raise SourceError(f"{path}: no such file or folder")
        super().__init__(str(path), self.paths)
        self.versions = versions_for(self.paths, times)

    def frame(self, index: int) -> SensorFrame:
        """Reads one scan by its number, from 0."""
        scan = read_scan(self.paths[index])
        return SensorFrame(
            version=self.versions[index],
            index=index,
            points=scan.points,
            ring=scan.ring,
            t=scan.t,
            frame_id=self.frame_id,
        )
