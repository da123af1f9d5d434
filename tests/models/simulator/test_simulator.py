"""The simulated frames against what must be true of any recording with perfect labels."""

import numpy as np
import pytest

from warploom.models.classes import CLASSES, PEDESTRIAN, VEHICLE
from warploom.models.simulator import LIDARS, Camera, PointClass, SimulatedFrame, Simulator, lidar_model, sample_scene

OBJECT_CLASSES = (
    PointClass.VEHICLE, PointClass.PEDESTRIAN, PointClass.CYCLIST, PointClass.CONE, PointClass.BARRIER,
)  # fmt: skip


@pytest.fixture(scope="module")
def drive() -> Simulator:
    return Simulator(seed=3, lidar="xt32", duration=2.0, turning=False)


@pytest.fixture(scope="module")
def scenes() -> list[SimulatedFrame]:
    return [sample_scene(seed, lidar="hdl32") for seed in range(6)]


def inside(points, box, grow):
    """Which points lie in a box grown by `grow` metres on each side."""
    x, y, z, length, width, height, yaw = box.astype(np.float64)
    c, s = np.cos(yaw), np.sin(yaw)
    p = points[:, :3] - [x, y, z]
    local = np.stack([p[:, 0] * c + p[:, 1] * s, p[:, 1] * c - p[:, 0] * s, p[:, 2]], 1)
    return np.all(np.abs(local) <= np.array([length, width, height]) / 2 + grow, axis=1)


def fields(frame):
    return {k: v.tobytes() if isinstance(v, np.ndarray) else v for k, v in frame.__dict__.items()}


def test_shapes_and_types_are_as_documented(drive):
    frame = drive.frame(0)
    n, k = len(frame.points), len(frame.boxes)
    for name, shape, dtype in (
        ("points", (n, 4), np.float32), ("ring", (n,), np.uint16), ("t", (n,), np.float32),
        ("point_class", (n,), np.int32), ("instance", (n,), np.int64), ("ground", (n,), np.bool_),
        ("boxes", (k, 7), np.float32), ("classes", (k,), np.int32), ("ids", (k,), np.int64),
        ("velocities", (k, 2), np.float32), ("counts", (k,), np.int32), ("pose", (4, 4), np.float64),
    ):  # fmt: skip
        array = getattr(frame, name)
        assert (array.shape, array.dtype) == (shape, dtype), name
    assert np.isfinite(frame.points).all()
    assert frame.points[:, 3].min() >= 0
    assert frame.points[:, 3].max() <= 1
    assert frame.t.min() >= 0
    assert frame.t.max() < 0.1
    assert len(drive) == 20
    assert frame.classes.max() < len(CLASSES)


def test_two_simulators_of_one_seed_give_the_same_bytes(drive):
    other = Simulator(seed=3, lidar="xt32", duration=2.0, turning=False)
    for index in (0, 7):
        assert fields(drive.frame(index)) == fields(other.frame(index))
    assert fields(drive.frame(0)) == fields(next(iter(drive)))


def test_another_seed_gives_another_street(drive):
    assert drive.frame(0).points.tobytes() != Simulator(seed=4, lidar="xt32", turning=False).frame(0).points.tobytes()


def test_a_scene_of_one_seed_is_the_same_whatever_came_before(scenes):
    sample_scene(99, lidar="vlp16")
    assert fields(sample_scene(2, lidar="hdl32")) == fields(scenes[2])


def test_points_of_an_object_lie_in_its_box(drive, scenes):
    # Range noise of 1–2 cm: at least 99 % within a box grown by 5 cm; mirrors stand out of it on purpose.
    held = total = 0
    for frame in [drive.frame(0), drive.frame(15), *scenes]:
        for box, ident, count in zip(frame.boxes, frame.ids, frame.counts, strict=True):
            if count:
                mine = frame.points[frame.instance == ident]
                held += inside(mine, box, 0.05).sum()
                total += len(mine)
    assert total > 5000
    assert held / total >= 0.99


def test_boxes_are_tight(scenes):
    # An object seen from near by touches each side of its box somewhere in many scenes: at least the height is reached.
    gaps = []
    for frame in scenes:
        for box, ident, label, count in zip(frame.boxes, frame.ids, frame.classes, frame.counts, strict=True):
            if label == PEDESTRIAN and count > 60:
                top = frame.points[frame.instance == ident][:, 2].max()
                gaps.append(box[2] + box[5] / 2 - top)
    assert gaps
    assert np.median(gaps) < 0.2


def test_counts_are_those_of_the_instances(drive, scenes):
    for frame in [drive.frame(3), *scenes]:
        for ident, count in zip(frame.ids, frame.counts, strict=True):
            assert (frame.instance == ident).sum() == count
        assert len(set(frame.ids.tolist())) == len(frame.ids)
        assert set(np.unique(frame.instance)) - {-1} <= set(frame.ids.tolist())
        assert np.array_equal(frame.instance >= 0, np.isin(frame.point_class, OBJECT_CLASSES))


def test_hidden_objects_are_in_the_truth_without_points(scenes):
    assert any((frame.counts == 0).any() for frame in scenes)


