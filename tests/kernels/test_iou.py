"""Overlaps of oriented boxes against shapely's polygons and OpenCV's rotated rectangles."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels import iou
from warploom.kernels.iou import GeneralizedIou, RotatedIou, giou_3d, iou_3d, rotated_iou_bev
from warploom.kernels.threads import set_thread_count, thread_count
from warploom.models.geometry import box_overlap


def some_boxes(rng, n, spread=8.0):
    return np.c_[
        rng.uniform(-spread, spread, (n, 2)),
        rng.uniform(-1, 1, n),
        rng.uniform(0.3, 6.0, (n, 2)),
        rng.uniform(0.5, 3.0, n),
        rng.uniform(-4.0, 4.0, n),
    ].astype(np.float32)


def polygons(boxes):
    shapely = pytest.importorskip("shapely")
    boxes = boxes.astype(np.float64)
    corners = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]])
    local = corners * boxes[:, None, 3:5]
    c, s = np.cos(boxes[:, 6, None]), np.sin(boxes[:, 6, None])
    x = boxes[:, None, 0] + c * local[..., 0] - s * local[..., 1]
    y = boxes[:, None, 1] + s * local[..., 0] + c * local[..., 1]
    return shapely.polygons(np.stack([x, y], axis=-1))


def reference(a, b):
    """From above and in space, in double precision."""
    import shapely

    pa, pb = polygons(a), polygons(b)
    area = shapely.area(shapely.intersection(pa[:, None], pb[None, :]))
    flat = [boxes[:, 3].astype(np.float64) * boxes[:, 4] for boxes in (a, b)]
    bev = area / (flat[0][:, None] + flat[1][None, :] - area)
    top = np.minimum((a[:, 2] + a[:, 5] / 2)[:, None], (b[:, 2] + b[:, 5] / 2)[None, :])
    low = np.maximum((a[:, 2] - a[:, 5] / 2)[:, None], (b[:, 2] - b[:, 5] / 2)[None, :])
    volume = area * np.clip(top - low, 0, None)
    space = volume / ((flat[0] * a[:, 5])[:, None] + (flat[1] * b[:, 5])[None, :] - volume)
    return bev, space


def on(device, array):
    return array if device == "cpu" else wp.array(array, dtype=wp.float32, device=device)


def test_every_pair_agrees_with_shapely(device):
    """Within 2e-5, the rounding of float32 coordinates of some metres."""
    rng = np.random.default_rng(3)
    a, b = some_boxes(rng, 150), some_boxes(rng, 130)
    bev, space = reference(a, b)
    assert (bev > 0).sum() > 1000
    got = [face(on(device, a), on(device, b)) for face in (rotated_iou_bev, iou_3d)]
    got = [array if isinstance(array, np.ndarray) else array.numpy() for array in got]
    np.testing.assert_allclose(got[0], bev, atol=2e-5)
    np.testing.assert_allclose(got[1], space, atol=2e-5)


def test_far_from_the_origin_it_is_as_exact():
    rng = np.random.default_rng(4)
    a = some_boxes(rng, 60)
    b = some_boxes(rng, 60)
    a[:, 0] += 64.0
    b[:, 0] += 64.0
    np.testing.assert_allclose(rotated_iou_bev(a, b), reference(a, b)[0], atol=5e-5)


def test_agrees_with_opencv():
    """Within 1e-3: OpenCV's own intersection is of float32 corners in its image coordinates."""
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(5)
    a, b = some_boxes(rng, 40, 4.0), some_boxes(rng, 40, 4.0)
    got = rotated_iou_bev(a, b)
    for i in range(40):
        for j in range(40):
            first, second = (
                ((float(r[0]), float(r[1])), (float(r[3]), float(r[4])), float(np.degrees(r[6]))) for r in (a[i], b[j])
            )
            kind, corners = cv2.rotatedRectangleIntersection(first, second)
            area = 0.0 if kind == cv2.INTERSECT_NONE else cv2.contourArea(cv2.convexHull(corners))
            union = a[i, 3] * a[i, 4] + b[j, 3] * b[j, 4] - area
            assert got[i, j] == pytest.approx(area / union, abs=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    st.floats(-60, 60, width=32),
    st.floats(0.25, 15, width=32),
    st.floats(0.25, 4, width=32),
    st.floats(-7, 7, width=32),
    st.sampled_from([0.0, np.pi, -np.pi, 2 * np.pi, 1e-7, -1e-6]),
)
def test_a_box_and_its_like_overlap_wholly(x, length, width, yaw, turn):
    """Edges that coincide, or nearly: the case that clipping algorithms get wrong."""
    box = np.array([[x, -x / 2, 0, length, width, 1.5, yaw]], np.float32)
    like = box.copy()
    like[0, 6] += turn
    assert rotated_iou_bev(box, like)[0, 0] == pytest.approx(1.0, abs=2e-4)
    assert iou_3d(box, like)[0, 0] == pytest.approx(1.0, abs=2e-4)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_it_is_symmetric_and_bounded(seed):
    rng = np.random.default_rng(seed)
    a, b = some_boxes(rng, 20, 3.0), some_boxes(rng, 20, 3.0)
    forth, back = rotated_iou_bev(a, b), rotated_iou_bev(b, a)
    np.testing.assert_allclose(forth, back.T, atol=2e-5)
    assert forth.min() >= 0
    assert forth.max() <= 1 + 1e-6


