"""Boxes of anchors against the equations of SECOND as loops in double precision.

1e-4 m and rad, relative 1e-5: the kernel's numbers are float32.
"""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.anchor_decode import AnchorDecode

ANCHORS = ((3.9, 1.6, 1.56, -1.0, 0.0), (3.9, 1.6, 1.56, -1.0, 1.5707963), (0.8, 0.6, 1.73, 0.265, 0.0))
SHAPE, CLASSES = (5, 7), 2


def plan(device="cpu", **changes):
    given = {"anchors": ANCHORS, "classes": CLASSES, "shape": SHAPE, "first": (-3.0, -2.0), "step": (0.5, 0.25),
             "capacity": 200, "trained_height": 1.7, "device": device}  # fmt: skip
    return AnchorDecode(**{**given, **changes})


def maps(seed):
    rng = np.random.default_rng(seed)
    return [
        rng.normal(0, scale, (1, len(ANCHORS) * channels, *SHAPE)).astype(np.float32)
        for channels, scale in ((CLASSES, 2.0), (7, 0.5), (2, 1.0))
    ]


def run(decode, arrays, threshold, height=1.7):
    decode.launch(
        *(wp.array(a, dtype=wp.float32, device=decode.device) for a in arrays), threshold,
        wp.array([height], dtype=wp.float32, device=decode.device),
    )  # fmt: skip
    n = int(decode.count.numpy()[0])
    return tuple(a.numpy()[:n] for a in (decode.boxes, decode.scores, decode.classes_found, decode.apart))


def slow(arrays, threshold, *, each_class=False, height=1.7):
    scores, residuals, directions = (a[0].astype(np.float64) for a in arrays)
    found = []
    for anchor, (length, width, tall, z0, yaw0) in enumerate(ANCHORS):
        for row in range(SHAPE[0]):
            for column in range(SHAPE[1]):
                own = 1 / (1 + np.exp(-scores[anchor * CLASSES : (anchor + 1) * CLASSES, row, column]))
                wanted = range(CLASSES) if each_class else [int(own.argmax())]
                for kind in wanted:
                    if own[kind] < threshold:
                        continue
                    x, y, z, dl, dw, dh, turn = residuals[anchor * 7 : anchor * 7 + 7, row, column]
                    half = np.argmax(directions[anchor * 2 : anchor * 2 + 2, row, column])
                    yaw = (turn + yaw0 - 0.78539) % np.pi + 0.78539 + np.pi * half
                    d = np.hypot(length, width)
                    found.append([
                        x * d - 3.0 + 0.5 * column, y * d - 2.0 + 0.25 * row, z * tall + z0 - (height - 1.7),
                        np.exp(dl) * length, np.exp(dw) * width, np.exp(dh) * tall,
                        (yaw + np.pi) % (2 * np.pi) - np.pi, own[kind], kind,
                    ])  # fmt: skip
    return np.array(found).reshape(-1, 9)


def agree(found, expected):
    boxes, scores, classes, _ = found
    assert len(boxes) == len(expected)
    np.testing.assert_allclose(boxes[:, :6], expected[:, :6], atol=1e-4, rtol=1e-5)
    turn = boxes[:, 6] - expected[:, 6]
    assert (np.abs((turn + np.pi) % (2 * np.pi) - np.pi) < 1e-4).all()
    np.testing.assert_allclose(scores, expected[:, 7], atol=1e-5)
    assert classes.tolist() == expected[:, 8].astype(int).tolist()


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.floats(0.4, 0.9))
def test_agrees_with_the_equations(seed, each_class, threshold):
    arrays = maps(seed)
    agree(run(plan(each_class=each_class), arrays, threshold), slow(arrays, threshold, each_class=each_class))


def test_on_every_device(device):
    arrays = maps(1)
    agree(run(plan(device), arrays, 0.5, height=2.2), slow(arrays, 0.5, height=2.2))


def test_classes_stand_apart_where_each_is_suppressed_by_itself():
    boxes, _, classes, apart = run(plan(each_class=True), maps(2), 0.5)
    assert set(classes.tolist()) == {0, 1}
    np.testing.assert_allclose(apart[:, 0], boxes[:, 0] + 1000.0 * classes, atol=1e-3)
    np.testing.assert_array_equal(apart[:, 1:], boxes[:, 1:])


def test_what_there_is_no_room_for_is_counted():
    arrays = maps(3)
    expected = slow(arrays, 0.3)
    small = plan(capacity=10)
    found = run(small, arrays, 0.3)
    agree(found, expected[:10])
    assert int(small.dropped.numpy()[0]) == len(expected) - 10 > 0


def test_no_score_is_sure_enough_when_not_a_number():
    arrays = maps(4)
    arrays[0][:] = np.nan
    assert len(run(plan(), arrays, 0.1)[0]) == 0


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="anchors must be rows of l w h z yaw"):
        plan(anchors=((1.0, 0.0, 1.0, 0.0, 0.0),))
    with pytest.raises(ValueError, match="capacity must be at least 1"):
        plan(capacity=0)
    short = maps(0)
    short[1] = short[1][:, :-1]
    with pytest.raises(ValueError, match=r"residuals must have shape \(1, 21, 5, 7\)"):
        run(plan(), short, 0.5)
