"""Every kernel function of the API on input that is empty, degenerate, not finite, huge, tiny, or oddly laid out.

None may crash, change its input, or give numbers that are not finite where the input is; and the layout and the type of
an array must not matter. What the numbers should be is told by the tests of each function.
"""

import dataclasses
import importlib
import inspect
import pkgutil

import numpy as np
import pytest
import warp as wp

import warploom as wl
import warploom.kernels
from warploom.kernels.anchor_decode import AnchorDecode
from warploom.kernels.gather import gather_rows
from warploom.kernels.ground import elevation_grid
from warploom.kernels.interop import borrow
from warploom.kernels.nms import rotated_nms
from warploom.kernels.pillar import pillar_channels, pillarize
from warploom.kernels.raycast import raycast

RANGE = (-20.0, -20.0, -4.0, 20.0, 20.0, 4.0)
CAMERA_FROM_LIDAR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0.0], [0, 0, 0, 1]])
INTRINSICS = np.array([[60, 0, 40], [0, 60, 30], [0, 0, 1.0]])
IMAGE = np.random.default_rng(0).random((60, 80, 3), np.float32)
SCENE_SIZE = 400
CHAIN = wl.ChainConfig(
    pillar_size=(0.5, 0.5, 8.0), pillar_range=RANGE, max_pillars=2000, bev_range=RANGE, bev_shape=(40, 50), min_size=2
)


def poses():
    moved = np.eye(4)
    moved[:3, 3] = 1, 0.5, 0
    return np.stack([np.eye(4), moved])


def labels_of(n):
    return (np.arange(n) % 7 - 1).astype(np.int32)


def states_of(table):
    """Tracks at the rows of a table, and their covariances."""
    state = np.zeros((len(table), 10), table.dtype)
    state[:, :4] = table[:, :4]
    state[:, 3:6] += 1
    return state, np.tile(np.eye(10, dtype=table.dtype), (len(table), 1, 1))


def boxes_of(table):
    """Boxes at the rows of a table: seven columns of its four."""
    size = (np.abs(table[:, :3]).astype(np.float32) * np.float32(0.1)).astype(table.dtype)
    return np.concatenate([table[:, :3], size, table[:, 3:]], axis=1)


def like(table, rows):
    """The rows of a table laid out as the table is, so that its layout reaches a function of more columns."""
    if table.flags.f_contiguous and not table.flags.c_contiguous:
        return np.asfortranarray(rows)
    if not table.flags.c_contiguous:
        wide = np.zeros((2 * len(rows), rows.shape[1] + 2), rows.dtype)
        wide[::2, : rows.shape[1]] = rows
        rows = wide[::2, : rows.shape[1]]
    rows.setflags(write=table.flags.writeable)
    return rows


def over_boxes(function):
    def call(table):
        boxes = like(table, boxes_of(table))
        return {"matrix": function(boxes, boxes)}

    return call


def predict(table):
    state, covariance = states_of(table)
    noise = np.ones(10, table.dtype)
    state, covariance = wl.kalman_predict(like(table, state), covariance, 0.1, noise)
    return {"state": state, "covariance": covariance}


def update(table):
    state, covariance = states_of(np.nan_to_num(table, nan=0, posinf=0, neginf=0))
    return wl.kalman_update(state, covariance, like(table, boxes_of(table)), np.ones(7, table.dtype))


def perspective(table):
    """The table as an image, four pixels wide."""
    pixels = np.concatenate([table, np.zeros((2, 4), table.dtype)])
    camera = np.linalg.inv(CAMERA_FROM_LIDAR)
    camera[2, 3] = 1.5
    return wl.inverse_perspective(like(table, pixels), INTRINSICS, camera, (2, -10, 22, 10), (20, 30))


def suppress(table):
    return rotated_nms(like(table, boxes_of(table)), like(table, table)[:, 3], 0.3)


def gather(table):
    """The intensities of the rows that a column of the table names, in the order of another."""
    n = len(table)
    values, owner = borrow(table[:, 3], wp.float32, (n,), "values")
    rows = wp.array(labels_of(n) * 3, dtype=wp.int32, device="cpu")
    out = wp.zeros(n, dtype=wp.float32, device="cpu")
    gather_rows(values, rows, wp.array([n], dtype=wp.int32, device="cpu"), out)
    del owner
    return out.numpy()


