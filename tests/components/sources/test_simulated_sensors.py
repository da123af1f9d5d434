"""The cameras and radars of a simulated vehicle: what they say fits the truth of the sweep they come before."""

import numpy as np
import pytest

from warploom.components.messages import CameraSet, RadarSet
from warploom.components.pipeline import Pipeline
from warploom.components.sources import open_source
from warploom.components.sources.simulated_sensors import SensorSuite, mounted_suite
from warploom.datamesh.messages import decode, encode
from warploom.errors import ConfigError
from warploom.models.fusion_sensors import image_boxes, radar_targets
from warploom.models.geometry import invert, rigid
from warploom.models.simulator import CameraDetector

DRIVE = "sim:street?seed=5&duration=0.6&lidar=vlp16"


@pytest.fixture(scope="module")
def source():
    return open_source(DRIVE)


@pytest.fixture(scope="module")
def frames(source):
    return list(source)


def test_what_comes_before_a_sweep_has_its_age(frames):
    for frame in frames:
        assert {one.sensor for one in frame.cameras.cameras} == {"camera_front", "camera_rear"}
        assert {one.sensor for one in frame.radars.radars} == {"radar_front", "radar_rear"}
        assert {frame.version - one.version for one in frame.cameras.cameras} == {50_000_000}
        assert {frame.version - one.version for one in frame.radars.radars} == {30_000_000}
    assert min(len(one.boxes) for frame in frames for one in frame.cameras.cameras) > 0


def test_a_perfect_detector_finds_the_true_boxes_where_the_projection_puts_them(source):
    drive = source._simulator
    frame = drive.frame(3)
    suite = SensorSuite(detector=CameraDetector(edge_noise=0.0, size_noise=0.0, confusion=0.0, false_objects=0.0))
    for camera in suite.cameras_of(drive, frame).cameras:
        velocities = frame.velocities.astype(float)
        (boxes,), _ = image_boxes(frame.boxes, [camera], frame.pose, velocities, [0.05])
        assert len(camera.boxes) > 3
        for box, kind in zip(camera.boxes, camera.classes, strict=True):
            off = np.abs(boxes - box).max(1)
            nearest = off.argmin()
            assert off[nearest] < 0.5  # pixels: a box is moved in float32, and by its velocity at the sweep's time
            assert frame.classes[nearest] == kind


def test_radar_targets_lie_on_true_objects_and_go_as_they_do(source, frames):
    on_something = total = 0
    for frame in frames:
        for radar in frame.radars.radars:
            targets = radar_targets([radar], frame.pose, [0.03], None)
            centres, velocities = frame.truth.boxes[:, :2].astype(float), frame.truth.velocities.astype(float)
            for place, direction, speed in zip(targets.positions, targets.directions, targets.speeds, strict=True):
                near = np.linalg.norm(centres - place, axis=1) < 4.0 + 0.02 * np.linalg.norm(place)
                total += 1
                # 0.1 m/s of noise, four times; half a metre a second for lines of sight to centre and echo
                on_something += bool((np.abs(velocities[near] @ direction - speed) < 0.9).any())
    assert total > 100
    assert on_something > 0.85 * total


def test_the_same_drive_gives_the_same_bytes(frames):
    again = list(open_source(DRIVE))
    assert [encode(frame.cameras) + encode(frame.radars) for frame in frames] == [
        encode(frame.cameras) + encode(frame.radars) for frame in again
    ]


def test_sets_survive_the_codec(frames):
    back = decode(encode(frames[0]))
    assert isinstance(back.cameras, CameraSet)
    assert isinstance(back.radars, RadarSet)
    np.testing.assert_array_equal(back.cameras.cameras[1].boxes, frames[0].cameras.cameras[1].boxes)


def test_the_lidar_alone_can_be_asked_for():
    frame = next(iter(open_source(DRIVE + "&sensors=lidar")))
    assert frame.cameras is None
    assert frame.radars is None
    with pytest.raises(ConfigError, match="sensors must be all or lidar"):
        open_source("sim:street?sensors=camera")


def test_sensors_are_where_the_vehicle_has_them():
    lidar, camera, radar = rigid((1.2, 0, 1.9)), rigid((2.1, 0.1, 1.45), yaw=0.9), rigid((3.7, 0, 0.5))
    suite = mounted_suite(lidar, {"left": camera}, {"nose": radar})
    np.testing.assert_allclose(suite.cameras["left"].lidar_from_body, invert(lidar) @ camera, atol=1e-12)
    np.testing.assert_allclose(suite.radars["nose"].lidar_from_radar[:3, 3], (2.5, 0, -1.4), atol=1e-12)


@pytest.mark.parametrize(("uri", "missing"), [(DRIVE, set()), (DRIVE + "&sensors=lidar", set())])
def test_the_shipped_pipeline_fuses_what_there_is(uri, missing):
    with Pipeline.from_profile("cpu") as pipeline:
        frames = list(pipeline.run(open_source(uri)))
        assert pipeline.losses == {}
    assert len(frames) == 6
    for frame in frames:
        assert set(frame.objects.missing_inputs) == missing
        assert frame.objects.velocity_reference == "world"  # the ego pose went through
    assert len(frames[-1].objects) > 3


def test_a_sensor_that_falls_silent_is_missing_from_then_on(frames):
    import dataclasses

    def silent(frame):
        late = frame.index >= 2
        return dataclasses.replace(frame, radars=None if late else frame.radars, version=frame.version + late * 10**9)

    with Pipeline.from_profile("cpu") as pipeline:
        objects = [frame.objects for frame in pipeline.run(silent(frame) for frame in frames)]
    assert [set(each.missing_inputs) for each in objects[:2]] == [set(), set()]
    assert {"radar_front", "radar_rear"} <= set(objects[-1].missing_inputs)
