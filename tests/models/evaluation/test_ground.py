"""Ground scores against scikit-learn, and the label maps."""

import numpy as np
import pytest

from warploom.models.evaluation.ground import RANGE_IMAGE_32, SEMANTIC_KITTI, SEMANTIC_KITTI_TRAIN, ground_scores


def test_scores_equal_scikit_learns():
    from sklearn.metrics import precision_recall_fscore_support

    rng = np.random.default_rng(1)
    mask, ground, scored = rng.random((3, 5000)) < np.array([[0.4], [0.5], [0.8]])
    expected = precision_recall_fscore_support(ground[scored], mask[scored], average="binary")[:3]
    scores = ground_scores(mask, ground, scored)
    np.testing.assert_allclose([scores.precision, scores.recall, scores.f1], expected, rtol=1e-12)


def test_nothing_to_score_is_nan():
    nothing = np.zeros(4, bool)
    scores = ground_scores(nothing, nothing)
    assert np.isnan([scores.precision, scores.recall, scores.f1]).all()


def test_shapes_that_differ_are_refused():
    with pytest.raises(ValueError, match="one shape"):
        ground_scores(np.zeros(3, bool), np.zeros(4, bool))


@pytest.mark.parametrize("labels", [SEMANTIC_KITTI, SEMANTIC_KITTI_TRAIN, RANGE_IMAGE_32])
def test_a_label_is_not_both_ground_and_ignored(labels):
    assert not set(labels.ground) & set(labels.ignored)


def test_vegetation_is_not_scored_and_terrain_is_ground():
    ground, scored = SEMANTIC_KITTI.masks(np.array([70, 72, 10, 40, 0]))
    assert ground.tolist() == [False, True, False, True, False]
    assert scored.tolist() == [False, True, True, True, False]