def decode_anchors(table):
    """The table as what a network says of sixteen anchors, as often as there is room."""
    maps = np.zeros(11 * 16, np.float32)
    flat = table.astype(np.float32).ravel()[: 11 * 16]
    maps[: len(flat)] = flat
    scores, residuals, directions = (
        wp.array(part.reshape(1, -1, 4, 4), dtype=wp.float32, device="cpu") for part in np.split(maps, [32, 144])
    )
    plan = AnchorDecode(
        anchors=((4.0, 1.8, 1.5, -1.0, 0.0),), classes=2, shape=(4, 4), first=(0.0, 0.0), step=(1.0, 1.0), capacity=8
    )
    plan.launch(scores, residuals, directions, 0.3, 1.8)
    assert 0 <= plan.count.numpy()[0] <= 8
    found = plan.count.numpy()[0]
    return {"scores": plan.scores.numpy()[:found], "classes": plan.classes_found.numpy()[:found]}


def cast_rays(table):
    """Rays from the table's points, downwards, to two triangles."""
    corners = np.array([[-30, -30, -3], [30, -30, -3], [30, 30, -3], [-30, 30, -3]], table.dtype)
    down = np.tile(np.array([0.1, 0, -1], table.dtype), (len(table), 1))
    hits = raycast(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), table[:, :3], like(table, down))
    return {"face": hits.face}


