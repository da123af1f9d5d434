"""Detections in images that were never drawn: the errors are as many and as large as was said."""

import numpy as np
import pytest

from warploom.models.classes import CONE, CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.simulator import Camera, CameraDetector, SimulatedFrame

CAMERA = Camera(width=1280, height=720)
TRUE = {"edge_noise": 0.0, "size_noise": 0.0, "confusion": 0.0, "false_objects": 0.0}


def frame_of(boxes, classes, visible=None):
    k = len(boxes)
    return SimulatedFrame(
        version=5, index=0, points=np.zeros((0, 4), np.float32), ring=np.zeros(0, np.uint16),
        t=np.zeros(0, np.float32), point_class=np.zeros(0, np.int32), instance=np.zeros(0, np.int64),
        ground=np.zeros(0, bool), boxes=np.array(boxes, np.float32), classes=np.array(classes, np.int32),
        ids=1 + np.arange(k), velocities=np.zeros((k, 2), np.float32), counts=np.full(k, 10, np.int32),
        seen_at=np.zeros(k, np.float32), visible=None if visible is None else np.array(visible, np.float32),
        pose=np.eye(4), poses=np.stack([np.eye(4)] * 3), pose_times=np.zeros(3), speed=0.0, lidar="none",
    )  # fmt: skip


def often(frame, detector, times=400):
    return [detector.detect(frame, CAMERA, seed=seed) for seed in range(times)]


def test_a_car_ahead_is_where_the_pinhole_puts_it():
    frame = frame_of([[20, 2, 0, 4, 2, 1.5, 0]], [VEHICLE])
    found = CameraDetector(best=1.0, half_height=0.1, **TRUE).detect(frame, CAMERA, seed=1)
    focal, cx, cy = CAMERA.intrinsics[0, 0], CAMERA.intrinsics[0, 2], CAMERA.intrinsics[1, 2]
    # Its rear is 18 m away; y is to the left, z up.
    expected = [cx - focal * 3 / 18, cy - focal * 0.75 / 18, cx - focal * 1 / 22, cy + focal * 0.75 / 18]
    np.testing.assert_allclose(found.boxes[0], expected, atol=0.01)
    assert (found.ids.tolist(), found.classes.tolist()) == ([1], [VEHICLE])


@pytest.mark.parametrize(
    ("box", "kind", "visible"),
    [((-20, 0, 0, 4, 2, 1.5, 0), VEHICLE, 1), ((20, 30, 0, 4, 2, 1.5, 0), VEHICLE, 1),
     ((20, 0, 0, 4, 2, 1.5, 0), VEHICLE, 0), ((10, 0, 0, 0.4, 0.4, 0.7, 0), CONE, 1)],
    ids=["behind", "beside the image", "hidden", "no road user"],
)  # fmt: skip
def test_what_is_not_found(box, kind, visible):
    frame = frame_of([box], [kind], [visible])
    assert not any(len(found.ids) for found in often(frame, CameraDetector(**TRUE), 50))


def test_the_far_and_the_half_hidden_are_missed_more_often():
    frame = frame_of(
        [[15, 0, 0, 4, 2, 1.5, 0], [60, 0, 0, 4, 2, 1.5, 0], [100, 0, 0, 4, 2, 1.5, 0], [62, 12, 0, 4, 2, 1.5, 0]],
        [VEHICLE] * 4, [1, 1, 1, 0.3],
    )  # fmt: skip
    found = np.concatenate([one.ids for one in often(frame, CameraDetector(**TRUE))])
    near, middle, far, hidden = (np.mean(found == k) * len(found) / 400 for k in (1, 2, 3, 4))
    assert near == pytest.approx(0.97, abs=0.03)
    assert near > middle > far
    assert middle > hidden + 0.1


def test_half_of_those_of_half_height_are_found():
    focal = CAMERA.intrinsics[0, 0]
    depth = focal * 1.7 / 18 + 0.25  # where a person of 1.7 m is 18 pixels high
    frame = frame_of([[depth, 0, 0, 0.5, 0.5, 1.7, 0]], [PEDESTRIAN])
    found = sum(len(one.ids) for one in often(frame, CameraDetector(best=1.0, half_height=18.0, **TRUE), 1000))
    assert found / 1000 == pytest.approx(0.5, abs=0.05)  # three standard deviations


def test_errors_are_as_large_as_was_said():
    frame = frame_of([[15, 0, 0, 4, 2, 1.5, 0], [12, 4, 0, 1.8, 0.6, 1.7, 0]], [VEHICLE, CYCLIST])
    exact = CameraDetector(best=1.0, half_height=0.1, **TRUE).detect(frame, CAMERA, seed=0).boxes[0]
    noisy = CameraDetector(best=1.0, half_height=0.1, edge_noise=2.0, size_noise=0.0, confusion=0.0, false_objects=0.7)
    some = often(frame, noisy)
    off = np.concatenate([one.boxes[one.ids == 1] - exact for one in some])
    assert off.std() == pytest.approx(2.0, abs=0.15)
    assert np.mean([np.sum(one.ids < 0) for one in some]) == pytest.approx(0.7, abs=0.15)
    assert [one.boxes.tobytes() for one in some] == [one.boxes.tobytes() for one in often(frame, noisy)]
