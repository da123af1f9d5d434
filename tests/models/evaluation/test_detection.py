"""Detection metrics: hand cases, and a slow evaluation written independently."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.evaluation.detection import (
    DetectionFrame,
    average_precision,
    evaluate_class,
    match_detections,
)


def box(x, y=0.0, yaw=0.0):
    return [x, y, 0.0, 4.0, 2.0, 1.5, yaw]


def frame(found, scores, truth, ignore=None):
    return DetectionFrame(
        boxes=np.array(found, np.float32).reshape(-1, 7),
        scores=np.array(scores, np.float32),
        classes=np.zeros(len(found), np.int32),
        truth=np.array(truth, np.float32).reshape(-1, 7),
        truth_classes=np.zeros(len(truth), np.int32),
        ignore=None if ignore is None else np.array(ignore),
    )


def test_the_better_score_takes_the_truth():
    matches = match_detections(np.array([box(0.4), box(0.1)]), np.array([0.9, 0.5]), np.array([box(0.0)]))
    assert matches.truth_of.tolist() == [0, -1]
    assert matches.detection_of.tolist() == [0]
    assert matches.value[0] == pytest.approx(0.4)


def test_each_measure_has_its_own_threshold():
    found, truth, scores = np.array([box(1.0)]), np.array([box(0.0)]), np.array([0.5])
    assert match_detections(found, scores, truth, threshold=1.1).truth_of[0] == 0
    assert match_detections(found, scores, truth, threshold=0.9).truth_of[0] == -1
    for measure in ("bev", "3d"):  # overlap 3 of 5 m
        assert match_detections(found, scores, truth, measure=measure, threshold=0.59).truth_of[0] == 0
        assert match_detections(found, scores, truth, measure=measure, threshold=0.61).truth_of[0] == -1


def test_average_precision_by_hand():
    """Hit, miss, hit with two truths: precision 1, ½, ⅔ at recall ½, ½, 1."""
    result = evaluate_class([frame([box(0), box(50), box(20)], [0.9, 0.8, 0.7], [box(0), box(20)])], 0)
    np.testing.assert_allclose(result.precision, [1, 1 / 2, 2 / 3])
    np.testing.assert_allclose(result.recall, [0.5, 0.5, 1.0])
    assert result.ap == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert result.ap_r40 == pytest.approx(0.5 * 1 + 0.5 * 2 / 3)
    assert result.at(0.75) == (0.5, 0.5)
    assert result.at(0.95)[1] == 0.0


def test_perfect_and_empty():
    assert evaluate_class([frame([box(0)], [0.5], [box(0)])], 0).ap == 1.0
    assert evaluate_class([frame([], [], [box(0)])], 0).ap == 0.0
    assert np.isnan(evaluate_class([frame([box(0)], [0.5], [])], 0).ap)
    assert average_precision(np.empty(0), np.empty(0)) == (0.0, 0.0)


def test_what_matches_an_ignored_truth_does_not_count():
    result = evaluate_class([frame([box(0), box(20), box(40)], [0.9, 0.8, 0.7], [box(0), box(20)], [False, True])], 0)
    assert result.truths == 1
    np.testing.assert_allclose(result.precision, [1.0, 0.5])


def test_other_classes_are_left_alone():
    mixed = DetectionFrame(
        boxes=np.array([box(0), box(20)], np.float32),
        scores=np.array([0.9, 0.8], np.float32),
        classes=np.array([0, 1]),
        truth=np.array([box(0), box(20)], np.float32),
        truth_classes=np.array([1, 1]),
    )
    assert evaluate_class([mixed], 0).truths == 0
    assert evaluate_class([mixed], 1).recall.tolist() == [0.5]


def slow_ap(frames, threshold):
    """nuScenes' way, written as loops: over all frames from the best score down, nearest free truth."""
    ranked = sorted(
        ((float(f.scores[k]), -i, -k) for i, f in enumerate(frames) for k in range(len(f.boxes))), reverse=True
    )
    taken, hits = set(), []
    for _, i, k in ranked:
        f = frames[-i]
        best, nearest = None, np.inf
        for m, truth in enumerate(f.truth):
            distance = np.hypot(*(f.boxes[-k, :2].astype(float) - truth[:2].astype(float)))
            if (-i, m) not in taken and distance < nearest:
                best, nearest = m, distance
        hits.append(best is not None and nearest <= threshold)
        if hits[-1]:
            taken.add((-i, best))
    total = sum(len(f.truth) for f in frames)
    points = [(sum(hits[: n + 1]) / total, sum(hits[: n + 1]) / (n + 1)) for n in range(len(hits))]
    area, last = 0.0, 0.0
    for n, (recall, _) in enumerate(points):
        area += (recall - last) * max(p for _, p in points[n:])
        last = recall
    return area


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 1.0, 2.0]))
def test_agrees_with_the_slow_evaluation(seed, threshold):
    rng = np.random.default_rng(seed)
    frames = []
    for _ in range(4):
        truth = [box(*rng.uniform(-10, 10, 2)) for _ in range(rng.integers(1, 6))]
        found = [box(*(np.array(t[:2]) + rng.normal(0, 0.7, 2))) for t in truth if rng.random() < 0.8]
        found += [box(*rng.uniform(-10, 10, 2)) for _ in range(rng.integers(0, 4))]
        frames.append(frame(found, rng.random(len(found)), truth))
    assert evaluate_class(frames, 0, threshold=threshold).ap == pytest.approx(slow_ap(frames, threshold), abs=1e-9)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="measure must be"):
        match_detections(np.zeros((1, 7)), np.zeros(1), np.zeros((1, 7)), measure="iou")
    with pytest.raises(ValueError, match="scores must be one for each"):
        match_detections(np.zeros((2, 7)), np.zeros(1), np.zeros((1, 7)))
