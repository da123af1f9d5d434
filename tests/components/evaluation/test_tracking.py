"""`warploom eval tracking`: a small set made here, and KITTI's sequences against AB3DMOT's figures."""

import json
import shutil

import numpy as np
import pytest

from warploom.components.evaluation.kitti_tracking import TYPES, TrackingSequence, detection_format
from warploom.components.evaluation.tracking import evaluate_tracking, lines_of, track_confidences
from warploom.components.perception.tracker_settings import TrackerSettings, load_tracker
from warploom.errors import ConfigError, SourceError
from warploom.models.tracker import TrackerConfig

CAR = next(kind for kind in TYPES if kind.name == "Car")
CALIBRATION = """P0: 700 0 600 0 0 700 180 0 0 0 1 0
P1: 700 0 600 0 0 700 180 0 0 0 1 0
P2: 700 0 600 0 0 700 180 0 0 0 1 0
P3: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0
"""
CHECKING = ("0001", "0012", "0013", "0014", "0016", "0019")


def label(frame, number, kind, z, x=2.0, hidden=0, cut=0):
    return f"{frame} {number} {kind} {cut} {hidden} 0 600 150 700 250 1.5 1.8 4.2 {x} 1.7 {z} -1.57"


def detection(frame, z, score, x=2.0):
    return f"{frame},2,600,150,700,250,{score},1.5,1.8,4.2,{x},1.7,{z},-1.57,0"


@pytest.fixture
def data(tmp_path):
    """One car that drives away before another, with a van and an area without labels beside them; 30 frames."""
    for folder in ("label_02", "calib", "found_Car"):
        (tmp_path / folder).mkdir()
    (tmp_path / "calib" / "0007.txt").write_text(CALIBRATION)
    labels, found = [], []
    for frame in range(30):
        labels += [
            label(frame, 1, "Car", 12 + 0.4 * frame),
            label(frame, 2, "Car", 20 + 0.4 * frame, x=-4.0),
            label(frame, 3, "Van", 25, x=6.0),
            f"{frame} -1 DontCare -1 -1 -10 1000 100 1200 250 -1 -1 -1 -1000 -1000 -1000 -10",
        ]
        found += [detection(frame, 12.1 + 0.4 * frame, 3.0), detection(frame, 25, 2.5, x=6.0)]
        if frame not in (11, 12):
            found.append(detection(frame, 20 + 0.4 * frame, 2.0, x=-4.0))
    (tmp_path / "label_02" / "0007.txt").write_text("\n".join(labels))
    (tmp_path / "found_Car" / "0007.txt").write_text("\n".join(found))
    return tmp_path


def test_reads_labels_detections_and_areas(data):
    kind, logits = detection_format(data / "found_Car", ["0007"])
    assert (kind, logits) == (CAR, True)
    sequence = TrackingSequence.read(data, data / "found_Car", "0007", kind, logits=logits)
    assert len(sequence.frames) == 30
    assert sequence.poses is None
    # Camera x right, y down, z forward: here x forward, y left, z up, and the centre in place of the bottom's.
    np.testing.assert_allclose(
        sequence.truth.boxes[0], [12, -2, 0.75 - 1.7, 4.2, 1.8, 1.5, 1.57 - np.pi / 2], atol=1e-12
    )
    assert sequence.truth.ignored.tolist()[:3] == [False, False, True]
    np.testing.assert_allclose(sequence.scores[0], 1 / (1 + np.exp([-3.0, -2.5, -2.0])))
    np.testing.assert_array_equal(sequence.dont_care[4], [[1000, 100, 1200, 250]])


def test_a_result_in_an_area_without_labels_or_too_low_is_ignorable(data):
    sequence = TrackingSequence.read(data, data / "found_Car", "0007", CAR)
    there, away, far = [14, -10, -1, 4.2, 1.8, 1.5, 0], [14, 2, -1, 4.2, 1.8, 1.5, 0], [80, 0, -1, 4.2, 1.8, 1.5, 0]
    assert sequence.ignorable(np.array([3, 3, 3]), np.array([there, away, far], float)).tolist() == [True, False, True]


