"""Fusion on scenes whose outcome is known: what each sensor adds, and what is said where one is missing."""

import dataclasses

import numpy as np
import pytest

from warploom.components.messages import CameraObjects, RadarObjects
from warploom.models.classes import CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from warploom.models.fusion import Fusion, FusionConfig
from warploom.models.fusion_sensors import camera_support, image_boxes, radar_support, radar_targets
from warploom.models.geometry import box_corners, invert, rigid, transform_boxes, transform_points

NS = 100_000_000
SIZE = (1280, 720)
PROJECTION = np.array([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]]) @ np.array(
    [[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]
)
NOTHING = np.empty((0, 7))


def car(x, y=0.0, yaw=0.0):
    return np.array([x, y, -0.8, 4.4, 1.9, 1.6, yaw])


def image_of(boxes):
    """Left, top, right, bottom of boxes, by hand."""
    uvw = box_corners(np.reshape(boxes, (-1, 7))) @ PROJECTION[:, :3].T
    uv = uvw[..., :2] / uvw[..., 2:]
    return np.clip(np.concatenate([uv.min(1), uv.max(1)], axis=1), 0, [*SIZE, *SIZE])


def camera(frame, boxes, kind=VEHICLE, score=0.9, late=0.0, pose=None):
    boxes = np.reshape(boxes, (-1, 7))
    return CameraObjects(
        version=round(frame * NS - late * 1e9), sensor="camera", boxes=image_of(boxes).astype(np.float32),
        scores=np.full(len(boxes), score, np.float32), classes=np.full(len(boxes), kind, np.int32),
        projection=PROJECTION, size=SIZE, pose=pose,
    )  # fmt: skip


def radar(frame, positions, velocities, own=(0.0, 0, 0), late=0.0, mounting=None, pose=None):
    """Targets at positions in the radar's frame, with velocities over ground along its axes."""
    positions, velocities = np.reshape(positions, (-1, 3)), np.reshape(velocities, (-1, 3))
    rays = positions / np.linalg.norm(positions, axis=1, keepdims=True)
    return RadarObjects(
        version=round(frame * NS - late * 1e9), sensor="radar", positions=positions.astype(np.float32),
        radial_velocities=((velocities - own) * rays).sum(1).astype(np.float32),
        scores=np.full(len(positions), 0.9, np.float32), mounting=np.eye(4) if mounting is None else mounting,
        velocity=np.asarray(own, float), pose=pose,
    )  # fmt: skip


def step(fusion, frame, boxes, score=0.9, kind=VEHICLE, **more):
    boxes = np.reshape(boxes, (-1, 7))
    more.setdefault("pose", np.eye(4))
    return fusion.update(frame * NS, boxes, np.full(len(boxes), score), np.full(len(boxes), kind), **more)


def test_boxes_are_projected_as_the_camera_saw_them():
    """The camera was 50 ms earlier, when the vehicle was 1 m farther back and the car 0.5 m."""
    pose, earlier = rigid((10.0, 2, 0), yaw=0.2), rigid((9.0, 2, 0), yaw=0.18)
    world = car(40, 8)
    now, velocity = transform_boxes(world[None], invert(pose)), np.array([[10.0, 0.0]]) @ pose[:2, :2]
    before = world - [0.5, 0, 0, 0, 0, 0, 0]
    expected = image_of(transform_boxes(before[None], invert(earlier)))
    view = dataclasses.replace(camera(0, NOTHING), pose=earlier)
    found, inside = image_boxes(now, [view], pose, velocity, [0.05])
    # 1e-3 pixels: a heading moved and turned back is laid onto the plane twice
    np.testing.assert_allclose(found[0], expected, atol=1e-3)
    assert inside.all()


def test_what_is_behind_or_beside_the_camera_is_not_expected_in_it():
    boxes = np.array([car(-20), car(20, 40), car(20), car(0.5)])
    _, inside = image_boxes(boxes, [camera(0, NOTHING)], None, None, [0.0])
    assert inside.tolist() == [[False, False, True, False]]


def test_the_image_object_goes_to_the_box_that_overlaps_it_most():
    boxes = np.array([car(30, 3), car(30, 0), car(30, -3)])
    support = camera_support(
        boxes, np.ones(3, bool), [camera(0, boxes[[2, 1]])], pose=None, ages=[0.0], least_overlap=0.3
    )
    assert support.row.tolist() == [[-1, 1, 0]]
    assert support.expected.all()


def test_radial_speeds_come_out_over_ground_along_the_line_of_sight():
    """A radar at the rear left corner, of a vehicle that drives and turns."""
    mounting = rigid((-2.0, 1.0, 0.5), yaw=2.5)
    pose, earlier = rigid((5.0, 1, 0), yaw=0.3), rigid((4.5, 1, 0), yaw=0.28)
    place, velocity = np.array([-30.0, 25, 0.5]), np.array([3.0, -7, 0])  # in the world
    to_radar = invert(earlier @ mounting)
    seen = transform_points(place[None], to_radar)
    own = np.array([9.0, 0.5, 0.0])
    view = radar(0, seen, velocity @ to_radar[:3, :3].T, own=own, mounting=mounting, pose=earlier)
    targets = radar_targets([view], pose, [0.04], None)
    ray = (place - (earlier @ mounting)[:3, 3]) / np.linalg.norm(seen)
    now = place + 0.04 * (velocity @ ray) * ray
    np.testing.assert_allclose(targets.speeds, [velocity @ ray], atol=1e-5)  # float32
    np.testing.assert_allclose(targets.positions, transform_points(now[None], invert(pose))[:, :2], atol=1e-4)
    direction = pose[:3, :3].T @ ray
    np.testing.assert_allclose(targets.directions[0], direction[:2] / np.linalg.norm(direction[:2]), atol=1e-6)
    assert np.isnan(radar_targets([dataclasses.replace(view, velocity=None)], pose, [0.04], None).speeds).all()


def test_a_target_belongs_to_the_nearest_box_and_a_box_to_its_surest_target():
    boxes = np.array([car(30), car(37)])
    view = radar(0, [[28.0, 0, 0], [31, 1.5, 0], [34.8, 0, 0], [60, 0, 0]], np.zeros((4, 3)))
    view = dataclasses.replace(view, scores=np.array([0.5, 0.9, 0.4, 0.9], np.float32))
    support = radar_support(boxes, radar_targets([view], None, [0.0], None), radars=1, gate=1.0, angle=0.0)
    assert support.row.tolist() == [[1, 2]]


def test_a_faint_detection_exists_where_a_camera_or_a_radar_agrees():
    shown = {}
    for sensors in ((), ("camera",), ("radar",)):
        fusion = Fusion()
        for frame in range(8):
            box = car(90 + frame)
            objects = step(
                fusion, frame, [box], score=0.2,
                cameras=[camera(frame, box)] if "camera" in sensors else [],
                radars=[radar(frame, box[:3], [0, 0, 0])] if "radar" in sensors else [],
            )  # fmt: skip
        shown[sensors] = len(objects)
    assert shown == {(): 0, ("camera",): 1, ("radar",): 1}


def test_a_radar_gives_the_velocity_at_birth():
    velocity = np.array([12.0, 0, 0])
    alone = step(Fusion(), 0, [car(50, 1)])
    joined = step(Fusion(), 0, [car(50, 1)], radars=[radar(0, [50, 1, -0.8], velocity)])
    assert np.linalg.norm(alone.velocities[0] - velocity[:2]) > 10
    assert np.linalg.norm(joined.velocities[0] - velocity[:2]) < 0.5
    assert joined.covariances[0, 2, 2] < 0.2 < alone.covariances[0, 2, 2]
    assert joined.radar.tolist() == [True]


def test_a_camera_turns_the_class():
    fusion = Fusion()
    for frame in range(6):
        box = np.array([15.0, 1, -0.6, 1.6, 0.6, 1.7, 0])
        objects = step(fusion, frame, [box], score=0.5, kind=CYCLIST, cameras=[camera(frame, box, PEDESTRIAN, 0.9)])
    assert objects.classes.tolist() == [PEDESTRIAN]
    assert objects.class_probabilities[0, PEDESTRIAN] > 0.9
    np.testing.assert_allclose(objects.class_probabilities.sum(1), 1.0)


def test_a_cluster_gets_the_class_that_a_camera_knows():
    fusion = Fusion()
    box = np.array([15.0, 1, -0.6, 0.7, 0.6, 1.7, 0])
    for frame in range(4):
        unseen = step(Fusion(), 0, [box], score=0.7, kind=UNKNOWN, background=np.ones(1, bool))
        objects = step(
            fusion, frame, [box], score=0.7, kind=UNKNOWN, background=np.ones(1, bool),
            cameras=[camera(frame, box, PEDESTRIAN)],
        )  # fmt: skip
    assert unseen.background.tolist() == [True]
    assert objects.classes.tolist() == [PEDESTRIAN]
    assert objects.background.tolist() == [False]


def test_one_image_that_is_wrong_about_the_class_tears_no_track():
    fusion = Fusion()
    ids, classes = [], []
    for frame in range(10):
        wrong = [camera(frame, car(20), kind=PEDESTRIAN, score=0.95)] if frame == 6 else []
        objects = step(fusion, frame, [car(20)], score=0.6, cameras=wrong)
        ids += objects.ids.tolist()
        classes += objects.classes.tolist()
    assert ids == [ids[0]] * 10
    assert classes[-1] == VEHICLE


def test_the_side_of_a_car_stays_a_cluster():
    side = np.array([20.0, 1, -0.8, 4.4, 0.3, 1.6, 0])
    fusion = Fusion()
    for frame in range(5):
        objects = step(
            fusion, frame, [side], score=0.7, kind=UNKNOWN, background=np.ones(1, bool), cameras=[camera(frame, side)]
        )
    assert objects.camera.tolist() == [True]
    assert objects.background.tolist() == [True]


def test_what_a_camera_looks_at_and_does_not_see_becomes_doubtful():
    def after(cameras):
        fusion = Fusion()
        for frame in range(10):
            objects = step(fusion, frame, [car(30)], score=0.35, cameras=[camera(frame, NOTHING)] if cameras else [])
        return objects.existence.tolist()

    assert after(False)[0] > 0.6
    assert after(True) == []  # did not pass the gate


def test_a_moving_target_without_a_box_is_an_object_and_keeps_its_id_when_the_lidar_finds_it():
    fusion, ids = Fusion(), []
    for frame in range(24):
        box = car(120 - 1.5 * frame, 2)
        seen = [box] if 10 <= frame < 16 else NOTHING
        objects = step(fusion, frame, seen, radars=[radar(frame, [*box[:2], 0], [-15, 0, 0])])
        ids.append(objects.ids.tolist())
        if frame > 4:
            assert len(objects) == 1
            np.testing.assert_allclose(objects.boxes[0, :2], box[:2], atol=1.0)
            np.testing.assert_allclose(objects.velocities[0], [-15, 0], atol=1.0)
    assert {i for frame in ids[4:] for i in frame} == {ids[5][0]}


def test_standing_targets_without_a_box_are_no_objects():
    fusion = Fusion()
    for frame in range(10):
        objects = step(fusion, frame, NOTHING, radars=[radar(frame, [40, 0, 0], [0, 0, 0], own=(10.0, 0, 0))])
    assert len(objects) == 0


def test_missing_and_stale_sensors_are_told():
    fusion = Fusion(FusionConfig(sensors=("camera", "radar")))
    box = car(30)
    assert step(fusion, 10, [box]).missing == ("camera", "radar")
    objects = step(
        fusion, 11, [box], cameras=[camera(11, box, late=0.05)], radars=[radar(11, [30, 0, 0], [0, 0, 0], late=1.0)]
    )
    assert objects.missing == ("radar",)
    assert objects.ages == {"camera": pytest.approx(0.05)}
    assert fusion.incidents == {"stale": 1}
    step(fusion, 12, [box], cameras=[camera(12, box, late=-0.05)])
    assert fusion.incidents == {"stale": 1, "from the future": 1}


def test_bad_data_of_any_sensor_does_no_harm():
    fusion = Fusion()
    for frame in range(5):
        box = car(30)
        view = camera(frame, np.array([box, box, box]))
        bad = np.array(view.boxes)
        bad[1], bad[2, 2:] = np.nan, bad[2, :2] - 5
        waves = radar(frame, [[30, 0, 0], [np.nan, 0, 0], [0, 0, 0]], np.zeros((3, 3)))
        boxes = np.array([box, car(np.nan), [5, 5, 0, 0, -1, 1, 0]])
        objects = step(fusion, frame, boxes, cameras=[dataclasses.replace(view, boxes=bad)], radars=[waves])
        assert objects.ids.tolist() == [1]
        assert np.isfinite(objects.boxes).all()
        assert np.isfinite(objects.existence).all()
    assert fusion.tracker.dropped == {"not finite": 5, "size not positive": 5}


def test_same_frames_same_bytes():
    def run():
        rng, fusion, out = np.random.default_rng(1), Fusion(), []
        for frame in range(12):
            boxes = np.array([car(x, y) for x, y in rng.uniform(5, 60, (6, 2))])
            objects = step(
                fusion, frame, boxes, score=0.4, cameras=[camera(frame, boxes[:3])],
                radars=[radar(frame, boxes[2:, :3], rng.normal(0, 5, (4, 3)))],
            )  # fmt: skip
            assert len(set(objects.ids.tolist())) == len(objects)
            out += [np.asarray(getattr(objects, f.name)).tobytes() for f in dataclasses.fields(objects)[:11]]
        return out

    assert run() == run()


@pytest.mark.parametrize(("change", "says"), [({"camera_weight": 1.0}, "camera_weight"), ({"memory": 0.0}, "memory")])
def test_impossible_settings_are_refused(change, says):
    with pytest.raises(ValueError, match=says):
        FusionConfig(**change)
