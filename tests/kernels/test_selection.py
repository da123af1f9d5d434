"""Choosing points by height and by boxes, against NumPy."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.selection import label_outside_boxes, select_heights
from warploom.models.geometry import points_in_boxes


def test_heights_are_selected_within_both_bounds(device):
    ground = np.array([False, True, False, False, False, False, False])
    height = np.array([0.1, 0.5, 0.05, 4.0, 4.01, np.nan, 1.0], np.float32)
    selected = wp.empty(7, dtype=wp.bool, device=device)
    count = wp.array([6], dtype=wp.int32, device=device)
    arrays = (wp.array(ground, dtype=wp.bool, device=device), wp.array(height, device=device))
    select_heights(*arrays, count, (np.float32(0.1), 4.0), selected)
    assert selected.numpy().tolist() == [True, False, False, True, False, False, False]


def scene(seed: int) -> tuple[np.ndarray, ...]:
    """Points in clusters that lie around their boxes, and boxes of known objects."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(-1, 12, 4000).astype(np.int32)
    centres = rng.uniform(-20, 20, (13, 3)) * [1, 1, 0.05]
    xyz = (centres[labels] + rng.uniform(-1.5, 1.5, (4000, 3))).astype(np.float32)
    around = np.full((12, 7), 0.0, np.float32)
    around[:, :3], around[:, 3:6] = centres[:12], 3.0
    known = np.zeros((6, 7), np.float32)
    known[:, :3] = centres[:6] + rng.normal(0, 1, (6, 3))
    known[:, 3:6] = rng.uniform(0.5, 5, (6, 3))
    known[:, 6] = rng.uniform(-4, 4, 6)
    return xyz, labels, around, known


@pytest.mark.parametrize("seed", range(4))
def test_points_in_grown_boxes_lose_their_label(seed, device):
    """The same labels as NumPy gives, but for points within 10 µm of a face, where rounding decides."""
    xyz, labels, around, known = scene(seed)
    outside = wp.empty(len(xyz), dtype=wp.int32, device=device)
    label_outside_boxes(
        wp.array(xyz, dtype=wp.vec3, device=device),
        wp.array(labels, dtype=wp.int32, device=device),
        wp.array([len(xyz)], dtype=wp.int32, device=device),
        known,
        around,
        0.2,
        outside,
    )
    surely_in = points_in_boxes(xyz, known, margin=0.2 - 1e-5).any(axis=0)
    surely_out = ~points_in_boxes(xyz, known, margin=0.2 + 1e-5).any(axis=0)
    actual = outside.numpy()
    assert surely_in.sum() > 50
    assert (actual[surely_in] == -1).all()
    assert np.array_equal(actual[surely_out], labels[surely_out])


def test_labels_without_a_box_keep_theirs(device):
    xyz, labels, around, known = scene(1)
    outside = wp.empty(len(xyz), dtype=wp.int32, device=device)
    arrays = (wp.array(xyz, dtype=wp.vec3, device=device), wp.array(labels, dtype=wp.int32, device=device))
    count = wp.array([len(xyz)], dtype=wp.int32, device=device)
    around[3] = np.nan
    label_outside_boxes(*arrays, count, known, around[:10], 0.2, outside)
    for label in (3, 10, 11):
        assert (outside.numpy()[labels == label] == label).all()
    label_outside_boxes(*arrays, count, known[:0], around, 0.2, outside)
    assert np.array_equal(outside.numpy(), labels)