def test_scores_both_cars_and_writes_files_that_give_the_same_boxes(data, tmp_path):
    out = tmp_path / "out"
    result = evaluate_tracking(data, data / "found_Car", out, config=load_tracker("pointrcnn"))
    average = result.averages[0.5]
    assert average.best.id_switches == 0
    assert average.best.false_positives == 0  # the van is ignored
    assert average.best.objects == 60
    # Births take two frames, which the first frame is spared; one frame of two without a detection is coasted.
    assert average.best.misses <= 2
    assert result.hota.association > 0.9
    rows = np.array(
        [[v for k, v in enumerate(line.split()) if k != 2] for line in (out / "0007.txt").read_text().splitlines()],
        float,
    )
    assert rows.shape[1] == 17
    assert len(np.unique(rows[:, 1])) == 3
    first = rows[rows[:, 0] == 0]
    np.testing.assert_allclose(sorted(first[:, 14]), [12.1, 20, 25], atol=1e-3)  # z of the camera
    np.testing.assert_allclose(first[:, 9:12], [[1.5, 1.8, 4.2]] * 3, atol=1e-3)
    summary = json.loads((out / "summary.json").read_text())
    assert summary["overlaps"]["0.5"]["sAMOTA"] == pytest.approx(100 * average.samota)
    assert (out / "recall.png").stat().st_size > 1000
    assert any("HOTA" in line for line in lines_of(result))


def test_the_score_of_a_track_is_the_mean_of_its_rows_to_the_bit():
    random = np.random.default_rng(5)
    ids = random.integers(0, 40, 2000)
    scores = np.where(random.random(2000) < 0.2, np.nan, random.random(2000))
    confidence = track_confidences(ids, scores)
    for number in range(40):
        own = confidence[ids == number]
        assert (own == own[0]).all()
        assert sum(own.tolist()) / len(own) == own[0]
    few, many = track_confidences(np.array([1, 2, 2, 2]), np.array([0.9, 0.9, 0.9, 0.9]))[:2]
    assert few < many


def damage_label(folder, line):
    """Puts a line in the place of the fifth."""
    path = folder / "label_02" / "0007.txt"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:4], line, *lines[5:]]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: shutil.rmtree(d / "found_Car"), r"found_Car: no such folder, nor in .*, which has: calib, label_02"),
        (lambda d: (d / "label_02" / "0007.txt").unlink(), "no sequence that .*label_02 has labels of"),
        (lambda d: (d / "found_Car" / "0007.txt").write_text("0,9" + 13 * ",1"), r"types \[9\] in the second column"),
        (lambda d: (d / "found_Car" / "0007.txt").write_text("\n0,2,x"), "line 2: could not convert string to .*'x'"),
        (lambda d: (d / "found_Car" / "0007.txt").write_text("0,2,1"), "line 1: expected 15 numbers, found '0,2,1'"),
        (lambda d: (d / "found_Car" / "0007.txt").write_text("0,nan" + 13 * ",1"), "line 1: expected 15 numbers"),
        (lambda d: (d / "found_Car" / "0007.txt").write_text("\n"), "no detection in 0007.txt"),
        (lambda d: (d / "found_Car" / "0007.txt").write_bytes(b"\xff"), "found_Car.0007.txt: not a text"),
        (lambda d: damage_label(d, "0 1 Car"), "line 5: not a KITTI label: '0 1 Car'; expected frame track type"),
        (lambda d: damage_label(d, "1 2 3"), "line 5: not a KITTI label"),
        (lambda d: damage_label(d, label(1, 1, "Car", "far")), "line 5: not a KITTI label"),
        (lambda d: damage_label(d, label(1, 1, "Car", "inf")), "line 5: not a KITTI label"),
        (lambda d: damage_label(d, label(1, 1, "car", 12)), "line 5: not a KITTI label.* with a type of Car, Van"),
        (lambda d: (d / "label_02" / "0007.txt").write_text(label(0, 3, "Van", 25)), "no Car that counts .* in 0007$"),
        (lambda d: (d / "calib" / "0007.txt").unlink(), "0007.txt: cannot read the .*: No such file or directory$"),
    ],
)  # fmt: skip
def test_what_is_missing_or_damaged_is_said(data, change, message):
    change(data)
    with pytest.raises(SourceError, match=message):
        evaluate_tracking(data, data / "found_Car", data / "out")


