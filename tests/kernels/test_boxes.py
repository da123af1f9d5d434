"""Box fit against OpenCV, a NumPy search over all points, and boxes whose truth is known."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels import boxes as boxes_module
from warploom.kernels.boxes import FitBoxes, fit_boxes
from warploom.kernels.threads import set_thread_count, thread_count


def l_shape(rng, n=150, noise=0.01):
    """Points of two sides of a box, as a LiDAR sees a car, and the box."""
    length, width = rng.uniform(3, 5), rng.uniform(1.2, 2)
    yaw, height = rng.uniform(-np.pi / 2, np.pi / 2), rng.uniform(0.8, 2)
    centre = rng.uniform([-40, -40, -1], [40, 40, 1])
    t = rng.uniform(0, length + width, n)
    x = np.where(t < length, t - length / 2, -length / 2) + rng.normal(0, noise, n)
    y = np.where(t < length, -width / 2, t - length - width / 2) + rng.normal(0, noise, n)
    z = rng.uniform(-height / 2, height / 2, n)
    c, s = np.cos(yaw), np.sin(yaw)
    points = np.stack([c * x - s * y, s * x + c * y, z], axis=1) + centre
    return points.astype(np.float32), np.array([*centre, length, width, height, yaw])


def scene(seed, clusters=20):
    """Shuffled points of several clusters and of none, their labels, and the true boxes."""
    rng = np.random.default_rng(seed)
    parts = [l_shape(rng, int(rng.integers(60, 400))) for _ in range(clusters)]
    points = np.concatenate([part[0] for part in parts] + [rng.uniform(-50, 50, (300, 3))]).astype(np.float32)
    labels = np.concatenate([np.full(len(part[0]), i) for i, part in enumerate(parts)] + [np.full(300, -1)])
    order = rng.permutation(len(points))
    return points[order], labels[order].astype(np.int32), np.array([part[1] for part in parts])


def turn(a, b):
    """Angle between two headings that have no front [rad]."""
    return np.abs((a - b + np.pi / 2) % np.pi - np.pi / 2)


def test_finds_the_box_of_two_sides():
    """Headings within 3°, centres within 0.2 m, the extents of the points upwards."""
    points, labels, truth = scene(1)
    boxes = fit_boxes(points, labels)
    assert boxes.shape == (20, 7)
    assert boxes.dtype == np.float32
    assert np.rad2deg(turn(boxes[:, 6], truth[:, 6])).max() < 3
    np.testing.assert_allclose(boxes[:, :2], truth[:, :2], atol=0.2)
    for i, box in enumerate(boxes):
        z = points[labels == i, 2]
        assert box[2] == pytest.approx((z.min() + z.max()) / 2, abs=2e-4)
        assert box[5] == pytest.approx(z.max() - z.min(), abs=2e-4)


def test_area_is_that_of_opencv():
    """Within 1e-4: both are exact, but for rounding."""
    import cv2

    points, labels, _ = scene(2)
    boxes = fit_boxes(points, labels, method="min_area", min_size=1e-3)
    for i, box in enumerate(boxes):
        _, size, _ = cv2.minAreaRect(points[labels == i, :2])
        assert box[3] * box[4] == pytest.approx(size[0] * size[1], rel=1e-4)


def test_closeness_is_near_the_best_of_all_angles():
    """For clusters that the search sees whole, the criterion is within 10 % of a search in steps of 0.1°."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        points, _ = l_shape(rng, 60, noise=0.03)

        xy = points[:, :2].astype(np.float64)

        def closeness(angle, xy=xy):
            c, s = np.cos(angle), np.sin(angle)
            along, across = xy @ [c, s], xy @ [-s, c]
            off = [np.minimum(v - v.min(), v.max() - v) for v in (along, across)]
            return (1 / np.maximum(np.minimum(*off), 0.01)).sum()

        best = max(closeness(angle) for angle in np.arange(0, np.pi / 2, np.deg2rad(0.1)))
        found = fit_boxes(points, np.zeros(60, np.int32))[0, 6]
        # The steps of the search are 0.94°: the best angle may lie half of one aside.
        assert max(closeness(found + d) for d in np.deg2rad([-0.5, -0.25, 0, 0.25, 0.5])) > 0.9 * best


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from(["l_shape", "min_area"]))
def test_every_point_is_in_its_box_and_length_is_not_less_than_width(seed, method):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, [3, 1, 1], (400, 3)).astype(np.float32) + np.float32([20, -30, 1])
    labels = rng.integers(-1, 8, 400).astype(np.int32)
    boxes = fit_boxes(points, labels, method=method)
    assert (boxes[:, 3] >= boxes[:, 4]).all()
    assert ((boxes[:, 6] > -np.pi / 2 - 1e-6) & (boxes[:, 6] <= np.pi / 2 + 1e-6)).all()
    own = labels >= 0
    box = boxes[labels[own]]
    off = points[own] - box[:, :3]
    c, s = np.cos(box[:, 6]), np.sin(box[:, 6])
    local = np.stack([c * off[:, 0] + s * off[:, 1], c * off[:, 1] - s * off[:, 0], off[:, 2]], axis=1)
    assert (np.abs(local) <= box[:, 3:6] / 2 + 3e-4).all()


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.floats(-np.pi, np.pi),
    st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-5, 5)),
)
def test_a_rigid_motion_moves_the_boxes(seed, angle, shift):
    """Headings by the motion's, to 2.5° for the steps of the search; centres to 0.15 m."""
    points, labels, _ = scene(seed % 1000, clusters=4)
    c, s = np.cos(angle), np.sin(angle)
    moved = (points @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + shift).astype(np.float32)
    before, after = fit_boxes(points, labels), fit_boxes(moved, labels)
    assert np.rad2deg(turn(after[:, 6], before[:, 6] + angle)).max() < 2.5
    expected = before[:, :3] @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + shift
    np.testing.assert_allclose(after[:, :3], expected, atol=0.15)


