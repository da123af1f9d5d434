"""The chain as a stage, against the single stages that it stands for: the same bytes, frame after frame."""

import numpy as np
import pytest

import warploom as wl
from warploom.components.checking import check_file
from warploom.components.execution import ExecutionContext
from warploom.components.perception import ChainProcessor, ClusterProcessor, FilterProcessor, GroundProcessor
from warploom.dag import ProcessorHarness

SETTINGS = {"radius": 0.6, "min_size": 5, "max_height": 3.0}


@pytest.fixture(scope="module")
def frames():
    return list(wl.read("sim:street?seed=4&duration=0.3&turning=1"))


@pytest.mark.parametrize("captured", [False, True])
@pytest.mark.parametrize("capacity", [150_000, 50_000])
def test_it_gives_what_the_single_stages_give(frames, captured, capacity):
    """Also where a frame has more points than there is room for."""
    context = ExecutionContext(capacity=capacity)
    chain = ProcessorHarness(ChainProcessor, {**SETTINGS, "captured": captured}, context)
    filtering, segmenting, clustering = (
        ProcessorHarness(processor, config, context)
        for processor, config in ((FilterProcessor, {}), (GroundProcessor, {}), (ClusterProcessor, SETTINGS))
    )
    for frame in frames:
        found = chain.feed(sensor=frame).run(frame.version)
        filtered = filtering.feed(sensor=frame).run(frame.version)["filtered"]
        ground = segmenting.feed(filtered=filtered).run(frame.version)["ground"]
        clusters = clustering.feed(filtered=filtered, ground=ground).run(frame.version)["clusters"]
        assert found["filtered"].sensor is frame
        assert found["filtered"].dropped == filtered.dropped
        assert (found["filtered"].dropped["over_capacity"] > 0) == (capacity < len(frame.points))
        assert found["ground"].sensor_height == ground.sensor_height
        assert found["clusters"].count == clusters.count > 0
        for ours, theirs in (
            (found["filtered"].xyz, filtered.xyz),
            (found["filtered"].index, filtered.index),
            (found["filtered"].count, filtered.count),
            (found["ground"].mask, ground.mask),
            (found["ground"].height, ground.height),
            (found["clusters"].labels, clusters.labels),
        ):
            assert ours.numpy().tobytes() == theirs.numpy().tobytes()


def test_a_frame_without_points(frames):
    import dataclasses

    frame = dataclasses.replace(frames[0], points=np.zeros((0, 4), np.float32), t=np.zeros(0, np.float32))
    found = ProcessorHarness(ChainProcessor, {}, ExecutionContext(capacity=1000)).feed(sensor=frame).run(0)
    assert found["clusters"].count == len(found["filtered"].xyz) == 0


def test_other_backends_are_refused():
    with pytest.raises(ValueError, match="backend must be 'warp'"):
        ProcessorHarness(ChainProcessor, {"backend": "taichi"}, ExecutionContext(capacity=1000))


@pytest.mark.parametrize("name", ["modules/perception-chain", "profiles/cpu-chain"])
def test_its_files_are_sound(repository, name):
    check_file(repository / "conf" / f"{name}.yaml")


def test_the_profile_gives_the_same_objects(frames):
    """To the bit, as the profile of single stages."""
    objects = []
    for profile in ("cpu", "cpu-chain"):
        with wl.Pipeline.from_profile(profile) as pipeline:
            objects.append([frame.objects for frame in pipeline.run(iter(frames))])
    assert objects[0][-1]
    for ours, theirs in zip(*objects, strict=True):
        assert repr(ours) == repr(theirs)


@pytest.mark.parametrize("captured", [False, True])
def test_motion_is_undone_where_times_and_poses_are_known_and_only_there(frames, captured):
    """Frame after frame in one chain: a turning sweep, one in an instant, one without poses, one that is not to be."""
    import dataclasses

    context = ExecutionContext(capacity=150_000)
    chain = ProcessorHarness(ChainProcessor, {"captured": captured}, context)
    single = ProcessorHarness(FilterProcessor, {}, context)
    left = [
        ProcessorHarness(kind, {"motion_compensation": False}, context) for kind in (ChainProcessor, FilterProcessor)
    ]
    sensor = frames[0]
    instant = dataclasses.replace(sensor, t=np.zeros_like(sensor.t), poses=None, pose_times=None)
    bare = dataclasses.replace(sensor, poses=None, pose_times=None)
    seen = wl.compensate_motion(sensor.points, sensor.t, sensor.poses, sensor.pose_times, 0.0)
    for frame, harnesses, moved in (
        (sensor, (chain, single), True), (instant, (chain, single), False), (sensor, (chain, single), True),
        (bare, (chain, single), False), (sensor, left, False),
    ):  # fmt: skip
        for harness in harnesses:
            filtered = harness.feed(sensor=frame).run(frame.version)["filtered"]
            assert filtered.compensated is moved
            expected = (seen if moved else sensor.points)[filtered.index.numpy(), :3]
            assert filtered.xyz.numpy().tobytes() == expected.tobytes()
