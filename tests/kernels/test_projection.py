"""Projection and painting against OpenCV's float64 projection and SciPy's interpolation."""

import cv2
import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from warploom.kernels import projection
from warploom.kernels.camera import camera_model
from warploom.kernels.projection import PointPainting, PointProjection, paint_points, project_points
from warploom.kernels.threads import set_thread_count, thread_count

SIZE = (640, 480)
K = np.array([[500.0, 0, 322.3], [0, 510.0, 238.8], [0, 0, 1]])
AHEAD = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # from x forward, y left, z up to a camera's axes
LENSES = ((-0.3, 0.1, 1e-3, -2e-3), (-0.3, 0.1, 1e-3, -2e-3, -0.01), (0.2, 0.1, 1e-3, 2e-3, 0.02, 0.4, 0.2, 0.01))
PIXEL = 2e-3  # tolerance of pixels of visible points


def rig(seed=0):
    """A camera that looks more or less forward."""
    rng = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.1, 3)).as_matrix() @ AHEAD
    pose[:3, 3] = rng.normal(0, 0.5, 3)
    return pose


def cloud(n, seed):
    return np.random.default_rng(seed).uniform([-20, -30, -5, 0], [60, 30, 5, 1], (n, 4)).astype(np.float32)


def reference(points, pose, k=K, lens=None):
    """Pixels and depth in float64 by OpenCV, for any point."""
    xyz = points[:, :3].astype(np.float64)
    turn, _ = cv2.Rodrigues(pose[:3, :3])
    pixels, _ = cv2.projectPoints(xyz.reshape(-1, 1, 3), turn, pose[:3, 3], k, None if lens is None else np.array(lens))
    return pixels.reshape(-1, 2), (xyz @ pose[:3, :3].T + pose[:3, 3])[:, 2]


def in_image(pixels, depth, slack=0.0):
    size = np.array(SIZE)
    return (depth > slack * 0.01) & ((pixels >= -0.5 + slack) & (pixels < size - 0.5 - slack)).all(axis=1)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 3000))
def test_equals_opencv(seed, n):
    """Pixels of visible points within 2e-3, depths within 1e-5 m; visible alike but within 2e-3 of the image's edge."""
    points, pose = cloud(n, seed), rig(seed)
    seen = project_points(points, pose, K, SIZE)
    pixels, depth = reference(points, pose)
    np.testing.assert_allclose(seen.depth, depth, atol=1e-5)
    assert not (seen.visible & ~in_image(pixels, depth, -PIXEL)).any()
    assert seen.visible[in_image(pixels, depth, PIXEL)].all()
    np.testing.assert_allclose(seen.pixels[seen.visible], pixels[seen.visible], atol=PIXEL)
    assert np.isnan(seen.pixels[seen.depth <= 0]).all()


@pytest.mark.parametrize("lens", LENSES)
def test_equals_opencv_with_distortion(lens):
    points, pose = cloud(5000, 1), rig(1)
    points[:, 1] *= 0.2
    seen = project_points(points, pose, K, SIZE, distortion=lens)
    pixels, _ = reference(points, pose, lens=lens)
    assert seen.visible.sum() > 1000
    np.testing.assert_allclose(seen.pixels[seen.visible], pixels[seen.visible], atol=PIXEL)


def test_points_that_the_distortion_would_fold_back_have_no_pixel():
    """With k1 = -0.3 the radius r (1 - 0.3 r²) falls from r = 1.054 on: such points are not in front of the lens."""
    side = np.linspace(0.5, 1.8, 200)
    points = np.column_stack([np.ones(200), -side, np.zeros(200)]).astype(np.float32)
    pose = np.eye(4)
    pose[:3, :3] = AHEAD
    seen = project_points(points, pose, K, SIZE, distortion=(-0.3, 0, 0, 0))
    assert np.array_equal(np.isfinite(seen.pixels[:, 0]), side < 1 / np.sqrt(0.9))


def test_a_projection_matrix_of_kitti_moves_the_camera():
    """P2's fourth column is K t: as if the camera were moved by t."""
    points, pose, shift = cloud(2000, 2), rig(2), np.array([0.06, -0.01, 0.003])
    seen = project_points(points, pose, np.column_stack([K, K @ shift]), SIZE)
    moved = pose.copy()
    moved[:3, 3] += shift
    pixels, _ = reference(points, moved)
    np.testing.assert_allclose(seen.pixels[seen.visible], pixels[seen.visible], atol=PIXEL)


