"""The columns around one, looked up on a map or met along the rows, against a search of all of them."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.cell_columns import Layout
from warploom.kernels.column_neighbors import FORWARD, LIST_NEIGHBORS, map_places

OFFSETS = [(0, 1), (1, 0), (1, -1), (1, 1), (0, 2), (2, 0), (1, -2), (1, 2), (2, -1), (2, 1), (2, -2), (2, 2)]


@wp.func_native(LIST_NEIGHBORS + "list_neighbors(begin, end, neighbors_out.data);")
def list_neighbors(
    layout: Layout,
    columns: wp.array(dtype=wp.vec4i),
    begin: int,
    end: int,
    column_map: wp.array(dtype=wp.int32),
    neighbors_out: wp.array(dtype=wp.int32),
):
    """What is tested."""


@wp.kernel
def _list(
    # in
    layout_in: wp.array(dtype=Layout),
    columns: wp.array(dtype=wp.vec4i),
    begin: int,
    end: int,
    # in out
    column_map: wp.array(dtype=wp.int32),
    # out
    neighbors_out: wp.array(dtype=wp.int32),
):
    list_neighbors(layout_in[0], columns, begin, end, column_map, neighbors_out)


@pytest.mark.parametrize("places", [map_places(0), 10])
@pytest.mark.parametrize("extent", [1, 6, 40])
def test_neighbours_are_those_of_a_search(places, extent):
    """With ten places there is no map to look them up on."""
    random = np.random.default_rng(extent)
    x, y = np.unique(random.integers(-extent, extent + 1, (4 * extent * extent, 2)), axis=0).T
    index = {(a, b): k for k, (a, b) in enumerate(zip(x, y, strict=True))}
    layout = Layout()
    layout.least = wp.vec4i(int(x.min()), int(y.min()), 0, 0)
    layout.levels, layout.high_digits = 1, 1
    layout.width, layout.depth = int(np.ptp(x)) + 1, int(np.ptp(y)) + 1
    columns = wp.array(np.stack([x, y, x, x], 1), dtype=wp.vec4i, device="cpu")
    column_map = wp.full(places, -1, dtype=wp.int32, device="cpu")
    for begin, end in ((0, len(x)), (len(x) // 3, 2 * len(x) // 3)):
        found = wp.full(FORWARD * len(x), -7, dtype=wp.int32, device="cpu")
        inputs = [wp.array([layout], dtype=Layout, device="cpu"), columns, begin, end, column_map]
        wp.launch(_list, 1, inputs=inputs, outputs=[found], device="cpu")
        expected = np.full((len(x), FORWARD), -7)
        for k in range(begin, end):
            others = [index.get((x[k] + dx, y[k] + dy), -1) for dx, dy in OFFSETS]
            expected[k] = [other if begin <= other < end else -1 for other in others]
        np.testing.assert_array_equal(found.numpy().reshape(-1, FORWARD), expected)
        assert (column_map.numpy() == -1).all()
