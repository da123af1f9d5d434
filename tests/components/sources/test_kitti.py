import logging
import shutil

import numpy as np
import pytest

from warploom.components.sources import KittiSource, open_source
from warploom.errors import SourceError
from warploom.models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.geometry import KittiCalibration, invert

CALIBRATION = """P2: 700 0 600 45 0 700 180 -0.3 0 0 1 0.005
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3
Tr_imu_to_velo: 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8
"""
# Camera: x right, y down, z forward. Bottom centre 3 m right, 1.5 m below, 10 m ahead, heading along the camera's x.
LABEL = "Car 0.00 0 1.0 0 0 50 50 1.5 1.6 4.0 3.0 1.5 10.0 0.0"
OXTS = "49.0 8.4 110.0 0.0 0.0 {yaw} 0 0 {speed} 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 4 6 4 4 0"


def scan(path, n=40, seed=0):
    path.parent.mkdir(parents=True, exist_ok=True)
    points = np.random.default_rng(seed).uniform(-20, 20, size=(n, 4)).astype(np.float32)
    points.tofile(path)
    return points


def text(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


def test_a_folder_of_bin_files_is_enough(tmp_path):
    for number in (40, 41, 137):
        scan(tmp_path / f"{number:06}.bin")
    source = open_source(f"kitti:{tmp_path}")
    assert isinstance(source, KittiSource)
    assert source.layout == "bare"
    frames = list(source)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert [frame.version for frame in frames] == [0, 100_000_000, 200_000_000]
    assert all(frame.truth is None and frame.pose is None for frame in frames)


def test_object_labels_become_truth_in_the_lidar_frame(tmp_path):
    points = scan(tmp_path / "velodyne" / "000007.bin")
    scan(tmp_path / "velodyne" / "000009.bin")
    text(tmp_path / "calib" / "000007.txt", CALIBRATION)
    dontcare = "DontCare -1 -1 -10 500 150 540 180 -1 -1 -1 -1000 -1000 -1000 -10"
    text(tmp_path / "label_2" / "000007.txt", f"{LABEL}\n{LABEL.replace('Car', 'Cyclist')}\n{dontcare}\n")
    source = open_source(f"kitti:{tmp_path}")
    first, second = source
    assert source.layout == "object"
    assert second.truth is None
    truth = first.truth
    assert truth.classes.tolist() == [VEHICLE, CYCLIST]
    assert truth.ids.tolist() == [-1, -1]
    assert np.isnan(truth.velocities).all()
    # By hand: camera (3, 1.5, 10) less the lever arm (0.1, −0.2, −0.3) is lidar (10.3, −2.9, −1.7); up half a height.
    np.testing.assert_allclose(truth.boxes[0], [10.3, -2.9, -0.95, 4.0, 1.6, 1.5, -np.pi / 2], atol=1e-5)
    dx, dy, dz = (points[:, :3] - truth.boxes[0, :3]).T
    inside = (np.abs(dx) <= 0.8) & (np.abs(dy) <= 2.0) & (np.abs(dz) <= 0.75)
    assert truth.points[0] == inside.sum()


@pytest.mark.parametrize("damage", ["Car 0 0\n", "Spaceship" + LABEL[3:], LABEL.replace("10.0", "far"), "\xff\xfe"])
def test_a_scan_with_damaged_labels_is_kept_without_truth(tmp_path, damage, caplog):
    scan(tmp_path / "velodyne" / "000007.bin")
    text(tmp_path / "calib" / "000007.txt", CALIBRATION)
    (tmp_path / "label_2").mkdir()
    (tmp_path / "label_2" / "000007.txt").write_bytes(damage.encode("latin-1"))
    with caplog.at_level(logging.WARNING):
        (frame,) = open_source(f"kitti:{tmp_path}")
    assert frame.truth is None
    assert "000007.txt" in caplog.text


def test_a_tracking_sequence_has_ids_and_poses(tmp_path):
    for number in range(3):
        scan(tmp_path / "velodyne" / "0001" / f"{number:06}.bin")
        scan(tmp_path / "velodyne" / "0002" / f"{number:06}.bin")
    text(tmp_path / "calib" / "0001.txt", CALIBRATION.replace("R0_rect:", "R_rect"))
    text(tmp_path / "label_02" / "0001.txt", f"0 5 {LABEL}\n2 5 {LABEL}\n2 6 {LABEL.replace('Car', 'Pedestrian')}\n")
    text(tmp_path / "oxts" / "0001.txt", "\n".join(OXTS.format(yaw=0.1 * k, speed=5) for k in range(3)))
    source = open_source(f"kitti:{tmp_path}?sequence=0001")
    frames = list(source)
    assert source.layout == "tracking"
    assert frames[0].truth.ids.tolist() == [5]
    assert frames[1].truth is None
    assert frames[2].truth.ids.tolist() == [5, 6]
    assert frames[2].truth.classes.tolist() == [VEHICLE, PEDESTRIAN]
    np.testing.assert_allclose(frames[0].pose, np.eye(4), atol=1e-12)
    yaw = np.arctan2(frames[2].pose[1, 0], frames[2].pose[0, 0])
    assert yaw == pytest.approx(0.2, abs=1e-9)
    for uri, message in (
        (f"kitti:{tmp_path}", "which sequence.*0001, 0002"),
        (f"kitti:{tmp_path}?sequence=7", "no sequence '7'"),
    ):
        with pytest.raises(SourceError, match=message):
            open_source(uri)


def test_a_raw_drive_has_stamps_and_poses(tmp_path):
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0005_sync"
    for number in range(2):
        scan(drive / "velodyne_points" / "data" / f"{number:010}.bin")
        text(drive / "oxts" / "data" / f"{number:010}.txt", OXTS.format(yaw=0.5, speed=5))
    stamps = "2011-09-26 13:02:25.594360375\n2011-09-26 13:02:25.697890115\n"
    text(drive / "velodyne_points" / "timestamps.txt", stamps)
    text(drive.parent / "calib_imu_to_velo.txt", "calib_time: 25-May\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n")
    source = open_source(f"kitti:{drive}")
    frames = list(source)
    assert source.layout == "raw"
    assert frames[1].version - frames[0].version == 103529740
    assert frames[0].version == np.datetime64("2011-09-26T13:02:25.594360375").astype(int)
    np.testing.assert_allclose(frames[1].pose, np.eye(4), atol=1e-9)  # it stands still
    named = open_source(f"kitti:{drive.parent}?sequence={drive.name}")
    assert [frame.version for frame in named] == [frame.version for frame in frames]
    with pytest.raises(SourceError, match=f"no .bin scans.*sequence={drive.name}"):
        open_source(f"kitti:{drive.parent}")


def test_an_odometry_sequence_has_times_poses_and_point_labels(tmp_path):
    sequence = tmp_path / "sequences" / "08"
    for number in range(2):
        scan(sequence / "velodyne" / f"{number:06}.bin", n=5)
    kinds = np.array([40, 10 | 7 << 16, 70, 0, 72 | 3 << 16], "<u4")
    (sequence / "labels").mkdir()
    kinds.tofile(sequence / "labels" / "000000.label")
    text(sequence / "times.txt", "0.0\n1.04e-01\n")
    text(sequence / "calib.txt", "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nTr: 0 -1 0 0.1 0 0 -1 -0.2 1 0 0 -0.3\n")
    text(tmp_path / "poses" / "08.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0 0 1 0 0 0 0 1 2.5\n")  # camera: 2.5 m ahead
    source = open_source(f"kitti:{tmp_path}?sequence=08")
    first, second = source
    assert source.layout == "odometry"
    assert second.version == 104_000_000
    expected = np.eye(4)
    expected[0, 3] = 2.5  # lidar: x is ahead
    np.testing.assert_allclose(second.pose, expected, atol=1e-12)
    assert first.truth.ground.tolist() == [True, False, False, False, True]
    assert first.truth.ground_scored.tolist() == [True, True, False, False, True]
    assert second.truth is None


def test_damaged_files_of_a_sequence_say_where(tmp_path):
    scan(tmp_path / "velodyne" / "000000.bin")
    text(tmp_path / "calib.txt", "Tr: 1 2 3\n")
    text(tmp_path / "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(SourceError, match=r"calib\.txt.*12 numbers"):
        open_source(f"kitti:{tmp_path}")
    text(tmp_path / "calib.txt", "Tr: 1 0 0 0 0 1 0 0 0 0 1 0\n")
    text(tmp_path / "poses.txt", "1 0 0 0 0 1\n")
    with pytest.raises(SourceError, match=r"poses\.txt.*12"):
        open_source(f"kitti:{tmp_path}")
    text(tmp_path / "poses.txt", "one two\n")
    with pytest.raises(SourceError, match=r"poses\.txt"):
        open_source(f"kitti:{tmp_path}")


def test_a_missing_folder_and_one_without_scans_are_told(tmp_path):
    with pytest.raises(SourceError, match="no such folder"):
        open_source(f"kitti:{tmp_path / 'none'}")
    with pytest.raises(SourceError, match=r"no \.bin scans"):
        open_source(f"kitti:{tmp_path}")
    (tmp_path / "a.bin").touch()
    with pytest.raises(SourceError, match="expected a folder"):
        open_source(f"kitti:{tmp_path / 'a.bin'}")


@pytest.mark.real
def test_every_labelled_car_of_real_frames_holds_points(shared_data):
    source = open_source(f"kitti:{shared_data / 'kitti_object'}")
    frames = list(source)
    assert len(frames) == 9
    assert not source.skipped
    cars = [
        count
        for frame in frames
        for count, kind in zip(frame.truth.points, frame.truth.classes, strict=True)
        if kind == VEHICLE
    ]
    assert len(cars) > 20
    assert min(cars) > 0


@pytest.mark.real
def test_boxes_of_real_frames_project_onto_their_labels_in_the_image(shared_data):
    """Axes, lever arm and yaw are all right when a car's box, projected, is the rectangle that annotators drew."""
    from warploom.models.geometry import box_corners

    folder = shared_data / "kitti_object"
    overlaps = []
    for frame, path in zip(open_source(f"kitti:{folder}"), sorted((folder / "label_2").iterdir()), strict=True):
        calibration = KittiCalibration.read(folder / "calib" / path.name)
        rows = [line.split() for line in path.read_text().splitlines() if not line.startswith("DontCare")]
        for row, box in zip(rows, frame.truth.boxes, strict=True):
            if row[0] != "Car" or float(row[1]) > 0.0:  # cut by the image's edge
                continue
            pixels, _ = calibration.project(box_corners(box[None])[0], camera=2)
            drawn = np.array([float(value) for value in row[4:8]])
            low, high = np.maximum(drawn[:2], pixels.min(axis=0)), np.minimum(drawn[2:], pixels.max(axis=0))
            common = np.prod(np.maximum(high - low, 0))
            overlaps.append(common / (np.prod(drawn[2:] - drawn[:2]) + np.prod(np.ptp(pixels, axis=0)) - common))
    assert len(overlaps) > 10
    assert min(overlaps) > 0.7
    assert np.median(overlaps) > 0.85


@pytest.mark.real
def test_a_real_tracking_sequence_is_read_with_truth_and_poses(shared_data, tmp_path):
    """Two packed scans of sequence 0000, unpacked as KITTI has them, beside its labels, calibration and GPS."""
    tracking = shared_data / "kitti_tracking"
    for number in (40, 41):
        packed = np.load(tracking / "velodyne_packed" / "0000" / f"{number:06}.npz")
        low, mid, high = packed["planes"].astype(np.int64)
        zigzag = low | mid << 8 | high << 16
        xyz = (np.cumsum((zigzag >> 1) ^ -(zigzag & 1), axis=1).T / 1000).astype(np.float32)
        points = np.column_stack([xyz, (packed["intensity_x100"] / 100).astype(np.float32)])
        path = tmp_path / "velodyne" / "0000" / f"{number:06}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        points.tofile(path)
    for kind in ("calib", "label_02", "oxts"):
        (tmp_path / kind).mkdir()
        shutil.copy(tracking / kind / "0000.txt", tmp_path / kind / "0000.txt")
    frames = list(open_source(f"kitti:{tmp_path}"))
    assert all((frame.truth.points > 0).all() for frame in frames)
    assert set(frames[0].truth.ids) & set(frames[1].truth.ids)
    step = invert(frames[0].pose) @ frames[1].pose
    # The car drives forward at 3 to 6.5 m/s; a frame is 0.1033 s.
    assert 0.2 < step[0, 3] < 0.8
    assert abs(step[1, 3]) < 0.1


@pytest.mark.real
def test_a_labelled_scan_of_semantic_kitti_says_what_is_ground(shared_data):
    *_, last = open_source(f"kitti:{shared_data / 'semantic_kitti' / 'full'}")
    assert last.truth.ground.shape == (len(last.points),)
    # The ground is below the sensor, which stands 1.73 m above it.
    assert np.median(last.points[last.truth.ground, 2]) == pytest.approx(-1.73, abs=0.3)
    assert 0.3 < last.truth.ground_scored.mean() < 1.0
