"""Refined boxes against an implementation in NumPy, and on cars whose truth is known."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.box_refine import BoxRefine

CAPACITY, MOST = 4096, 16


def seen_car(rng, x, y, yaw, size=(4.2, 1.8, 1.5), count=200, noise=0.01):
    """Points on the two sides of a car that the sensor at the origin sees, above its underside at z = −1.7."""
    half = 0.5 * np.array(size[:2])
    c, s = np.cos(yaw), np.sin(yaw)
    sensor = np.array([-x * c - y * s, x * s - y * c])
    points = []
    for axis in (0, 1):
        if abs(sensor[axis]) > half[axis]:
            side = rng.uniform(-1, 1, (count, 2)) * half
            side[:, axis] = np.sign(sensor[axis]) * half[axis]
            points.append(side)
    local = np.concatenate(points) + rng.normal(0, noise, (len(points) * count, 2))
    turned = local @ np.array([[c, s], [-s, c]]) + [x, y]
    return np.c_[turned, rng.uniform(-1.3, -0.4, len(turned))].astype(np.float32)


def refine(points, boxes, kinds, refined=(True, False), keep=None, launches=1):
    plan = BoxRefine(capacity=CAPACITY, boxes=MOST, refined=refined)
    keep = np.arange(len(boxes)) if keep is None else keep
    padded = np.zeros(MOST, np.int32)
    padded[: len(keep)] = keep
    found = wp.array(np.asarray(boxes, np.float32), dtype=wp.float32, device="cpu")
    xyz = wp.array(np.asarray(points, np.float32).reshape(-1, 3), dtype=wp.vec3, device="cpu")
    for _ in range(launches):
        plan.launch(
            xyz,
            wp.array([len(xyz)], dtype=wp.int32, device="cpu"),
            found,
            wp.array(np.asarray(kinds, np.int32), dtype=wp.int32, device="cpu"),
            wp.array(padded, dtype=wp.int32, device="cpu"),
            wp.array([len(keep)], dtype=wp.int32, device="cpu"),
        )
    return found.numpy()


def off(a, b):
    return np.degrees(abs((a - b + np.pi / 2) % np.pi - np.pi / 2))


@pytest.mark.parametrize("seed", range(12))
def test_a_car_is_turned_and_moved_onto_its_sides(seed):
    """To 0.7 degrees, and half of the way: the points are exact to 1 cm, bins 2 cm, a first look 1 degree wide."""
    rng = np.random.default_rng(seed)
    bearing, distance, yaw = rng.uniform(-np.pi, np.pi), rng.uniform(8, 25), rng.uniform(-3, 3)
    x, y = distance * np.cos(bearing), distance * np.sin(bearing)
    c, s = np.cos(yaw), np.sin(yaw)
    if min(abs(-x * c - y * s) - 2.1, abs(x * s - y * c) - 0.9) < 0.6:
        x, y = 12 * np.cos(yaw + 0.6), 12 * np.sin(yaw + 0.6)  # both a side and an end are seen
    points = seen_car(rng, x, y, yaw)
    given = np.array([[x, y, -0.95, 4.2, 1.8, 1.5, yaw + rng.uniform(-0.1, 0.1)]])
    turned = refine(points, given, [0])
    assert off(turned[0, 6], yaw) < 0.7
    np.testing.assert_array_equal(turned[0, 2:6], given[0, 2:6].astype(np.float32))
    moved = given.copy()
    moved[0, :2] += rng.uniform(-0.15, 0.15, 2)
    moved[0, 6] = yaw
    closer = refine(points, moved, [0])
    before, after = (np.hypot(*(box[0, :2] - [x, y])) for box in (moved, closer))
    assert after < 0.7 * before + 0.02


def reference(points, box):
    """What the module says in words, in NumPy; for no more points than it looks at."""
    x, y, z, length, width, height, yaw = np.float32(box)
    c, s = np.cos(yaw), np.sin(yaw)
    d = points[:, :2] - [x, y]
    local = np.c_[d[:, 0] * c + d[:, 1] * s, d[:, 1] * c - d[:, 0] * s]
    half = np.array([0.5 * length, 0.5 * width])
    above = points[:, 2] - z
    local = local[(np.abs(local) <= half + 0.25).all(1) & (above > 0.25 - 0.5 * height) & (above < 0.5 * height + 0.2)]
    if len(local) < 30:
        return np.array(box)
    sensor = np.array([-x * c - y * s, x * s - y * c])
    near = np.where(sensor < 0, -1.0, 1.0)

    def depths(angle):
        a, b = np.cos(angle), np.sin(angle)
        turned = np.c_[local[:, 0] * a + local[:, 1] * b, local[:, 1] * a - local[:, 0] * b] * near
        return np.clip(np.floor((half + 0.25 - turned) / 0.02), 0, 63).astype(int)

    def sides(depth, share):
        outside = int(np.float32(share) * len(local))
        return np.sort(depth, axis=0)[outside]

    scores = []
    for angle in np.radians(np.arange(-12, 13)):
        depth = depths(angle)
        away = np.abs(depth - sides(depth, 0.01)).min(1)
        close = np.rint(1024 * np.exp(-((away * 0.02 / 0.12) ** 2))).sum()
        scores.append(close / (1024 * len(local)) - 0.03 * (angle / np.radians(5)) ** 2)
    scores = np.array(scores)
    best = scores.argmax()
    turn = best - 12.0
    if 0 < best < 24:
        bend = scores[best - 1] - 2 * scores[best] + scores[best + 1]
        turn += 0.5 * (scores[best - 1] - scores[best + 1]) / bend if bend < 0 else 0.0
    angle = np.radians(turn)
    gap = 0.25 - (sides(depths(angle), 0.02) + 0.5) * 0.02 + 0.03
    gap = np.where((np.abs(sensor) >= half + 0.5) & (np.abs(gap) < 0.35), 0.5 * gap * near, 0.0)
    heading = yaw + angle
    c, s = np.cos(heading), np.sin(heading)
    heading = (heading + np.pi) % (2 * np.pi) - np.pi
    return np.array([x + c * gap[0] - s * gap[1], y + s * gap[0] + c * gap[1], z, length, width, height, heading])


@pytest.mark.parametrize("seed", range(20))
def test_it_is_what_numpy_computes(seed):
    """Within 2 cm and 0.2 degrees: a point at the border of a bin may fall into the next in float32."""
    rng = np.random.default_rng(100 + seed)
    x, y = rng.uniform(-25, 25, 2)
    size = (rng.uniform(3.3, 10), rng.uniform(1.5, 2.5), 1.5)
    yaw = rng.uniform(-np.pi, np.pi)
    points = seen_car(rng, x, y, yaw, size, count=int(rng.integers(3, 120)), noise=rng.uniform(0.0, 0.08))
    clutter = np.c_[rng.uniform(-4, 4, (40, 2)) + np.array([x, y]), rng.uniform(-2, 1, 40)].astype(np.float32)
    points = np.concatenate([points, clutter])
    box = np.array([x, y, -0.95, *size, yaw]) + rng.normal(0, [0.1, 0.1, 0.05, 0.1, 0.1, 0.1, 0.05])
    got, expected = refine(points, box[None], [0])[0], reference(points, box)
    np.testing.assert_allclose(got[:2], expected[:2], atol=0.02)
    np.testing.assert_allclose(got[2:6], expected[2:6], atol=1e-6)
    assert off(got[6], expected[6]) < 0.2


def test_others_stay_as_they_are():
    rng = np.random.default_rng(3)
    points = seen_car(rng, 12.0, 5.0, 0.4)
    car = [12.0, 5.0, -0.95, 4.2, 1.8, 1.5, 0.45]
    empty = [-20.0, 5.0, -0.95, 4.2, 1.8, 1.5, 0.45]
    beyond = [300.0, -200.0, -0.95, 4.2, 1.8, 1.5, 0.45]
    boxes = np.array([empty, car, beyond], np.float32)
    changed = refine(points, boxes, [0, 0, 0])
    np.testing.assert_array_equal(changed[[0, 2]], boxes[[0, 2]])
    assert changed[1, 6] != boxes[1, 6]
    np.testing.assert_array_equal(refine(points, boxes, [1, 1, 1]), boxes)
    np.testing.assert_array_equal(refine(points, boxes, [0, 0, 0], keep=[0, 2]), boxes)
    np.testing.assert_array_equal(refine(points[:29], boxes, [0, 0, 0]), boxes)
    np.testing.assert_array_equal(refine(np.full((30, 3), np.nan), boxes, [0, 0, 0]), boxes)


def test_the_order_of_the_points_does_not_matter_and_a_plan_forgets():
    rng = np.random.default_rng(4)
    points = seen_car(rng, 12.0, 5.0, 0.4, count=120)
    box = np.array([[12.1, 5.0, -0.95, 4.2, 1.8, 1.5, 0.45]], np.float32)
    once = refine(points, box, [0])
    assert once.tobytes() == refine(rng.permutation(points), box, [0]).tobytes()
    twice = refine(points, once, [0])
    assert twice.tobytes() == refine(points, box, [0], launches=2).tobytes()


def test_many_points_are_looked_at_in_part():
    """As close as with a few, see above, of 4,000 points."""
    rng = np.random.default_rng(5)
    points = seen_car(rng, 12.0, 5.0, 0.4, count=2000)
    box = np.array([[12.1, 5.0, -0.95, 4.2, 1.8, 1.5, 0.47]], np.float32)
    assert off(refine(points, box, [0])[0, 6], 0.4) < 0.7


def test_what_does_not_fit_is_refused():
    for options, message in (
        ({"capacity": 0}, "capacity and boxes"),
        ({"refined": ()}, "refined must say"),
        ({"size": (0.0, 1.0)}, "size must be positive"),
    ):
        with pytest.raises(ValueError, match=message):
            BoxRefine(**({"capacity": 8, "boxes": 2, "refined": (True,)} | options))
    with pytest.raises(ValueError, match="more than the plan"):
        refine(np.zeros((CAPACITY + 1, 3)), np.zeros((1, 7)), [0])
