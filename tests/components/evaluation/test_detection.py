"""`warploom eval detection` on a KITTI folder made here, where every figure is known, and on real scans."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from warploom.cli import app
from warploom.components.evaluation.detection import evaluate_detection, lines_of, write_summary
from warploom.components.evaluation.detection_figures import figures_of
from warploom.components.evaluation.detection_frames import EvaluationFrame, evaluation_frames
from warploom.components.evaluation.detection_outcomes import judge
from warploom.components.evaluation.detection_report import write_report
from warploom.components.evaluation.detection_reviews import Review
from warploom.components.evaluation.kitti_objects import label_files, read_results, unpack_scan
from warploom.errors import ConfigError, SourceError
from warploom.models.classes import VEHICLE
from warploom.models.detections import Detections

P = "721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003"
CALIBRATION = (
    "".join(f"P{k}: {P}\n" for k in range(4))
    + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)
# type, x z in the camera's frame (right, forward); the bottom 1.65 m below it
CARS = (("Car", 2.0, 12.0), ("Car", -3.0, 20.0), ("Van", 4.0, 30.0), ("Car", 30.0, 15.0))


def row(kind, x, z, image="600 150 700 250", tail=""):
    return f"{kind} 0.00 0 0.00 {image} 1.50 1.60 4.00 {x:.2f} 1.65 {z:.2f} 0.00{tail}"


@pytest.fixture
def kitti(tmp_path):
    """One scan: 30 points on each car, the last of which the camera does not see; and a folder of results."""
    root = tmp_path / "set"
    for name in ("velodyne", "label_2", "calib", "results"):
        (root / name).mkdir(parents=True)
    points = [(z + 0.27 + 0.02 * k, -x, -1.0, 0.5) for _, x, z in CARS for k in range(30)]
    np.array(points, np.float32).tofile(root / "velodyne" / "000001.bin")
    rows = [row(*car) for car in CARS] + [
        "DontCare -1 -1 -10 50.00 100.00 400.00 300.00 -1 -1 -1 -1000 -1000 -1000 -10"
    ]
    (root / "label_2" / "000001.txt").write_text("\n".join(rows) + "\n")
    (root / "calib" / "000001.txt").write_text(CALIBRATION)
    found = [
        row("Car", 2.3, 12.0, tail=" 0.9"), row("Car", -2.3, 20.0, tail=" 0.8"), row("Car", 4.0, 31.0, tail=" 0.7"),
        row("Car", -1.0, 40.0, tail=" 0.6"), row("Car", -6.0, 11.0, tail=" 0.55"), row("Car", 0.0, 50.0, tail=" 0.2"),
    ]  # fmt: skip
    (root / "results" / "000001.txt").write_text("\n".join(found) + "\n")
    return root


def test_the_figures_are_those_worked_out_by_hand(kitti):
    result = evaluate_detection([f"kitti:{kitti}"], kitti / "results", score=0.5, also=[0.1])
    figures = result.sets["kitti"]
    at = figures["at"]["0.5"]
    assert at["tasks"]["cars within 1 m"] == {"objects": 3, "found": 2}
    assert at["tasks"]["cars within 0.5 m"] == {"objects": 3, "found": 1}
    assert at["tasks"]["vans within 1.5 m"] == {"objects": 1, "found": 1}
    # The one 40 m ahead is false; the one in the DontCare area is not counted with it.
    assert at["false_vehicles_per_frame"] == 1.0
    assert at["and_in_dont_care_areas"] == 1.0
    assert figures["at"]["0.1"]["false_vehicles_per_frame"] == 2.0
    assert at["yaw_error_degrees"]["median"] == pytest.approx(0.0, abs=0.01)
    assert figures["recall"]["vehicle"]["by_range"][1] == {"low": 10.0, "high": 20.0, "objects": 1, "found": 1}
    assert figures["kitti_ap_r40"]["Car"]["3d"]["easy"]["objects"] == 3
    assert [each.frame for each in result.false] == ["set/000001"]
    assert result.false[0].score == pytest.approx(0.6)


def test_a_reviewed_vehicle_is_not_false(kitti, tmp_path):
    review = tmp_path / "reviewed.yaml"
    review.write_text("- {frame: set/000001, at: [40.5, 1.0], note: parked behind the hedge}\n")
    result = evaluate_detection([f"kitti:{kitti}"], kitti / "results", score=0.5, review=Review.read(review))
    at = result.sets["kitti"]["at"]["0.5"]
    assert (at["false_vehicles_per_frame"], at["reviewed_as_real"]) == (0.0, 1)
    for text in ("- {frame: x}", "frame: x", "- [", "- {frame: x, at: [1]}"):
        review.write_text(text)
        with pytest.raises(ConfigError, match=r"reviewed\.yaml"):
            Review.read(review)


def test_summary_and_report_hold_what_was_found(kitti, tmp_path):
    result = evaluate_detection([f"kitti:{kitti}"], kitti / "results", score=0.5)
    write_summary(result, tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["sets"]["kitti"]["frames"] == 1
    assert summary["false_vehicles"][0]["frame"] == "set/000001"
    page = write_report(result, tmp_path / "out").read_text()
    assert "cars within 1 m" in page
    assert "{frame: set/000001, at: [40.3, 1.0]}" in page
    assert sorted(path.name for path in (tmp_path / "out" / "pictures").iterdir()) == ["false_001.png", "scan_001.png"]


def test_the_command_scores_result_files(kitti, tmp_path):
    run = CliRunner().invoke(
        app,
        ["eval", "detection", "--data", f"kitti:{kitti}", "--detections", str(kitti / "results"), "--score", "0.5",
         "--out", str(tmp_path / "out")],
    )  # fmt: skip
    assert run.exit_code == 0, run.output
    assert "cars within 1 m                    2/3" in run.output
    assert (tmp_path / "out" / "report.html").is_file()


def test_what_there_is_nothing_of_is_no_share_of_it(kitti, tmp_path):
    """No pedestrians among the labels, and a range image without cars: neither 0/0 nor nan."""
    np.savez(tmp_path / "0.npz", xyz=np.ones((2, 3, 3), np.float32), depth=np.ones((2, 3)), label=np.full((2, 3), 15))
    result = evaluate_detection([f"kitti:{kitti}"], kitti / "results", score=0.5)
    assert f"    {'pedestrians within 0.5 m':<34} none there" in lines_of(result)
    frame = next(evaluation_frames(f"range:{tmp_path}"))
    figures = figures_of("range", [judge(frame, Detections.empty(), 0.0, 0.5, None)], 0.5, (), None)
    assert figures["at"]["0.5"]["car_points_in_boxes"] is None
    result = replace(result, sets={"range": figures})
    assert f"    {'car points in boxes':<34} none there" in lines_of(result)
    write_summary(result, tmp_path)
    assert "NaN" not in (tmp_path / "summary.json").read_text()


def test_scans_of_several_sensors_are_scored_apart():
    card = SimpleNamespace(name="blind", sha256="", score_threshold=0.5)
    head = SimpleNamespace(card=card, provider="cpu", fallback="", overflow=0, warm_up=lambda: None,
                           detect_points=lambda *_: Detections.empty())  # fmt: skip
    few, many = (f"sim:scenes?seeds={seeds}" for seeds in ("500", "501-502"))
    result = evaluate_detection([f"{few}&lidar=vlp16", f"{many}&lidar=hdl32", f"{few}&lidar=hdl32"], head)
    assert {name: each["frames"] for name, each in result.sets.items()} == {"sim vlp16": 1, "sim hdl32": 3}
    assert list(evaluate_detection([f"{few}&lidar=vlp16"], head).sets) == ["sim"], "one alone needs no name"


def test_damaged_data_are_named(kitti):
    labels = kitti / "label_2" / "000001.txt"
    whole = labels.read_text()
    for text, message in (
        ("Car 1 2\n", "line 1: not a KITTI label"),
        (whole.replace("2.00 1.65", "x 1.65"), r"line \d: not a KITTI label"),
        (whole.replace("2.00 1.65", "nan 1.65"), r"line \d: not a KITTI label"),
        (whole.replace("Car", "car"), r"line \d: not a KITTI label.*with a type of Car, Van"),
    ):
        labels.write_text(text)
        with pytest.raises(SourceError, match=message):
            list(evaluation_frames(f"kitti:{kitti}"))
    (kitti / "packed.npz").write_bytes(b"PK")
    with pytest.raises(SourceError, match="not a packed scan"):
        unpack_scan(kitti / "packed.npz")
    labels.write_text(whole)
    with pytest.raises(SourceError, match="cannot read the labels"):
        read_results(kitti / "none.txt", label_files(kitti)[0][1]().calibration)


def test_what_has_no_counterpart_is_told(kitti, caplog):
    (kitti / "velodyne" / "scan_2.bin").write_bytes((kitti / "velodyne" / "000001.bin").read_bytes())
    for name in ("000002.txt", "000003.txt"):
        (kitti / "label_2" / name).write_text("")
    assert [frame.name for frame in evaluation_frames(f"kitti:{kitti}")] == ["set/000001"]
    assert "1 scans without labels are left out, such as scan_2" in caplog.text
    assert "2 labels without a scan are left out, such as 000002" in caplog.text


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("kitti", "expected one of kitti:"),
        ("lyft:x", "expected one of kitti:"),
        ("kitti:", "nothing after kitti:"),
        ("kitti:/nowhere?speed=3", "unknown key 'speed'"),
        ("kitti:.?every=0", "every is '0'; expected a whole number from 1 on"),
        ("kitti:.?height=inf", "height is 'inf'; expected a number"),
        ("kitti:/nowhere", "/nowhere is not there; expected a folder with velodyne/ and label_2/ or label_02/"),
        ("kitti:some.txt", "some.txt is no folder; expected"),
        ("kitti:.", "no KITTI set with labels: neither label_2/ beside velodyne/"),
        ("sim:scenes?seeds=9-3", "seeds is '9-3'; expected a seed, or the first and the last of several"),
        ("sim:scenes?seeds=x", "seeds is 'x'; expected a seed"),
        ("sim:scenes?seeds=1000000-1000001", "are trained on"),
        ("sim:scenes?seeds=1&lidar=hdl65", "lidar is 'hdl65'; expected one of vlp16, hdl32"),
        ("sim:mars", "scenario must be one of"),
        ("sim:street?seed=x", "seed is 'x'; expected a whole number"),
        ("sim:street?every=x", "every is 'x'; expected a whole number from 1 on"),
        ("sim:street?seeds=9-3", "holds no seed"),
        ("sim:street?seeds=9", "seeds is '9'; write it as"),
        ("nuscenes:/nowhere", "/nowhere is not there; expected a folder with key frames of nuScenes"),
        ("nuscenes:.", "info.json is not there"),
        ("range:/nowhere", "/nowhere is not there; expected a folder with range images"),
        ("range:.", "no range images"),
        ("range:/nowhere?labels=x", "labels must be one of"),
    ],
)
def test_what_makes_no_sense_is_said(uri, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "some.txt").write_text("")
    with pytest.raises(ConfigError, match=message) as refused:
        list(evaluation_frames(uri))
    assert " _" not in str(refused.value), "no name of our own code"


def test_a_set_without_scans_or_sequences_says_what_is_missing(kitti):
    (kitti / "label_2").rename(kitti / "label_02")
    (kitti / "label_02" / "0001.txt").write_text("")
    (kitti / "velodyne" / "0001").mkdir()
    (kitti / "velodyne" / "000001.bin").rename(kitti / "velodyne" / "0001" / "000000.bin")
    with pytest.raises(ConfigError, match=r"no labelled sequence 7; there are: 0001; add \?sequence=NAME"):
        list(evaluation_frames(f"kitti:{kitti}?sequence=7"))
    (kitti / "label_2").mkdir()
    with pytest.raises(ConfigError, match=r"no scan in velodyne/ \(\.bin\) has labels in label_2/"):
        list(evaluation_frames(f"kitti:{kitti}"))


@pytest.mark.parametrize(
    ("results", "message"),
    [
        ("nowhere", "nowhere is not there; expected one of KITTI's result files"),
        ("label_2/000001.txt", "000001.txt is no folder; expected one of KITTI's result files"),
        ("calib/..", "000001.txt: not there; each scan has a result file"),
        ("label_2", "000001.txt, line 1: not a KITTI label"),
    ],
)
def test_results_that_cannot_be_scored_end_as_bad_usage(kitti, warploom, results, message):
    said = warploom("eval", "detection", "--data", f"kitti:{kitti}", "--detections", kitti / results, "--score", 0.5,
                    expect=2)  # fmt: skip
    assert message in said


def test_data_that_are_not_there_end_as_bad_usage(kitti, warploom):
    for data in ("kitti:/nowhere", f"kitti:{kitti}/calib"):
        said = warploom(
            "eval", "detection", "--data", data, "--detections", kitti / "results", "--score", 0.5, expect=2
        )
        assert data[6:] in said


def test_simulated_scenes_come_with_their_truth():
    scenes = list(evaluation_frames("sim:scenes?seeds=500&lidar=vlp16"))
    assert [scene.name for scene in scenes] == ["scene 500"]
    assert all(len(scene.boxes) == len(scene.types) == len(scene.counts) > 0 for scene in scenes)
    assert all(1.0 < scene.sensor_height < 3.0 for scene in scenes)


def test_several_drives_are_one_after_the_other():
    frames = list(evaluation_frames("sim:street?seeds=500-501&lidar=vlp16&duration=0.4&every=2"))
    one = list(evaluation_frames("sim:street?seed=501&lidar=vlp16&duration=0.4&every=2"))
    names = [f"street {seed}, frame {index}" for seed in (500, 501) for index in (0, 2)]
    assert [frame.name for frame in frames] == names
    assert all(np.array_equal(a.points, b.points) for a, b in zip(frames[2:], one, strict=True))


@pytest.mark.real
def test_real_scans_have_as_many_objects_as_are_known(shared_data):
    """41 cars with 20 points within 40 m, and 36 vans, in the 29 scans that heads are judged on."""
    uris = (f"kitti:{shared_data}/kitti_object", f"kitti:{shared_data}/kitti_tracking?sequence=0000&every=5")
    frames = [frame for uri in uris for frame in evaluation_frames(uri)]
    assert len(frames) == 29
    counts = dict.fromkeys(("Car", "Van"), 0)
    for frame in frames:
        near = (frame.counts >= 20) & (np.hypot(*frame.boxes[:, :2].T) < 40)
        for kind in counts:
            counts[kind] += int((near & (np.array(frame.types, object) == kind)).sum())
    assert counts == {"Car": 41, "Van": 36}


@pytest.mark.real
def test_reference_detections_find_the_cars(shared_data):
    """OpenPCDet's PointPillars, trained on such frames: nine in ten near cars within 1 m."""
    folder = shared_data / "kitti_object" / "ref_openpcdet_pointpillars"
    frames = [
        f for f in evaluation_frames(f"kitti:{shared_data}/kitti_object") if (folder / f"{f.name[-6:]}.txt").exists()
    ]
    assert len(frames) == 4
    found = total = 0
    for frame in frames:
        boxes, scores, types = read_results(folder / f"{frame.name[-6:]}.txt", frame.kitti.calibration)
        near = (frame.counts >= 20) & (np.hypot(*frame.boxes[:, :2].T) < 40) & (frame.classes == VEHICLE)
        cars = frame.boxes[near & (np.array(frame.types, object) == "Car")]
        own = boxes[(np.array(types, object) == "Car") & (scores > 0.3)]
        found += sum(np.hypot(*(own[:, :2] - car[:2]).T).min() < 1.0 for car in cars)
        total += len(cars)
    assert total >= 6
    assert found >= 0.9 * total


