"""Nearest detections, errors of boxes and recall by ranges, on small cases worked out by hand."""

import numpy as np
import pytest

from warploom.models.evaluation.recall import box_errors, nearest_detections, recall_by


def boxes(*places):
    return np.array([[x, y, 0.0, 4.0, 2.0, 1.5, yaw] for x, y, yaw in places])


def test_each_object_has_its_nearest_detection():
    near = nearest_detections(boxes((0, 0, 0), (10, 0, 0)), boxes((9, 0, 0), (0.3, 0.4, 0)))
    np.testing.assert_allclose(near.distance, [0.5, 1.0])
    assert near.index.tolist() == [1, 0]


def test_nothing_found_is_infinitely_far():
    assert np.isinf(nearest_detections(boxes((0, 0, 0)), np.empty((0, 7))).distance).all()
    assert nearest_detections(np.empty((0, 7)), boxes((0, 0, 0))).distance.shape == (0,)


@pytest.mark.parametrize(("found", "error"), [(0.1, 0.1), (np.pi, 0.0), (np.pi / 2, np.pi / 2), (-3.0, np.pi - 3.0)])
def test_axes_are_compared_front_and_back_alike(found, error):
    turn, size = box_errors(boxes((0, 0, 0.0)), boxes((0, 0, found)))
    np.testing.assert_allclose(turn, [error], atol=1e-12)
    assert (size == 0).all()


def test_sizes_are_found_minus_true():
    larger = boxes((0, 0, 0))
    larger[0, 3:6] += (0.5, -0.25, 0.125)
    np.testing.assert_allclose(box_errors(boxes((0, 0, 0)), larger)[1], [[0.5, -0.25, 0.125]])


def test_recall_by_ranges_leaves_nothing_out_within_the_edges():
    bins = recall_by(np.array([0, 4.9, 5, 9.9, 10, -1]), np.array([1, 0, 1, 1, 1, 1]), (0, 5, 10))
    assert [(each.objects, each.found) for each in bins] == [(2, 1), (2, 2)]


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="edges must be two or more that ascend"):
        recall_by(np.zeros(1), np.zeros(1), (0, 5, 5))
    with pytest.raises(ValueError, match="found must be of the shape"):
        recall_by(np.zeros(2), np.zeros(1), (0, 5))
