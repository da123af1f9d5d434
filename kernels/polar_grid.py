"""The polar grid on which the ground is looked for: segments around the z axis, rings that widen with the distance."""

from __future__ import annotations

import warp as wp

from .device import DEFAULT_DEVICE  # noqa: F401  (starts Warp quietly)

__all__ = ["FIRST_RING", "LOW_WORD", "RINGS", "RING_BITS", "SEGMENTS", "cell_of"]

# A ring is an eighth of an octave of r², so its width is 3 to 6 % of its radius: the float's own bits name it. Segments
# divide the diamond |x| + |y| = 1 evenly, so they are 0.9 to 1.8° wide.
SEGMENTS = wp.constant(256)
RINGS = wp.constant(128)
RING_BITS = wp.constant(20)
FIRST_RING = wp.constant(127 * 8)  # the upper bits of 1 m²

LOW_WORD = wp.constant(wp.int64(0x7FFFFFFF))
"""Less the lower bits of a cell's key, this is its lowest point; the upper bits are that point's depth."""


@wp.func
def cell_of(x: float, y: float) -> int:
    """The polar cell of a position: segment × rings + ring."""
    # The angle as the diamond's, 0 to 4: monotone in the true one, for one division.
    angle = x / (wp.abs(x) + wp.abs(y) + 1.0e-30)
    angle = wp.where(y < 0.0, 3.0 + angle, 1.0 - angle)
    segment = int(angle * (float(SEGMENTS) * 0.25)) & (SEGMENTS - 1)
    ring = (wp.cast(x * x + y * y, wp.int32) >> RING_BITS) - FIRST_RING
    return segment * RINGS + wp.clamp(ring, 0, RINGS - 1)
