"""Random scenes: batches of them against the same ones alone, what is in them, and how cars look in them."""

from collections import Counter

import numpy as np
import pytest

from warploom.models.classes import VEHICLE
from warploom.models.simulator import PointClass, SceneBatch, Simulator, sample_scene, sample_views
from warploom.models.simulator.scenes import _draw


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
    with pytest.raises(ValueError, match="seed must be at least 0, not -1"):
        batch.frames([-1])
    with pytest.raises(TypeError, match="seed must be a whole number"):
        batch.frames([1.5])
    with pytest.raises(ValueError, match="worlds"):
        SceneBatch(0)
    with pytest.raises(TypeError, match="worlds must be a whole number"):
        SceneBatch(1.5)
    with pytest.raises(ValueError, match="lidar must be one of"):
        SceneBatch(1, lidar=None)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"seed": -1}, "seed must be at least 0"), ({"lidar": ""}, "lidar must be one of"), ({"rain": np.nan}, "rain"),
     ({"mounting_height": 0}, "mounting_height must be a number above 0"), ({"mounting_height": np.nan}, "mounting_h")],
)  # fmt: skip
def test_scenes_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        sample_scene(**{"seed": 1, "lidar": "vlp16"} | options)


def test_views_that_cannot_be_are_refused():
    with pytest.raises(ValueError, match="seed must be at least 0"):
        sample_views(-1, 1)
    with pytest.raises(ValueError, match="count must be at least 1, not 0"):
        sample_views(1, 0)


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


def test_streets_are_cluttered():
    """What clutters comes before the land is grown over, or there is no room for it."""
    kinds = Counter()
    for seed in range(6):
        scene = _draw(np.random.default_rng([seed, 11]), None, False)
        kinds.update(scene.street.things.kind)
    for kind in ("column", "gate", "topiary", "flower_bed", "bastion", "panel"):
        assert kinds[kind] >= 3  # of at most 4 to 39 a scene
    assert sum(kinds[kind] for kind in ("flower_bed", "bastion", "topiary")) >= 40


def test_the_far_ends_of_cars_seen_along_their_flank_return_little():
    """KITTI's labelled cars seen so have their last points 0.6 m before the end of the box in the median."""
    ends = []
    for seed in range(500, 508):
        frame = sample_scene(seed, lidar="hdl64", mounting_height=1.73)
        for k in np.flatnonzero((frame.classes == VEHICLE) & (frame.counts > 150)):
            box = frame.boxes[k].astype(np.float64)
            c, s = np.cos(box[6]), np.sin(box[6])
            sensor = np.array([-(box[0] * c + box[1] * s), box[0] * s - box[1] * c])
            half = 0.5 * box[3:5]
            grazing = abs(sensor[0]) > 2.5 * (abs(sensor[1]) - half[1])
            if not 3.2 < box[3] < 5.0 or abs(sensor[1]) < half[1] + 1.0 or not grazing:
                continue
            apart = frame.points[frame.instance == frame.ids[k], :2] - box[:2]
            along = (apart[:, 0] * c + apart[:, 1] * s) * np.sign(sensor[0])
            ends.append(np.percentile(along, 0.7) + half[0])
    assert len(ends) > 8
    assert 0.3 < np.median(ends) < 0.9


def test_polish_takes_echoes_from_vehicles_alone():
    dull, shiny = (Simulator(seed=3, lidar="vlp16", duration=0.1, polish=p, turning=False).frame(0) for p in (0.0, 2.0))
    on = [frame.point_class == PointClass.VEHICLE for frame in (dull, shiny)]
    assert on[1].sum() < 0.95 * on[0].sum()
    assert (~on[1]).sum() == pytest.approx((~on[0]).sum(), rel=0.01)  # panes of bus stops are polished too
    with pytest.raises(ValueError, match="polish"):
        Simulator(polish=-1.0)