def test_hand_cases():
    unit = np.array([[0, 0, 0, 2, 2, 2, 0]], np.float32)
    half = np.array(
        [[1, 0, 0, 2, 2, 2, 0], [0, 0, 1, 2, 2, 2, np.pi / 2], [0, 0, 0, 1, 1, 1, 0.3], [9, 9, 0, 2, 2, 2, 1]]
    )
    half = half.astype(np.float32)
    np.testing.assert_allclose(rotated_iou_bev(unit, half)[0], [1 / 3, 1, 0.25, 0], atol=1e-6)
    np.testing.assert_allclose(iou_3d(unit, half)[0], [1 / 3, 1 / 3, 0.125, 0], atol=1e-6)


def test_nothing_overlaps_what_is_not_finite_or_empty():
    good = np.array([[0, 0, 0, 4, 2, 2, 0]], np.float32)
    bad = np.repeat(good, 3, axis=0)
    bad[0, 0], bad[1, 6], bad[2, 3] = np.nan, np.nan, 0.0
    assert np.nan_to_num(rotated_iou_bev(good, bad)).max() == 0
    assert rotated_iou_bev(good, np.empty((0, 7), np.float32)).shape == (1, 0)


def test_the_family_comes_back():
    torch = pytest.importorskip("torch")
    boxes = torch.tensor([[0.0, 0, 0, 4, 2, 2, 0.5]])
    got = rotated_iou_bev(boxes, boxes)
    assert isinstance(got, torch.Tensor)
    assert float(got[0, 0]) == pytest.approx(1.0, abs=1e-5)


def test_a_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"a must have shape \(n, 7\)"):
        rotated_iou_bev(np.zeros((2, 6), np.float32), np.zeros((2, 7), np.float32))


def enclosing_hulls(a, b):
    """The areas from above of the convex hulls of all pairs."""
    import shapely

    pa, pb = polygons(a), polygons(b)
    corners = np.concatenate(
        [
            np.broadcast_to(shapely.get_coordinates(pa).reshape(len(a), 1, 5, 2), (len(a), len(b), 5, 2)),
            np.broadcast_to(shapely.get_coordinates(pb).reshape(1, len(b), 5, 2), (len(a), len(b), 5, 2)),
        ],
        axis=2,
    )
    return shapely.area(shapely.convex_hull(shapely.multipoints(corners)))


def test_giou_agrees_with_shapelys_convex_hulls(device):
    """Within 3e-5, the rounding of float32 coordinates of some metres."""
    rng = np.random.default_rng(6)
    a, b = some_boxes(rng, 90), some_boxes(rng, 80)
    _, overlap = reference(a, b)
    a64, b64 = a.astype(np.float64), b.astype(np.float64)
    volume = [boxes[:, 3] * boxes[:, 4] * boxes[:, 5] for boxes in (a64, b64)]
    both = volume[0][:, None] + volume[1][None, :]
    union = both / (1 + overlap)
    top = np.maximum((a64[:, 2] + a64[:, 5] / 2)[:, None], (b64[:, 2] + b64[:, 5] / 2)[None, :])
    low = np.minimum((a64[:, 2] - a64[:, 5] / 2)[:, None], (b64[:, 2] - b64[:, 5] / 2)[None, :])
    body = enclosing_hulls(a, b) * (top - low)
    got = giou_3d(on(device, a), on(device, b))
    got = got if isinstance(got, np.ndarray) else got.numpy()
    np.testing.assert_allclose(got, overlap - (body - union) / body, atol=3e-5)


def test_giou_with_the_box_along_the_first_agrees_with_numpys(device):
    """Within 3e-5, as above."""
    rng = np.random.default_rng(7)
    a, b = some_boxes(rng, 70), some_boxes(rng, 60)
    expected = box_overlap(np.repeat(a, len(b), axis=0), np.tile(b, (len(a), 1)))[2].reshape(len(a), len(b))
    got = giou_3d(on(device, a), on(device, b), enclosing="box")
    got = got if isinstance(got, np.ndarray) else got.numpy()
    np.testing.assert_allclose(got, expected, atol=3e-5)


