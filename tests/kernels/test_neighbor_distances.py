"""Mean distances to the nearest neighbours against SciPy's KD-tree in float64."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from warploom.kernels import neighbor_distances
from warploom.kernels.leaf_lanes import parts_for
from warploom.kernels.neighbor_distances import NeighborDistances
from warploom.kernels.threads import set_thread_count, thread_count

# Float32 loses this share of a distance between coordinates near zero.
TOLERANCE = 2e-6


def cloud(n, seed):
    """Clumps of very different density, some points many times over."""
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 1, (n, 3)) * 10.0 ** rng.integers(-3, 2, (n, 1))
    again = rng.random(n) < 0.2
    points[again] = points[rng.integers(0, max(n // 20, 1), again.sum())]
    return points.astype(np.float32)


def measured(points, neighbors, device="cpu", parts=None):
    """The mean distance of each point, in the order of the points."""
    before = thread_count()
    try:
        set_thread_count(parts or before)
        plan = NeighborDistances(capacity=max(len(points), 1), neighbors=neighbors, device=device)
    finally:
        set_thread_count(before)
    xyz = wp.array(points, dtype=wp.vec3, device=device)
    plan.launch(xyz, wp.array([len(points)], dtype=wp.int32, device=device))
    size = int(plan.tree.size.numpy()[0])
    mean = np.full(len(points), np.nan, np.float32)
    mean[plan.tree.index.numpy()[:size]] = plan.mean.numpy()[:size]
    return mean


def expected(points, neighbors):
    wide = points.astype(np.float64)
    k = min(neighbors, len(points) - 1)
    return cKDTree(wide).query(wide, k + 1)[0][:, 1:].mean(axis=1) if k > 0 else np.zeros(len(points))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 1500), st.sampled_from([1, 2, 7, 20, 60]))
def test_equal_to_scipys(seed, n, neighbors):
    points = cloud(n, seed)
    assert np.allclose(measured(points, neighbors), expected(points, neighbors), rtol=TOLERANCE, atol=1e-7)


def test_many_neighbours():
    """So many that lists are cut short several times."""
    points = cloud(3000, 1)
    assert np.allclose(measured(points, 1000), expected(points, 1000), rtol=TOLERANCE)


@pytest.mark.parametrize("parts", [2, 3, 7])
def test_parts_do_not_change_a_byte(parts):
    points = cloud(6000, 2)
    assert parts_for(len(points), parts) == parts
    assert measured(points, 20, parts=parts).tobytes() == measured(points, 20, parts=1).tobytes()


def test_lists_side_by_side_give_the_same_bytes():
    """As a GPU lays them out, one thread for each leaf."""
    points = cloud(2000, 3)
    plan = NeighborDistances(capacity=len(points), neighbors=20, device="cpu")
    plan.launch(wp.array(points, dtype=wp.vec3, device="cpu"), wp.array([len(points)], dtype=wp.int32, device="cpu"))
    tree, held = plan.tree, 8 * plan.tree.leaves
    lists = plan._lists
    mean = wp.zeros_like(plan.mean)
    wp.launch(
        neighbor_distances._mean_distances,
        tree.leaves,
        inputs=[tree.points, *plan._eights, tree.size, tree.low, tree.high, tree.leaves, plan.neighbors, lists],
        outputs=[
            wp.zeros(lists.room * held, dtype=wp.float32, device="cpu"),
            wp.zeros(held, dtype=wp.int32, device="cpu"),
            wp.zeros(held, dtype=wp.float32, device="cpu"),
            mean,
        ],
        device="cpu",
    )
    assert mean.numpy().tobytes() == plan.mean.numpy().tobytes()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 600))
def test_a_rotation_and_a_shift_keep_distances(seed, n):
    rng = np.random.default_rng(seed)
    points = cloud(n, seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    moved = (points.astype(np.float64) @ turn.T + rng.uniform(-5, 5, 3)).astype(np.float32)
    # Coordinates of up to 60 m are rounded to 4e-6 m.
    assert np.allclose(measured(moved, 10), measured(points, 10), rtol=TOLERANCE, atol=3e-5)


def test_all_points_in_one_place():
    assert (measured(np.ones((3000, 3), np.float32), 20) == 0).all()


def test_points_in_a_line_and_a_plane():
    line = np.float32([[k, 0, 0] for k in range(100)])
    assert np.allclose(measured(line, 2)[1:-1], 1.0)
    plane = np.float32([[i, j, 0] for i in range(20) for j in range(20)])
    assert np.allclose(measured(plane, 4), expected(plane, 4))


@pytest.mark.parametrize("points", [0, 1, 2])
def test_almost_no_points(points, device):
    assert (measured(np.arange(3 * points, dtype=np.float32).reshape(-1, 3), 5, device) >= 0).all()


@pytest.mark.parametrize(("capacity", "neighbors", "message"), [(100, 0, "neighbors"), (0, 5, "capacity")])
def test_wrong_sizes_are_refused(capacity, neighbors, message):
    with pytest.raises(ValueError, match=message):
        NeighborDistances(capacity=capacity, neighbors=neighbors)
