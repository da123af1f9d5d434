"""LZF, the compression of PCD files.

A control byte below 32 is followed by that many bytes and one more, taken as they are; any other is a copy of what was
unpacked before: its upper three bits are the length less two (seven: one more byte is added), its lower five bits and
the next byte the distance back less one.

Source: Marc Lehmann's LibLZF, http://oldhome.schmorp.de/marc/liblzf.html.
"""

from __future__ import annotations

import numpy as np

__all__ = ["lzf_compress", "lzf_decompress"]

_FARTHEST = 8192
_LONGEST = 264
_PIECE = 16


def lzf_compress(data: bytes) -> bytes:
    """Packs data; what does not repeat becomes 3 % longer.

    Args:
        data: Any bytes.
    """
    out = bytearray()
    taken = 0
    for position, at in _repeats(data):
        if position < taken:
            continue
        _append_literals(out, data, taken, position)
        longest = min(_LONGEST, len(data) - position)
        length = 3
        while length + _PIECE <= longest and (
            data[at + length : at + length + _PIECE] == data[position + length : position + length + _PIECE]
        ):
            length += _PIECE
        while length < longest and data[at + length] == data[position + length]:
            length += 1
        back = position - at - 1
        if length < 9:
            out += bytes(((length - 2) << 5 | back >> 8, back & 255))
        else:
            out += bytes((7 << 5 | back >> 8, length - 9, back & 255))
        taken = position + length
    _append_literals(out, data, taken, len(data))
    return bytes(out)


def _repeats(data: bytes) -> list[tuple[int, int]]:
    """Where three bytes begin that were there before, near enough to be copied, and where they were last."""
    if len(data) < 4:
        return []
    values = np.frombuffer(data, np.uint8).astype(np.uint32)
    three = values[:-2] | values[1:-1] << 8 | values[2:] << 16
    order = np.argsort(three, kind="stable")
    same = three[order[1:]] == three[order[:-1]]
    positions, before = order[1:][same], order[:-1][same]
    near = positions - before <= _FARTHEST
    positions, before = positions[near], before[near]
    forward = np.argsort(positions)
    return list(zip(positions[forward].tolist(), before[forward].tolist(), strict=True))


def _append_literals(out: bytearray, data: bytes, start: int, end: int) -> None:
    for at in range(start, end, 32):
        piece = data[at : min(at + 32, end)]
        out.append(len(piece) - 1)
        out += piece


def lzf_decompress(data: bytes, size: int) -> bytes:
    """Unpacks LZF data.

    Args:
        data: The packed bytes.
        size: How many bytes they make.

    Raises:
        ValueError: They are damaged, or do not make that many bytes.
    """
    # The longest copy makes 264 bytes of three: more than that in all is a lie, told before memory is taken for it.
    if size > 88 * len(data):
        raise ValueError(f"damaged: {len(data)} compressed bytes cannot make {size}")
    out = bytearray(size)
    position = made = 0
    end = len(data)
    try:
        while position < end:
            control = data[position]
            position += 1
            if control < 32:
                length = control + 1
                if position + length > end or made + length > size:
                    raise IndexError
                out[made : made + length] = data[position : position + length]
                position += length
            else:
                length = control >> 5
                if length == 7:
                    length += data[position]
                    position += 1
                length += 2
                begin = made - ((control & 31) << 8) - data[position] - 1
                position += 1
                if begin < 0 or made + length > size:
                    raise IndexError
                distance = made - begin
                if distance >= length:
                    out[made : made + length] = out[begin : begin + length]
                else:  # the copy runs into itself: a pattern that repeats
                    pattern = out[begin:made]
                    out[made : made + length] = (pattern * (length // distance + 1))[:length]
            made += length
    except IndexError:
        raise ValueError(f"damaged compressed data near byte {position}") from None
    if made != size:
        raise ValueError(f"damaged: the compressed data makes {made} bytes, not {size}")
    return bytes(out)
