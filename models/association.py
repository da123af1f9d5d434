"""Assignment of detections to tracks: the pairs that may be, their costs, and the cheapest choice among them."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

__all__ = ["assign", "assign_sparse"]

_NOT = -1
# Costs of the sparse solver must not be zero; shifted by this, which both choices of every row share.
_SHIFT = 1.0


def assign(cost: np.ndarray) -> np.ndarray:
    """The cheapest one-to-one assignment where staying alone costs 1.

    So a pair that costs 1 or more is never made, and two fair pairs beat one good and one impossible.

    Args:
        cost: Of each pair, finite and not negative, shape (n, m).

    Returns:
        The column for each row, −1 where a row stays alone; shape (n,), int64. Of equal solutions always the same.
    """
    columns = np.full(cost.shape[0], _NOT)
    if cost.size:
        clipped = np.minimum(cost, 1.0)
        rows, chosen = linear_sum_assignment(clipped)
        made = clipped[rows, chosen] < 1.0
        columns[rows[made]] = chosen[made]
    return columns


def assign_sparse(rows: np.ndarray, columns: np.ndarray, cost: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """`assign` for when only some pairs can be: thousands of rows and columns with a few neighbours each.

    Args:
        rows: Row of each possible pair, shape (p,).
        columns: Its column, shape (p,); no pair comes twice.
        cost: Its cost, finite and not negative, shape (p,).
        shape: How many rows and columns there are.

    Returns:
        As `assign`.
    """
    n, m = shape
    chosen = np.full(n, _NOT)
    possible = cost < 1.0
    if not possible.any():
        return chosen
    # Each row may also take a column of its own, which stands for staying alone: so a full matching exists.
    every = np.arange(n)
    graph = coo_array(
        (
            np.concatenate([cost[possible] + _SHIFT, np.full(n, 1.0 + _SHIFT)]),
            (np.concatenate([rows[possible], every]), np.concatenate([columns[possible], m + every])),
        ),
        shape=(n, m + n),
    ).tocsr()
    row, column = min_weight_full_bipartite_matching(graph)
    made = column < m
    chosen[row[made]] = column[made]
    return chosen
