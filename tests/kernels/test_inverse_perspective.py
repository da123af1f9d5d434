"""Inverse perspective mapping against float64 NumPy, SciPy's interpolation and OpenCV's remap."""

import cv2
import numpy as np
import pytest
import warp as wp
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

from warploom.kernels import inverse_perspective as ground_module
from warploom.kernels.camera import camera_model
from warploom.kernels.inverse_perspective import InversePerspective, inverse_perspective
from warploom.kernels.threads import set_thread_count, thread_count

SIZE = (640, 480)
K = np.array([[500.0, 0, 322.3], [0, 510.0, 238.8], [0, 0, 1]])
RANGE, SHAPE = (3.0, -8.0, 30.0, 8.0), (135, 80)
LENS = (-0.2, 0.05, 1e-3, -2e-3)


def rig(pitch=5.0):
    """A camera 1.5 m above the ground that looks forward and a little down; vehicle from camera."""
    pose = np.eye(4)
    axes = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    pose[:3, :3] = Rotation.from_euler("zyx", [2.0, pitch, 1.0], degrees=True).as_matrix() @ axes
    pose[:3, 3] = 1.2, 0.1, 1.5
    return pose


def picture(channels, dtype, seed=3):
    coarse = np.random.default_rng(seed).uniform(0, 1, (12, 16, channels)).astype(np.float32)
    image = cv2.resize(coarse, SIZE, interpolation=cv2.INTER_CUBIC).reshape(*SIZE[::-1], channels).clip(0, 1)
    return (image * 255).astype(np.uint8) if dtype == np.uint8 else image.astype(dtype)


def pixels_of_cells(pose, plane=(0, 0, 1, 0), lens=None, limits=RANGE, shape=SHAPE):
    """Pixels of the cells' centres in float64, shape (rows, columns, 2), and which are seen."""
    steps = [(limits[i + 2] - limits[i]) / shape[i] for i in (0, 1)]
    x, y = np.meshgrid(*(limits[i] + steps[i] * (np.arange(shape[i]) + 0.5) for i in (0, 1)), indexing="ij")
    z = -(plane[0] * x + plane[1] * y + plane[3]) / plane[2]
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    camera = np.linalg.inv(pose)
    pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(camera[:3, :3])[0], camera[:3, 3], K, lens and np.array(lens))
    ahead = (points @ camera[:3, :3].T + camera[:3, 3])[:, 2] > 0
    pixels = pixels.reshape(-1, 2)
    inside = ahead & (pixels >= -0.5).all(axis=1) & (pixels < np.array(SIZE) - 0.5).all(axis=1)
    return pixels.reshape(*shape, 2), inside.reshape(shape)


@pytest.mark.parametrize("plane", [(0, 0, 1, 0), (0.02, -0.03, 1, 0.1), (0, 0, -2, 0.2)])
@pytest.mark.parametrize("lens", [None, LENS])
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_equals_scipys_interpolation(plane, lens, dtype):
    """Floats within 1e-3 of the range of values, as pixels are within 2e-3; bytes within one step."""
    image, pose = picture(3, dtype), rig()
    ground = inverse_perspective(image, K, pose, RANGE, SHAPE, plane=plane, distortion=lens)
    pixels, inside = pixels_of_cells(pose, plane, lens)
    assert ground.image.dtype == dtype
    assert inside.mean() > 0.5
    assert (ground.seen == inside).mean() > 0.999  # the outermost pixel's edge
    both = ground.seen & inside
    for channel in range(3):
        expected = map_coordinates(image[..., channel].astype(float), pixels[both].T[::-1], order=1, mode="nearest")
        error = np.abs(ground.image[both, channel] - expected)
        assert error.max() < (0.75 if dtype == np.uint8 else 1e-3)
    assert not ground.image[~ground.seen].any()