def test_ground_points_lie_on_the_ground(drive):
    # Measured against the height field itself; a beam that grazes turns range noise into little height.
    frame = drive.frame(5)
    world = frame.points[:, :3] @ frame.pose[:3, :3].T + frame.pose[:3, 3]
    ground = drive.ground
    height = ground.height(*ground.to_street(world[:, 0], world[:, 1]))
    off = np.abs(world[frame.ground, 2] - height[frame.ground])
    assert np.percentile(off, 99) < 0.06
    assert frame.ground.mean() > 0.2
    assert (world[~frame.ground, 2] - height[~frame.ground]).mean() > 0.3


def test_velocities_are_those_of_the_boxes_between_frames(drive):
    one, two = drive.frame(4), drive.frame(5)
    checked = 0
    for k, ident in enumerate(one.ids):
        j = np.flatnonzero(two.ids == ident)
        if not len(j):
            continue
        a = one.pose[:3, :3] @ one.boxes[k, :3] + one.pose[:3, 3]
        b = two.pose[:3, :3] @ two.boxes[j[0], :3] + two.pose[:3, 3]
        truth = 0.5 * (
            one.pose[:3, :2] @ one.velocities[k].astype(np.float64)
            + two.pose[:3, :2] @ two.velocities[j[0]].astype(np.float64)
        )
        if one.classes[k] == VEHICLE:
            # Boxes are float32 and tight to a body that pitches with the road: 1 cm in 0.1 s.
            assert np.allclose((b - a)[:2] / 0.1, truth[:2], atol=0.12)
            checked += np.linalg.norm(truth) > 1
        else:
            # A walker's box breathes with the step.
            assert np.linalg.norm((b - a)[:2] / 0.1 - truth[:2]) < 4.0
    assert checked >= 3


def test_the_ego_moves_as_its_speed_says(drive):
    one, two = drive.frame(8), drive.frame(9)
    gone = np.linalg.norm(two.pose[:3, 3] - one.pose[:3, 3])
    assert gone / 0.1 == pytest.approx(0.5 * (one.speed + two.speed), abs=0.05)
    assert two.version - one.version == 100_000_000
    assert np.allclose(one.pose[:3, :3] @ one.pose[:3, :3].T, np.eye(3), atol=1e-9)


def test_rings_have_the_elevations_of_the_sensor(scenes):
    elevation = LIDARS["hdl32"].elevation
    for frame in scenes[:2]:
        seen = np.rad2deg(np.arctan2(frame.points[:, 2], np.hypot(frame.points[:, 0], frame.points[:, 1])))
        assert np.allclose(seen, elevation[frame.ring], atol=1e-3)


def test_the_demo_sees_people_and_traffic(drive):
    frame = drive.frame(0)
    seen = frame.counts >= 10
    assert (frame.classes[seen] == VEHICLE).sum() >= 5
    assert (frame.classes[seen] == PEDESTRIAN).sum() >= 1
    assert (np.linalg.norm(frame.velocities, axis=1) > 4).sum() >= 3


def test_a_sensor_object_does_as_well_as_its_name():
    assert fields(sample_scene(1, lidar=lidar_model("vlp16"))) == fields(sample_scene(1, lidar="vlp16"))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"scenario": "moon"}, "scenario"), ({"lidar": "abacus"}, "lidar"), ({"duration": 0}, "duration"),
        ({"rate": -1}, "rate"), ({"mounting_height": 0}, "mounting_height"), ({"seed": -1}, "seed must be at least 0"),
        ({"duration": np.inf}, "duration"), ({"rate": np.inf}, "rate"), ({"mounting_height": np.inf}, "mounting_h"),
        ({"rain": -1}, "rain must be a number from 0 on"), ({"polish": np.nan}, "polish"), ({"lidar": None}, "lidar"),
        ({"lidar": 64}, "lidar must be one of vlp16"), ({"scenario": None}, "scenario"),
    ],
)  # fmt: skip
def test_wrong_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        Simulator(**options)


@pytest.mark.parametrize("name", ["seed", "duration", "rate", "mounting_height", "rain", "polish"])
def test_what_is_no_number_is_named(name):
    with pytest.raises(TypeError, match=f"{name} must be a (whole )?number, not 'many'"):
        Simulator(**{name: "many"})


def test_what_a_drive_cannot_give_is_named(drive):
    with pytest.raises(ValueError, match="delay must be a number of seconds, not nan"):
        drive.image(0, Camera(), delay=np.nan)
    with pytest.raises(ValueError, match="outages must be pairs of a beginning and an end not before it"):
        drive.gnss(outages=[(2.0, 1.0)])


def test_a_frame_that_is_not_there(drive):
    with pytest.raises(IndexError, match="0 to 19"):
        drive.frame(20)


def test_a_drive_may_be_minutes_long():
    """Far more ground and things than in a usual one, and still a street at its end."""
    long = Simulator(seed=3, lidar="vlp16", duration=400.0)
    assert len(long.ground.mesh()[1]) > 100_000
    last = long.frame(len(long) - 1)
    assert len(last.points) > 10_000
    assert last.ground.mean() > 0.1
    assert (last.counts > 10).any()


def test_a_drive_that_is_too_long_is_refused():
    with pytest.raises(ValueError, match="duration must be 3600 s at most, not 3601"):
        Simulator(duration=3601.0)
