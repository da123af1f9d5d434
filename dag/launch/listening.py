"""What `echo` and `hz` show of a topic: its commits as they arrive over a link from the process that makes them."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib
import math
import queue
import time
from collections import deque
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from ...datamesh import DataMesh, Entry
from ...errors import WarploomError
from .control import ControlClient

__all__ = ["RateMeter", "listen", "plain_value"]

_SHOWN_ITEMS = 16
_SHOWN_TEXT = 400
_DEPTH = 6
_LOOK_S = 0.5
"""How often is looked whether the node is still there, while nothing comes [s]."""


def _register_message(client: ControlClient, topic: str) -> None:
    """Imports the module that defines a topic's message, which is needed to read it, where it can be found here."""
    for one in client.ask("topics")["topics"]:
        if one["topic"] == topic and one.get("home"):
            with contextlib.suppress(ImportError):  # what cannot be read is told when it comes
                importlib.import_module(one["home"])


def listen(
    client: ControlClient,
    node: str,
    topic: str,
    name: str,
    timeout_s: float | None = None,
    *,
    ends: bool = True,
    past: bool = True,
) -> Iterator[Entry | None]:
    """The commits to a topic of a running node.

    Args:
        client: To its supervisor, which has the topic exported.
        node: Its name.
        topic: Which one.
        name: Of who listens, unique in the node.
        timeout_s: How long to wait for each commit [s]; None: for ever.
        past: Whether those come too that were there before, as far as the producer keeps them.
        ends: Whether it ends when none comes in time; otherwise it gives None and goes on.

    Raises:
        WarploomError: Nobody commits the topic, or the node has ended.
        TimeoutError: Nothing came in time.
    """
    from .linking import LinkPlan, Links

    _register_message(client, topic)
    client.ask("export", topic=topic)
    began = time.perf_counter_ns()  # the same clock in all processes of a host
    # Few versions, so that the producer has its memory back soon.
    mesh = DataMesh(2)
    arrived: queue.SimpleQueue[Entry] = queue.SimpleQueue()
    mesh.window(topic).subscribe(arrived.put, lambda version, epoch: None)
    links = Links(mesh, LinkPlan((), (topic,)), node=node, name=name)
    links.start()
    due = None
    try:
        while True:
            if due is None:
                due = math.inf if timeout_s is None else time.monotonic() + timeout_s
            try:
                entry = arrived.get(timeout=max(0.0, min(_LOOK_S, due - time.monotonic())))
            except queue.Empty:
                if client.ended:
                    raise WarploomError(f"node {node!r} has ended") from None
                if time.monotonic() < due:
                    continue
                if ends:
                    raise TimeoutError(f"nothing was committed to {topic!r} for {timeout_s:g} s") from None
                due = None
                yield None
                continue
            due = None
            if past or entry.committed_ns >= began:
                yield entry
    finally:
        links.stop()


def plain_value(value: Any, depth: int = 0) -> Any:
    """A payload as plain values to show: arrays by type, shape and range, long things shortened."""
    if isinstance(value, (bool, int, type(None))):
        return value
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else str(value)  # which JSON has not
    if isinstance(value, str):
        return value if len(value) <= _SHOWN_TEXT else f"{value[:_SHOWN_TEXT]}… ({len(value)} characters)"
    if isinstance(value, (bytes, bytearray, memoryview)):
        return f"{len(value)} bytes"
    if isinstance(value, np.generic):
        return plain_value(value.item(), depth)
    if not isinstance(value, np.ndarray) and callable(getattr(value, "numpy", None)):
        value = value.numpy()
    if isinstance(value, np.ndarray):
        return _array(value)
    if depth >= _DEPTH:
        return type(value).__name__
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = dataclasses.fields(value)
        return {field.name: plain_value(getattr(value, field.name), depth + 1) for field in fields}
    if isinstance(value, Mapping):
        return _shortened({str(key): plain_value(item, depth + 1) for key, item in value.items()})
    if isinstance(value, (list, tuple, set, frozenset)):
        items = list(value)
        shown = [plain_value(item, depth + 1) for item in items[:_SHOWN_ITEMS]]
        return [*shown, f"… {len(items)} in all"] if len(items) > _SHOWN_ITEMS else shown
    return plain_value(str(value), depth)


def _shortened(items: dict[str, Any]) -> dict[str, Any]:
    if len(items) <= _SHOWN_ITEMS:
        return items
    return {**dict(list(items.items())[:_SHOWN_ITEMS]), "…": f"{len(items)} in all"}


def _array(array: np.ndarray) -> Any:
    if array.size <= _SHOWN_ITEMS and array.dtype.kind in "biuf":
        return array.tolist() if np.isfinite(array).all() else plain_value(array.tolist())
    text = f"{array.dtype}{list(array.shape)}"
    if array.dtype.kind in "iuf" and array.size:
        finite = array[np.isfinite(array)] if array.dtype.kind == "f" else array
        if finite.size:
            text += f" {finite.min():g} … {finite.max():g}"
    return text


class RateMeter:
    """The rate of a topic and how evenly it comes, over the last commits."""

    def __init__(self, window: int = 1000) -> None:
        """Begins without any.

        Args:
            window: How many commits the figures are of.
        """
        self._arrivals: deque[float] = deque(maxlen=window + 1)
        self.count = 0

    def add(self, now: float | None = None) -> None:
        """Notes a commit that arrives at `now` [s]; by default just now."""
        self._arrivals.append(time.monotonic() if now is None else now)
        self.count += 1

    def figures(self, now: float | None = None) -> dict[str, float | int]:
        """`hz`, and of the intervals between arrivals min, mean, max and standard deviation [ms].

        Where nothing has come up to `now` [s] for longer than ever before and a second, that tells the silence instead.
        """
        if len(self._arrivals) < 2:
            return {"count": self.count}
        silent = (time.monotonic() if now is None else now) - self._arrivals[-1]
        if silent > max(1.0, 2 * float(np.diff(np.array(self._arrivals)).max())):
            return {"count": self.count, "hz": 0.0, "silent_s": round(silent, 3)}
        intervals = np.diff(np.array(self._arrivals)) * 1e3
        mean = float(intervals.mean())
        return {
            "count": self.count,
            "hz": round(1e3 / mean, 3) if mean > 0 else 0.0,
            "min_ms": round(float(intervals.min()), 3),
            "mean_ms": round(mean, 3),
            "max_ms": round(float(intervals.max()), 3),
            "std_ms": round(float(intervals.std()), 3),
        }
