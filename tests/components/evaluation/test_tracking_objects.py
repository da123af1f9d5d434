"""Scores of a drive whose truth is known, on frames made by hand; and the tracker on them."""

import json

import numpy as np
import pytest

from warploom.components.evaluation import tracking_objects
from warploom.components.evaluation.tracking_objects import drive_uris, lines_of_drives, score_drives
from warploom.components.messages import Obstacles, SensorFrame, Truth
from warploom.errors import ConfigError, SourceError
from warploom.models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.geometry import invert, rigid, transform_boxes
from warploom.models.tracker import Tracker

NS = 100_000_000
SIZES = {VEHICLE: (4.4, 1.9, 1.6), PEDESTRIAN: (0.7, 0.7, 1.7), CYCLIST: (1.7, 0.6, 1.7)}


def truth_of(boxes, classes, ids, velocities, points):
    return Truth(
        boxes=np.asarray(boxes, np.float32), classes=np.asarray(classes, np.int32), ids=np.asarray(ids, np.int64),
        velocities=np.asarray(velocities, np.float32), points=np.asarray(points, np.int32),
    )  # fmt: skip


def frame(index, truth, pose=None):
    points = np.empty((0, 4), np.float32)
    return SensorFrame(
        version=index * NS, index=index, points=points, pose=np.eye(4) if pose is None else pose, truth=truth
    )


def objects(sensor, boxes, ids, velocities, classes=None):
    n = len(ids)
    return Obstacles(
        version=sensor.version, frame=sensor.index, frame_id="lidar", velocity_reference="world",
        ids=np.asarray(ids, np.int64), classes=np.asarray([VEHICLE] * n if classes is None else classes, np.int32),
        scores=np.full(n, 0.9, np.float32), boxes=np.asarray(boxes, np.float32).reshape(-1, 7),
        velocities=np.asarray(velocities, np.float32).reshape(-1, 2), background=np.zeros(n, bool),
    )  # fmt: skip


def drive(ids_after, error=0.3):
    """A car that is hidden for a second, and then is found under another id or not."""
    for k in range(40):
        hidden = 15 <= k < 25
        box = [[10 + k, 2, 0, 4.4, 1.9, 1.6, 0]]
        sensor = frame(k, truth_of(box, [VEHICLE], [7], [[10, 0]], [0 if hidden else 50]))
        if hidden:
            yield sensor, objects(sensor, [], [], [])
        else:
            yield sensor, objects(sensor, box, [1 if k < 15 else ids_after], [[10 + error, 0]])


def test_an_id_that_is_kept_and_one_that_is_not():
    kept, lost = score_drives("kept", [drive(1)]), score_drives("lost", [drive(2)])
    assert (kept.occlusions, kept.kept) == (1, 1)
    assert (lost.occlusions, lost.kept) == (1, 0)
    assert kept.summary.recall == kept.summary.precision == 1.0
    assert kept.hota.hota > lost.hota.hota


def test_velocities_count_once_a_track_is_a_second_old():
    result = score_drives("drive", [drive(1)])
    assert result.settled_velocity_error == pytest.approx(0.3, abs=1e-5)
    assert result.settled == 5 + 15  # 10 to 14, and all after
    assert "0.30 m/s" in "\n".join(lines_of_drives(result))


def test_an_object_that_is_seen_and_not_found_is_not_occluded():
    def missed():
        for k in range(40):
            box = [[10 + k, 2, 0, 4.4, 1.9, 1.6, 0]]
            sensor = frame(k, truth_of(box, [VEHICLE], [7], [[10, 0]], [50]))
            found = not 15 <= k < 25
            yield sensor, objects(sensor, box if found else [], [1] if found else [], [[10, 0]] if found else [])

    result = score_drives("missed", [missed()])
    assert result.occlusions == 0
    assert result.summary.recall == 0.75


def test_several_drives_are_one_score_and_their_ids_are_their_own():
    both = score_drives("both", [drive(1), drive(2)])
    assert (both.drives, both.occlusions, both.kept) == (2, 2, 1)
    assert both.settled == 20 + 10  # of the second drive: 10 to 14, and 35 to 39
    assert both.summary.objects == 60
    assert "50 %" in "\n".join(lines_of_drives(both))


@pytest.mark.parametrize(
    ("first_visible", "again", "cases", "kept"),
    [(15, 25, 1, 1), (15, 27, 1, 1), (15, 36, 1, 0), (12, 19, 1, 1), (15, 19, 0, 0), (15, 39, 0, 0)],
    ids=["found at once", "found a little later", "not found again", "0.8 s", "too short", "not seen for long enough"],
)
def test_what_counts_as_an_occlusion(first_visible, again, cases, kept):
    """Hidden from a frame to 25 (or 19, or the 38th) by the truth; found again from a frame on."""
    back = {19: 19, 39: 38}.get(again, 25)

    def life():
        for k in range(40):
            hidden = first_visible <= k < back
            box = [[10 + k, 2, 0, 4.4, 1.9, 1.6, 0]]
            sensor = frame(k, truth_of(box, [VEHICLE], [7], [[10, 0]], [0 if hidden else 50]))
            found = not hidden and (k < first_visible or k >= again)
            yield sensor, objects(sensor, box if found else [], [1] if found else [], [[10, 0]] if found else [])

    result = score_drives("life", [life()])
    assert (result.occlusions, result.kept) == (cases, kept)


