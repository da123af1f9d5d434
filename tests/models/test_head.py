"""The shipped head: on scenes of unseen seeds, and on real scans, which it never saw; and its interface."""

import numpy as np
import pytest
import warp as wp

from warploom.errors import ModelError
from warploom.models.card import DEFAULT_CARD, load_card, save_card
from warploom.models.classes import CLASSES, VEHICLE
from warploom.models.geometry import KittiCalibration, points_in_boxes
from warploom.models.head import DetectionHead


@pytest.fixture(scope="module")
def head():
    return DetectionHead(threads=2, score_threshold=0.3)


@pytest.fixture(scope="module")
def scenes():
    """Random scenes from seeds that training does not use, with an HDL-64E, as (points, sensor height, frame)."""
    from warploom.models.simulator import sample_scene
    from warploom.models.training.frames import height_over_ground

    frames = [sample_scene(seed, lidar="hdl64") for seed in (101, 102, 103)]
    return [(f.points, height_over_ground(f.points, f.ground), f) for f in frames]


def found_within(truth, found, distance):
    if len(truth) == 0 or len(found) == 0:
        return np.zeros(len(truth), bool)
    return np.linalg.norm(truth[:, None, :2] - found[None, :, :2], axis=2).min(axis=1) < distance


def test_it_finds_vehicles_in_scenes_it_has_not_seen(head, scenes):
    """At least 80 % of those with 30 returns within 40 m, within 1 m."""
    hits = total = 0
    for points, height, frame in scenes:
        seen = (frame.classes == VEHICLE) & (frame.counts >= 30) & (np.hypot(*frame.boxes[:, :2].T) < 40)
        found = head.detect_points(points, height)
        hits += found_within(frame.boxes[seen], found.boxes[found.classes == VEHICLE], 1.0).sum()
        total += seen.sum()
    assert total >= 10
    assert hits >= 0.8 * total


@pytest.mark.real
def test_it_finds_cars_in_real_scans(head, shared_data):
    """At least three in four of the labelled cars with 20 returns within 40 m, in KITTI's object scans."""
    folder = shared_data / "kitti_object"
    hits = total = 0
    for path in sorted((folder / "velodyne").glob("*.bin")):
        points = np.fromfile(path, np.float32).reshape(-1, 4)
        calibration = KittiCalibration.read(folder / "calib" / f"{path.stem}.txt")
        rows = [line.split() for line in (folder / "label_2" / f"{path.stem}.txt").read_text().splitlines()]
        cars = [[float(value) for value in row[8:15]] for row in rows if row[0] == "Car"]
        if not cars:
            continue
        boxes = calibration.boxes_from_camera(np.array(cars))
        seen = (points_in_boxes(points, boxes).sum(axis=1) >= 20) & (np.hypot(boxes[:, 0], boxes[:, 1]) < 40)
        found = head.detect_points(points, 1.73)
        hits += found_within(boxes[seen], found.boxes[found.classes == VEHICLE], 1.0).sum()
        total += seen.sum()
    assert total >= 15
    assert hits >= 0.75 * total


def test_what_it_says_is_whole(head, scenes):
    points, height, _ = scenes[0]
    found = head.detect_points(points, height)
    assert len(found) > 0
    assert found.boxes.shape == (len(found), 7)
    assert found.boxes.dtype == found.scores.dtype == found.velocities.dtype == np.float32
    assert found.classes.dtype == np.int32
    assert np.isfinite(found.boxes).all()
    assert (np.diff(found.scores) <= 0).all()
    assert found.scores.min() >= 0.3
    assert found.scores.max() <= 1.0
    assert set(found.classes.tolist()) <= set(range(CLASSES.index("unknown")))
    assert np.isnan(found.velocities).all()
    assert not found.background.any()


def test_the_same_scan_gives_the_same_bytes(head, scenes):
    points, height, _ = scenes[1]
    first = head.detect_points(points, height)
    head.detect_points(scenes[0][0], scenes[0][1])
    again = head.detect_points(points, height)
    other = DetectionHead(threads=2, score_threshold=0.3).detect_points(points, height)
    for found in (again, other):
        assert found.boxes.tobytes() == first.boxes.tobytes()
        assert found.scores.tobytes() == first.scores.tobytes()


