"""Images and clouds beside their peers: range images, a camera's view of points, and its view of the ground."""

import numpy as np
import pytest
import warp as wp

from warploom.bench.contest import contenders, on_device, peer, processors
from warploom.bench.scans import REAL, SCANS
from warploom.kernels.camera import camera_model
from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.inverse_perspective import InversePerspective, inverse_perspective
from warploom.kernels.projection import PointPainting, PointProjection, paint_points, project_points
from warploom.kernels.range_image import RangeProjection, range_image

GOAL_SCANS = ("street 120k", REAL)
SHAPE, FOV = (64, 1024), (-25.0, 3.0)
# A camera as KITTI's: x right, y down, z ahead, a little before and above the LiDAR.
SIZE = (1242, 375)
K = np.array([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]])
CAMERA_FROM_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1]])
LENS = (-0.37, 0.2, 1e-3, 2e-4, -0.07)
GROUND_RANGE, GROUND_SHAPE = (6.0, -15.0, 36.0, 15.0), (600, 600)
GROUND = (0.0, 0.0, 1.0, 1.73)


def goals_on(scan, **goals):
    return goals if scan in GOAL_SCANS else {}


def borrowed(points, device):
    cloud = borrow_points(on_device(points, device))
    return cloud, count_on(len(cloud), device)


# ---- range images


def numpy_range_image(points):
    """RangeNet++'s way: angles of all points, drawn from the farthest to the nearest."""
    rows, columns = SHAPE
    low, high = np.deg2rad(FOV, dtype=np.float32)

    def call():
        distance = np.linalg.norm(points[:, :3], axis=1)
        yaw, pitch = -np.arctan2(points[:, 1], points[:, 0]), np.arcsin(points[:, 2] / distance)
        column = np.clip(np.floor(0.5 * (yaw / np.pi + 1.0) * columns), 0, columns - 1).astype(np.int32)
        row = np.floor((1.0 - (pitch - low) / (high - low)) * rows).astype(np.int32)
        order = np.argsort(distance)[::-1]
        order = order[(row[order] >= 0) & (row[order] < rows)]
        at = (row[order], column[order])
        index, channels = np.full(SHAPE, -1, np.int32), np.zeros((5, *SHAPE), np.float32)
        index[at], channels[0][at] = order, distance[order]
        channels[1:, at[0], at[1]] = points[order, :4].T
        return channels, index

    return call


def same_pixels(ours, theirs):
    return f"{100 * (ours.index == theirs[1]).mean():.3f} % of the pixels show the same point"


@pytest.mark.parametrize("contender", contenders("numpy"))
@pytest.mark.parametrize("scan", SCANS)
def bench_range_image(contest, contender, scan):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = RangeProjection(capacity=len(points), shape=SHAPE, vertical_fov=FOV, device=device)
        return lambda: made.launch(cloud.xyz, cloud.intensity, count)

    def function(device):
        given = on_device(points, device)
        return lambda: range_image(given, SHAPE, vertical_fov=FOV)

    calls = {"warploom": function, "warploom plan": plan, "numpy": lambda _: numpy_range_image(points)}
    contest.run(
        contender, calls, kernel="range_image", on=scan, size=len(points), agree=same_pixels,
        goals=goals_on(scan, numpy=1 / 5),
    )  # fmt: skip


# ---- a camera's view of points


def numpy_projection(points):
    turn, move, k = (part.astype(np.float32) for part in (CAMERA_FROM_LIDAR[:3, :3], CAMERA_FROM_LIDAR[:3, 3], K))

    def call():
        with np.errstate(divide="ignore", invalid="ignore"):
            seen = points[:, :3] @ turn.T + move
            pixels = (seen @ k.T)[:, :2] / seen[:, 2:]
        u, v = pixels.T
        inside = (u >= -0.5) & (v >= -0.5) & (u < SIZE[0] - 0.5) & (v < SIZE[1] - 0.5)
        return pixels, seen[:, 2], (seen[:, 2] > 0) & inside

    return call


def opencv_projection(points, lens):
    cv2 = peer("cv2", "opencv-python-headless")
    wide = points[:, :3].astype(np.float64).reshape(-1, 1, 3)
    turn, move = cv2.Rodrigues(CAMERA_FROM_LIDAR[:3, :3])[0], CAMERA_FROM_LIDAR[:3, 3]
    coefficients = np.array(lens)

    def call():
        pixels = cv2.projectPoints(wide, turn, move, K, coefficients)[0].reshape(-1, 2)
        return pixels, None, None

    return call


def pixel_error(ours, theirs):
    error = np.abs(ours.pixels - theirs[0])[ours.visible]
    return f"{ours.visible.sum()} visible; pixels within {error.max():.1e}"


@pytest.mark.parametrize("contender", contenders("numpy", "opencv"))
@pytest.mark.parametrize("lens", [None, LENS], ids=["pinhole", "distorted"])
@pytest.mark.parametrize("scan", SCANS)
def bench_project_points(contest, contender, lens, scan):
    if lens and contender.who == "numpy":
        pytest.skip("numpy is tried without distortion")
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        made = PointProjection(capacity=len(points), image_size=SIZE, device=device)
        camera = camera_model(CAMERA_FROM_LIDAR, K, lens)
        return lambda: made.launch(cloud.xyz, count, camera)

    def function(device):
        given = on_device(points, device)
        return lambda: project_points(given, CAMERA_FROM_LIDAR, K, SIZE, distortion=lens)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "numpy": lambda _: numpy_projection(points),
        "opencv": lambda _: opencv_projection(points, lens or (0.0,) * 5),
    }
    contest.run(
        contender, calls, kernel="project_points", on=f"{scan}, {'distorted' if lens else 'pinhole'}",
        size=len(points), agree=pixel_error, goals=goals_on(scan, numpy=1 / 5, opencv=1 / 5),
    )  # fmt: skip


