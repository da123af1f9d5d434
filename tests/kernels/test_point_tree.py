"""The tree of boxes: every point once, in a leaf whose box and all boxes above hold it."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels import point_tree
from warploom.kernels.point_tree import LEAF, PointTree


def build(points, device="cpu", capacity=None):
    tree = PointTree(capacity=capacity or max(len(points), 1), device=device)
    xyz = wp.array(points, dtype=wp.vec3, device=device) if len(points) else wp.zeros(0, dtype=wp.vec3, device=device)
    tree.build(xyz, wp.array([len(points)], dtype=wp.int32, device=device))
    return tree


def assert_holds(tree, points):
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    size = int(tree.size.numpy()[0])
    index = tree.index.numpy()[:size]
    assert np.array_equal(np.sort(index), finite)
    assert np.array_equal(tree.points.numpy()[:size], points[index])
    low, high = tree.low.numpy(), tree.high.numpy()
    node = tree.leaves + np.arange(size) // LEAF
    while node.size and node[0] >= 1:
        assert (low[node] <= points[index]).all()
        assert (high[node] >= points[index]).all()
        node = node // 2
    if size:
        assert np.array_equal(low[1], points[finite].min(axis=0))
        assert np.array_equal(high[1], points[finite].max(axis=0))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 600), st.sampled_from([1e-45, 1e-20, 1.0, 1e5, 3e37]))
def test_every_finite_point_is_within_its_boxes(seed, n, scale):
    rng = np.random.default_rng(seed)
    points = (rng.normal(0, 2, (n, 3)) * scale).astype(np.float32)
    points[rng.random(n) < 0.05] = np.nan
    assert_holds(build(points, capacity=600), points)


def test_neighbours_in_the_order_are_neighbours_in_space():
    """The boxes of the leaves of a filled cube are small: their mean volume is that of a few points' share."""
    points = np.random.default_rng(1).uniform(0, 1, (8192, 3)).astype(np.float32)
    tree = build(points)
    extent = (tree.high.numpy() - tree.low.numpy())[tree.leaves :]
    assert np.median(extent.prod(axis=1)) * tree.leaves < 1.0


def test_a_few_points_far_away_leave_the_order_of_the_others_as_good():
    """Also where they are a million times as far as the others are wide, and the others come in no order."""
    points = np.random.default_rng(3).uniform(0, 1, (8192, 3)).astype(np.float32)
    points[:8] = [(x, y, z) for x in (-1e6, 1e6) for y in (-1e6, 1e6) for z in (-1e6, 1e6)]
    tree = build(points)
    assert_holds(tree, points)
    extent = (tree.high.numpy() - tree.low.numpy())[tree.leaves :]
    assert np.median(extent.prod(axis=1)) * tree.leaves < 2.0


@pytest.mark.parametrize("columns", [3, 4, 5])
def test_rows_that_are_apart_in_memory(columns):
    points = np.random.default_rng(4).normal(0, 5, (1001, columns)).astype(np.float32)
    points[7, 0], points[500, 2] = np.nan, np.inf
    rows = wp.array(ptr=points.ctypes.data, dtype=wp.vec3, shape=1001, strides=(4 * columns,), device="cpu")
    tree = PointTree(capacity=2000)
    tree.build(rows, wp.array([1001], dtype=wp.int32, device="cpu"))
    assert_holds(tree, points[:, :3])


def test_level_by_level_bounds_the_same_nodes():
    """As on a GPU; on a CPU one thread bounds them all."""
    tree = build(np.random.default_rng(2).normal(0, 5, (777, 3)).astype(np.float32))
    low, high = wp.clone(tree.low), wp.clone(tree.high)
    for corners in (low, high):
        corners[: tree.leaves].zero_()
    first = tree.leaves // 2
    while first:
        wp.launch(point_tree._bound_nodes, first, inputs=[first], outputs=[low, high], device="cpu")
        first //= 2
    assert np.array_equal(low.numpy()[1:], tree.low.numpy()[1:])
    assert np.array_equal(high.numpy()[1:], tree.high.numpy()[1:])


def test_duplicates_and_a_plan_used_again(device):
    tree = PointTree(capacity=1024, device=device)
    for points in (np.ones((1000, 3), np.float32), np.eye(3, dtype=np.float32), np.zeros((1, 3), np.float32)):
        tree.build(
            wp.array(points, dtype=wp.vec3, device=device), wp.array([len(points)], dtype=wp.int32, device=device)
        )
        assert_holds(tree, points)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="capacity must be"):
        PointTree(capacity=0)
    with pytest.raises(ValueError, match="more than the plan's capacity"):
        PointTree(capacity=2).build(wp.zeros(3, dtype=wp.vec3, device="cpu"), wp.zeros(1, dtype=wp.int32, device="cpu"))