def test_both_faces_agree(head, scenes):
    points, height, _ = scenes[0]
    xyz = wp.array(np.ascontiguousarray(points[:, :3]), dtype=wp.vec3, device="cpu")
    count = wp.array([len(points)], dtype=wp.int32, device="cpu")
    on_device = head.detect(xyz, count, sensor_height=wp.array([height], dtype=wp.float32, device="cpu"))
    assert on_device.boxes.tobytes() == head.detect_points(points, height).boxes.tobytes()


@pytest.mark.parametrize("points", [np.zeros((0, 4)), np.zeros((1, 4)), np.full((9, 3), np.nan), np.full((9, 3), 1e9)])
def test_little_or_no_cloud_gives_no_objects(head, points):
    assert len(head.detect_points(points.astype(np.float32), 1.7)) == 0


def test_a_box_that_holds_the_sensor_is_left_out():
    from warploom.models.head import _holds_the_sensor

    boxes = np.array([[1, 0.5, -1, 4, 2, 1.5, 0.1], [0, 2.5, -1, 4, 2, 1.5, 0], [0, 2.5, -1, 8, 2, 1.5, np.pi / 2]])
    assert _holds_the_sensor(boxes).tolist() == [True, False, True]
    assert _holds_the_sensor(np.empty((0, 7))).tolist() == []


def test_refined_vehicles_head_as_the_true_ones_and_nothing_else_changes(scenes, tmp_path):
    """Of the first stage alone: the median error of those with 50 returns within 40 m falls to less than two thirds."""
    from warploom.models.card import default_card, load_card, save_card

    card, model = load_card(default_card("cpu"))
    assert card.decode.refine == ("vehicle",)
    (tmp_path / model.name).write_bytes(model.read_bytes())
    for name, refine in (("refined", ("vehicle",)), ("plain", ())):
        decode = card.decode.model_copy(update={"refine": refine})
        save_card(tmp_path / f"{name}.yaml", card.model_copy(update={"decode": decode, "second": None}))
    plain, refined = (
        DetectionHead(tmp_path / f"{name}.yaml", threads=2, score_threshold=0.3) for name in ("plain", "refined")
    )
    errors = []
    for points, height, frame in scenes:
        pair = [each.detect_points(points, height) for each in (plain, refined)]
        assert pair[0].scores.tobytes() == pair[1].scores.tobytes()
        others = pair[0].classes != VEHICLE
        np.testing.assert_array_equal(pair[0].boxes[others], pair[1].boxes[others])
        np.testing.assert_array_equal(pair[0].boxes[:, 2:6], pair[1].boxes[:, 2:6])
        for box in frame.boxes[(frame.classes == VEHICLE) & (frame.counts >= 50)]:
            away = np.hypot(*(pair[0].boxes[~others, :2] - box[:2]).T)
            if np.hypot(*box[:2]) < 40 and away.min() < 1.0:
                yaws = [found.boxes[~others][away.argmin(), 6] for found in pair]
                errors.append([abs((yaw - box[6] + np.pi / 2) % np.pi - np.pi / 2) for yaw in yaws])
    assert len(errors) >= 10
    before, after = np.median(errors, axis=0)
    assert after < before / 1.5


def test_a_higher_threshold_gives_fewer(head, scenes):
    points, height, _ = scenes[0]
    strict = DetectionHead(threads=2, score_threshold=0.6).detect_points(points, height)
    assert len(strict) < len(head.detect_points(points, height))
    assert strict.scores.min() >= 0.6


def test_wrong_arguments_are_refused(head):
    with pytest.raises(ValueError, match="score_threshold must be in"):
        DetectionHead(score_threshold=1.5)
    with pytest.raises(ValueError, match="threads must be"):
        DetectionHead(threads=0)
    with pytest.raises(ModelError, match="cannot read the head's card"):
        DetectionHead("no_such_card.yaml")
    with pytest.raises(ValueError, match="points must have shape"):
        head.detect_points(np.zeros((3, 2), np.float32), 1.7)