@pytest.mark.parametrize(("records", "first"), [(30, 0), (40, 0), (19, 11)])
def test_records_of_poses_that_begin_after_the_labels_are_refused(data, records, first):
    """Frames without a record would else be left out, and the score be of the others alone."""
    (data / "oxts").mkdir()
    (data / "oxts" / "0007.txt").write_text(f"49.0 8.4 100 {' 0' * 27}\n" * records)
    if first:
        with pytest.raises(SourceError, match=f"19 records, which are of the frames {first} to 29 .* begin at frame 0"):
            TrackingSequence.read(data, data / "found_Car", "0007", CAR)
    else:
        assert len(TrackingSequence.read(data, data / "found_Car", "0007", CAR).frames) == records


def test_a_damaged_record_of_poses_is_named_by_its_line(data):
    (data / "oxts").mkdir()
    (data / "oxts" / "0007.txt").write_text(f"49.0 8.4 100 {' 0' * 27}\n" * 29 + "1 2 3\n")
    with pytest.raises(SourceError, match=r"oxts.0007.txt, line 30: expected 30 numbers, found '1 2 3'"):
        TrackingSequence.read(data, data / "found_Car", "0007", CAR)


def test_a_sequence_that_is_not_there_is_named(data):
    with pytest.raises(SourceError, match="no sequence 0099 with labels and detections; there are: 0007"):
        evaluate_tracking(data, data / "found_Car", data / "out", sequences=["0099"])


def test_settings_of_the_tracker_by_class_and_for_all():
    settings = TrackerSettings(vehicle={"coast": 2.0}, size_weight=3.0)
    config = settings.tracker_config()
    usual = TrackerConfig()
    assert (config.of(0).coast, config.of(1).coast, config.size_weight) == (2.0, usual.of(1).coast, 3.0)
    assert TrackerSettings().tracker_config() == usual
    assert load_tracker("pointrcnn", ["pedestrian.coast=0.9"]).of(1).coast == 0.9


def test_a_setting_that_does_not_exist_is_refused_by_name():
    with pytest.raises(ConfigError, match="coast"):
        load_tracker("pointrcnn", ["vehicle.coasst=2.0"])
    with pytest.raises(ConfigError, match="pointrcnn"):
        load_tracker("pointrcn")


@pytest.mark.real
@pytest.mark.parametrize(
    ("kind", "goals", "most_switches"),
    [
        # sAMOTA of AB3DMOT's program, run on the same detections of these sequences, at 3D overlaps 0.25, 0.5 (0.7).
        ("Car", {0.25: 95.67, 0.5: 95.06, 0.7: 81.57}, 5),
        ("Pedestrian", {0.25: 84.32, 0.5: 78.93}, 5),
        ("Cyclist", {0.25: 92.27, 0.5: 91.83}, 5),
    ],
)
def test_kitti_is_tracked_better_than_by_ab3dmot(shared_data, tmp_path, kind, goals, most_switches):
    """On those of its validation sequences that are here, by which nothing was chosen."""
    folder = shared_data / "kitti_tracking"
    if not folder.is_dir():
        pytest.skip("KITTI's tracking sequences (../shared/data/kitti_tracking) are not here")
    detections = folder / f"pointrcnn_{kind}"
    names = [name for name in CHECKING if (detections / f"{name}.txt").exists()]
    result = evaluate_tracking(folder, detections, tmp_path, sequences=names, config=load_tracker("pointrcnn"))
    for overlap, goal in goals.items():
        assert 100 * result.averages[overlap].samota > goal
        assert result.averages[overlap].best.id_switches <= most_switches
