"""Assignment: the cheapest choice among pairs that may be."""

from __future__ import annotations

import numpy as np

__all__ = ["assign"]

_NOT = -1


def assign(cost: np.ndarray) -> np.ndarray:
    """The cheapest one-to-one assignment where staying alone costs 1.

    So a pair that costs 1 or more is never made, and two fair pairs beat one good and one impossible.

    Args:
        cost: Of each pair, finite and not negative, shape (n, m).

    Returns:
        The column for each row, −1 where a row stays alone; shape (n,), int64. Of equal solutions always the same.
    """
    # Here, as it takes a third of a second: who only checks a configuration does without.
    from scipy.optimize import linear_sum_assignment

    columns = np.full(cost.shape[0], _NOT)
    if cost.size:
        clipped = np.minimum(cost, 1.0)
        rows, chosen = linear_sum_assignment(clipped)
        made = clipped[rows, chosen] < 1.0
        columns[rows[made]] = chosen[made]
    return columns
