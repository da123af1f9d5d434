"""Values of the points that passed a filter, by the rows they came from."""

from __future__ import annotations

import warp as wp

__all__ = ["gather_rows"]


@wp.kernel
def _gather_rows(
    # in
    values_in: wp.array(dtype=wp.float32),
    rows_in: wp.array(dtype=wp.int32),
    count_in: wp.array(dtype=wp.int32),
    # out
    values_out: wp.array(dtype=wp.float32),
):
    """Takes the value of each row that is one; others become 0."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    row = rows_in[i]
    value = float(0.0)
    if row >= 0 and row < values_in.shape[0]:
        value = values_in[row]
    values_out[i] = value


def gather_rows(values: wp.array, rows: wp.array, count: wp.array, out: wp.array) -> None:
    """Fills the first `count[0]` of `out` with `values[rows]`; rows that are none give 0.

    Args:
        values: Shape (m,), float32, possibly strided.
        rows: Indices into `values`, shape (n,), int32.
        count: Shape (1,), int32.
        out: Shape (n or more,), float32.
    """
    if out.shape[0] < rows.shape[0]:
        raise ValueError(f"out must have room for {rows.shape[0]} values, not {out.shape[0]}")
    wp.launch(_gather_rows, rows.shape[0], inputs=[values, rows, count], outputs=[out], device=out.device)