# By function: how it is called with a table of points x y z intensity, and the shapes of its results for n rows; None
# stands for any length.
CASES = {
    "bev": (lambda p: wl.bev(p, RANGE, (40, 50)), {"": (3, 40, 50)}),
    "cluster": (lambda p: wl.cluster(p, 0.5, 2), {"": ("n",)}),
    "cluster by range": (lambda p: wl.cluster(p, 0.3, radius_per_metre=0.02), {"": ("n",)}),
    "compensate_motion": (
        lambda p: wl.compensate_motion(p, np.linspace(0, 0.1, len(p)), poses(), [0, 0.1], 0.1),
        {"": ("n", 4)},
    ),
    "dbscan": (lambda p: wl.dbscan(p, 0.5, 3), {"": ("n",)}),
    "dynamic_voxelize": (
        lambda p: wl.dynamic_voxelize(p, 0.5, RANGE),
        {"voxel_of_point": ("n",), "coords": (None, 3), "counts": (None,), "means": (None, 4)},
    ),
    "elevation_grid": (
        lambda p: elevation_grid(p, grid_range=(-20, -20, 20, 20), cell_size=2, sensor_height=1.8),
        {"": (20, 20)},
    ),
    "filter_points": (
        lambda p: wl.filter_points(p, point_range=RANGE, ego_box=(-1, -1, -1, 1, 1, 1)),
        {"points": (None, 4), "index": (None,)},
    ),
    "fit_boxes": (lambda p: wl.fit_boxes(p, labels_of(len(p))), {"": (None, 7)}),
    "fit_boxes by area": (lambda p: wl.fit_boxes(p, labels_of(len(p)), method="min_area"), {"": (None, 7)}),
    "giou_3d": (over_boxes(wl.giou_3d), {"matrix": ("n", "n")}),
    "grid_cluster": (lambda p: wl.grid_cluster(p, 0.5), {"": ("n",)}),
    "in_polygons": (
        lambda p: wl.in_polygons(p, [np.array([[-5, -5], [9, -6], [8, 8]])], (-20, -20, 20, 20), exact=True),
        {"": ("n",)},
    ),
    "inverse_perspective": (perspective, {"image": (20, 30), "seen": (20, 30)}),
    "iou_3d": (over_boxes(wl.iou_3d), {"matrix": ("n", "n")}),
    "kalman_predict": (predict, {"state": ("n", 10), "covariance": ("n", 10, 10)}),
    "kalman_update": (
        update,
        {"state": ("n", 10), "covariance": ("n", 10, 10), "distance": ("n",), "log_likelihood": ("n",)},
    ),
    "paint_points": (
        lambda p: wl.paint_points(p, IMAGE, CAMERA_FROM_LIDAR, INTRINSICS),
        {"values": ("n", 3), "visible": ("n",)},
    ),
    "project_points": (
        lambda p: wl.project_points(p, CAMERA_FROM_LIDAR, INTRINSICS, (80, 60), occlusion_cell=4),
        {"pixels": ("n", 2), "depth": ("n",), "visible": ("n",)},
    ),
    "AnchorDecode": (decode_anchors, {"scores": (None,), "classes": (None,)}),
    "gather_rows": (gather, {"": ("n",)}),
    "pillarize": (
        lambda p: pillarize(p, sensor_height=1.8, point_range=RANGE, cell=0.5),
        {"": (len(pillar_channels()), 80, 80)},
    ),
    "raycast": (cast_rays, {"face": ("n",)}),
    "rotated_nms": (suppress, {"": (None,)}),
    "radius_outliers": (lambda p: wl.radius_outliers(p, 0.8), {"": ("n",)}),
    "range_image": (lambda p: wl.range_image(p, (16, 64)), {"channels": (None, 16, 64), "index": (16, 64)}),
    "register": (lambda p: wl.register(p, p[: len(p) // 2 + 1]), {"transform": (4, 4)}),
    "rotated_iou_bev": (over_boxes(wl.rotated_iou_bev), {"matrix": ("n", "n")}),
    "segment_ground": (lambda p: wl.segment_ground(p), {"mask": ("n",), "height": ("n",)}),
    "statistical_outliers": (lambda p: wl.statistical_outliers(p, 5), {"": ("n",)}),
    "voxel_downsample": (lambda p: wl.voxel_downsample(p, 0.5), {"": (None, 3)}),
    "voxelize": (
        lambda p: wl.voxelize(p, 0.5, RANGE, max_points=4, max_voxels=300),
        {"features": (None, 4, 4), "coords": (None, 3), "counts": (None,)},
    ),
    "KernelChain": (
        lambda p: wl.KernelChain(config=CHAIN, capacity=SCENE_SIZE)(p),
        {"xyz": (None, 3), "height": (None,), "labels": (None,), "boxes": (None, 7), "bev": (3, 40, 50)},
    ),
}  # fmt: skip


def results_of(function, points):
    """The arrays of a result by name."""
    result = function(points)
    if isinstance(result, np.ndarray):
        return {"": result}
    if not isinstance(result, dict):
        result = {field.name: getattr(result, field.name) for field in dataclasses.fields(result)}
    return {name: value for name, value in result.items() if isinstance(value, np.ndarray)}


def scene():
    """A road with a few blocks on it."""
    rng = np.random.default_rng(5)
    points = rng.uniform((-18, -18, -1.8, 0), (18, 18, -1.8, 1), (SCENE_SIZE, 4))
    standing = slice(0, None, 3)
    points[standing, :3] = rng.uniform((-10, -10, -1.5), (10, 10, 0), (8, 3))[rng.integers(0, 8, 134)]
    points[standing, :3] += rng.normal(0, 0.2, (134, 3))
    return points.astype(np.float32)


def not_finite():
    points = scene()
    points[::3, 0], points[1::7, 1], points[2::11, 2], points[4::13] = np.nan, np.inf, -np.inf, np.nan
    points[5::17, :3] = np.inf, -np.inf, np.nan
    return points


def far():
    points = np.random.default_rng(6).uniform(-1e5, 1e5, (SCENE_SIZE, 4)).astype(np.float32)
    points[::2, :3] = np.sign(points[::2, :3]) * np.float32(1e5)
    return points


def tiny():
    """Denormal numbers, and the least normal one."""
    points = np.random.default_rng(7).uniform(-1e-40, 1e-40, (SCENE_SIZE, 4)).astype(np.float32)
    points[::5] = np.finfo(np.float32).tiny
    return points


INPUTS = {
    "empty": lambda: np.zeros((0, 4), np.float32),
    "one point": lambda: scene()[:1],
    "two points": lambda: scene()[:2],
    "the origin": lambda: np.zeros((1, 4), np.float32),
    "duplicates": lambda: np.tile(scene()[:1], (SCENE_SIZE, 1)),
    "collinear": lambda: np.linspace((-9, -9, 0, 0), (9, 9, 0, 1), SCENE_SIZE, dtype=np.float32),
    "coplanar": lambda: scene() * np.float32([1, 1, 0, 1]),
    "all NaN": lambda: np.full((SCENE_SIZE, 4), np.nan, np.float32),
    "all infinite": lambda: np.full((SCENE_SIZE, 4), -np.inf, np.float32),
    "some not finite": not_finite,
    "far away": far,
    "denormal": tiny,
}


def strided(points):
    wide = np.full((2 * len(points), 9), 7, points.dtype)
    wide[::2, 2:6] = points
    return wide[::2, 2:6]


def backwards(points):
    return points[::-1].copy()[::-1]


def read_only(points):
    points = points.copy()
    points.setflags(write=False)
    return points


LAYOUTS = {
    "strided": strided,
    "backwards": backwards,
    "read-only": read_only,
    "Fortran order": np.asfortranarray,
    "float64": lambda points: points.astype(np.float64),
}


def takes_arrays(function):
    """Whether a function takes arrays of any family: then it borrows them."""
    return inspect.isfunction(function) and "borrow" in inspect.getsource(function)


def test_every_kernel_function_is_here():
    """The functions of the API, and those of any module of kernels that take arrays of any family."""
    functions = {name for home, names in wl._HOMES.items() if home.startswith("kernels.") for name in names}
    functions = {name for name in functions if name[0].islower()}
    for found in pkgutil.iter_modules(warploom.kernels.__path__):
        if found.ispkg or found.name in ("camera", "interop"):  # they only hand the arrays on
            continue
        module = importlib.import_module(f"warploom.kernels.{found.name}")
        functions |= {name for name in module.__all__ if takes_arrays(getattr(module, name))}
    assert {"bev", "pillarize", "rotated_nms"} <= functions
    assert functions <= {name.partition(" ")[0] for name in CASES}


@pytest.mark.parametrize("kind", INPUTS)
@pytest.mark.parametrize("name", CASES)
def test_odd_input_gives_sound_results(name, kind):
    function, shapes = CASES[name]
    points = INPUTS[kind]()
    before = points.copy()
    n, sound = len(points), np.isfinite(points).all(axis=1)
    results = results_of(function, points)
    assert points.tobytes() == before.tobytes()
    for key, shape in shapes.items():
        array = results[key]
        assert array.ndim == len(shape), key
        wanted = tuple({None: got, "n": n}.get(want, want) for want, got in zip(shape, array.shape, strict=True))
        assert array.shape == wanted, key
        if array.dtype.kind != "f":
            continue
        if key == "pixels":  # NaN for what is not ahead of the camera
            array = array[results["visible"]]
        elif shape[0] == "n":
            array = array[sound][:, sound] if shape[1:] == ("n",) else array[sound]
        elif name.startswith("fit_boxes"):  # NaN for a cluster without a point that is finite
            with_points = np.unique(labels_of(n)[np.isfinite(points[:, :3]).all(axis=1)])
            array = array[with_points[with_points >= 0]]
        elif name in ("inverse_perspective", "dynamic_voxelize", "voxelize", "bev", "range_image") and not sound.all():
            continue  # pixels and intensities that are not finite are handed on
        assert np.isfinite(array).all(), key


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("name", CASES)
def test_the_layout_and_the_type_do_not_matter(name, layout):
    """To the bit; the filters of Kalman compute in double precision what is double: to 1e-5."""
    function, _ = CASES[name]
    points = not_finite()
    if name.startswith("kalman"):
        points = scene()
    expected = results_of(function, points)
    other = LAYOUTS[layout](points)
    before = other.copy()
    results = results_of(function, other)
    assert other.tobytes() == before.tobytes()
    assert results.keys() == expected.keys()
    for key, array in results.items():
        if name.startswith("kalman") and layout == "float64":
            assert array.dtype == np.float64
            np.testing.assert_allclose(array, expected[key], rtol=1e-5, atol=1e-5)
        else:
            assert array.dtype == expected[key].dtype, key
            np.testing.assert_array_equal(array, expected[key], err_msg=key)
