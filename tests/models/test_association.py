"""Assignment against trying everything."""

import itertools

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.association import assign


def total(cost, columns):
    return sum(cost[row, column] if column >= 0 else 1.0 for row, column in enumerate(columns))


def cheapest(cost):
    n, m = cost.shape
    choices = itertools.product(range(-1, m), repeat=n)
    return min(total(cost, c) for c in choices if len({x for x in c if x >= 0}) == sum(x >= 0 for x in c))


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 4), st.integers(0, 4), st.integers(0, 10_000))
def test_no_other_choice_is_cheaper(n, m, seed):
    cost = np.random.default_rng(seed).uniform(0, 1.6, (n, m))
    found = assign(cost)
    assert found.shape == (n,)
    taken = found[found >= 0]
    assert len(set(taken.tolist())) == len(taken)
    assert all(cost[row, column] < 1.0 for row, column in enumerate(found) if column >= 0)
    # 1e-9: the sums are taken in another order
    assert total(cost, found) <= cheapest(cost) + 1e-9


def test_two_fair_pairs_beat_one_perfect_one():
    cost = np.array([[0.0, 0.4], [0.5, 1.0]])
    np.testing.assert_array_equal(assign(cost), [1, 0])


def test_alone_rather_than_far():
    np.testing.assert_array_equal(assign(np.array([[1.0, 1.2]])), [-1])
