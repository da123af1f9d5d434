"""What fusion gains, on traffic made up for it: cars out to 140 m, where the LiDAR sees little.

Its detector finds near cars surely and misses more of them the farther they are, with lower scores, and finds false
ones of low score as well; the camera finds cars as far as they have pixels, at a third of the misses; the radar sees
their radial speed. All three err at random, apart from each other.
"""

import dataclasses
import json

import numpy as np
import pytest

from warploom.components.evaluation.fusion import RANGES, fusion_gains, lines_of_gains
from warploom.components.messages import CameraObjects, CameraSet, RadarObjects, RadarSet, SensorFrame, Truth
from warploom.errors import SourceError
from warploom.models.classes import VEHICLE
from warploom.models.detections import Detections
from warploom.models.geometry import box_corners, invert, rigid, transform_boxes

PERIOD = 100_000_000
IMAGE = (1280, 720)
PROJECTION = np.array([[1100.0, 0, 640], [0, 1100, 360], [0, 0, 1]]) @ np.array(
    [[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]
)


def scene(seed, frames=120, cars=14):
    """The frames of a scene, ten a second; camera and radar are 50 and 30 ms older than the LiDAR."""
    random = np.random.default_rng([seed, 23])
    lane = random.choice([-3.5, 0.0, 3.5, 7.0], cars)
    speed = np.where(lane > 1.0, -1.0, 1.0) * random.uniform(6, 16, cars)
    start = np.stack([random.uniform(-20, 220, cars), lane + random.normal(0, 0.2, cars)], axis=1)
    yaw = np.where(speed > 0, 0.0, np.pi)
    return [_frame(random, k, start, speed, yaw) for k in range(frames)]


def _frame(random, k, start, speed, yaw):
    now = 0.1 * k

    def seen(time):
        """Boxes of all cars and the pose at a time."""
        pose = rigid((8.0 * time, 0.0, 1.7))
        world = np.zeros((len(start), 7))
        world[:, 0], world[:, 1], world[:, 2] = start[:, 0] + speed * time, start[:, 1], 0.8
        world[:, 3:6], world[:, 6] = (4.4, 1.9, 1.6), yaw
        return transform_boxes(world, invert(pose)), pose

    truth, pose = seen(now)
    away = np.linalg.norm(truth[:, :2], axis=1)
    there = (away < 140.0) & (truth[:, 0] > 5.0)
    chance = np.clip(1.15 - away / 110.0, 0.12, 0.98)
    found = there & (random.random(len(truth)) < chance)
    boxes = truth[found] + random.normal(0, 1, (found.sum(), 7)) * [0.12, 0.12, 0.05, 0.2, 0.1, 0.1, 0.06]
    scores = np.clip(chance[found] * random.uniform(0.55, 1.1, found.sum()), 0.05, 0.99)
    false = random.poisson(1.5)
    places = random.uniform([10, -20], [140, 20], (false, 2))
    shape = np.tile([-0.9, 4.2, 1.8, 1.6, 0.0], (false, 1))
    boxes = np.concatenate([boxes, np.concatenate([places, shape], axis=1)])
    scores = np.concatenate([scores, random.uniform(0.1, 0.4, false)])

    then, camera_pose = seen(now - 0.05)
    uvw = box_corners(then) @ PROJECTION[:, :3].T + PROJECTION[:, 3]
    uv = uvw[..., :2] / np.maximum(uvw[..., 2:], 0.1)
    image = np.clip(np.concatenate([uv.min(1), uv.max(1)], axis=1), 0, [*IMAGE, *IMAGE])
    tall = image[:, 3] - image[:, 1]
    visible = there & (tall > 6) & (random.random(len(truth)) < 1.0 - (1.0 - chance) / 3.0)
    camera = CameraObjects(
        version=round((now - 0.05) * 1e9) + 10**9,
        sensor="camera",
        boxes=(image[visible] + random.normal(0, 1.0, (visible.sum(), 4))).astype(np.float32),
        scores=random.uniform(0.5, 0.95, visible.sum()).astype(np.float32),
        classes=np.full(visible.sum(), VEHICLE, np.int32),
        projection=PROJECTION,
        size=IMAGE,
        pose=camera_pose,
    )
    then, radar_pose = seen(now - 0.03)
    echo = there & (random.random(len(truth)) < 0.85)
    points = then[echo, :3] + random.normal(0, 0.4, (echo.sum(), 3)) * [1, 1, 0]
    velocity = np.stack([speed[echo] - 8.0, np.zeros(echo.sum()), np.zeros(echo.sum())], axis=1)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    clutter = random.poisson(1.0)
    ghosts = random.uniform([5, -40, 0], [140, 40, 0.01], (clutter, 3))
    radar = RadarObjects(
        version=round((now - 0.03) * 1e9) + 10**9,
        sensor="radar",
        positions=np.concatenate([points, ghosts]).astype(np.float32),
        radial_velocities=np.concatenate(
            [(velocity * rays).sum(1) + random.normal(0, 0.1, echo.sum()), random.uniform(-20, 5, clutter)]
        ).astype(np.float32),
        scores=np.full(echo.sum() + clutter, 0.8, np.float32),
        mounting=np.eye(4),
        velocity=np.array([8.0, 0.0, 0.0]),
        pose=radar_pose,
    )
    n, known = len(boxes), int(there.sum())
    version = k * PERIOD + 10**9
    sensor = SensorFrame(
        version=version, index=k, points=np.empty((0, 4), np.float32), pose=pose,
        truth=Truth(
            boxes=truth[there].astype(np.float32), classes=np.full(known, VEHICLE, np.int32),
            ids=np.flatnonzero(there), velocities=np.stack([speed, np.zeros_like(speed)], 1)[there].astype(np.float32),
            points=np.full(known, 9, np.int32),
        ),
        cameras=CameraSet(version=camera.version, cameras=(camera,)),
        radars=RadarSet(version=radar.version, radars=(radar,)),
    )  # fmt: skip
    return sensor, Detections(
        boxes=boxes.astype(np.float32), scores=scores.astype(np.float32), classes=np.full(n, VEHICLE, np.int32),
        velocities=np.full((n, 2), np.nan, np.float32), background=np.zeros(n, bool),
    )  # fmt: skip


@pytest.fixture(scope="module")
def gains():
    return fusion_gains(scene(seed) for seed in range(2))


def test_cameras_and_radars_find_what_is_too_far_for_the_lidar(gains):
    lidar, cameras, radars, both = gains
    assert cameras.recall[3] > lidar.recall[3] + 0.05
    assert radars.recall[3] > lidar.recall[3] + 0.4
    assert both.recall[3] >= radars.recall[3] - 0.02
    assert min(score.recall[0] for score in gains) > 0.9
    assert min(score.precision for score in gains) > 0.95


def test_radars_know_velocities_from_birth_on(gains):
    lidar, _, radars, both = gains
    assert radars.birth_velocity_error < 0.6 * lidar.birth_velocity_error
    assert both.velocity_error < 0.6 * lidar.velocity_error


def test_scores_are_json_and_a_table(gains):
    rows = json.loads(json.dumps([score.as_dict() for score in gains]))
    assert list(rows[0]["recall"]) == [f"{low:g} to {high:g} m" for low, high in RANGES]
    assert rows[3]["sensors"] == ["cameras", "radars"]
    lines = lines_of_gains(gains)
    assert len(lines) == 6
    assert lines[4].startswith("cameras + radars")


def test_perfect_detections_are_perfect_scores():
    def drive():
        for sensor, _ in scene(3, frames=20, cars=6):
            n = len(sensor.truth.boxes)
            yield sensor, Detections(
                boxes=sensor.truth.boxes, scores=np.full(n, 0.95, np.float32), classes=sensor.truth.classes,
                velocities=np.full((n, 2), np.nan, np.float32), background=np.zeros(n, bool),
            )  # fmt: skip

    lidar = fusion_gains([drive()])[0]
    assert all(value == 1.0 for value in lidar.recall if value == value)
    assert (lidar.precision, lidar.right_class, lidar.id_switches) == (1.0, 1.0, 0)
    assert lidar.velocity_error < 0.1


def test_frames_without_truth_are_refused():
    (sensor, found), *_ = scene(0, frames=1)
    with pytest.raises(SourceError, match="without truth"):
        fusion_gains([[(dataclasses.replace(sensor, truth=None), found)]])
