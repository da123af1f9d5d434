"""The columns near one, met along the rows, against a search of all of them."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels import device  # noqa: F401  (starts Warp quietly)
from warploom.kernels.column_neighbors import NEAR_COLUMNS

FAR = 2139095039  # the bits of the largest float32: cells are numbered as far as that


@wp.func_native(
    NEAR_COLUMNS
    + """
    NearColumns near{columns.data, end, dx, dy, begin, begin};
    for (int k = begin; k < end; ++k) {
        near.move_to(k);
        found_out.data[k] = wp::vec2i(near.first, near.last);
    }
"""
)
def _near_columns(
    columns: wp.array(dtype=wp.vec4i), begin: int, end: int, dx: int, dy: int, found_out: wp.array(dtype=wp.vec2i)
):
    """What is tested."""


@wp.kernel
def _list(
    # in
    columns: wp.array(dtype=wp.vec4i),
    begin: int,
    end: int,
    dx: int,
    dy: int,
    # out
    found_out: wp.array(dtype=wp.vec2i),
):
    _near_columns(columns, begin, end, dx, dy, found_out)


@pytest.mark.parametrize("origin", [0, FAR - 3, -FAR])
@pytest.mark.parametrize("extent", [1, 6, 40])
def test_columns_are_those_of_a_search(extent, origin):
    random = np.random.default_rng(extent)
    x, y = np.unique(random.integers(0, extent + 1, (extent * extent, 2)), axis=0).T
    if origin > 0:
        x, y = x[x < 3], y[x < 3]
    x = x + origin
    # One place more than there are columns, as the walk may look at it.
    columns = wp.array(
        np.stack(
            [
                *np.pad([x, y], ((0, 0), (0, 1))),
            ]
            * 2,
            1,
        ),
        dtype=wp.vec4i,
        device="cpu",
    )
    for begin, end in ((0, len(x)), (len(x) // 3, 2 * len(x) // 3)):
        for dx in (-2, -1, 0, 1, 2):
            for dy in (1, 2):
                found = wp.full(len(x), wp.vec2i(-7, -7), dtype=wp.vec2i, device="cpu")
                wp.launch(_list, 1, inputs=[columns, begin, end, dx, dy], outputs=[found], device="cpu")
                for k, (first, last) in enumerate(found.numpy()):
                    if not begin <= k < end:
                        assert (first, last) == (-7, -7)
                        continue
                    near = (x[begin:end] == x[k] + dx) & (abs(y[begin:end] - y[k]) <= dy)
                    np.testing.assert_array_equal(np.arange(first, last), begin + np.flatnonzero(near))
