"""Values by row, against NumPy's indexing."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.gather import gather_rows


def test_values_follow_their_rows_and_the_rest_stays(device):
    values = wp.array(np.arange(10, dtype=np.float32) / 4, dtype=wp.float32, device=device)
    rows = wp.array([9, 0, 3, 3, 7], dtype=wp.int32, device=device)
    out = wp.full(6, -1.0, dtype=wp.float32, device=device)
    gather_rows(values, rows, wp.array([4], dtype=wp.int32, device=device), out)
    assert out.numpy().tolist() == [2.25, 0.0, 0.75, 0.75, -1.0, -1.0]


def test_rows_that_are_none_give_zero(device):
    values = wp.array([5.0, 6.0], dtype=wp.float32, device=device)
    rows = wp.array([-1, 2, 1], dtype=wp.int32, device=device)
    out = wp.full(3, -1.0, dtype=wp.float32, device=device)
    gather_rows(values, rows, wp.array([3], dtype=wp.int32, device=device), out)
    assert out.numpy().tolist() == [0.0, 0.0, 6.0]


def test_columns_of_a_table_do(device):
    table = wp.array(np.arange(12, dtype=np.float32).reshape(3, 4), dtype=wp.float32, device=device)
    column = wp.array(ptr=table.ptr + 12, dtype=wp.float32, shape=(3,), strides=(16,), device=device)
    out = wp.zeros(3, dtype=wp.float32, device=device)
    rows = wp.array([2, 1, 0], dtype=wp.int32, device=device)
    gather_rows(column, rows, wp.array([3], dtype=wp.int32, device=device), out)
    assert out.numpy().tolist() == [11.0, 7.0, 3.0]


def test_too_little_room_is_refused():
    rows, count = wp.zeros(3, dtype=wp.int32, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
    with pytest.raises(ValueError, match="out must have room for 3 values, not 2"):
        gather_rows(wp.zeros(3, device="cpu"), rows, count, wp.zeros(2, device="cpu"))
