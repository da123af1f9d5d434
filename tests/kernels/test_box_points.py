"""The points of boxes against an implementation in NumPy, which looks at every point for every box."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.box_points import BOX_CHANNELS, POINT_CHANNELS, BoxPoints
from warploom.kernels.threads import set_thread_count, thread_count

CAPACITY, ROOM, CLASSES, HEIGHT = 20_000, 32, 3, 1.7


def gather(points, boxes, scores, kinds, keep=None, *, most=40, height=HEIGHT, launches=1, plan=None):
    plan = plan or BoxPoints(capacity=CAPACITY, boxes=most, points_of_box=ROOM, classes=CLASSES)
    keep = np.arange(len(boxes)) if keep is None else keep
    padded = np.zeros(max(len(keep), 1), np.int32)
    padded[: len(keep)] = keep

    def array(values, dtype, *shape):
        return wp.array(np.ascontiguousarray(values).reshape(shape), dtype=dtype, device="cpu")

    for _ in range(launches):
        plan.launch(
            array(np.asarray(points, np.float32), wp.vec3, -1, 3),
            array([len(points)], wp.int32, 1),
            array(np.asarray(boxes, np.float32), wp.float32, -1, 7),
            array(np.asarray(scores, np.float32), wp.float32, -1),
            array(np.asarray(kinds, np.int32), wp.int32, -1),
            array(padded, wp.int32, -1),
            array([len(keep)], wp.int32, 1),
            height,
        )
    return plan.points.numpy().copy(), plan.described.numpy().copy(), plan.totals.numpy().copy()


def chosen(total):
    """Ranks of the points that are taken, by the words of the module: one of each of as many shares as rows."""
    if total <= ROOM:
        return np.arange(total)
    ranks = []
    for share in range(ROOM):
        first, last = share * total // ROOM, (share + 1) * total // ROOM
        ranks.append(first + (((share + 1) * 0x9E3779B1 % 2**32) >> 8) % (last - first))
    return np.array(ranks)


def reference(points, boxes, scores, kinds, keep, most):
    """In float32 where a comparison hangs on it."""
    gathered = np.zeros((most, ROOM, len(POINT_CHANNELS)), np.float32)
    described, totals = np.zeros((most, len(BOX_CHANNELS) + CLASSES), np.float32), np.zeros(most, np.int32)
    points, boxes = np.asarray(points, np.float32).reshape(-1, 3), np.asarray(boxes, np.float32)
    for row, b in enumerate(keep[:most]):
        x, y, z, length, width, height, yaw = boxes[b]
        c, s = np.cos(yaw), np.sin(yaw)
        dx, dy, up = points[:, 0] - x, points[:, 1] - y, points[:, 2] - z
        along, across = dx * c + dy * s, dy * c - dx * s
        with np.errstate(invalid="ignore"):
            inside = (np.abs(along) <= 0.5 * length + np.float32(0.75)) & (
                np.abs(across) <= 0.5 * width + np.float32(0.75)
            )
            inside &= (points[:, 2] >= z - 0.5 * height + np.float32(0.1)) & (points[:, 2] <= z + 0.5 * height + 1)
            inside &= (points[:, :2] >= -60).all(1) & (points[:, :2] < 60).all(1)
        which = np.flatnonzero(inside)
        totals[row] = len(which)
        which = which[chosen(len(which))]
        a, d, u = along[which], across[which], up[which]
        columns = [
            a,
            d,
            u,
            length / 2 - a,
            length / 2 + a,
            width / 2 - d,
            width / 2 + d,
            height / 2 - u,
            height / 2 + u,
        ]
        gathered[row, : len(which)] = np.stack([*columns, points[which, 2] + HEIGHT, np.ones(len(which))], 1)
        away = np.hypot(x, y)
        described[row, :9] = [
            *np.log(boxes[b, 3:6]), np.log(away), np.log1p(totals[row]), z - height / 2 + HEIGHT,
            -(x * c + y * s) / away, (x * s - y * c) / away, scores[b],
        ]  # fmt: skip
        described[row, 9 + kinds[b]] = 1
    return gathered, described, totals


def scene(rng, boxes, points):
    centres = np.c_[rng.uniform(-55, 55, (boxes, 2)), rng.uniform(-1.5, -0.5, boxes)]
    made = np.c_[centres, rng.uniform(0.4, 5, (boxes, 1)), rng.uniform(0.4, 2, (boxes, 2)), rng.uniform(-4, 4, boxes)]
    near = made[rng.integers(boxes, size=points), :3] + rng.normal(0, [1.5, 1.5, 0.8], (points, 3))
    return np.float32(near), np.float32(made), rng.random(boxes), rng.integers(0, CLASSES, boxes)


def assert_same(found, wanted):
    """Within rounding: 1e-5 m at 60 m in float32 comes to four units in the last place of a place."""
    np.testing.assert_array_equal(found[2], wanted[2])
    np.testing.assert_array_equal(found[0][..., 10], wanted[0][..., 10])
    np.testing.assert_allclose(found[0], wanted[0], atol=2e-5)
    np.testing.assert_allclose(found[1], wanted[1], atol=2e-5)


@pytest.mark.parametrize(("boxes", "points"), [(1, 1), (1, 500), (5, 0), (12, 300), (33, 9000), (40, 20_000)])
def test_it_is_what_numpy_gathers(boxes, points):
    rng = np.random.default_rng(boxes)
    given = scene(rng, boxes, points)
    assert_same(gather(*given), reference(*given, np.arange(boxes), 40))


def test_only_some_boxes_and_not_more_than_there_is_room_for():
    rng = np.random.default_rng(3)
    given = scene(rng, 60, 5000)
    keep = rng.permutation(60)[:50]
    assert_same(gather(*given, keep), reference(*given, keep, 40))
    assert_same(gather(*given, keep[:7]), reference(*given, keep[:7], 40))


@pytest.mark.parametrize("edge", [(59.9, 0), (-59.95, 59.95), (62, 3), (-80, -80), (0, -60.4)])
def test_boxes_at_the_border_of_what_is_seen_and_beyond(edge):
    rng = np.random.default_rng(8)
    box = np.array([[*edge, -0.9, 4.2, 1.8, 1.6, 0.7]])
    points = box[:, :3] + rng.normal(0, 1.5, (400, 3))
    given = (np.float32(points), np.float32(box), [0.5], [1])
    assert_same(gather(*given), reference(*given, [0], 40))


def test_no_box_gives_zeros_also_where_there_were_some():
    rng = np.random.default_rng(4)
    plan = BoxPoints(capacity=CAPACITY, boxes=40, points_of_box=ROOM, classes=CLASSES)
    points, *boxes = scene(rng, 20, 3000)
    assert gather(points, *boxes, plan=plan)[0].any()
    for array in gather(points, *boxes, keep=[], plan=plan):
        assert not array.any()


def test_points_that_are_none_are_in_no_box():
    box = np.array([[10, 2, -1, 4, 2, 1.5, 0.3]], np.float32)
    points = np.array(
        [[np.nan, 2, -1], [10, np.nan, -1], [10, 2, np.nan], [np.inf, 2, -1], [10, 2, np.inf], [10, 2, -1]]
    )
    assert gather(np.float32(points), box, [0.5], [0])[2][0] == 1


def test_again_and_on_any_number_of_threads_the_same_bytes():
    given = scene(np.random.default_rng(5), 40, 20_000)
    before, results = thread_count(), []
    try:
        for parts in (1, 2, 3, 7):
            set_thread_count(parts)
            results += [gather(*given), gather(*given, launches=2)]
    finally:
        set_thread_count(before)
    for result in results[1:]:
        for a, b in zip(results[0], result, strict=True):
            assert a.tobytes() == b.tobytes()


def test_the_choice_is_even_over_the_order_of_the_points():
    """Of 1,024 points in 32 rows each of 32 equal runs has one."""
    rng = np.random.default_rng(6)
    box = np.array([[10, 0, -1, 4, 2, 1.5, 0.0]], np.float32)
    points = np.c_[rng.uniform(9, 11, 1024), np.linspace(-0.9, 0.9, 1024), rng.uniform(-1.4, -0.5, 1024)]
    rows = gather(np.float32(points), box, [0.5], [0])[0][0]
    ranks = np.rint((rows[:, 1] + 0.9) / 1.8 * 1023)
    np.testing.assert_array_equal(np.floor(ranks * 32 / 1024), np.arange(32))


@given(turn=st.floats(-3.1, 3.1), seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_the_whole_scene_turned_is_the_same_to_the_network(turn, seed):
    """Places in boxes do not say where the sensor looks; to 1e-4 m, but for a point so close to a border."""
    rng = np.random.default_rng(seed)
    points, boxes, scores, kinds = scene(rng, 6, 100)
    points[:, :2] *= 0.6
    boxes[:, :2] *= 0.6
    c, s = np.cos(turn), np.sin(turn)
    turned, around = points.copy(), boxes.copy()
    turned[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
    around[:, :2] = boxes[:, :2] @ np.array([[c, s], [-s, c]])
    around[:, 6] += turn
    here, there = gather(points, boxes, scores, kinds), gather(turned, around, scores, kinds)
    for k in np.flatnonzero(here[2] == there[2]):
        if here[2][k] <= ROOM:
            np.testing.assert_allclose(here[0][k], there[0][k], atol=1e-4)
        np.testing.assert_allclose(here[1][k], there[1][k], atol=1e-4)
    assert (np.abs(here[2] - there[2]) <= 1).all()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"boxes": 0}, "boxes"),
        ({"points_of_box": 0}, "points_of_box"),
        ({"capacity": 2**28, "points_of_box": 64}, "capacity"),
        ({"around": -1.0}, "around"),
        ({"size": (0.0, 1.0)}, "size"),
        ({"points": wp.zeros((2, 2, 2), dtype=wp.float32, device="cpu")}, "points"),
    ],
)
def test_wrong_arguments_are_refused(wrong, said):
    with pytest.raises(ValueError, match=said):
        BoxPoints(**{"capacity": 100, "boxes": 4, "points_of_box": 8, "classes": 2, **wrong})


def test_more_points_than_capacity_are_refused():
    plan = BoxPoints(capacity=100, boxes=4, points_of_box=ROOM, classes=CLASSES)
    with pytest.raises(ValueError, match="capacity"):
        gather(np.zeros((101, 3)), np.ones((1, 7)), [0.5], [0], plan=plan)
