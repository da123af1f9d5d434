"""What cameras and radars say of boxes, all sensors at once, against one box, corner and pair after the other."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.components.messages import CameraObjects, RadarObjects
from warploom.models.classes import VEHICLE
from warploom.models.fusion_sensors import camera_support, image_boxes, radar_support, radar_targets
from warploom.models.geometry import invert, rigid

SIZE = (1280, 720)
OPTICAL = np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
LEAST_OVERLAP = 0.35


def camera_at(name, lidar_from_body, boxes=(), scores=None, pose=None, focal=700.0):
    boxes = np.array(boxes, np.float32).reshape(-1, 4)
    scores = np.full(len(boxes), 0.9) if scores is None else np.asarray(scores)
    intrinsics = np.array([[focal, 0, 640], [0, focal, 360], [0, 0, 1]])
    return CameraObjects(
        version=0, sensor=name, boxes=boxes, scores=scores.astype(np.float32),
        classes=np.full(len(boxes), VEHICLE, np.int32), projection=intrinsics @ OPTICAL @ invert(lidar_from_body),
        size=SIZE, pose=pose,
    )  # fmt: skip


def image_box(box, camera, pose, velocity, age):
    """The image of one box, corner by corner, and whether it is seen."""
    then_from_now = np.eye(4) if pose is None or camera.pose is None else np.linalg.inv(camera.pose) @ pose
    seen_at = []
    for signs in itertools.product((-0.5, 0.5), repeat=3):
        along, across, up = np.array(signs) * box[3:6]
        x = box[0] - age * velocity[0] + along * np.cos(box[6]) - across * np.sin(box[6])
        y = box[1] - age * velocity[1] + along * np.sin(box[6]) + across * np.cos(box[6])
        u, v, depth = camera.projection @ (then_from_now @ [x, y, box[2] + up, 1.0])
        if depth <= 0.3:
            return None
        seen_at.append((u / depth, v / depth))
    low, high = np.min(seen_at, 0), np.max(seen_at, 0)
    cut_low, cut_high = np.clip(low, 0, SIZE), np.clip(high, 0, SIZE)
    inside, area = np.prod(cut_high - cut_low), np.prod(high - low)
    return np.concatenate([cut_low, cut_high]) if inside > 0.25 * area and inside > 1.0 else None


def overlap(a, b):
    width, height = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    shared = max(width, 0.0) * max(height, 0.0)
    return shared / ((a[2] - a[0]) * (a[3] - a[1]) + (b[2] - b[0]) * (b[3] - b[1]) - shared)


def cheapest(cost):
    """The pairs of the least total cost, where staying alone costs 1, by trying all."""
    n, m = cost.shape
    best, pairs = np.inf, {}
    for choice in itertools.product(range(-1, m), repeat=n):
        taken = [c for c in choice if c >= 0]
        if len(set(taken)) == len(taken):
            total = sum(1.0 if c < 0 else cost[r, c] for r, c in enumerate(choice))
            if total < best - 1e-12:
                best, pairs = total, {r: c for r, c in enumerate(choice) if c >= 0}
    return pairs


def around(random, count):
    """Boxes of cars, people and vans on all sides, near and far."""
    boxes = np.zeros((count, 7))
    away, azimuth = random.uniform(0.5, 60, count), random.uniform(-np.pi, np.pi, count)
    boxes[:, 0], boxes[:, 1], boxes[:, 2] = (
        away * np.cos(azimuth),
        away * np.sin(azimuth),
        random.normal(-0.8, 0.4, count),
    )
    boxes[:, 3:6] = random.uniform((0.4, 0.4, 0.8), (9.0, 2.6, 3.4), (count, 3))
    boxes[:, 6] = random.uniform(-4, 4, count)
    return boxes


def ring_of_cameras(random, count):
    """Cameras that look all around, each from a pose of its own, one of them from an unknown one."""
    cameras = []
    for k in range(count):
        at = rigid(random.normal(0, 1, 3), roll=random.normal(0, 0.03), pitch=random.normal(0, 0.05), yaw=k * 2.1)
        pose = None if k == 1 else rigid(random.normal(0, 1, 3), yaw=0.05 * random.normal())
        cameras.append(camera_at(f"c{k}", at, pose=pose, focal=random.uniform(300, 1500)))
    return cameras


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_all_cameras_see_boxes_as_each_corner_is_projected(seed):
    random = np.random.default_rng(seed)
    boxes, cameras = around(random, 12), ring_of_cameras(random, 4)
    velocities, ages = random.normal(0, 5, (12, 2)), random.uniform(0, 0.2, 4)
    velocities[3] = np.nan
    pose = rigid((0.5, 0.1, 0.0), yaw=0.02)
    image, seen = image_boxes(boxes, cameras, pose, velocities, ages)
    assert image.shape == (4, 12, 4)
    for k, camera in enumerate(cameras):
        for b, box in enumerate(boxes):
            expected = image_box(box, camera, pose, np.nan_to_num(velocities[b]), ages[k])
            assert seen[k, b] == (expected is not None)
            if expected is not None:
                # 1e-6 pixels: rounding of double precision, magnified where a corner is 0.3 m before the camera
                np.testing.assert_allclose(image[k, b], expected, atol=1e-6)


def some_objects(random, projected, seen):
    """Objects near the images of some boxes, and some elsewhere."""
    chosen = np.flatnonzero(seen)[:3]
    found = projected[chosen] + random.normal(0, 8, (len(chosen), 4))
    corner = random.uniform(0, 600, (1, 2))
    return np.concatenate([found, np.concatenate([corner, corner + random.uniform(10, 100, (1, 2))], 1)])


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_each_image_gets_the_cheapest_pairs_and_those_who_choose_first_do(seed):
    random = np.random.default_rng(seed)
    boxes, cameras = around(random, 14), ring_of_cameras(random, 3)
    first, ages = random.random(14) < 0.6, [0.0, 0.05, 0.1]
    image, seen = image_boxes(boxes, cameras, None, None, ages)
    cameras = [
        dataclasses.replace(c, boxes=found.astype(np.float32), scores=np.full(len(found), 0.8, np.float32),
                            classes=np.full(len(found), VEHICLE, np.int32))
        for c, found in zip(cameras, (some_objects(random, image[k], seen[k]) for k in range(3)), strict=True)
    ]  # fmt: skip
    cameras[2] = dataclasses.replace(
        cameras[2], scores=cameras[2].scores * np.array([np.nan] + [1.0] * 9)[: len(cameras[2].scores)]
    )
    support = camera_support(boxes, first, cameras, pose=None, ages=ages, least_overlap=LEAST_OVERLAP)
    for k, camera in enumerate(cameras):
        objects = camera.boxes.astype(float)
        free = [
            o for o in range(len(objects))
            if np.isfinite(camera.scores[o]) and (objects[o, 2:] > objects[o, :2]).all()
        ]  # fmt: skip
        row = np.full(len(boxes), -1)
        for stage in (first, ~first):
            mine = np.flatnonzero(stage & seen[k])
            # Only those that overlap anything can be chosen: so few that all choices can be tried.
            table = np.array(
                [[(1 - overlap(image[k, b], objects[o])) / (1 - LEAST_OVERLAP) for o in free] for b in mine]
            )
            close = [r for r in range(len(mine)) if free and table[r].min() < 1.0]
            for r, c in cheapest(table[close]).items() if close else ():
                row[mine[close[r]]] = free[c]
            free = [o for o in free if o not in row]
        np.testing.assert_array_equal(support.row[k], row)
        np.testing.assert_array_equal(support.expected[k], seen[k])


def test_without_cameras_boxes_or_objects_nothing_is_seen():
    nobody = {"pose": None, "least_overlap": LEAST_OVERLAP}
    boxes, camera = around(np.random.default_rng(0), 5), camera_at("c", np.eye(4))
    assert camera_support(boxes, np.ones(5, bool), [], ages=[], **nobody).row.shape == (0, 5)
    assert camera_support(boxes[:0], np.ones(0, bool), [camera], ages=[0.0], **nobody).row.shape == (1, 0)
    assert not camera_support(boxes, np.ones(5, bool), [camera, camera], ages=[0.0, 0.0], **nobody).seen.any()


def test_a_camera_whose_columns_differ_in_length_is_refused():
    two = camera_at("left", np.eye(4), boxes=[[0, 0, 9, 9], [5, 5, 9, 9]])
    one = dataclasses.replace(camera_at("right", np.eye(4), boxes=[[0, 0, 9, 9]]), scores=np.ones(2, np.float32))
    two = dataclasses.replace(two, scores=np.ones(1, np.float32))
    boxes = np.array([[10.0, 0, 0, 4, 2, 2, 0]])
    with pytest.raises(ValueError, match="left"):
        camera_support(boxes, np.ones(1, bool), [two, one], pose=None, ages=[0, 0], least_overlap=0.3)


def radar_at(name, mounting, random, count, pose=None, velocity=None):
    return RadarObjects(
        version=0, sensor=name, positions=(random.normal(0, 25, (count, 3)) * [1, 1, 0]).astype(np.float32),
        radial_velocities=random.normal(0, 6, count).astype(np.float32), mounting=mounting, velocity=velocity,
        scores=random.choice([0.3, 0.5, 0.9], count).astype(np.float32), pose=pose,
    )  # fmt: skip


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_targets_of_all_radars_are_those_of_each_target_by_itself(seed):
    random = np.random.default_rng(seed)
    pose, then = rigid((3.0, 1, 0), yaw=0.3), rigid((2.6, 1, 0), yaw=0.29)
    mountings = [rigid((k, 0.5, -1.0), yaw=2.0 * k) for k in range(3)]
    radars = [
        radar_at("a", mountings[0], random, 5, pose=then, velocity=np.array([9.0, 0.2, 0])),
        radar_at("b", mountings[1], random, 4, pose=None),  # from where the LiDAR is now; does not know its speed
        radar_at("c", mountings[2], random, 0, pose=then),
    ]
    ego, ages = np.array([9.1, 0.1, 0.0]), [0.03, 0.08, 0.0]
    targets = radar_targets(radars, pose, ages, ego)
    expected = []
    for k, radar in enumerate(radars):
        now_from_radar = (np.eye(4) if radar.pose is None else np.linalg.inv(pose) @ radar.pose) @ radar.mounting
        own = radar.velocity if radar.velocity is not None else radar.mounting[:3, :3].T @ ego
        for place, relative in zip(radar.positions.astype(float), radar.radial_velocities, strict=True):
            ray = place / np.linalg.norm(place)
            speed = relative + ray @ own
            turned = now_from_radar[:3, :3] @ ray
            at = (now_from_radar @ [*place, 1.0])[:3] + ages[k] * speed * turned
            expected.append([k, *at[:2], *(turned[:2] / np.linalg.norm(turned[:2])), speed, np.linalg.norm(place)])
    got = np.column_stack([targets.radar, targets.positions, targets.directions, targets.speeds, targets.distances])
    np.testing.assert_allclose(got, np.reshape(expected, (-1, 7)), atol=1e-9)  # metres: rounding of double precision


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_each_radar_gives_a_box_its_surest_target(seed):
    random = np.random.default_rng(seed)
    boxes = around(random, 8)
    radars = [radar_at(str(k), np.eye(4), random, 12) for k in range(3)]
    targets = radar_targets(radars, None, [0.0] * 3, None)
    support = radar_support(boxes, targets, radars=3, gate=2.0, angle=0.02)
    for k in range(3):
        row = np.full(len(boxes), -1)
        for target in np.flatnonzero(targets.radar == k):
            away = []
            for box in boxes:
                dx, dy = targets.positions[target] - box[:2]
                along = abs(np.cos(box[6]) * dx + np.sin(box[6]) * dy) - box[3] / 2
                across = abs(np.cos(box[6]) * dy - np.sin(box[6]) * dx) - box[4] / 2
                away.append(np.hypot(max(along, 0.0), max(across, 0.0)))
            owner = int(np.argmin(away))
            surer = row[owner] < 0 or targets.scores[target] >= targets.scores[row[owner]]  # of equals the later
            if away[owner] < 2.0 + 0.02 * targets.distances[target] and surer:
                row[owner] = target
        np.testing.assert_array_equal(support.row[k], row)