def test_clouds_of_a_batch_are_found_as_each_by_itself(scenes):
    """The same network in one run; 1e-3 m and 1e-4 of the score are for the order of its sums."""
    one = DetectionHead(threads=2, score_threshold=0.3)
    three = DetectionHead(threads=2, score_threshold=0.3, batch=3)
    together = three.detect_batch([points for points, _, _ in scenes], [height for _, height, _ in scenes])
    for found, (points, height, _) in zip(together, scenes, strict=True):
        alone = one.detect_points(points, height)
        assert len(found) == len(alone) > 0
        assert found.classes.tolist() == alone.classes.tolist()
        np.testing.assert_allclose(found.scores, alone.scores, atol=1e-4)
        np.testing.assert_allclose(found.boxes[:, :6], alone.boxes[:, :6], atol=1e-3)


def test_a_batch_may_be_smaller_than_there_is_room_for(scenes):
    head = DetectionHead(threads=2, score_threshold=0.3, batch=2)
    points, height, _ = scenes[2]
    assert len(head.detect_batch([points], [height])) == 1
    with pytest.raises(ValueError, match="clouds must be 1 to 2"):
        head.detect_batch([points] * 3, [height] * 3)
    with pytest.raises(ValueError, match="clouds must be 1 to 2"):
        head.detect_batch([points], [])
    with pytest.raises(ValueError, match="batch must be 1 to 127"):
        DetectionHead(batch=0)


def test_the_head_reads_its_grid_where_it_was_drawn(head, scenes):
    """No copy of the input: the array bound to the network is the plan's own, and DLPack shows the same memory."""
    points, height, _ = scenes[0]
    head.detect_points(points, height)
    grid = head._slots[0].pillars.grid
    assert head._grids.ptr == grid.ptr
    assert np.from_dlpack(grid).ctypes.data == grid.ptr


@pytest.mark.parametrize(("height", "error"), [(np.nan, ValueError), (-np.inf, ValueError), (None, TypeError),
                                               ("1.7", TypeError)])  # fmt: skip
def test_a_height_that_is_none_is_refused_by_name(head, scenes, height, error):
    points = scenes[0][0]
    with pytest.raises(error, match=r"sensor_height must be a .*number"):
        head.detect_points(points, height)
    xyz = wp.array(np.ascontiguousarray(points[:, :3]), dtype=wp.vec3, device="cpu")
    with pytest.raises(error, match=r"sensor_height must be a .*number"):
        head.detect(xyz, wp.array([len(points)], dtype=wp.int32, device="cpu"), sensor_height=height)


def test_a_limit_of_the_card_that_was_too_low_is_named(scenes, tmp_path, caplog):
    card, model = load_card(DEFAULT_CARD)
    for file in (card.file, card.second.file):
        (tmp_path / file).write_bytes((model.parent / file).read_bytes())
    many = DetectionHead(DEFAULT_CARD, candidates_only=True)
    found = len(many.detect_points(scenes[0][0], 1.8))
    decode = card.decode.model_copy(update={"max_objects": 3})
    save_card(tmp_path / "few.yaml", card.model_copy(update={"decode": decode}))
    few = DetectionHead(tmp_path / "few.yaml", candidates_only=True)
    few.detect_points(scenes[0][0], 1.8)
    assert f"pillar_center: beyond the card's limits: dropped {found - 3} of {found}, for decode.max_objects is 3" in (
        caplog.text
    )
    assert few.overflow == found - 3 > 0


def test_a_missing_provider_is_said_or_refused(caplog):
    head = DetectionHead(providers=("tensorrt", "cuda", "cpu"))
    assert head.provider == "cpu"
    assert head.fallback == "no provider tensorrt, cuda here: the network runs on cpu"
    assert head.fallback in caplog.text
    assert DetectionHead().fallback == ""
    with pytest.raises(ModelError, match="none of the providers cuda is there for device cpu"):
        DetectionHead(providers=("cuda",))


def test_a_precision_that_there_is_not_is_refused():
    with pytest.raises(ValueError, match="precision must be one of fp32, tf32, fp16, not 'int4'"):
        DetectionHead(precision="int4")