@pytest.mark.real
def test_a_nuscenes_frame_is_turned_to_look_forward(shared_data):
    (frame,) = evaluation_frames(f"nuscenes:{shared_data}/nuscenes_sample")
    assert len(frame.boxes) == 69
    from warploom.models.geometry import points_in_boxes

    inside = points_in_boxes(frame.points, frame.boxes, margin=0.05).sum(axis=1)
    assert np.corrcoef(inside, frame.counts)[0, 1] > 0.95


def test_where_a_range_image_has_no_labels_nothing_is_false(tmp_path):
    """Three boxes of equal points: on a car, on what is labelled something else, and on what has no label."""
    xyz = np.full((1, 90, 3), 0.0, np.float32)
    xyz[0, :, 0] = np.repeat([10.0, 20.0, 55.0], 30) + np.tile(np.linspace(-1, 1, 30), 3)
    label = np.repeat([1, 15, 0], 30)[None]
    np.savez(tmp_path / "0.npz", xyz=xyz, depth=np.linalg.norm(xyz, axis=2), label=label)
    frame = next(evaluation_frames(f"range:{tmp_path}"))
    assert frame.point_labels.known.sum() == 60
    found = Detections(
        boxes=np.array([[x, 0, 0, 4, 2, 2, 0] for x in (10, 20, 55)], np.float32),
        scores=np.full(3, 0.9, np.float32),
        classes=np.zeros(3, np.int32),
        velocities=np.full((3, 2), np.nan, np.float32),
        background=np.zeros(3, bool),
    )
    outcome = judge(frame, found, 0.0, 0.5, None)
    assert outcome.false.tolist() == [1]
    assert outcome.in_dont_care.tolist() == [2]
    figures = figures_of("range", [outcome], 0.5, (), None)["at"]["0.5"]
    assert (figures["false_vehicles_per_frame"], figures["and_without_labels"]) == (1.0, 1.0)
    assert figures["car_points_in_boxes"] == 1.0


