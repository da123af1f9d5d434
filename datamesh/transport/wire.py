"""What writer and reader say to each other, as messages of a Unix socket that keeps their boundaries.

    reader → writer   once: a hello (codec), then 8 bytes for each slab that it lets go of: its offset; in place of one
                      `LEAVES`, a good-bye: nothing is kept for it; and `ENDS`: it reads no more, but holds what it has
                      until it lets go of it, or closes the socket
    writer → reader   once: a welcome (codec) with the descriptor of the memory, then events

An event is its head, for each slab offset and size, and its body: the payload as the codec makes it, arrays in slabs by
reference. A body that is too long for a message lies in the last of the slabs, from its beginning.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

from ..messages import decode, encode

__all__ = [
    "COMMIT",
    "ENDS",
    "INLINE",
    "LEAVES",
    "MESSAGE",
    "NEWEST",
    "NEWEST_TRIGGERS",
    "RELEASE",
    "SETTLE",
    "SOON",
    "Event",
    "new_event",
    "pack_commit",
    "pack_event",
    "pack_greeting",
    "pack_soon",
    "read_event",
    "read_greeting",
    "read_soon",
    "set_number",
]

INLINE = 4096
"""The longest body in a message [B]."""
MESSAGE = 1 << 15
"""The longest message that is received [B]."""
RELEASE = struct.Struct("<Q")
LEAVES = (1 << 64) - 1
ENDS = (1 << 64) - 2
COMMIT, SETTLE, SOON = _KINDS = (1, 2, 3)
"""The last says that a commit will probably follow; it has no number."""
_TRIGGERS, _NEWEST, _IN_SLAB = 1, 2, 4
_HEAD = struct.Struct("<BBHIQQQqq")
_SLAB = struct.Struct("<QQ")
_NUMBER = struct.Struct("<Q")
_HEAD_SIZE, _SLAB_SIZE, _NUMBER_AT = _HEAD.size, _SLAB.size, 8
_pack_head, _unpack_head, _unpack_slab, _put_number = (
    _HEAD.pack,
    _HEAD.unpack_from,
    _SLAB.unpack_from,
    _NUMBER.pack_into,
)
NEWEST, NEWEST_TRIGGERS = _NEWEST, _NEWEST | _TRIGGERS
"""Flags of a commit that is the newest, without and with starting runs."""
pack_commit = struct.Struct(f"{_HEAD.format}{_SLAB.format[1:]}").pack
"""What stands before the body of a commit that lies in one slab, in one go: `COMMIT`, flags, 1 (slab), 0, number,
epoch, version, received [ns], committed [ns], offset and size of the slab [B]."""
_PROTOCOL = 2
_MOST_SLABS = 256


class Event(NamedTuple):
    """A commit, or a settled version, on its way; or the word that one is about to come."""

    kind: int
    number: int
    """Of the event on this connection, so that what was dropped is noticed."""
    epoch: int
    version: int
    received_ns: int
    committed_ns: int
    triggers: bool = False
    newest: bool = False
    """Whether it was the newest of the window when it was committed."""
    slabs: tuple[tuple[int, int], ...] = ()
    """Offset and size of each [B]."""
    body: bytes | memoryview = b""
    """The payload; empty where it lies in the last slab."""
    body_size: int = 0
    """Of the payload there."""


new_event = partial(tuple.__new__, Event)  # what a named tuple calls is written in Python, and takes twice as long


def pack_event(event: Event) -> bytearray:
    """An event as bytes, whose number `set_number` can change."""
    kind, number, epoch, version, received, committed, triggers, newest, slabs, body, body_size = event
    flags = (_TRIGGERS if triggers else 0) | (_NEWEST if newest else 0) | (_IN_SLAB if body_size else 0)
    data = bytearray(_pack_head(kind, flags, len(slabs), body_size, number, epoch, version, received, committed))
    for slab in slabs:
        data += _SLAB.pack(*slab)
    data += body
    return data


def pack_soon(core: int, soon_ns: int, late_ns: int) -> bytes:
    """The word that a commit is about to come.

    Args:
        core: On which it is built.
        soon_ns: From which time of `time.perf_counter_ns` on it is expected, which all processes of a host share.
        late_ns: Until when.
    """
    return _pack_head(SOON, 0, 0, 0, 0, 0, core, soon_ns, late_ns)


def read_soon(data: bytes) -> tuple[int, int, int]:
    """On which core a commit is built, and between which times it is expected.

    Raises:
        ValueError: It is truncated.
    """
    if len(data) < _HEAD_SIZE:
        raise ValueError(f"truncated: a message of {len(data)} bytes, where a head has {_HEAD_SIZE}")
    return _unpack_head(data)[-3:]


def set_number(data: bytearray, number: int) -> None:
    """Gives an event as bytes another number."""
    _put_number(data, _NUMBER_AT, number)


def read_event(data: bytes, memory: int) -> Event:
    """The event in a message.

    Args:
        data: The message.
        memory: Size of the writer's memory [B].

    Raises:
        ValueError: It is truncated, damaged, or speaks of slabs outside the memory.
    """
    if len(data) < _HEAD_SIZE:
        raise ValueError(f"truncated: a message of {len(data)} bytes, where a head has {_HEAD_SIZE}")
    kind, flags, count, body_size, number, epoch, version, received, committed = _unpack_head(data)
    if kind not in _KINDS or flags >= 8 or count > _MOST_SLABS:
        raise ValueError(f"no event: kind {kind}, flags {flags}, {count} slabs")
    at, end = _HEAD_SIZE, _HEAD_SIZE + count * _SLAB_SIZE
    if len(data) < end:
        raise ValueError(f"truncated: {count} slabs expected in {len(data) - _HEAD_SIZE} bytes")
    slabs: tuple[tuple[int, int], ...] = ()
    while at < end:
        slab = offset, size = _unpack_slab(data, at)
        if size == 0 or offset + size > memory:
            raise ValueError(f"a slab at {offset} of {size} bytes in a memory of {memory}")
        slabs += (slab,)
        at += _SLAB_SIZE
    if not flags & _IN_SLAB:
        body_size = 0
    elif not slabs or not 0 < body_size <= slabs[-1][1]:
        raise ValueError(f"a payload of {body_size} bytes in {slabs[-1][1] if slabs else 0} bytes of a slab")
    # What comes over zenoh may be long, and is not to be copied.
    body = data[end:] if len(data) <= MESSAGE else memoryview(data)[end:]
    triggers, newest = flags & _TRIGGERS != 0, flags & _NEWEST != 0
    return new_event((kind, number, epoch, version, received, committed, triggers, newest, slabs, body, body_size))


def pack_greeting(content: Mapping[str, Any]) -> bytes:
    """A hello or a welcome as bytes."""
    return encode({"warploom": _PROTOCOL, **content})


def read_greeting(data: bytes, wanted: Sequence[tuple[str, type]]) -> dict[str, Any]:
    """A hello or a welcome.

    Args:
        data: The message.
        wanted: The keys that it must have, and the types of their values.

    Raises:
        ValueError: It is damaged, of another protocol, or lacks something.
    """
    content = decode(data)
    if not isinstance(content, dict) or content.get("warploom") != _PROTOCOL:
        spoken = content.get("warploom") if isinstance(content, dict) else None
        raise ValueError(f"the other end speaks protocol {spoken!r}, this one {_PROTOCOL}: run one version of warploom")
    for key, kind in wanted:
        if type(content.get(key)) is not kind:
            raise ValueError(f"{key} of the other end is {content.get(key)!r}, expected {kind.__name__}")
    return content
