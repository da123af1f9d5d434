"""Points sorted into columns of cells, against NumPy's lexsort."""

import itertools

import numpy as np
import pytest
import warp as wp

from warploom.kernels.cell_columns import CellColumns
from warploom.kernels.cell_pairs import radius_of
from warploom.kernels.interop import count_on

RADIUS = 0.5
CELL = RADIUS * (1.0 - 1e-6) / np.sqrt(3.0)  # the side of a cell


def clouds():
    rng = np.random.default_rng(2)
    street = rng.normal(0, [20, 20, 1.5], (3_000, 3))
    street[::70] = np.nan
    yield "street", street
    yield "too wide for bits", np.concatenate([street, street + np.array((9e4, -9e4, 3e4))])
    yield "blocks on top of each other", rng.uniform(0, 1, (2_000, 3)) * (5, 5, 300)
    yield "too tall for bits", rng.uniform(0, 1, (2_000, 3)) * (200, 200, 3e4)
    yield "one cell", np.full((500, 3), 0.1)
    yield "nothing finite", np.full((20, 3), np.inf)
    yield "nothing", np.empty((0, 3))


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_points_are_sorted_by_cell_and_cells_stand_in_columns(parts):
    for name, points in clouds():
        points = points.astype(np.float32)
        n = len(points)
        by_cell = CellColumns(radius_of(RADIUS), 8_000, parts)
        include = wp.zeros(1, dtype=wp.uint8, device="cpu")
        for given in (points[::-1].copy(), points):  # what the first leaves is met by the second
            by_cell.launch(wp.array(given, dtype=wp.vec3, device="cpu"), count_on(n, "cpu"), include, 0)
        finite = np.flatnonzero(np.isfinite(points).all(axis=1))
        cells = np.floor(points.astype(np.float64)[finite] / CELL).astype(np.int64)
        order = finite[np.lexsort((finite, *cells.T[::-1]))]
        np.testing.assert_array_equal(by_cell.order.numpy()[: len(order)], order, err_msg=name)
        np.testing.assert_array_equal(by_cell.points.numpy()[: len(order)], points[order], err_msg=name)
        # Every point's cell and column, as the numbers of the parts tell.
        of_point, stacks, columns = (a.numpy() for a in (by_cell.cell_of_point, by_cell.stacks, by_cell.columns))
        assert (of_point[:n][~np.isfinite(points).all(axis=1)] == -1).all()
        at, found = 0, np.full((n, 3), -(2**40))
        for first, last, first_column, last_column in by_cell.ranges.numpy():
            ends = columns[first_column:last_column, 2:]
            np.testing.assert_array_equal(np.concatenate([*(np.arange(*end) for end in ends), []]), range(first, last))
            for x, y, begin, end in columns[first_column:last_column]:
                for cell in range(begin, end):
                    members = order[stacks[cell, 1] : stacks[cell + 1, 1]]
                    assert stacks[cell, 1] == at
                    at = stacks[cell + 1, 1]
                    assert (of_point[members] == cell).all()
                    found[members] = x, y, stacks[cell, 0]
        assert at == len(order)
        np.testing.assert_array_equal(found[finite], cells, err_msg=name)


def test_parts_have_whole_rows_and_the_order_may_be_left_out():
    points = np.random.default_rng(3).normal(0, [20, 20, 1.5], (3_000, 3)).astype(np.float32)
    by_cell = CellColumns(radius_of(RADIUS), len(points), 7, ordered=False)
    include = wp.zeros(1, dtype=wp.uint8, device="cpu")
    by_cell.launch(wp.array(points, dtype=wp.vec3, device="cpu"), count_on(len(points), "cpu"), include, 0)
    columns = by_cell.columns.numpy()
    rows = [set(columns[first:last, 0]) for _, _, first, last in by_cell.ranges.numpy()]
    assert all(rows)
    assert all(max(a) < min(b) for a, b in itertools.pairwise(rows))
