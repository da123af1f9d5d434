"""Images against the LiDAR of the same moment and the truth of the objects."""

import numpy as np
import pytest

from warploom.models.geometry import box_corners, rigid
from warploom.models.simulator import Camera, PointClass, Simulator

WIDTH, HEIGHT = 240, 120


@pytest.fixture(scope="module")
def simulator() -> Simulator:
    return Simulator(seed=7, lidar="vlp16", duration=1.0, turning=False)


@pytest.fixture(scope="module")
def camera() -> Camera:
    return Camera(width=WIDTH, height=HEIGHT, field_of_view=80.0, lidar_from_body=rigid((0.3, 0.1, -0.2), yaw=0.1))


@pytest.fixture(scope="module")
def view(simulator, camera):
    return simulator.image(4, camera)


def project(camera, points):
    """Pixels and depths of points in the LiDAR's frame."""
    p = np.c_[points, np.ones(len(points))] @ camera.projection.T
    return p[:, :2] / p[:, 2:], p[:, 2]


def test_directions_are_the_inverse_of_the_projection(camera):
    optical = camera.directions * 7.0
    there = optical @ camera.lidar_from_body[:3, :3].T + camera.lidar_from_body[:3, 3]
    pixels, depth = project(camera, there)
    row, column = np.divmod(np.arange(WIDTH * HEIGHT), WIDTH)
    assert np.allclose(pixels, np.stack([column, row], 1), atol=1e-6)
    assert (depth > 0).all()
    assert camera.intrinsics[0, 0] == pytest.approx(0.5 * WIDTH / np.tan(np.deg2rad(40.0)))


def test_depth_is_that_of_the_lidars_points(simulator, camera, view):
    """Points of surfaces that face the sensor: within 5 % in nine of ten pixels; edges differ by the pixel's width."""
    frame = simulator.frame(4)
    solid = np.isin(frame.point_class, (PointClass.ROAD, PointClass.BUILDING, PointClass.VEHICLE))
    pixels, depth = project(camera, frame.points[solid, :3].astype(np.float64))
    column, row = np.rint(pixels).astype(int).T
    inside = (depth > 0.5) & (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
    seen = view.depth[row[inside], column[inside]]
    assert inside.sum() > 500
    assert (np.abs(seen / depth[inside] - 1) < 0.05).mean() > 0.9


def test_boxes_hold_their_pixels_and_lie_within_the_projected_solid(simulator, camera, view):
    frame = simulator.frame(4)
    assert len(view.ids) >= 3
    for k, ident in enumerate(view.ids):
        rows, columns = np.nonzero(view.instance == ident)
        assert len(rows) == view.pixels[k]
        left, top, right, bottom = view.boxes[k]
        assert (left, top, right, bottom) == (
            columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5
        )  # fmt: skip
        row = np.flatnonzero(frame.ids == ident)
        if not len(row):
            continue
        assert view.classes[k] == frame.classes[row[0]]
        pixels, depth = project(camera, box_corners(frame.boxes[row].astype(np.float64))[0])
        if (depth > 1.0).all():
            # Mirrors stand out of a vehicle's box by up to 0.25 m.
            slack = 1.5 + 0.25 * camera.intrinsics[0, 0] / depth.min()
            assert left >= pixels[:, 0].min() - slack
            assert right <= pixels[:, 0].max() + slack
            assert bottom <= pixels[:, 1].max() + slack


def test_sky_is_above_and_road_below(view):
    assert (view.point_class[0] == -1).mean() > 0.3
    assert np.isinf(view.depth[view.point_class == -1]).all()
    assert (view.point_class[-1] == PointClass.ROAD).mean() > 0.3
    sky, road = view.image[view.point_class == -1], view.image[view.point_class == PointClass.ROAD]
    assert sky[:, 2].mean() > sky[:, 0].mean() + 20
    assert np.abs(road.mean(0) - road.mean()).max() < 10
    assert view.image.std() > 20


def test_visibility_of_what_is_shown(view):
    assert view.visible.shape == view.ids.shape
    assert ((view.visible >= 0) & (view.visible <= 1)).all()
    assert view.visible[view.pixels > 150].min() > 0.2


def test_the_same_image_twice_and_another_at_another_time(simulator, camera, view):
    again, later = simulator.image(4, camera), simulator.image(4, camera, delay=0.04)
    assert again.image.tobytes() == view.image.tobytes()
    assert later.version - view.version == 40_000_000
    assert later.depth.tobytes() != view.depth.tobytes()


@pytest.mark.parametrize(
    ("options", "message"),
    [({"width": 0}, "width must be at least 1"), ({"field_of_view": 180.0}, "field_of_view"),
     ({"lidar_from_body": np.eye(3)}, "lidar_from_body")],
)  # fmt: skip
def test_cameras_that_cannot_be_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        Camera(**options)