@pytest.fixture(scope="module")
def image():
    """Colours that differ from pixel to pixel."""
    return np.random.default_rng(7).integers(0, 256, (*SIZE[::-1], 3)).astype(np.uint8)


def numpy_painting(points, image):
    project = numpy_projection(points)

    def call():
        pixels, _, visible = project()
        u, v = pixels[visible].clip(0, np.array(SIZE) - 1).T
        left, top = np.minimum(u.astype(int), SIZE[0] - 2), np.minimum(v.astype(int), SIZE[1] - 2)
        a, b = (u - left)[:, None].astype(np.float32), (v - top)[:, None].astype(np.float32)
        above = image[top, left] * (1 - a) + image[top, left + 1] * a
        below = image[top + 1, left] * (1 - a) + image[top + 1, left + 1] * a
        values = np.zeros((len(points), 3), np.float32)
        values[visible] = above * (1 - b) + below * b
        return values, visible

    return call


def same_colours(ours, theirs):
    both = ours.visible & theirs[1]
    return f"{both.sum()} visible; colours of 0 to 255 within {np.abs(ours.values - theirs[0])[both].max():.2f}"


@pytest.mark.parametrize("contender", contenders("numpy"))
@pytest.mark.parametrize("scan", SCANS)
def bench_paint_points(contest, contender, scan, image):
    points = contest.cloud(scan)

    def plan(device):
        cloud, count = borrowed(points, device)
        projection = PointProjection(capacity=len(points), image_size=SIZE, device=device)
        made, camera = PointPainting(channels=3, projection=projection), camera_model(CAMERA_FROM_LIDAR, K)
        picture = wp.array(image, dtype=wp.uint8, device=device)
        return lambda: made.launch(cloud.xyz, count, camera, picture)

    def function(device):
        given, picture = on_device(points, device), on_device(image, device)
        return lambda: paint_points(given, picture, CAMERA_FROM_LIDAR, K)

    calls = {"warploom": function, "warploom plan": plan, "numpy": lambda _: numpy_painting(points, image)}
    contest.run(
        contender, calls, kernel="paint_points", on=scan, size=len(points), agree=same_colours,
        goals=goals_on(scan, numpy=1 / 5),
    )  # fmt: skip


# ---- its view of the ground


def opencv_ground(image, threads):
    """The homography of the plane as maps by NumPy, then OpenCV's remap."""
    cv2 = peer("cv2", "opencv-python-headless")
    x0, y0, x1, y1 = GROUND_RANGE
    rows, columns = GROUND_SHAPE

    def call():
        cv2.setNumThreads(threads)
        a, b, c, d = GROUND
        on_plane = np.array([[1.0, 0, 0], [0, 1, 0], [-a / c, -b / c, -d / c], [0, 0, 1]])
        h = (K @ CAMERA_FROM_LIDAR[:3] @ on_plane).astype(np.float32)
        x, y = np.meshgrid(
            np.float32(x0 + (np.arange(rows) + 0.5) * (x1 - x0) / rows),
            np.float32(y0 + (np.arange(columns) + 0.5) * (y1 - y0) / columns),
            indexing="ij",
        )
        u, v, w = (h[i, 0] * x + h[i, 1] * y + h[i, 2] for i in range(3))
        return cv2.remap(image, u / w, v / w, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    return call


def same_ground(ours, theirs):
    error = np.abs(ours.image.astype(int) - theirs)[ours.seen]
    return f"{100 * ours.seen.mean():.0f} % seen; bytes within {error.max()}, {error.mean():.2f} on average"


@pytest.mark.parametrize("contender", contenders("opencv", "opencv, all threads"))
def bench_inverse_perspective(contest, contender, image):
    def plan(device):
        made = InversePerspective(
            image_size=SIZE, bev_range=GROUND_RANGE, shape=GROUND_SHAPE, plane=GROUND, device=device
        )
        made.set_camera(camera_model(CAMERA_FROM_LIDAR, K))
        picture = wp.array(image, dtype=wp.uint8, device=device)
        return lambda: made.launch(picture)

    def function(device):
        picture, vehicle_from_camera = on_device(image, device), np.linalg.inv(CAMERA_FROM_LIDAR)
        return lambda: inverse_perspective(picture, K, vehicle_from_camera, GROUND_RANGE, GROUND_SHAPE, plane=GROUND)

    calls = {
        "warploom": function,
        "warploom plan": plan,
        "opencv": lambda _: opencv_ground(image, 1),
        "opencv, all threads": lambda _: opencv_ground(image, processors()),
    }
    contest.run(
        contender, calls, kernel="inverse_perspective", on="600 × 600 cells of 3 channels", size=600 * 600,
        agree=same_ground, goals={"opencv": 1 / 5, "opencv, all threads": 1 / 5},
        threads={"opencv, all threads": processors()},
    )  # fmt: skip
