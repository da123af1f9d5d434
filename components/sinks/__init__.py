"""Sinks of perception's output: JSON lines and MCAP recordings."""

from .json_lines import JsonLinesSink, ObjectsRecord, read_objects
from .mcap import McapSink
from .sink import Sink

__all__ = ["JsonLinesSink", "McapSink", "ObjectsRecord", "Sink", "read_objects"]