@pytest.mark.real
def test_the_points_of_a_labelled_car_are_within_its_box(shared_data):
    """On a KITTI frame, with its calibration, points in a car's 3D box project into its 2D box."""
    folder = shared_data / "kitti_object"
    lines = (folder / "calib" / "000008.txt").read_text().splitlines()
    calib = {line.split(":")[0]: np.array(line.split(":")[1].split(), float) for line in lines if ":" in line}
    pose, rectify = np.eye(4), np.eye(4)
    pose[:3], rectify[:3, :3] = calib["Tr_velo_to_cam"].reshape(3, 4), calib["R0_rect"].reshape(3, 3)
    points = np.fromfile(folder / "velodyne" / "000008.bin", np.float32).reshape(-1, 4)
    seen = project_points(points, rectify @ pose, calib["P2"].reshape(3, 4), (1242, 375))
    in_camera = points[:, :3] @ (rectify @ pose)[:3, :3].T + (rectify @ pose)[:3, 3]
    cars = 0
    for line in (folder / "label_2" / "000008.txt").read_text().splitlines():
        kind, *numbers = line.split()
        truncated, _, _, x1, y1, x2, y2, h, w, length, x, y, z, yaw = map(float, numbers[:14])
        if kind != "Car" or truncated > 0:
            continue
        local = (in_camera - [x, y, z]) @ Rotation.from_euler("y", yaw).as_matrix()
        inside = (
            (np.abs(local[:, 0]) < length / 2) & (np.abs(local[:, 2]) < w / 2) & (local[:, 1] < 0) & (local[:, 1] > -h)
        )
        u, v = seen.pixels[inside].T
        assert seen.visible[inside].all()
        assert inside.sum() > 20
        assert ((u > x1 - 3) & (u < x2 + 3) & (v > y1 - 3) & (v < y2 + 3)).mean() > 0.97
        cars += 1
    assert cars >= 2


# ---- occlusion


def test_a_wall_hides_what_is_behind_it():
    """Per cell of the depth buffer only what is near its nearest point stays visible."""
    pose = np.eye(4)
    pose[:3, :3] = AHEAD
    y, z = (grid.ravel() for grid in np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-1, 1, 0.05)))
    wall = np.column_stack([np.full(len(y), 10.0), y, z])
    behind = np.column_stack([np.full(len(y), 20.0), 1.9 * y, 1.9 * z])
    beside = behind + np.array([0, 15.0, 0])
    points = np.concatenate([behind, wall, wall + np.array([0.3, 0, 0]), beside]).astype(np.float32)
    n = len(wall)
    visible = project_points(points, pose, K, (2000, 480), occlusion_cell=8).visible
    assert project_points(points, pose, K, (2000, 480)).visible[:n].all()
    assert not visible[:n].any()
    assert visible[n : 3 * n].all()
    np.testing.assert_array_equal(visible[3 * n :], project_points(beside, pose, K, (2000, 480)).visible)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 7, 40, 5000]), st.sampled_from([0.0, 0.5, 10.0]))
def test_the_depth_buffer_equals_numpy(seed, cell, margin):
    points, pose = cloud(2000, seed), rig(seed)
    free = project_points(points, pose, K, SIZE)
    hidden = project_points(points, pose, K, SIZE, occlusion_cell=cell, occlusion_margin=margin)
    assert np.array_equal(hidden.pixels, free.pixels, equal_nan=True)
    at = np.flatnonzero(free.visible)
    u, v = np.int64(free.pixels[at].T + np.float32(0.5)) // cell
    nearest = np.full((-(-SIZE[1] // cell), -(-SIZE[0] // cell)), np.inf, np.float32)
    np.minimum.at(nearest, (v, u), free.depth[at])
    expected = np.zeros(len(points), bool)
    expected[at] = free.depth[at] <= nearest[v, u] + np.float32(margin)
    assert np.array_equal(hidden.visible, expected)


# ---- painting


def picture(channels, dtype, seed=3):
    """A smooth picture, so that a pixel's error does little."""
    coarse = np.random.default_rng(seed).uniform(0, 1, (12, 16, channels)).astype(np.float32)
    image = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC).reshape(*SIZE[::-1], channels).clip(0, 1)
    return (image * 255).astype(np.uint8) if dtype == np.uint8 else image.astype(dtype)


@pytest.mark.parametrize("channels", [1, 3, 20])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32, np.float64])
def test_bilinear_painting_equals_scipys(channels, dtype):
    """Within 1e-3 of the range of values, as pixels are within 2e-3; beyond the outermost centres their value."""
    points, pose, image = cloud(5000, 4), rig(4), picture(channels, dtype)
    painted = paint_points(points, image, pose, K)
    seen = project_points(points, pose, K, SIZE)
    assert painted.values.dtype == np.float32
    assert np.array_equal(painted.visible, seen.visible)
    assert not painted.values[~seen.visible].any()
    pixels = reference(points, pose)[0][seen.visible]
    for channel in range(channels):
        plane = image[..., channel].astype(np.float64)
        expected = map_coordinates(plane, pixels.T[::-1], order=1, mode="nearest")
        tolerance = 0.25 if dtype == np.uint8 else 1e-3
        np.testing.assert_allclose(painted.values[seen.visible, channel], expected, atol=tolerance)