def test_what_is_found_beyond_the_range_is_neither_right_nor_wrong(tmp_path):
    """AP from above within 60 m: a box out there is left out, a wrong one within it is not."""
    boxes = np.array([[x, 0, 0, 4, 2, 2, 0] for x in (10.0, 70.0)], np.float64)
    frame = EvaluationFrame(
        name="one", kind="sim", sensor="hdl64", points=np.zeros((1, 3), np.float32), sensor_height=1.7, boxes=boxes,
        classes=np.zeros(2, np.int32), types=("object",) * 2, counts=np.full(2, 50), velocities=np.zeros((2, 2)),
    )  # fmt: skip

    def average(*places):
        found = Detections(
            boxes=np.array([[x, 0, 0, 4, 2, 2, 0] for x in places], np.float32),
            scores=np.linspace(0.9, 0.5, len(places), dtype=np.float32),
            classes=np.zeros(len(places), np.int32),
            velocities=np.full((len(places), 2), np.nan, np.float32),
            background=np.zeros(len(places), bool),
        )
        figures = figures_of("sim", [judge(frame, found, 0.0, 0.4, None)], 0.4, (), None)["bev_ap"]["vehicle"]
        return figures["ap"], figures["objects"]

    assert average(10.0) == (100.0, 1)
    assert average(73.0, 10.0) == (100.0, 1)
    assert average(30.0, 10.0) == (50.0, 1)