def test_small_clusters_do_not_hang_on_the_order_of_the_points():
    """With up to 64 points the search sees them all: a shuffle changes boxes by rounding only."""
    rng = np.random.default_rng(5)
    points = np.concatenate([l_shape(rng, 60)[0] for _ in range(5)])
    labels = np.repeat(np.arange(5, dtype=np.int32), 60)
    order = rng.permutation(300)
    np.testing.assert_allclose(fit_boxes(points, labels), fit_boxes(points[order], labels[order]), atol=5e-4)
    assert np.array_equal(fit_boxes(points, labels), fit_boxes(points, labels))


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
def test_degenerate_clusters_get_the_least_size(method):
    line = np.stack([np.linspace(0, 3, 40), np.linspace(0, 3, 40), np.zeros(40)], axis=1)
    points = np.concatenate([[[5, 6, 7]], np.tile([[1, 2, 3]], (9, 1)), line, np.full((2, 3), np.nan)])
    labels = np.array([0] + [1] * 9 + [3] * 40 + [4] * 2, np.int32)
    boxes = fit_boxes(points.astype(np.float32), labels, method=method)
    np.testing.assert_allclose(boxes[0, :6], [5, 6, 7, 0.1, 0.1, 0.1], atol=1e-5)
    np.testing.assert_allclose(boxes[1, :6], [1, 2, 3, 0.1, 0.1, 0.1], atol=1e-5)
    np.testing.assert_allclose(boxes[3], [1.5, 1.5, 0, 3 * np.sqrt(2), 0.1, 0.1, np.pi / 4], atol=0.02)
    assert np.isnan(boxes[[2, 4]]).all()
    assert fit_boxes(points.astype(np.float32), labels, min_size=0.5)[0, 3] == 0.5


def test_far_from_the_origin():
    points, _ = l_shape(np.random.default_rng(6), 200)
    labels = np.zeros(200, np.int32)
    shift = np.float32([1e5, -1e5, 100])
    near, far = fit_boxes(points, labels)[0], fit_boxes(points + shift, labels)[0]
    # A float32 is 8 mm wide out there.
    np.testing.assert_allclose(far[:3], near[:3] + shift, atol=0.1)
    assert np.rad2deg(turn(far[6], near[6])) < 3