def test_nearest_painting_gives_labels():
    points, pose = cloud(5000, 5), rig(5)
    labels = np.random.default_rng(5).integers(0, 19, SIZE[::-1]).astype(np.uint8)
    painted = paint_points(points, labels, pose, K, method="nearest", occlusion_cell=4)
    seen = project_points(points, pose, K, SIZE, occlusion_cell=4)
    u, v = np.int64(seen.pixels[seen.visible].T + np.float32(0.5))
    assert painted.values.shape == (5000, 1)
    assert np.array_equal(painted.values[seen.visible, 0], labels[v, u])
    assert not painted.values[~seen.visible].any()


# ---- any input


@pytest.mark.parametrize("scale", [1e-45, 1e5, 1e30])
def test_far_and_tiny_coordinates(scale):
    points = (cloud(500, 6) * np.float32(scale)).astype(np.float32)
    points[:3, 0] = np.nan, np.inf, -np.inf
    seen = project_points(points, rig(6), K, SIZE)
    finite = np.isfinite(points[:, :3]).all(axis=1)
    assert not seen.visible[~finite].any()
    pixels, _ = reference(points[finite], rig(6))
    at = seen.visible[finite]
    np.testing.assert_allclose(seen.pixels[finite][at], pixels[at], atol=PIXEL)


def test_no_point_and_any_layout():
    pose, points = rig(7), cloud(300, 7)
    assert project_points(np.zeros((0, 3), np.float32), pose, K, SIZE).pixels.shape == (0, 2)
    assert paint_points(np.zeros((0, 3), np.float32), picture(3, np.uint8), pose, K).values.shape == (0, 3)
    expected = project_points(points, pose, K, SIZE)
    frozen = points.copy()
    frozen.setflags(write=False)
    for given_points in (frozen, np.asfortranarray(points), points.astype(np.float64), np.repeat(points, 2, 0)[::2]):
        seen = project_points(given_points, pose, K, SIZE)
        assert np.array_equal(seen.pixels, expected.pixels, equal_nan=True)
        assert np.array_equal(seen.visible, expected.visible)
    image = picture(3, np.uint8)
    turned = paint_points(points, np.ascontiguousarray(image[..., ::-1]), pose, K).values
    assert np.array_equal(paint_points(points, image[..., ::-1], pose, K).values, turned)


def test_arrays_of_other_families():
    import torch

    pose, points, image = rig(8), cloud(300, 8), picture(3, np.uint8)
    expected = paint_points(points, image, pose, K)
    painted = paint_points(torch.from_numpy(points), torch.from_numpy(image), pose, K)
    assert isinstance(painted.values, torch.Tensor)
    assert np.array_equal(painted.values.numpy(), expected.values)
    assert np.array_equal(painted.visible.numpy(), expected.visible)
    given_points = wp.array(points, dtype=wp.float32, device="cpu")
    assert np.array_equal(paint_points(given_points, image, pose, K).values.numpy(), expected.values)


