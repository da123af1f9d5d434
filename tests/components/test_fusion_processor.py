"""Fusion as a stage: ports, messages, and what is missing."""

import dataclasses

import numpy as np
import pytest

from warploom.components.messages import CameraObjects, CameraSet, DetectedObjects, RadarObjects, RadarSet, SensorFrame
from warploom.components.perception import FusionProcessor, TrackingProcessor
from warploom.dag import ProcessorHarness
from warploom.datamesh.messages import decode, encode
from warploom.models.classes import VEHICLE
from warploom.models.detections import Detections

NS = 100_000_000
CAMERA = CameraObjects(
    version=5 * NS, sensor="front", boxes=np.array([[560, 300, 720, 420]], np.float32),
    scores=np.array([0.9], np.float32), classes=np.array([VEHICLE], np.int32),
    projection=np.array([[1000.0, 0, 640], [0, 1000, 360], [0, 0, 1]])
    @ np.array([[0, -1.0, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]]),
    size=(1280, 720),
)  # fmt: skip
RADAR = RadarObjects(
    version=5 * NS, sensor="radar", positions=np.array([[30, 0, 0]], np.float32),
    radial_velocities=np.array([-4.0], np.float32), scores=np.array([0.8], np.float32), mounting=np.eye(4),
    velocity=np.array([10.0, 0, 0]),
)  # fmt: skip


def detected(frame, *boxes, pose=True, **more):
    boxes = np.array(boxes, np.float32).reshape(-1, 7)
    n = len(boxes)
    sensor = SensorFrame(
        version=frame * NS, index=frame, points=np.empty((0, 4), np.float32), pose=np.eye(4) if pose else None, **more
    )
    detections = Detections(
        boxes=boxes, scores=np.full(n, 0.6, np.float32), classes=np.full(n, VEHICLE, np.int32),
        velocities=np.full((n, 2), np.nan, np.float32), background=np.zeros(n, bool),
    )  # fmt: skip
    return DetectedObjects(sensor=sensor, detections=detections, missing_inputs=("background",))


CAR = (30, 0, 0, 4.4, 1.9, 1.6, 0)


def test_all_sensors_make_one_obstacle():
    harness = ProcessorHarness(FusionProcessor, {"sensors": ["front", "radar"]})
    obstacles = harness.feed(detected=detected(5, CAR), cameras=CAMERA, radars=(RADAR,)).run(5 * NS)["obstacles"]
    assert obstacles.missing_inputs == ("background",)
    assert obstacles.classes.tolist() == [VEHICLE]
    assert obstacles.velocities[0, 0] == pytest.approx(6.0, abs=0.2)
    assert obstacles.velocity_reference == "world"
    assert obstacles.scores[0] > 0.8


@pytest.mark.parametrize(
    ("given", "missing"),
    [({}, ("front", "radar")), ({"cameras": CAMERA}, ("radar",)), ({"radars": RADAR}, ("front",))],
)
def test_it_works_with_any_sensor_missing_and_says_so(given, missing):
    harness = ProcessorHarness(FusionProcessor, {"sensors": ["front", "radar"]})
    obstacles = harness.feed(detected=detected(5, CAR), **given).run(5 * NS)["obstacles"]
    assert obstacles.missing_inputs == ("background", *missing)
    assert len(obstacles) == 1


def test_without_other_sensors_the_objects_are_those_of_tracking():
    fusion, tracking = ProcessorHarness(FusionProcessor), ProcessorHarness(TrackingProcessor)
    for frame in range(6):
        found = detected(frame, CAR, (10 + frame, 5, 0, 4.4, 1.9, 1.6, 0))
        a = fusion.feed(detected=found).run(frame * NS)["obstacles"]
        b = tracking.feed(detected=found).run(frame * NS)["obstacles"]
        for name in ("ids", "classes", "boxes", "velocities", "background"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_frame_that_does_not_continue_the_one_before_begins_anew():
    harness = ProcessorHarness(FusionProcessor)
    first = harness.feed(detected=detected(5, CAR)).run(5 * NS)["obstacles"]
    second = harness.feed(detected=detected(2, CAR, continues=False)).run(2 * NS)["obstacles"]
    assert first.ids.tolist() == [1]
    assert second.ids.tolist() == [2]


def test_a_message_of_another_kind_is_refused():
    harness = ProcessorHarness(FusionProcessor)
    with pytest.raises(TypeError, match="port cameras holds RadarObjects"):
        harness.feed(detected=detected(5, CAR), cameras=RADAR).run(5 * NS)


@pytest.mark.parametrize("message", [CAMERA, RADAR])
def test_messages_survive_the_codec(message):
    back = decode(encode(message))
    for each in dataclasses.fields(message):
        np.testing.assert_array_equal(getattr(back, each.name), getattr(message, each.name))


def test_it_says_which_sensors_joined_and_which_are_missing():
    harness = ProcessorHarness(FusionProcessor, {"sensors": ["front", "radar"]})
    assert harness.processor.state()["missing"] == "front radar"
    harness.feed(detected=detected(5, CAR), cameras=CameraSet(version=CAMERA.version, cameras=(CAMERA,))).run(5 * NS)
    assert harness.processor.state() == {"tracks": 1, "joined": "front 0 ms", "missing": "radar"}
    harness.feed(radars=RadarSet(version=RADAR.version, radars=(RADAR,)), detected=detected(6, CAR)).run(6 * NS)
    assert harness.processor.state() == {"tracks": 1, "joined": "front 100 ms radar 100 ms"}


def test_a_sensor_that_nobody_announced_is_missed_once_it_was_there():
    harness = ProcessorHarness(FusionProcessor)
    first = harness.feed(detected=detected(5, CAR), cameras=CAMERA).run(5 * NS)["obstacles"]
    later = harness.feed(detected=detected(12, CAR)).run(12 * NS)["obstacles"]
    assert first.missing_inputs == ("background",)
    assert later.missing_inputs == ("background", "front")
    assert harness.processor.losses.as_dict() == {"FusionProcessor": {"stale": 1}}


@pytest.mark.parametrize("processor", [TrackingProcessor, FusionProcessor])
def test_what_cannot_be_used_is_counted_by_reason(processor):
    harness = ProcessorHarness(processor)
    bad = (np.nan, 0, 0, 4.4, 1.9, 1.6, 0)
    flat = (60, 0, 0, 4.4, 0, 1.6, 0)
    harness.feed(detected=detected(5, CAR, bad, flat)).run(5 * NS)
    harness.feed(detected=detected(6, CAR, bad)).run(6 * NS)
    harness.feed(detected=detected(7, CAR, pose=False)).run(7 * NS)
    harness.feed(detected=detected(90, CAR)).run(90 * NS)
    (told,) = harness.processor.losses.as_dict().values()
    # Fusion has a tracker of its own for radar targets, which knows of the missing pose as well.
    assert told["not finite"] == 2
    assert told["size not positive"] == 1
    assert told["gap"] == 1
    assert told["pose missing"] >= 1
