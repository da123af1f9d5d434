"""Overlaps of oriented boxes against shapely's polygons and OpenCV's rotated rectangles."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from warploom.kernels.iou import iou_3d, rotated_iou_bev


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
    import warp as wp

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