def test_the_plans_read_their_count(device):
    pose, points, image = rig(9), cloud(1000, 9), picture(3, np.float32)
    projection = PointProjection(capacity=1024, image_size=SIZE, occlusion_cell=8, device=device)
    plan = PointPainting(channels=3, projection=projection)
    xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device=device)
    for n in (1000, 200):
        plan.launch(
            xyz,
            wp.array([n], dtype=wp.int32, device=device),
            camera_model(pose, K),
            wp.array(image, dtype=wp.float32, device=device),
        )
        expected = paint_points(points[:n], image, pose, K, occlusion_cell=8)
        np.testing.assert_allclose(plan.values.numpy()[:n], expected.values, atol=1e-4)
        assert np.array_equal(projection.visible.numpy()[:n], expected.visible)
        assert not projection.visible.numpy()[n:1000].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_from_lidar": np.eye(3)}, "camera_from_… must be a finite transform"),
        ({"camera_from_lidar": np.full((4, 4), np.nan)}, "camera_from_… must be a finite transform"),
        ({"camera_from_lidar": np.diag([2.0, 1, 1, 1])}, "camera_from_… must be rigid"),
        ({"intrinsics": np.eye(4)}, "intrinsics must be finite, of shape"),
        ({"intrinsics": np.ones((3, 3))}, "intrinsics must be upper triangular"),
        ({"image_size": (0, 5)}, "image_size must be"),
        ({"distortion": (0.1, 0.2)}, "distortion must be"),
        ({"distortion": (0.1, np.nan, 0, 0)}, "distortion must be"),
        ({"occlusion_cell": -1}, "occlusion_cell must be"),
        ({"occlusion_margin": np.nan}, "occlusion_margin must be"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {"camera_from_lidar": np.eye(4), "intrinsics": K, "image_size": SIZE, **change}
    with pytest.raises(ValueError, match=message):
        project_points(np.zeros((5, 3), np.float32), **arguments)


def test_wrong_images_are_refused():
    points = np.zeros((5, 3), np.float32)
    with pytest.raises(ValueError, match="image must have shape"):
        paint_points(points, np.zeros(5, np.uint8), np.eye(4), K)
    with pytest.raises(ValueError, match="method must be"):
        paint_points(points, np.zeros((5, 5), np.uint8), np.eye(4), K, method="cubic")
    with pytest.raises(TypeError, match="image must be a NumPy"):
        paint_points(points, [[1]], np.eye(4), K)


@pytest.mark.parametrize("lens", [None, LENSES[2]])
@pytest.mark.parametrize("columns", [3, 4, 5])
@pytest.mark.parametrize("method", ["bilinear", "nearest"])
def test_parts_and_many_threads_give_the_same_bytes(lens, columns, method, monkeypatch):
    """Parts of a CPU, and the kernels of a GPU on a CPU."""
    points = np.column_stack([cloud(120_000, 8), np.zeros(120_000, np.float32)])[:, :columns].copy()
    odd = np.random.default_rng(9).random((120_000, 3)) < 0.003
    points[:, :3][odd] = np.random.default_rng(10).choice(
        np.float32([0, np.nan, np.inf, -np.inf, 1e-45, 3e38]), odd.sum()
    )
    image = np.random.default_rng(11).integers(0, 256, (*SIZE[::-1], 3)).astype(np.uint8)
    before, found = thread_count(), set()
    for parts in (1, 2, 3, 7, None):
        if parts is None:
            monkeypatch.setattr(projection, "_in_parts", lambda _: False)
        try:
            set_thread_count(parts or before)
            seen = project_points(points, rig(), K, SIZE, distortion=lens)
            painted = paint_points(points, image, rig(), K, distortion=lens, method=method)
        finally:
            set_thread_count(before)
        # Which of the bits of NaN a processor gives is its own affair.
        arrays = [np.nan_to_num(seen.pixels, nan=-1e9), np.nan_to_num(seen.depth, nan=-1e9), seen.visible]
        found.add(b"".join(array.tobytes() for array in [*arrays, painted.values, painted.visible]))
    assert len(found) == 1
    assert seen.visible.sum() > 10_000


def test_the_plan_hides_points_past_its_count_in_parts():
    points = cloud(40_000, 12)
    xyz = wp.array(points[:, :3].copy(), dtype=wp.vec3, device="cpu")
    plan = PointProjection(capacity=40_000, image_size=SIZE, device="cpu")
    for n in (40_000, 25_000, 100, 0):
        plan.launch(xyz, wp.array([n], dtype=wp.int32, device="cpu"), camera_model(rig(), K))
        assert np.array_equal(plan.visible.numpy()[:n], project_points(points[:n], rig(), K, SIZE).visible)
        assert not plan.visible.numpy()[n:].any()