@settings(max_examples=40, deadline=None)
@given(
    st.floats(-1e5, 1e5, width=32),
    st.floats(0.25, 15, width=32),
    st.floats(0.25, 4, width=32),
    st.floats(-7, 7, width=32),
    st.sampled_from([0.0, np.pi, -np.pi, 2 * np.pi, 1e-7, -1e-6]),
    st.sampled_from(["hull", "box"]),
)
def test_giou_of_a_box_with_its_like_is_one(x, length, width, yaw, turn, enclosing):
    """Corners that coincide, or nearly, wherever the box is: the case that walks around hulls get wrong."""
    box = np.array([[x, -x / 2, 0, length, width, 1.5, yaw]], np.float32)
    like = box.copy()
    like[0, 6] += turn
    assert giou_3d(box, like, enclosing=enclosing)[0, 0] == pytest.approx(1.0, abs=4e-4)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_giou_is_bounded_and_falls_with_distance(seed):
    rng = np.random.default_rng(seed)
    a = some_boxes(rng, 1, 3.0)
    b = np.repeat(some_boxes(rng, 1, 3.0), 30, axis=0)
    b[:, 0] = a[0, 0] + np.linspace(20, 400, 30)
    apart = giou_3d(a, b)[0]
    assert (np.diff(apart) < 1e-6).all()
    assert apart.min() >= -1
    close = some_boxes(rng, 40, 3.0)
    near = giou_3d(a, close)
    assert near.min() >= -1
    assert (near <= iou_3d(a, close) + 1e-6).all()


def test_giou_hand_cases():
    unit = np.array([[0, 0, 0, 2, 2, 2, 0]], np.float32)
    others = np.float32([[2, 0, 0, 2, 2, 2, 0], [0, 0, 2, 2, 2, 2, np.pi / 2], [4, 0, 0, 2, 2, 2, 0]])
    for enclosing in ("hull", "box"):
        np.testing.assert_allclose(giou_3d(unit, others, enclosing=enclosing)[0], [0, 0, -1 / 3], atol=1e-6)
    corner = np.float32([[2, 2, 0, 2, 2, 2, 0]])
    assert giou_3d(unit, corner)[0, 0] == pytest.approx(-4 / 12, abs=1e-6)
    assert giou_3d(unit, corner, enclosing="box")[0, 0] == pytest.approx(-8 / 16, abs=1e-6)


def test_giou_of_what_is_not_finite_or_empty_is_minus_one():
    good = np.array([[0, 0, 0, 4, 2, 2, 0]], np.float32)
    bad = np.repeat(good, 4, axis=0)
    bad[0, 0], bad[1, 6], bad[2, 3], bad[3, 5] = np.inf, np.nan, 0.0, -1.0
    assert (giou_3d(good, bad) == -1).all()
    assert (giou_3d(bad, good) == -1).all()
    assert giou_3d(np.empty((0, 7), np.float32), good).shape == (0, 1)


def test_giou_refuses_what_it_does_not_know():
    box = np.zeros((1, 7), np.float32)
    with pytest.raises(ValueError, match="enclosing must be one of hull, box, not 'sphere'"):
        giou_3d(box, box, enclosing="sphere")
    with pytest.raises(ValueError, match="enclosing must be one of"):
        GeneralizedIou(rows=1, columns=1, enclosing="sphere")
    with pytest.raises(ValueError, match="more than the plan's 1 × 1"):
        GeneralizedIou(rows=1, columns=1).launch(wp.zeros((2, 7)), wp.zeros((2, 7)), wp.zeros(2, dtype=int))


def crossed(boxes, others):
    """All three overlaps by the kernels that a GPU runs, one thread a pair."""
    n, m = len(boxes), len(others)
    given_boxes, given_others = (wp.array(array, dtype=wp.float32, device="cpu") for array in (boxes, others))
    pairs = iou._Pairs(rows=n, columns=m, device="cpu")
    pairs.shape(given_boxes, given_others)
    counts = wp.array([n, m], dtype=wp.int32, device="cpu")
    bev, space, hull, box = (wp.empty((n, m), dtype=wp.float32, device="cpu") for _ in range(4))
    inputs = [pairs.shapes, pairs.other_shapes, counts]
    wp.launch(iou._iou_matrix, (n, m), inputs=inputs, outputs=[bev, space], device="cpu")
    for out, as_box in ((hull, False), (box, True)):
        wp.launch(iou._giou_matrix, (n, m), inputs=[*inputs, as_box], outputs=[out], device="cpu")
    return [array.numpy() for array in (bev, space, hull, box)]