def test_no_points_and_no_clusters():
    assert fit_boxes(np.zeros((0, 3), np.float32), np.zeros(0, np.int32)).shape == (0, 7)
    assert fit_boxes(np.zeros((5, 3), np.float32), np.full(5, -1)).shape == (0, 7)


def test_arrays_of_other_families():
    import torch

    points, labels, _ = scene(7)
    expected = fit_boxes(points, labels)
    boxes = fit_boxes(torch.from_numpy(points), torch.from_numpy(labels).long())
    assert isinstance(boxes, torch.Tensor)
    assert np.array_equal(boxes.numpy(), expected)
    boxes = fit_boxes(wp.array(points, dtype=wp.vec3, device="cpu"), wp.array(labels, dtype=wp.int32, device="cpu"))
    assert np.array_equal(boxes.numpy(), expected)


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
def test_the_plan_counts_what_it_leaves_out(device, method):
    points, labels, _ = scene(8, clusters=10)
    expected = fit_boxes(points, labels, method=method)
    points = np.concatenate([points, np.full((3, 3), np.inf), np.zeros((7, 3))]).astype(np.float32)
    labels = np.concatenate([labels, np.full(3, 2), np.full(7, 1)]).astype(np.int32)
    plan = FitBoxes(capacity=8192, max_clusters=8, method=method, device=device)
    xyz = wp.array(points, dtype=wp.vec3, device=device)
    label = wp.array(labels, dtype=wp.int32, device=device)
    count = wp.array([len(points) - 7], dtype=wp.int32, device=device)
    for _ in range(2):
        plan.launch(xyz, label, count)
        np.testing.assert_allclose(plan.boxes.numpy(), expected[:8], atol=1e-4)
        assert plan.cluster_count.numpy()[0] == 8
        assert plan.dropped.numpy().tolist() == [3, int((labels >= 8).sum())]


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda p, c: fit_boxes(p[:, :2], c), ValueError, "points must have shape"),
        (lambda p, c: fit_boxes(p, c[:3]), ValueError, "labels must have shape"),
        (lambda p, c: fit_boxes(p, c.astype(float)), TypeError, "labels must be of an integer type"),
        (lambda p, c: fit_boxes(p, c, method="pca"), ValueError, "method must be one of l_shape, min_area"),
        (lambda p, c: fit_boxes(p, c, min_size=0), ValueError, "min_size must be > 0"),
        (lambda p, c: FitBoxes(capacity=4, max_clusters=0), ValueError, "max_clusters must be"),
    ],
)
def test_wrong_arguments_are_refused(call, error, message):
    with pytest.raises(error, match=message):
        call(np.zeros((4, 3), np.float32), np.zeros(4, np.int32))


