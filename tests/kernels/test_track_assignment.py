"""Sparse assignment against SciPy's dense one, where staying alone costs 1."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from warploom.kernels.track_assignment import MOST_CANDIDATES, Pairs, Search, assign_stage, offer


@wp.kernel
def _assign(
    cost: wp.array2d(dtype=wp.float64), stage: wp.array(dtype=wp.int32), stages: int, pairs: Pairs, search: Search
):
    for i in range(cost.shape[0]):
        for j in range(cost.shape[1]):
            if stage[j] != 0 and cost[i, j] < wp.float64(1.0):
                offer(pairs, i, j, cost[i, j])
    for s in range(1, stages + 1):
        assign_stage(pairs, search, stage, s, cost.shape[0], 1 + (s - 1) * cost.shape[0])


def assigned(cost, stage=None):
    """The detection of each track, −1 for none."""
    n, m = cost.shape
    stage = np.ones(m, np.int32) if stage is None else np.asarray(stage, np.int32)
    pairs, search = Pairs(), Search()
    pairs.count = wp.zeros(n, dtype=wp.int32, device="cpu")
    pairs.detection = wp.zeros((n, int(MOST_CANDIDATES)), dtype=wp.int32, device="cpu")
    pairs.cost = wp.zeros((n, int(MOST_CANDIDATES)), dtype=wp.float64, device="cpu")
    search.of_track = wp.full(n, -1, dtype=wp.int32, device="cpu")
    search.of_detection = wp.full(m, -1, dtype=wp.int32, device="cpu")
    search.track_price = wp.zeros(n, dtype=wp.float64, device="cpu")
    search.detection_price = wp.zeros(m, dtype=wp.float64, device="cpu")
    search.distance = wp.zeros(m, dtype=wp.float64, device="cpu")
    for name in ("before", "reached", "touched"):
        setattr(search, name, wp.zeros(m, dtype=wp.int32, device="cpu"))
    search.work = wp.zeros(2, dtype=wp.int32, device="cpu")
    table = wp.array(np.ascontiguousarray(cost), dtype=wp.float64, device="cpu")
    of_stage = wp.array(stage, dtype=wp.int32, device="cpu")
    wp.launch(_assign, 1, inputs=[table, of_stage, int(stage.max(initial=1)), pairs, search], device="cpu")
    found, back = search.of_track.numpy(), search.of_detection.numpy()
    for track, detection in enumerate(found):
        assert detection < 0 or back[detection] == track
    assert (back >= 0).sum() == (found >= 0).sum()
    return found


def total(cost, found):
    return sum(cost[i, j] if j >= 0 else 1.0 for i, j in enumerate(found))


def reference(cost):
    """Of SciPy's solution for costs cut at 1 the pairs below 1."""
    clipped = np.minimum(cost, 1.0)
    rows, columns = linear_sum_assignment(clipped)
    found = np.full(len(cost), -1)
    made = clipped[rows, columns] < 1.0
    found[rows[made]] = columns[made]
    return found


@settings(deadline=None, max_examples=150)
@given(st.integers(1, 30), st.integers(1, 30), st.floats(0.05, 1.0), st.integers(0, 10_000))
def test_it_is_the_cheapest_assignment(n, m, density, seed):
    rng = np.random.default_rng(seed)
    cost = np.where(rng.random((n, m)) < density, rng.uniform(0, 1.3, (n, m)), 5.0)
    found = assigned(cost)
    assert all(cost[i, j] < 1.0 for i, j in enumerate(found) if j >= 0)
    # Random costs have one best solution; 1e-9: prices are sums of costs.
    assert total(cost, found) == pytest.approx(total(cost, reference(cost)), abs=1e-9)
    np.testing.assert_array_equal(found, reference(cost))


@settings(deadline=None, max_examples=50)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 10_000))
def test_equal_costs_are_assigned_as_cheaply(n, m, seed):
    cost = np.random.default_rng(seed).integers(0, 4, (n, m)) / 3.0
    assert total(cost, assigned(cost)) == pytest.approx(total(cost, reference(cost)), abs=1e-9)


@settings(deadline=None, max_examples=50)
@given(st.integers(1, 12), st.integers(1, 12), st.integers(0, 10_000))
def test_the_second_stage_gets_what_the_first_leaves(n, m, seed):
    rng = np.random.default_rng(seed)
    cost, stage = rng.uniform(0, 1.5, (n, m)), rng.integers(0, 3, m)
    expected = reference(np.where(stage == 1, cost, 5.0))
    left = expected < 0
    expected[left] = reference(np.where(stage == 2, cost, 5.0)[left])
    np.testing.assert_array_equal(assigned(cost, stage), expected)


def test_of_too_many_candidates_the_cheapest_stay():
    cost = np.linspace(0.9, 0.1, 60)[None]
    assert assigned(cost).tolist() == [59]


def test_thousands_in_one_place_end():
    cost = np.random.default_rng(0).uniform(0, 0.99, (1500, 1500))
    found = assigned(cost)
    assert len(set(found[found >= 0].tolist())) == (found >= 0).sum() > 1400