def test_agrees_with_opencvs_remap():
    """Within 3 steps of a byte: OpenCV interpolates between 32 places of a pixel."""
    image, pose = picture(3, np.uint8), rig()
    ground = inverse_perspective(image, K, pose, RANGE, SHAPE)
    pixels, inside = pixels_of_cells(pose)
    expected = cv2.remap(image, pixels.astype(np.float32), None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    both = ground.seen & inside
    assert np.abs(ground.image[both].astype(int) - expected[both]).max() <= 3


def test_a_chessboard_on_the_ground_is_one_again():
    """Paint a board on the ground, take its picture by ray casting, and map it back."""
    pose = rig(pitch=20.0)
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T @ pose[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        hits = pose[:3, 3] + rays * (-pose[2, 3] / rays[..., 2:])
    board = ((np.floor(hits[..., 0]) + np.floor(hits[..., 1])) % 2).astype(np.float32)
    ground = inverse_perspective(board, K, pose, (4, -2, 8, 2), (4, 4))
    assert ground.image.shape == (4, 4)
    assert ground.seen.all()
    assert np.array_equal(ground.image, (np.add.outer(np.arange(4, 8), np.arange(-2, 2)) % 2).astype(np.float32))


def test_what_the_camera_does_not_see_is_zero():
    ground = inverse_perspective(picture(1, np.uint8) | 1, K, rig(), (-20, -8, -5, 8), (10, 10))
    assert not ground.seen.any()
    assert not ground.image.any()


def test_arrays_of_other_families():
    import torch

    image, pose = picture(3, np.uint8), rig()
    expected = inverse_perspective(image, K, pose, RANGE, SHAPE)
    ground = inverse_perspective(torch.from_numpy(image), K, pose, RANGE, SHAPE)
    assert ground.image.dtype == torch.uint8
    assert np.array_equal(ground.image.numpy(), expected.image)
    assert np.array_equal(ground.seen.numpy(), expected.seen)
    frozen = np.asfortranarray(image)
    frozen.setflags(write=False)
    assert np.array_equal(inverse_perspective(frozen, K, pose, RANGE, SHAPE).image, expected.image)
    wide = inverse_perspective(image.astype(np.float64), K, pose, RANGE, SHAPE)
    assert np.abs(wide.image - expected.image).max() <= 0.5


def test_the_plan(device):
    plan = InversePerspective(image_size=SIZE, bev_range=RANGE, shape=SHAPE, device=device)
    image = picture(3, np.uint8)
    for pose in (rig(), rig(pitch=12.0)):
        plan.set_camera(camera_model(np.linalg.inv(pose), K))
        plan.launch(wp.array(image, dtype=wp.uint8, device=device))
        expected = inverse_perspective(image, K, pose, RANGE, SHAPE)
        assert np.abs(plan.ground.numpy().astype(int) - expected.image).max() <= 1
        assert np.array_equal(plan.seen.numpy(), expected.seen)
    with pytest.raises(ValueError, match="image must be contiguous uint8"):
        plan.launch(wp.array(image.astype(np.float32), device=device))


@pytest.mark.parametrize("size", [SIZE, (1, 3), (3, 1), (2, 2), (7, 5)])
def test_parts_and_many_threads_give_the_same_bytes(size, monkeypatch):
    """Parts of a CPU, and the kernels of a GPU on a CPU; to the last byte of an image."""
    image = wp.array(np.random.default_rng(4).integers(0, 256, (*size[::-1], 3)).astype(np.uint8), device="cpu")
    k = np.array([[size[0] / 1.3, 0, size[0] / 2 - 0.5], [0, size[1] / 0.9, size[1] / 2 - 0.5], [0, 0, 1]])
    before, drawn = thread_count(), set()
    for parts in (1, 2, 3, 7, None):
        if parts is None:
            monkeypatch.setattr(ground_module, "_in_parts", lambda _: False)
        try:
            set_thread_count(parts or before)
            plan = InversePerspective(image_size=size, bev_range=RANGE, shape=(401, 307), device="cpu")
        finally:
            set_thread_count(before)
        plan.launch(image)
        assert not plan.ground.numpy().any()
        plan.set_camera(camera_model(np.linalg.inv(rig()), k))
        plan.launch(image)
        drawn.add(plan.ground.numpy().tobytes())
    assert len(drawn) == 1
    assert plan.seen.numpy().any()


def test_a_camera_that_has_moved_is_noticed():
    image = picture(3, np.uint8)
    first = inverse_perspective(image, K, rig(), RANGE, SHAPE).image
    assert not np.array_equal(inverse_perspective(image, K, rig(pitch=6.0), RANGE, SHAPE).image, first)
    assert not np.array_equal(inverse_perspective(image, K, rig(), RANGE, SHAPE, distortion=LENS).image, first)
    assert np.array_equal(inverse_perspective(image, K, rig(), RANGE, SHAPE).image, first)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 9, 3), (9, 1, 1), (2, 2, 4)])
def test_images_of_few_pixels(shape):
    """A camera straight above, one pixel a metre: the ground is the image itself, turned."""
    image = np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8)
    down = np.eye(4)
    down[:3, :3] = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]  # image rows towards -x, columns towards -y
    down[2, 3] = 2.0
    height, width = shape[:2]
    k = np.array([[2.0, 0, 0], [0, 2.0, 0], [0, 0, 1]])
    ground = inverse_perspective(image, k, down, (0.5 - height, 0.5 - width, 0.5, 0.5), (height, width))
    assert ground.seen.all()
    assert np.array_equal(ground.image, image[::-1, ::-1])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"image": np.zeros(5, np.uint8)}, "image must have shape"),
        ({"vehicle_from_camera": np.zeros((4, 4))}, "vehicle_from_camera must be"),
        ({"vehicle_from_camera": np.eye(3)}, "vehicle_from_camera must be"),
        ({"intrinsics": np.ones((3, 3))}, "intrinsics must be"),
        ({"bev_range": (0, 0, 0, 1)}, "bev_range must be"),
        ({"bev_range": (0, 0, 1)}, "bev_range must be"),
        ({"shape": (0, 4)}, "shape must be"),
        ({"plane": (1, 0, 0, 1)}, "plane must be"),
        ({"distortion": (1,)}, "distortion must be"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {
        "image": np.zeros((4, 4, 3), np.uint8),
        "intrinsics": K,
        "vehicle_from_camera": np.eye(4),
        "bev_range": RANGE,
        "shape": SHAPE,
    }
    with pytest.raises(ValueError, match=message):
        inverse_perspective(**{**arguments, **change})