def odd_scene(seed, n=5000):
    """Clusters of one point to thousands: blobs, circles, lines, grids, one place; some points not finite."""
    rng = np.random.default_rng(seed)
    labels = np.minimum(rng.geometric(0.15, n), 30) - 2
    points = rng.normal(0, [3, 1, 1], (n, 3)) + np.float32([20, -30, 1])
    for label in range(29):
        own = labels == label
        count, turned = int(own.sum()), rng.uniform(0, np.pi)
        t = rng.uniform(-3, 3, count)
        shape = label % 5
        if shape == 1:
            points[own, :2] = 4 * np.column_stack([np.cos(t), np.sin(t)])
        elif shape == 2:
            points[own, :2] = t[:, None] * [np.cos(turned), np.sin(turned)]
        elif shape == 3:
            points[own, :2] = rng.integers(0, 4, (count, 2))
        elif shape == 4:
            points[own] = [1, 2, 3]
    points[rng.random(n) < 0.01, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    return points.astype(np.float32), labels.astype(np.int32)


def launched(points, labels, method, parts=None):
    before = thread_count()
    try:
        set_thread_count(parts or before)
        plan = FitBoxes(capacity=len(points), max_clusters=20, method=method, device="cpu")
    finally:
        set_thread_count(before)
    xyz, label = wp.array(points, dtype=wp.vec3, device="cpu"), wp.array(labels, dtype=wp.int32, device="cpu")
    plan.launch(xyz, label, wp.array([len(points)], dtype=wp.int32, device="cpu"))
    return [array.numpy().tobytes() for array in (plan.boxes, plan.cluster_count, plan.dropped)]


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
@pytest.mark.parametrize("parts", [2, 3, 7])
def test_parts_do_not_change_a_byte(method, parts, monkeypatch):
    monkeypatch.setattr(boxes_module, "_LEAST_OF_PART", 1)
    points, labels = odd_scene(9, 15_000)
    assert launched(points, labels, method, parts) == launched(points, labels, method, 1)


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
def test_many_threads_give_the_same_bytes(method, monkeypatch):
    """The kernels of a GPU on a CPU."""
    points, labels = odd_scene(10)
    expected = launched(points, labels, method)
    monkeypatch.setattr(boxes_module, "_in_parts", lambda _: False)
    assert launched(points, labels, method) == expected


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_least_area_is_that_of_opencv_whatever_the_shape(seed):
    """Within 1e-4 of the area, and of what 1e-4 m of width adds: OpenCV, too, computes in float32."""
    import cv2

    points, labels = odd_scene(seed)
    boxes = fit_boxes(points, labels, method="min_area", min_size=1e-6)
    for label, box in enumerate(boxes):
        own = points[(labels == label) & np.isfinite(points).all(axis=1), :2]
        if not len(own):
            assert np.isnan(box).all()
            continue
        _, size, _ = cv2.minAreaRect(own)
        assert box[3] * box[4] == pytest.approx(size[0] * size[1], rel=1e-4, abs=1e-4 * (1 + max(size)))


@settings(max_examples=20, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.floats(-np.pi, np.pi), st.tuples(st.floats(-50, 50), st.floats(-50, 50)),
)  # fmt: skip
def test_a_rigid_motion_moves_boxes_of_least_area(seed, angle, shift):
    """Centres and sizes within 1 mm, headings within 0.1°: the least area of two sides of a car is without rivals."""
    points, labels, _ = scene(seed % 1000, clusters=4)
    c, s = np.cos(angle), np.sin(angle)
    motion = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    moved = (points @ motion + (*shift, 0)).astype(np.float32)
    before, after = (fit_boxes(p, labels, method="min_area") for p in (points, moved))
    np.testing.assert_allclose(after[:, 3] * after[:, 4], before[:, 3] * before[:, 4], rtol=1e-3)
    alike = np.abs(after[:, 3:5] - before[:, 3:5]).max(axis=1) < 1e-2  # unless two sides tie to rounding
    assert alike.sum() >= 3
    np.testing.assert_allclose(after[alike, :3], before[alike, :3] @ motion + (*shift, 0), atol=1e-3)
    assert np.rad2deg(turn(after[:, 6], before[:, 6] + angle))[alike].max() < 0.1


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
@pytest.mark.parametrize("scale", [1e-44, 1e-20, 1e5, 1e18, 3e38])
def test_tiny_and_huge_coordinates_end(method, scale):
    """Nothing hangs or is lost; what float32 can say of such boxes is finite where their sizes are."""
    points = (np.random.default_rng(11).uniform(-1, 1, (600, 3)) * scale).astype(np.float32)
    boxes = fit_boxes(points, np.repeat(np.arange(3, dtype=np.int32), 200), method=method)
    assert boxes.shape == (3, 7)
    if scale < 1e10:
        assert np.isfinite(boxes).all()
        assert (np.abs(boxes[:, :3]) <= 2 * scale + 0.1).all()


@pytest.mark.parametrize("method", ["l_shape", "min_area"])
def test_other_floats_strides_and_read_only_arrays(method):
    points, labels, _ = scene(12, clusters=5)
    wide = np.zeros((2 * len(points), 5))
    wide[::2, 1:4] = points
    wide.setflags(write=False)
    labels.setflags(write=False)
    boxes = fit_boxes(wide[::2, 1:4], labels.astype(np.int64), method=method)
    assert np.array_equal(boxes, fit_boxes(points, labels, method=method))
