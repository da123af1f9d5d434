"""How work is cut into parts: every thing is in one part, and in no other."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.parts import first_row_of, part_start, parts_for, run_parts
from warploom.kernels.threads import set_thread_count, thread_count


@wp.kernel
def _mark(
    part: int,
    parts: int,
    cells: wp.array(dtype=wp.int32),
    rows: int,
    width: int,
    owner: wp.array(dtype=wp.int32),
    row_owner: wp.array(dtype=wp.int32),
):
    n = cells.shape[0]
    for i in range(part_start(n, part, parts), part_start(n, part + 1, parts)):
        owner[i] = owner[i] + part
    first = first_row_of(part, parts, cells, n, rows, width)
    last = first_row_of(part + 1, parts, cells, n, rows, width)
    for row in range(first, last):
        row_owner[row] = row_owner[row] + part


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
@pytest.mark.parametrize("n", [0, 1, 6, 10_000])
def test_points_and_rows_are_dealt_out_once_in_order_and_about_evenly(n, parts):
    rng = np.random.default_rng(n)
    rows, width = 200, 32
    row = np.clip(rng.normal(60, 15, n), 0, rows - 1).astype(int)
    cells = np.where(rng.random(n) < 0.1, -1, row * width + rng.integers(0, width, n)).astype(np.int32)
    owner, row_owner = (wp.full(length, -100, dtype=wp.int32, device="cpu") for length in (n, rows))
    run_parts(_mark, parts, "cpu", [wp.array(cells, device="cpu"), rows, width], [owner, row_owner])
    whose, whose_row = owner.numpy() + 100, row_owner.numpy() + 100
    assert np.array_equal(whose, np.sort(whose))
    assert np.array_equal(whose_row, np.sort(whose_row))
    if n >= parts:
        shares = np.bincount(whose, minlength=parts)
        assert shares.max() - shares.min() < parts
    if n == 10_000:  # a sample of 512 points tells the shares to a few in a hundred
        points = np.bincount(whose_row[cells[cells >= 0] // width], minlength=parts)
        assert np.all(np.abs(points / points.sum() - 1 / parts) < 0.08)


def test_small_clouds_are_one_part_and_large_ones_one_a_thread():
    before = thread_count()
    try:
        set_thread_count(4)
        assert [parts_for(n, 1000) for n in (1, 1999, 2000, 3999, 1_000_000)] == [1, 1, 2, 3, 4]
    finally:
        set_thread_count(before)