def test_what_is_hidden_for_the_most_part_is_told_apart_where_that_is_known():
    """One car of two is found, the other is behind something: half of all, all of what is half visible or more."""
    boxes = np.array([[x, 0, 0, 4, 2, 2, 0] for x in (10.0, 20.0)], np.float64)
    found = Detections(
        boxes=boxes[:1].astype(np.float32),
        scores=np.array([0.9], np.float32),
        classes=np.zeros(1, np.int32),
        velocities=np.full((1, 2), np.nan, np.float32),
        background=np.zeros(1, bool),
    )

    def average(visible):
        frame = EvaluationFrame(
            name="one", kind="sim", sensor="hdl64", points=np.zeros((1, 3), np.float32), sensor_height=1.7, boxes=boxes,
            classes=np.zeros(2, np.int32), types=("object",) * 2, counts=np.full(2, 50), velocities=np.zeros((2, 2)),
            visible=visible,
        )  # fmt: skip
        return figures_of("sim", [judge(frame, found, 0.0, 0.4, None)], 0.4, (), None)["bev_ap"]["vehicle"]

    assert "half_visible" not in average(None)
    figures = average(np.array([0.9, 0.2]))
    assert (figures["ap"], figures["objects"]) == (50.0, 2)
    assert (figures["half_visible"]["ap"], figures["half_visible"]["objects"]) == (100.0, 1)
