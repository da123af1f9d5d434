"""What a file or folder holds, for `warploom info`."""

from __future__ import annotations

import os
import pathlib
from collections import Counter

import numpy as np

from ...datamesh.recording import EventKind
from ...datamesh.recording_reader import Recording
from ...errors import SourceError
from ..messages import SensorFrame
from .kitti import KittiSource
from .opening import open_source
from .scan_files import ScanFileSource, read_scan
from .source import Source

__all__ = ["describe", "describe_lines"]


def describe(path: str | os.PathLike) -> dict[str, object]:
    """Says what a recording holds: names to values, plain enough for JSON.

    Of a source of several frames the first, the middle and the last are read.

    Args:
        path: A scan, a folder, a URI of `open_source`, an `.mcap` file, or an `objects.jsonl`.

    Raises:
        ConfigError: The URI makes no sense.
        SourceError: There is nothing there, or it cannot be read.
    """
    suffix = pathlib.Path(path).suffix.lower()
    if suffix in (".mcap", ".jsonl") and not pathlib.Path(path).is_file():
        raise SourceError(f"{os.fspath(path)}: no such file")
    if suffix == ".mcap":
        return _describe_mcap(pathlib.Path(path))
    if suffix == ".jsonl":
        return _describe_objects(pathlib.Path(path))
    return _describe_source(open_source(path))


def describe_lines(description: dict[str, object]) -> list[str]:
    """A description as lines of text: name, value."""
    lines = []
    for name, value in description.items():
        if isinstance(value, dict):
            lines.append(f"{name}:")
            lines += [f"  {key}: {_text(inner)}" for key, inner in value.items()]
        else:
            lines.append(f"{name}: {_text(value)}")
    return lines


def _text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {_text(inner)}" for key, inner in value.items())
    if isinstance(value, list | tuple):
        return " ".join(_text(inner) for inner in value)
    # Counts are read more easily with their thousands apart; stamps are not counts.
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) and value < 10**12 else str(value)


def _describe_source(source: Source) -> dict[str, object]:
    result: dict[str, object] = {"source": source.name, "kind": type(source).__name__.removesuffix("Source").lower()}
    length = source.length
    result["frames"] = length
    if isinstance(source, ScanFileSource | KittiSource):
        if isinstance(source, KittiSource):
            result["kind"] = f"KITTI folder, {source.layout}"
        else:
            result["kind"] = "folder of scans" if source.length > 1 else "scan"
        frames, bad = list[SensorFrame](), list[str]()
        for index in sorted({0, source.length // 2, source.length - 1}):
            try:
                frames.append(source.frame(index))
            except SourceError as error:
                if source.length == 1:
                    raise
                bad.append(str(error))
        scan = next((scan for scan in map(_scan_or_none, source.paths[:3]) if scan is not None), None)
        if scan is not None:
            result["format"], result["fields"] = scan.format, list(scan.fields)
        result["duration [s]"] = round((source.versions[-1] - source.versions[0]) * 1e-9, 3)
        if bad:
            result["cannot be read"] = bad
    else:
        frames = [next(iter(source))]
    result["points"] = [len(frame.points) for frame in frames]
    if frames:
        result |= _contents(frames)
    return result


def _scan_or_none(path: pathlib.Path):
    try:
        return read_scan(path)
    except SourceError:
        return None


def _contents(frames: list[SensorFrame]) -> dict[str, object]:
    points = np.concatenate([frame.points for frame in frames])
    finite = points[np.isfinite(points).all(axis=1)]
    contents: dict[str, object] = {"points not finite": len(points) - len(finite)}
    if len(finite):
        low, high = finite.min(axis=0), finite.max(axis=0)
        for axis, name in enumerate(("x [m]", "y [m]", "z [m]", "intensity")):
            contents[name] = [round(float(low[axis]), 3), round(float(high[axis]), 3)]
    first = frames[0]
    contents["first version [ns]"] = first.version
    contents["frame"] = first.frame_id
    contents["has"] = [name for name in ("ring", "t", "pose", "truth") if getattr(first, name) is not None]
    if first.truth is not None:
        contents["labelled objects"] = [0 if frame.truth is None else len(frame.truth.boxes) for frame in frames]
    return contents


def _describe_mcap(path: pathlib.Path) -> dict[str, object]:
    from mcap.exceptions import McapError
    from mcap.reader import make_reader

    broken = _describe_broken(path)
    if broken is not None:
        return broken
    try:
        with path.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (McapError, ValueError, EOFError) as error:
        raise SourceError(f"{path}: not an MCAP file, or truncated: {type(error).__name__}: {error}") from None
    except Exception as error:  # whatever the reader meets in a damaged file
        raise SourceError(f"{path}: a damaged MCAP file: {type(error).__name__}: {error}") from None
    if summary is None or summary.statistics is None:
        raise SourceError(f"{path}: an MCAP file without its summary: the recording was not closed")
    statistics = summary.statistics
    topics = {}
    for key, channel in sorted(summary.channels.items(), key=lambda item: item[1].topic):
        schema = summary.schemas.get(channel.schema_id)
        topics[channel.topic] = {
            "messages": statistics.channel_message_counts.get(key, 0),
            "schema": schema.name if schema else "none",
            "encoding": channel.message_encoding,
        }
    return {
        "source": str(path),
        "kind": "MCAP recording",
        "messages": statistics.message_count,
        "duration [s]": round((statistics.message_end_time - statistics.message_start_time) * 1e-9, 3),
        "first log time [ns]": statistics.message_start_time,
        "compression": sorted({index.compression or "none" for index in summary.chunk_indexes}),
        "topics": topics,
    }


def _describe_broken(path: pathlib.Path) -> dict[str, object] | None:
    """What is in a recording of ours that was cut off, up to the break; None where it is whole, or not of ours."""
    try:
        recording = Recording(path)
        events = [(event.topic, event.version) for event in recording if event.kind is EventKind.COMMIT]
    except SourceError:
        return None
    if recording.broken is None:
        return None
    versions = [version for _, version in events]
    return {
        "source": str(path),
        "kind": "MCAP recording",
        "broken": recording.broken,
        "messages": len(events),
        "first version [ns]": min(versions, default=0),
        "last version [ns]": max(versions, default=0),
        "topics": {topic: {"messages": count} for topic, count in sorted(Counter(t for t, _ in events).items())},
    }


def _describe_objects(path: pathlib.Path) -> dict[str, object]:
    from ...models.classes import CLASSES
    from ..sinks.json_lines import read_objects

    records = list(read_objects(path))
    classes = np.concatenate([record.obstacles.classes for record in records] or [np.empty(0, np.int32)])
    ids = np.concatenate([record.obstacles.ids for record in records] or [np.empty(0, np.int64)])
    versions = [record.obstacles.version for record in records]
    return {
        "source": str(path),
        "kind": "objects, JSON lines",
        "frames": len(records),
        "duration [s]": round((versions[-1] - versions[0]) * 1e-9, 3) if versions else 0.0,
        "objects": len(classes),
        "tracks": len(np.unique(ids)),
        "classes": {name: int((classes == index).sum()) for index, name in enumerate(CLASSES)},
        "frame": sorted({record.obstacles.frame_id for record in records}),
    }