def test_seeds_stand_for_several_drives():
    assert drive_uris("sim:street?seed=3") == ["sim:street?seed=3"]
    assert drive_uris("sim:street?seeds=3-5&duration=2") == [f"sim:street?seed={k}&duration=2" for k in (3, 4, 5)]
    with pytest.raises(ConfigError, match="holds no seed"):
        drive_uris("sim:street?seeds=5-3")


def test_frames_without_truth_are_refused():
    sensor = frame(0, None)
    with pytest.raises(SourceError, match="without truth"):
        score_drives("drive", [[(sensor, objects(sensor, [], [], []))]])


def tracked(seed, classes, speeds):
    """What the tracker makes of noisy boxes of objects that pass behind something for a second, seen on the move."""
    rng, tracker, n = np.random.default_rng(seed), Tracker(), len(classes)
    start = np.c_[rng.uniform(-15, 15, n), np.linspace(-35, 35, n)]
    heading = rng.uniform(-np.pi, np.pi, n)
    velocity = np.asarray(speeds)[:, None] * np.c_[np.cos(heading), np.sin(heading)]
    begin = rng.integers(22, 30, n)
    for k in range(60):
        pose = rigid((0.8 * k, 0, 0), yaw=0.01 * k)
        world = np.c_[start + 0.1 * k * velocity, np.zeros(n), [SIZES[c] for c in classes], heading]
        boxes, hidden = transform_boxes(world, invert(pose)), (k >= begin) & (k < begin + 10)
        sensor = frame(
            k, truth_of(boxes, classes, np.arange(n), velocity @ pose[:2, :2], np.where(hidden, 0, 40)), pose
        )
        seen = ~hidden & (rng.random(n) < 0.97)
        noise = rng.normal(0, 1, (n, 7)) * [0.1, 0.1, 0.05, 0.2, 0.1, 0.1, 0.08]
        found = tracker.update(
            sensor.version + 1, (boxes + noise)[seen], rng.uniform(0.4, 0.95, seen.sum()), classes[seen], pose=pose
        )
        yield sensor, objects(sensor, found.boxes, found.ids, found.velocities, found.classes)


def test_velocities_and_ids_through_a_second_of_occlusion():
    """Noise as of a good head at middle distances; the goals of the tracker."""
    kept = occlusions = 0
    errors = []
    for seed in range(8):
        classes = np.resize([VEHICLE, PEDESTRIAN, CYCLIST, VEHICLE], 12)
        speeds = np.where(classes == VEHICLE, 9.0, np.where(classes == CYCLIST, 5.0, 1.3))
        result = score_drives("scene", [tracked(seed, classes, speeds)])
        kept, occlusions = kept + result.kept, occlusions + result.occlusions
        errors.append(result.settled_velocity_error)
    assert occlusions > 60
    assert kept >= 0.9 * occlusions
    assert np.median(errors) <= 0.5


def test_scans_give_poses_to_the_tracker_and_result_files(shared_data, tmp_path, monkeypatch):
    """A part of a sequence, of which 8 frames are tracked: each scan has the ego pose of its own GPS/IMU record."""
    data = shared_data / "kitti_tracking"
    whole, poses = tracking_objects._scans, []

    def first(sequence, folder):
        scans = list(whole(sequence, folder))
        poses.extend(scan.pose for scan in scans)
        yield from scans[:8]

    monkeypatch.setattr(tracking_objects, "_scans", first)
    results = tracking_objects.evaluate_scans(data, ["0000"], tmp_path)
    records = np.loadtxt(data / "oxts" / "0000.txt")
    assert len(poses) == len(records) == 98
    turned = [np.arctan2(pose[1, 0], pose[0, 0]) for pose in poses]
    # Headings say which record a pose is of, without a map projection; 1 mrad: roll and pitch tilt the axes a little.
    away = np.angle(np.exp(1j * (np.subtract(turned, turned[0]) - (records[:, 5] - records[0, 5]))))
    np.testing.assert_allclose(away, 0.0, atol=1e-3)
    assert np.ptp(np.unwrap(turned)) > 0.05
    steps = np.linalg.norm(np.diff([pose[:3, 3] for pose in poses[:8]], axis=0), axis=1)
    speed = np.hypot(records[:8, 8], records[:8, 9])  # forward and leftward [m/s]
    np.testing.assert_allclose(steps, 0.1 * speed[:7], atol=0.1)  # records are 0.1 s apart, give or take
    assert not any("pose missing" in reason for result in results for reason in result.dropped)
    assert {result.kind.name for result in results} <= {"Car", "Pedestrian", "Cyclist"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary) == {result.kind.name for result in results}
    rows = [line.split() for line in (tmp_path / "0000.txt").read_text().splitlines()]
    assert rows
    assert all(len(row) == 18 for row in rows)
    assert [int(row[0]) for row in rows] == sorted(int(row[0]) for row in rows)
    assert all((tmp_path / f"recall_{name}.png").is_file() for name in summary)


def test_true_detections_keep_ids_and_velocities(tmp_path):
    """The scripted rider behind a van, with a coarse sensor to be quick; the whole campaign is the command."""
    result = tracking_objects.evaluate_drives(
        "sim:occlusion?seed=1&duration=6.5&lidar=vlp16&sensors=lidar", tmp_path, true_detections=True
    )
    assert result.occlusions >= 1
    assert result.kept == result.occlusions
    assert result.settled_velocity_error < 0.5
    assert json.loads((tmp_path / "summary.json").read_text())["ids_kept"] == result.kept
