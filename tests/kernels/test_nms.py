"""Suppression of oriented boxes against the textbook's loop over shapely polygons."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels import nms
from warploom.kernels.iou import rotated_iou_bev
from warploom.kernels.nms import RotatedNms, rotated_nms
from warploom.kernels.threads import set_thread_count, thread_count


def crowded(rng, n):
    boxes = np.c_[
        rng.uniform(-15, 15, (n, 2)),
        np.zeros(n),
        rng.uniform(1.0, 5.0, (n, 2)),
        np.ones(n),
        rng.uniform(-3.2, 3.2, n),
    ].astype(np.float32)
    return boxes, rng.random(n).astype(np.float32)


def reference(overlap, scores, threshold):
    kept = []
    for i in np.argsort(-scores, kind="stable"):
        if all(overlap[i, j] <= threshold for j in kept):
            kept.append(int(i))
    return kept


def shapely_overlap(boxes):
    shapely = pytest.importorskip("shapely")
    from shapely import affinity

    rectangles = [
        affinity.translate(
            affinity.rotate(shapely.box(-b[3] / 2, -b[4] / 2, b[3] / 2, b[4] / 2), b[6], use_radians=True), b[0], b[1]
        )
        for b in boxes.astype(np.float64)
    ]
    shapes = np.array(rectangles)
    area = shapely.area(shapely.intersection(shapes[:, None], shapes[None, :]))
    own = shapely.area(shapes)
    return area / (own[:, None] + own[None, :] - area)


@pytest.mark.parametrize("threshold", [0.1, 0.3, 0.6])
def test_keeps_what_the_textbook_keeps(device, threshold):
    rng = np.random.default_rng(11)
    boxes, scores = crowded(rng, 220)
    overlap = shapely_overlap(boxes)
    # No pair so near the threshold that rounding decides: the comparison is then exact.
    assert np.abs(overlap - threshold).min() > 1e-5
    given_boxes, given_scores = boxes, scores
    if device != "cpu":
        given_boxes, given_scores = (wp.array(a, dtype=wp.float32, device=device) for a in (boxes, scores))
    kept = rotated_nms(given_boxes, given_scores, threshold)
    kept = kept if isinstance(kept, np.ndarray) else kept.numpy()
    assert kept.tolist() == reference(overlap, scores, threshold)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 120), st.sampled_from([0.0, 0.2, 0.5]))
def test_no_two_kept_overlap_and_every_lost_one_lost_to_a_better(seed, n, threshold):
    rng = np.random.default_rng(seed)
    boxes, scores = crowded(rng, n)
    kept = rotated_nms(boxes, scores, threshold)
    overlap = rotated_iou_bev(boxes, boxes)
    among = overlap[np.ix_(kept, kept)] - np.eye(len(kept))
    assert among.max() <= threshold + 1e-5
    for lost in set(range(n)) - set(kept.tolist()):
        better = kept[scores[kept] >= scores[lost]]
        assert overlap[lost, better].max() >= threshold - 1e-5


def test_equal_scores_keep_the_first():
    boxes = np.array([[0, 0, 0, 4, 2, 1, 0], [0.5, 0, 0, 4, 2, 1, 0], [20, 0, 0, 4, 2, 1, 0]], np.float32)
    assert rotated_nms(boxes, np.full(3, 0.5, np.float32), 0.3).tolist() == [0, 2]


def test_a_limit_keeps_the_best_and_the_plan_counts_the_rest():
    rng = np.random.default_rng(2)
    boxes, scores = crowded(rng, 100)
    everything = rotated_nms(boxes, scores, 0.2)
    assert rotated_nms(boxes, scores, 0.2, max_output=5).tolist() == everything[:5].tolist()
    plan = RotatedNms(capacity=128, threshold=0.2, max_output=5)
    plan.launch(wp.array(boxes, dtype=wp.float32), wp.array(scores), wp.array([100], dtype=wp.int32))
    assert plan.keep.numpy().tolist() == everything[:5].tolist()
    assert plan.dropped.numpy()[0] == len(everything) - 5


def test_a_plan_looks_at_the_count_alone():
    rng = np.random.default_rng(6)
    boxes, scores = crowded(rng, 90)
    plan = RotatedNms(capacity=128, threshold=0.3, max_output=128)
    plan.launch(wp.array(boxes, dtype=wp.float32), wp.array(scores), wp.array([40], dtype=wp.int32))
    kept = plan.keep.numpy()[: plan.keep_count.numpy()[0]]
    assert kept.tolist() == rotated_nms(boxes[:40], scores[:40], 0.3).tolist()


def test_nan_scores_are_left_out_and_nothing_gives_nothing():
    boxes, _ = crowded(np.random.default_rng(0), 3)
    assert rotated_nms(boxes, np.array([np.nan, 0.1, np.nan], np.float32), 0.5).tolist() == [1]
    assert rotated_nms(np.empty((0, 7), np.float32), np.empty(0, np.float32), 0.5).shape == (0,)


def test_wrong_arguments_are_refused():
    boxes, scores = crowded(np.random.default_rng(0), 3)
    with pytest.raises(ValueError, match=r"scores must have shape \(3\)"):
        rotated_nms(boxes, scores[:2], 0.5)
    with pytest.raises(ValueError, match="threshold must be in"):
        rotated_nms(boxes, scores, 1.5)


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_parts_and_all_pairs_give_the_same_bits(parts, monkeypatch):
    """A CPU looks only at boxes that are near, in parts; a GPU at all."""
    boxes, scores = crowded(np.random.default_rng(12), 500)
    boxes[::50, 3], boxes[7::60, 0], boxes[11::70, 6] = 0.0, np.nan, np.inf
    monkeypatch.setattr(nms, "_PAIRS_OF_PART", 1)
    before = thread_count()
    try:
        set_thread_count(parts)
        plan = RotatedNms(capacity=512, threshold=0.2, max_output=512, device="cpu")
    finally:
        set_thread_count(before)
    count = wp.array([500], dtype=wp.int32, device="cpu")
    plan.launch(wp.array(boxes, dtype=wp.float32, device="cpu"), wp.array(scores, device="cpu"), count)
    bits = wp.zeros_like(plan._bits)
    wp.launch(nms._overlap_bits, (500, 16), inputs=[plan._shapes, count, 500, 0.2], outputs=[bits], device="cpu")
    for i in range(500):
        assert np.array_equal(plan._bits.numpy()[i, (i + 1) // 32 :], bits.numpy()[i, (i + 1) // 32 :])
    assert plan.keep.numpy()[: plan.keep_count.numpy()[0]].tolist() == rotated_nms(boxes, scores, 0.2).tolist()