def called(boxes, others):
    ious = [rotated_iou_bev(boxes, others), iou_3d(boxes, others)]
    return ious + [giou_3d(boxes, others, enclosing=enclosing) for enclosing in ("hull", "box")]


def odd_boxes(rng, n):
    """Some of no area, not finite, of the same place, or very far."""
    boxes = some_boxes(rng, n)
    boxes[rng.random(n) < 0.2] = boxes[0]
    boxes[rng.random(n) < 0.1, :2] += 1e5
    odd = rng.random((n, 7)) < 0.02
    boxes[odd] = rng.choice(np.float32([0, -1, np.nan, np.inf, -np.inf, 1e-45, 3e38]), odd.sum())
    return boxes


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 150), st.integers(1, 90))
def test_rows_and_pairs_give_the_same_bytes(seed, n, m):
    """A CPU looks only at boxes that are near, and a GPU at all."""
    rng = np.random.default_rng(seed)
    boxes, others = odd_boxes(rng, n), odd_boxes(rng, m)
    for ours, theirs in zip(called(boxes, others), crossed(boxes, others), strict=True):
        assert ours.tobytes() == theirs.tobytes()
        assert np.isfinite(ours).all()


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_parts_do_not_change_a_byte(parts, monkeypatch):
    monkeypatch.setattr(iou, "_PAIRS_OF_PART", 1)
    monkeypatch.setattr(iou, "_GENERALISED_OF_PART", 1)
    rng = np.random.default_rng(8)
    boxes, others = odd_boxes(rng, 400), odd_boxes(rng, 300)
    expected, before = called(boxes, others), thread_count()
    given_boxes, given_others = (wp.array(array, dtype=wp.float32, device="cpu") for array in (boxes, others))
    counts = wp.array([400, 300], dtype=wp.int32, device="cpu")
    try:
        set_thread_count(parts)
        both = RotatedIou(rows=400, columns=300, device="cpu")
        plans = [GeneralizedIou(rows=400, columns=300, enclosing=e, device="cpu") for e in ("hull", "box")]
    finally:
        set_thread_count(before)
    for plan in (both, *plans):
        plan.launch(given_boxes, given_others, counts)
    got = [both.bev, both.space, *(plan.giou for plan in plans)]
    for ours, theirs in zip(got, expected, strict=True):
        assert ours.numpy().tobytes() == theirs.tobytes()


def test_a_plan_forgets_what_overlapped_before():
    rng = np.random.default_rng(9)
    plan = RotatedIou(rows=50, columns=50, device="cpu")
    for n, m in ((50, 50), (30, 40), (50, 20)):
        boxes, others = some_boxes(rng, 50), some_boxes(rng, 50)
        given_so = [wp.array(array, dtype=wp.float32, device="cpu") for array in (boxes, others)]
        plan.launch(*given_so, wp.array([n, m], dtype=wp.int32, device="cpu"))
        assert np.array_equal(plan.bev.numpy()[:n, :m], rotated_iou_bev(boxes[:n], others[:m]))
        assert np.array_equal(plan.space.numpy()[:n, :m], iou_3d(boxes[:n], others[:m]))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3, 3), st.floats(-50, 50), st.floats(-50, 50))
def test_a_turn_and_a_shift_of_all_boxes_change_nothing(seed, turn, x, y):
    """Within 5e-5: coordinates of 60 m are rounded to 4e-6 m."""
    rng = np.random.default_rng(seed)
    boxes, others = some_boxes(rng, 15, 3.0), some_boxes(rng, 15, 3.0)
    c, s = np.cos(turn), np.sin(turn)
    moved = []
    for given_so in (boxes, others):
        wide = given_so.astype(np.float64)
        wide[:, :2] = wide[:, :2] @ np.array([[c, s], [-s, c]]) + (x, y)
        wide[:, 6] += turn
        moved.append(wide.astype(np.float32))
    for before, after in zip(called(boxes, others), called(*moved), strict=True):
        np.testing.assert_allclose(after, before, atol=5e-5)


def test_other_floats_strides_and_read_only_arrays():
    rng = np.random.default_rng(10)
    wide = np.zeros((40, 9))
    wide[:, 1:8] = some_boxes(rng, 40)
    wide.setflags(write=False)
    boxes = wide[::2, 1:8]
    plain = np.ascontiguousarray(boxes, np.float32)
    for ours, theirs in zip(called(boxes, boxes), called(plain, plain), strict=True):
        assert np.array_equal(ours, theirs)
