"""Boxes after a second look against an implementation in NumPy."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.box_rescore import BoxRescore

KINDS, MOST = 3, 16
SHARES = (0.5, 1.0, 1.0)
POWERS = (1.0, 0.7, 1.2)


def rescore(boxes, scores, keep, said, *, moved=(True, False, True), weights=(0.3, 0.5, 0.2), least=0.2, count=None):
    plan = BoxRescore(boxes=MOST, candidates=64, moved=moved, size_shares=SHARES, powers=POWERS, weights=weights)

    def array(values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")

    plan.launch(
        array(np.float32(boxes), wp.float32),
        array(np.float32(scores), wp.float32),
        array(np.int32(keep), wp.int32),
        array(np.int32([len(keep) if count is None else count]), wp.int32),
        array(np.float32(said), wp.float32),
        least,
    )
    n = int(plan.count.numpy()[0])
    return plan.boxes_out.numpy()[:n], plan.scores.numpy()[:n], plan.kinds.numpy()[:n], int(plan.dropped.numpy()[0])


def scene(rng, n):
    boxes = np.c_[
        rng.uniform(-50, 50, (n, 2)), rng.uniform(-2, 0, n), rng.uniform(0.5, 5, (n, 3)), rng.uniform(-3.1, 3.1, n)
    ]
    said = np.c_[rng.normal(0, 2, (MOST, 2 + KINDS)), rng.normal(0, 0.2, (MOST, 7))]
    return np.float32(boxes), np.float32(rng.random(n)), np.float32(said)


def reference(boxes, scores, keep, said, moved, weights, least):
    out = boxes[keep].astype(float)
    said = said[: len(keep)].astype(float)
    p = np.exp(said[:, : KINDS + 1])
    p = (p / p.sum(1, keepdims=True))[:, 1:]
    kinds = p.argmax(1)
    overlap = 1 / (1 + np.exp(-said[:, KINDS + 1]))
    new = scores[keep] ** weights[0] * p.max(1) ** weights[1] * overlap ** weights[2]
    new = new ** np.array(POWERS)[kinds]
    move = np.clip(said[:, KINDS + 2 :], -1, 1) * np.array(moved)[kinds][:, None]
    c, s = np.cos(out[:, 6]), np.sin(out[:, 6])
    diagonal = np.hypot(out[:, 3], out[:, 4])
    a, b = move[:, 0] * diagonal, move[:, 1] * diagonal
    out[:, 0] += a * c - b * s
    out[:, 1] += a * s + b * c
    out[:, 2] += move[:, 2] * out[:, 5]
    out[:, 3:6] *= np.exp(move[:, 3:6] * np.array(SHARES)[kinds][:, None])
    out[:, 6] = (out[:, 6] + move[:, 6] + np.pi) % (2 * np.pi) - np.pi
    return out, np.where(new >= least, new, np.nan), kinds


@pytest.mark.parametrize("n", [0, 1, 5, 16])
@pytest.mark.parametrize("weights", [(0.3, 0.5, 0.2), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)])
def test_it_is_what_numpy_computes(n, weights):
    """To 1e-4 of places in metres and of scores: powers and exponentials in float32."""
    rng = np.random.default_rng(n)
    boxes, scores, said = scene(rng, 20)
    keep = rng.permutation(20)[:n]
    moved = (True, False, True)
    if n == 0:
        found = rescore(boxes, scores, np.zeros(4), said, weights=weights, count=0)
        assert len(found[0]) == 0
        return
    found = rescore(boxes, scores, keep, said, moved=moved, weights=weights)
    wanted = reference(boxes, scores, keep, said, moved, weights, 0.2)
    np.testing.assert_allclose(found[0], wanted[0], atol=1e-4)
    np.testing.assert_allclose(found[1], wanted[1], atol=1e-4)
    np.testing.assert_array_equal(found[2], wanted[2])
    assert found[3] == 0


def test_what_nobody_looks_at_is_counted_where_its_score_would_do():
    boxes, _, said = scene(np.random.default_rng(2), 30)
    scores = np.linspace(1, 0.05, 30)
    found = rescore(boxes, scores, np.arange(30), said, least=0.3)
    assert len(found[0]) == MOST
    assert found[3] == (scores[MOST:] >= 0.3).sum() > 0


def test_large_residuals_are_bounded():
    boxes = np.array([[10, 0, -1, 3, 4, 1.5, 0]])
    said = np.zeros((MOST, 12))
    said[:, 3], said[:, 5:] = 5, 9
    moved = rescore(boxes, [0.9], [0], said)[0][0]
    np.testing.assert_allclose(moved, [15, 5, 0.5, 3 * np.e, 4 * np.e, 1.5 * np.e, 1], rtol=1e-5)


def test_a_network_that_says_nan_finds_nothing():
    found = rescore(np.ones((1, 7)), [0.9], [0], np.full((MOST, 12), np.nan))
    assert np.isnan(found[1]).all()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"boxes": 0}, "boxes"),
        ({"candidates": 0}, "candidates"),
        ({"moved": ()}, "moved"),
        ({"weights": (0.5, 0.6, -0.1)}, "weights"),
        ({"size_shares": (2.0,)}, "size_shares"),
        ({"powers": (0.0,)}, "powers"),
        ({"size_shares": (1.0, 1.0)}, "size_shares"),
    ],
)
def test_wrong_arguments_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        BoxRescore(
            **{
                "boxes": 4,
                "candidates": 9,
                "moved": (True,),
                "size_shares": (1.0,),
                "powers": (1.0,),
                "weights": (0.5, 0.5, 0.0),
                **wrong,
            }
        )


def test_a_network_of_other_outputs_is_refused():
    with pytest.raises(ValueError, match="said"):
        rescore(np.ones((1, 7)), [0.9], [0], np.zeros((MOST, 11)))


def test_boxes_that_cannot_reach_the_least_score_are_not_chosen():
    """What is chosen is all that would do if the network were certain, in its order."""
    rng = np.random.default_rng(9)
    scores, kinds, keep = np.float32(rng.random(40)), rng.integers(0, KINDS, 40), rng.permutation(40)[:30]
    plan = BoxRescore(
        boxes=MOST, candidates=30, moved=(True,) * 3, size_shares=SHARES, powers=POWERS, weights=(0.4, 0.4, 0.2)
    )
    values = (scores, wp.float32), (np.int32(kinds), wp.int32), (np.int32(keep), wp.int32), (np.int32([25]), wp.int32)
    given = [wp.array(value, dtype=dtype, device="cpu") for value, dtype in values]
    plan.choose(*given, 0.6)
    wanted = [b for b in keep[:25] if scores[b] ** (0.4 * POWERS[kinds[b]]) >= 0.6]
    assert plan.chosen.numpy()[: plan.chosen_count.numpy()[0]].tolist() == wanted
    assert 0 < len(wanted) < 25
    with pytest.raises(ValueError, match="candidates"):
        plan.choose(*given[:2], wp.zeros(31, dtype=wp.int32, device="cpu"), given[3], 0.6)
