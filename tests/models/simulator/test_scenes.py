"""Batches of scenes against the same scenes one by one."""

import numpy as np
import pytest

from warploom.models.simulator import SceneBatch, sample_scene


def fields(frame):
    return {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in frame.__dict__.items()}


@pytest.mark.parametrize("turning", [False, True])
def test_a_batch_gives_the_frames_of_its_seeds(turning):
    batch = SceneBatch(3, lidar="vlp16", turning=turning)
    seeds = [7, 2, 30]
    for frame, seed in zip(batch.frames(seeds, visibility=True), seeds, strict=True):
        alone = sample_scene(seed, lidar="vlp16", turning=turning, visibility=True)
        assert fields(frame) == fields(alone)
    fewer = batch.frames([2])
    assert len(fewer) == 1
    assert fewer[0].points.tobytes() == sample_scene(2, lidar="vlp16", turning=turning).points.tobytes()


def test_sizes_of_a_batch_are_checked():
    batch = SceneBatch(1, lidar="vlp16")
    with pytest.raises(ValueError, match="seeds must be 1 to 1, not 2"):
        batch.frames([1, 2])
    with pytest.raises(ValueError, match="worlds"):
        SceneBatch(0)


def test_the_ego_vehicle_of_a_turning_scene_drives():
    gone = [
        np.linalg.norm(frame.poses[2][:2, 3] - frame.poses[0][:2, 3]) * 10
        for frame in (sample_scene(seed, lidar="vlp16", turning=True) for seed in range(4))
    ]
    assert max(gone) > 2
    assert max(gone) < 15


def test_the_mounting_height_can_be_given():
    frame = sample_scene(3, lidar="vlp16", mounting_height=3.0)
    near = frame.ground & (np.linalg.norm(frame.points[:, :2], axis=1) < 15)
    assert np.median(frame.points[near, 2]) == pytest.approx(-3.0, abs=0.3)
