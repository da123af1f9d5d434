"""Elements of contiguous arrays, at an index that is not negative: `at(array, i)` and `put(array, i, value)`.

Warp's own indexing counts from the end where an index is negative, and goes by strides that it reads at run time. On a
CPU that makes five instructions and three registers of every access, too many for a loop with a dozen arrays.
"""

import warp as wp

from .device import resolve_device  # noqa: F401  (starts Warp)

__all__ = ["at", "put"]

# Each turn adds an overload.
for _dtype in (wp.int32, wp.uint64, wp.vec2i, wp.vec3i, wp.vec4i, wp.vec3):

    @wp.func_native("return array.data[i];")
    def at(array: wp.array(dtype=_dtype), i: int) -> _dtype:
        """The element at an index from 0 of a contiguous array."""

    @wp.func_native("array.data[i] = value;")
    def put(array: wp.array(dtype=_dtype), i: int, value: _dtype):
        """Sets the element at an index from 0 of a contiguous array."""
