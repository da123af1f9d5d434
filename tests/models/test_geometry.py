"""Geometry against SciPy, shapely, and KITTI's own numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from shapely.geometry import Polygon

from warploom.errors import SourceError
from warploom.models.geometry import (
    KittiCalibration,
    box_corners,
    box_corners_bev,
    box_overlap,
    invert,
    kitti_poses,
    points_in_boxes,
    quaternion,
    rigid,
    rotation_vector,
    transform_boxes,
    transform_points,
    turned,
    wrap_angle,
)


def some_boxes(rng, k, reach=3.0):
    return np.c_[rng.uniform(-reach, reach, (k, 3)), rng.uniform(0.3, 5.0, (k, 3)), rng.uniform(-4, 4, k)]


@given(st.floats(-1e4, 1e4))
def test_wrapped_angle_is_the_same_angle_in_range(angle):
    wrapped = wrap_angle(angle)
    assert -np.pi <= wrapped <= np.pi
    # 1e-10: the rounding of a thousand turns
    assert abs(np.exp(1j * wrapped) - np.exp(1j * angle)) < 1e-10


def test_rigid_is_scipys_rotation():
    T = rigid((1.0, 2.0, 3.0), roll=0.3, pitch=-0.2, yaw=2.5)
    np.testing.assert_allclose(T[:3, :3], Rotation.from_euler("xyz", [0.3, -0.2, 2.5]).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(invert(T) @ T, np.eye(4), atol=1e-15)
    np.testing.assert_allclose(invert(np.stack([T, T @ T])) @ np.stack([T, T @ T]), [np.eye(4)] * 2, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 0.3, 2.0, 3.1415, np.pi - 1e-9])
def test_rotations_are_scipys(angle):
    """Within rounding; half a turn away, where two vectors mean one rotation, the matrix tells."""
    rng = np.random.default_rng(1)
    for axis in (*np.eye(3), *-np.eye(3), *rng.normal(size=(20, 3))):
        vector = axis / np.linalg.norm(axis) * angle
        turn = Rotation.from_rotvec(vector)
        np.testing.assert_allclose(turned(vector), turn.as_matrix(), atol=1e-15)
        np.testing.assert_allclose(rotation_vector(turn.as_matrix()), vector, atol=2e-15)
        w, x, y, z = quaternion(turn.as_matrix())
        np.testing.assert_allclose((x, y, z, w), turn.as_quat(canonical=True), atol=1e-15)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0, 0.6, -0.8)])
def test_half_a_turn(axis):
    turn = Rotation.from_rotvec(np.pi * np.array(axis)).as_matrix()
    assert np.linalg.norm(rotation_vector(turn)) == pytest.approx(np.pi, abs=1e-12)
    np.testing.assert_allclose(turned(rotation_vector(turn)), turn, atol=1e-12)
    turn = np.diag(2.0 * np.square(axis) - 1) if 1 in axis else np.round(turn, 12)  # without rounding: w is 0
    assert quaternion(turn)[np.flatnonzero(quaternion(turn))[0]] > 0


def test_points_keep_further_columns_and_their_type():
    points = np.array([[1, 0, 0, 0.5], [0, 1, 0, 0.25]], np.float32)
    moved = transform_points(points, rigid((0, 0, 1), yaw=np.pi / 2))
    assert moved.dtype == np.float32
    np.testing.assert_allclose(moved, [[0, 1, 1, 0.5], [-1, 0, 1, 0.25]], atol=1e-7)
    np.testing.assert_array_equal(points[:, 3], [0.5, 0.25])


def test_boxes_move_with_their_corners():
    rng = np.random.default_rng(0)
    boxes, T = some_boxes(rng, 20), rigid((5, -3, 1), yaw=1.1)
    moved = box_corners(transform_boxes(boxes, T))
    corners = box_corners(boxes)
    np.testing.assert_allclose(moved, corners @ T[:3, :3].T + T[:3, 3], atol=1e-12)


def test_corners_run_counter_clockwise_from_front_left():
    corners = box_corners(np.array([[10, 0, 1, 4, 2, 3, np.pi / 2]]))[0]
    np.testing.assert_allclose(corners[0], [9, 2, -0.5], atol=1e-12)
    np.testing.assert_allclose(corners[4], [9, 2, 2.5], atol=1e-12)
    for corner in box_corners_bev(some_boxes(np.random.default_rng(1), 10)):
        assert Polygon(corner).exterior.is_ccw


def test_points_in_boxes_as_by_turning_all_points():
    rng = np.random.default_rng(2)
    boxes, points = some_boxes(rng, 12), rng.uniform(-6, 6, (4000, 4)).astype(np.float32)
    points[7] = np.nan
    inside = points_in_boxes(points, boxes)
    for row, box in zip(inside, boxes, strict=True):
        local = transform_points(points.astype(float), invert(rigid(box[:3], yaw=box[6])))
        np.testing.assert_array_equal(row, (np.abs(local[:, :3]) <= 0.5 * box[3:6]).all(1))
    assert inside.any()
    assert not inside[:, 7].any()
    assert (points_in_boxes(points, boxes, margin=0.2) >= inside).all()


def test_overlap_is_shapelys():
    rng = np.random.default_rng(3)
    a, b = some_boxes(rng, 400), some_boxes(rng, 400)
    b[:20] = a[:20]  # equal
    b[20:40] = a[20:40] + np.array([0, 0, 0, 0, 0, 0, np.pi / 2])  # crossed
    b[40:60] = a[40:60] + np.array([100, 0, 0, 0, 0, 0, 0])  # apart
    b[60:80] = np.c_[a[60:80, :3], 0.5 * a[60:80, 3:6], a[60:80, 6]]  # within
    bev, iou, giou = box_overlap(a, b)
    polygons = [[Polygon(c) for c in box_corners_bev(boxes)] for boxes in (a, b)]
    area = np.array([p.intersection(q).area for p, q in zip(*polygons, strict=True)])
    union = np.array([p.union(q).area for p, q in zip(*polygons, strict=True)])
    np.testing.assert_allclose(bev, area / union, atol=1e-12)
    top = np.minimum(a[:, 2] + a[:, 5] / 2, b[:, 2] + b[:, 5] / 2)
    bottom = np.maximum(a[:, 2] - a[:, 5] / 2, b[:, 2] - b[:, 5] / 2)
    volume = area * np.maximum(top - bottom, 0)
    np.testing.assert_allclose(iou, volume / (a[:, 3:6].prod(1) + b[:, 3:6].prod(1) - volume), atol=1e-12)
    assert (giou <= iou + 1e-12).all()
    assert (giou >= -1).all()
    np.testing.assert_allclose(giou[:20], 1.0, atol=1e-9)
    np.testing.assert_allclose(iou[40:60], 0.0)
    assert all(part.shape == (0,) for part in box_overlap(np.empty((0, 7)), np.empty((0, 7))))


@pytest.mark.real
def test_kitti_boxes_go_to_the_lidar_and_back(shared_data):
    calibration = KittiCalibration.read(shared_data / "kitti_object" / "calib" / "000008.txt")
    rows = (shared_data / "kitti_object" / "label_2" / "000008.txt").read_text().splitlines()
    labels = np.array([[float(v) for v in row.split()[8:15]] for row in rows if not row.startswith("DontCare")])
    boxes = calibration.boxes_from_camera(labels)
    back = calibration.boxes_to_camera(boxes)
    # 1e-4 m: the file's matrices are rotations to 7 digits; 0.1°: the vertical axes differ by about a degree
    np.testing.assert_allclose(back[:, :6], labels[:, :6], atol=1e-4)
    assert np.abs(wrap_angle(back[:, 6] - labels[:, 6])).max() < np.radians(0.1)
    scan = np.fromfile(shared_data / "kitti_object" / "velodyne" / "000008.bin", np.float32).reshape(-1, 4)
    assert (points_in_boxes(scan, boxes).sum(1) > 0).all()
    pixels, depth = calibration.project(boxes)
    assert (depth > 0).all()
    assert ((pixels > -50) & (pixels < [1300, 450])).all()


@pytest.mark.real
def test_kitti_poses_follow_the_road(shared_data):
    folder = shared_data / "kitti_tracking"
    calibration = KittiCalibration.read(folder / "calib" / "0000.txt")
    oxts = np.loadtxt(folder / "oxts" / "0000.txt")
    poses = kitti_poses(oxts, calibration.lidar_from_imu)
    # 1e-6: the file's lidar-to-IMU rotation has 7 digits
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-6)
    np.testing.assert_allclose(poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), [np.eye(3)] * 98, atol=1e-6)
    # The data set's description gives this path: 45.7 m.
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum() == pytest.approx(45.7, abs=0.1)
    assert np.degrees(wrap_angle(oxts[-1, 5] - oxts[0, 5])) == pytest.approx(
        np.degrees(np.arctan2(poses[-1, 1, 0], poses[-1, 0, 0])), abs=2.0
    )


def test_calibration_of_any_kitti_dialect(tmp_path):
    row = " ".join(["1", "0", "0", "0.5", "0", "1", "0", "0", "0", "0", "1", "0"])
    (tmp_path / "a.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nP2: {row}\nR_rect 1 0 0 0 1 0 0 0 1\nTr_velo_cam {row}\nTr_imu_velo {row}\n"
    )
    calibration = KittiCalibration.read(tmp_path / "a.txt")
    assert calibration.camera_from_lidar[0, 3] == 0.5
    assert calibration.projection[2, 0, 3] == 0.5
    assert np.isnan(calibration.projection[0]).all()
    assert calibration.lidar_from_imu is not None


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("P0: 1 2 3", "P0 has 3 numbers"),
        ("R0_rect: 1 0 0 0 1 0 0 0 1", "needs R0_rect and Tr_velo_to_cam"),
        ("Tr_velo_to_cam: 1 0 x", "line 1"),
    ],
)
def test_broken_calibration_says_what_is_wrong(tmp_path, text, says):
    path = tmp_path / "calib.txt"
    path.write_text(text + ("\nR0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: " + "1 " * 12 if "P0" in text else ""))
    with pytest.raises(SourceError, match=says):
        KittiCalibration.read(path)


def test_missing_calibration_is_a_source_error(tmp_path):
    with pytest.raises(SourceError, match="cannot read"):
        KittiCalibration.read(tmp_path / "none.txt")


def test_oxts_of_wrong_shape_are_refused():
    with pytest.raises(ValueError, match="oxts has shape"):
        kitti_poses(np.zeros((3, 5)))
