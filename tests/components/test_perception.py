"""The stages alone, by the harness: no graph, no runtime."""

import dataclasses

import numpy as np
import pytest

import warploom as wl
from warploom.components.execution import ExecutionContext
from warploom.components.messages import SensorFrame
from warploom.components.perception import (
    BackgroundProcessor,
    ClusterBoxProcessor,
    ClusterProcessor,
    DetectionProcessor,
    FilterProcessor,
    GroundProcessor,
    MergeProcessor,
    PointLabelsProcessor,
    TrackingProcessor,
)
from warploom.dag import ProcessorHarness
from warploom.models.classes import VEHICLE
from warploom.models.detections import Detections
from warploom.models.geometry import points_in_boxes

CONTEXT = ExecutionContext(capacity=150_000)


@pytest.fixture(scope="module")
def sensor() -> SensorFrame:
    return next(iter(wl.read("sim:street?seed=2&duration=0.1&turning=1")))


@pytest.fixture(scope="module")
def stages(sensor) -> dict:
    """The data of one frame, stage by stage, with the true vehicles in place of the head's."""
    data = {"sensor": sensor}
    truth = sensor.truth
    cars = (truth.classes == VEHICLE) & (truth.points >= 20)
    k = int(cars.sum())
    data["foreground"] = Detections(
        boxes=truth.boxes[cars],
        scores=np.full(k, 0.9, np.float32),
        classes=truth.classes[cars],
        velocities=np.full((k, 2), np.nan, np.float32),
        background=np.zeros(k, bool),
    )
    for processor in (
        FilterProcessor,
        GroundProcessor,
        ClusterProcessor,
        ClusterBoxProcessor,
        BackgroundProcessor,
        MergeProcessor,
        PointLabelsProcessor,
    ):
        harness = ProcessorHarness(processor, {}, CONTEXT)
        inputs = {name: data[name] for name, port in harness.processor.ports.items() if name in data}
        data.update(harness.feed(**inputs).run(sensor.version))
        data[f"{processor.__name__} kept alive"] = harness  # its workspace holds the outputs
    return data


def test_the_filter_keeps_points_in_order_and_counts_the_rest(stages, sensor):
    filtered = stages["filtered"]
    index = filtered.index.numpy()
    assert (np.diff(index) > 0).all()
    seen = wl.compensate_motion(sensor.points, sensor.t, sensor.poses, sensor.pose_times, 0.0)
    assert filtered.compensated
    assert np.array_equal(filtered.xyz.numpy(), seen[index, :3])
    assert not np.array_equal(filtered.xyz.numpy(), sensor.points[index, :3])
    assert len(index) + sum(filtered.dropped.values()) == len(sensor.points)


def test_ground_is_what_the_truth_calls_ground(stages, sensor):
    truth = sensor.truth
    mask = stages["labels"].ground
    scored = truth.ground_scored
    assert (mask[scored] == truth.ground[scored]).mean() > 0.97
    assert stages["ground"].sensor_height == pytest.approx(1.73, abs=0.1)


def test_clusters_have_no_ground_and_every_car_is_in_few(stages, sensor):
    labels = stages["labels"].clusters
    assert not (stages["labels"].ground & (labels >= 0)).any()
    assert stages["clusters"].count == labels.max() + 1


def test_boxes_hold_the_points_of_their_clusters(stages):
    found, xyz = stages["cluster_boxes"], stages["filtered"].xyz.numpy()
    for label in np.flatnonzero(found.sizes >= 50)[:40]:
        own = xyz[found.labels == label]
        assert len(own) == found.sizes[label]
        assert points_in_boxes(own, found.boxes[label : label + 1], margin=0.01).all()


def test_long_clusters_are_cut(stages):
    """A piece is as long as its share of the whole; 1.5 of the asked length is where cutting begins."""
    boxes = stages["cluster_boxes"].boxes
    uncut = ProcessorHarness(ClusterBoxProcessor, {"split_length": 1000.0}, CONTEXT)
    outputs = uncut.feed(filtered=stages["filtered"], clusters=stages["clusters"]).run()
    assert np.nanmax(outputs["cluster_boxes"].boxes[:, 3]) > 15.5
    assert np.nanmax(boxes[:, 3]) < 0.9 * np.nanmax(outputs["cluster_boxes"].boxes[:, 3])


def test_the_background_has_no_box_where_a_known_object_is(stages):
    foreground, background = stages["foreground"], stages["background"]
    assert len(background) > 10
    assert background.background.all()
    apart = np.linalg.norm(background.boxes[:, None, :2] - foreground.boxes[None, :, :2], axis=2)
    like = np.abs(background.boxes[:, None, 3:6] - foreground.boxes[None, :, 3:6]).max(axis=2)
    assert not ((apart < 0.3) & (like < 0.3)).any()


def test_merging_says_what_was_missing(stages, sensor):
    assert stages["detected"].missing_inputs == ()
    assert len(stages["detected"].detections) == len(stages["foreground"]) + len(stages["background"])
    alone = ProcessorHarness(MergeProcessor).feed(filtered=stages["filtered"], background=stages["background"]).run()
    assert alone["detected"].missing_inputs == ("foreground",)


def test_tracking_says_over_ground_only_where_the_pose_is_known(stages, sensor):
    tracked = ProcessorHarness(TrackingProcessor).feed(detected=stages["detected"]).run(sensor.version)["obstacles"]
    assert tracked.velocity_reference == "world"
    assert tracked.version == sensor.version
    assert (~tracked.background).sum() == len(stages["foreground"])


def test_a_frame_that_does_not_continue_the_one_before_begins_new_tracks_at_once(stages, sensor):
    tracking = ProcessorHarness(TrackingProcessor)
    first = tracking.feed(detected=stages["detected"]).run(sensor.version)["obstacles"]
    elsewhere = dataclasses.replace(sensor, version=sensor.version + 1, continues=False)
    second = tracking.feed(detected=dataclasses.replace(stages["detected"], sensor=elsewhere)).run(elsewhere.version)
    assert len(second["obstacles"]) == len(first)
    assert not set(second["obstacles"].ids) & set(first.ids)


def test_the_head_finds_most_of_the_near_vehicles(stages, sensor):
    harness = ProcessorHarness(DetectionProcessor, {}, CONTEXT)
    outputs = harness.feed(filtered=stages["filtered"], ground=stages["ground"]).run(sensor.version)
    found, truth = outputs["foreground"], sensor.truth
    near = (truth.classes == VEHICLE) & (truth.points >= 100) & (np.hypot(*truth.boxes[:, :2].T) < 30)
    apart = np.linalg.norm(truth.boxes[near][:, None, :2] - found.boxes[None, found.classes == VEHICLE, :2], axis=2)
    assert (apart.min(axis=1) < 1.0).mean() >= 0.7


@pytest.mark.parametrize(
    ("processor", "config", "message"),
    [
        (FilterProcessor, {"point_range": [1, 0, 0, 0, 1, 1]}, "each min below its max"),
        (ClusterProcessor, {"radius": 0}, "greater than 0"),
        (BackgroundProcessor, {"min_sise": 3}, "Extra inputs are not permitted"),
        (DetectionProcessor, {"score_threshold": 2.0}, "less than or equal to 1"),
    ],
)
def test_a_wrong_configuration_is_refused(processor, config, message):
    with pytest.raises(ValueError, match=message):
        ProcessorHarness(processor, config, CONTEXT)
