"""Range images against NumPy, whose angles are of float64."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels import range_image as range_module
from warploom.kernels.interop import borrow_points
from warploom.kernels.range_image import RangeProjection, range_image
from warploom.kernels.threads import set_thread_count, thread_count

FOV = (-25.0, 3.0)
VLP16 = np.arange(-15.0, 15.1, 2.0)


def row_edges(rows, fov=FOV, elevations=None):
    """Elevations of the rows' edges from the top [deg]."""
    if elevations is None:
        return np.linspace(fov[1], fov[0], rows + 1)
    between = (elevations[1:] + elevations[:-1]) / 2
    edges = [2 * elevations[0] - between[0], *between, 2 * elevations[-1] - between[-1]]
    return np.array(edges)[::-1]


def reference(points, shape, fov=FOV, elevations=None, ring=None):
    """Every angle by float64; then sorted by pixel, range and index: the first of each pixel is seen."""
    rows, columns = shape
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        x, y, z = points[:, :3].T
        distance = np.sqrt(x * x + y * y + z * z)  # float32, as it is shown
        x, y, z = points[:, :3].T.astype(np.float64)
        sine = z / np.sqrt(x * x + y * y + z * z)
    place = (0.5 - np.arctan2(y, x) / (2 * np.pi)) * columns
    row = np.searchsorted(-np.sin(np.deg2rad(row_edges(rows, fov, elevations))), -sine, side="right") - 1
    if ring is not None:
        row = rows - 1 - ring.astype(np.int64)
    seen = np.flatnonzero(np.isfinite(distance) & (distance > 0) & (row >= 0) & (row < rows))
    pixel = row[seen] * columns + np.floor(place[seen]).astype(np.int64) % columns
    order = np.lexsort([seen, distance[seen], pixel])
    pixel, first = np.unique(pixel[order], return_index=True)
    drawn = seen[order][first]
    channels, index = np.zeros((5, rows * columns), np.float32), np.full(rows * columns, -1, np.int32)
    channels[0, pixel], index[pixel] = distance[drawn], drawn
    channels[1 : 1 + points.shape[1], pixel] = points[drawn, :4].T
    return channels.reshape(5, *shape), index.reshape(shape)


def cloud(n, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(0, [15, 15, 2, 1], (n, 4)).astype(np.float32)
    points[rng.random(n) < 0.02, rng.integers(0, 3)] = rng.choice([np.nan, np.inf, -np.inf])
    points[rng.random(n) < 0.1] = points[: max(n, 1)][-1] if n else 0  # duplicates
    return points


def assert_equal(image, expected):
    assert np.array_equal(image.index, expected[1])
    assert np.array_equal(image.channels, expected[0])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 4000), st.sampled_from([(64, 1024), (1, 1), (16, 7), (128, 4096)]))
def test_equals_numpy_to_the_bit(seed, n, shape):
    """Pixels could differ where a point lies within 1e-15 rad of an edge; none of these does."""
    points = cloud(n, seed)
    image = range_image(points, shape, vertical_fov=FOV)
    assert image.channels.dtype == np.float32
    assert image.index.dtype == np.int32
    assert_equal(image, reference(points, shape))


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([(-90.0, 90.0), (-1.0, 45.0), (10.0, 11.0)]))
def test_any_field_of_view(seed, fov):
    points = cloud(3000, seed)
    assert_equal(range_image(points, (40, 360), vertical_fov=fov), reference(points, (40, 360), fov))


def test_rows_of_a_table_of_lasers():
    points = cloud(5000, 3)
    uneven = np.array([-25.0, -15.6, -8.8, -4.0, -3.6, -3.3, -0.3, 0.0, 0.3, 4.7, 15.0])
    for table in (VLP16, uneven):
        shape = (len(table), 900)
        assert_equal(range_image(points, shape, elevations=table), reference(points, shape, elevations=table))


def test_rows_by_ring():
    points = cloud(5000, 4)
    ring = np.random.default_rng(0).integers(0, 20, 5000)  # some beyond the image
    for given_ring in (ring, ring.astype(np.uint16), ring.astype(np.int32)):
        assert_equal(range_image(points, (16, 900), ring=given_ring), reference(points, (16, 900), ring=ring))


@pytest.mark.real
def test_equals_numpy_on_a_scan(shared_data):
    points = np.fromfile(shared_data / "semantic_kitti" / "full" / "08_000000.bin", np.float32).reshape(-1, 4)
    for shape in ((64, 1024), (64, 2083)):
        assert_equal(range_image(points, shape), reference(points, shape))


def test_the_image_looks_as_the_sensor_does():
    """Ahead in the middle, left on the left, up above."""
    ahead, left, behind, right = np.float32([[10, 0, 0], [0, 10, 0], [-10, 0, 0], [0, -10, 0]])
    points = np.stack([ahead, left, behind, right, ahead + np.float32([0, 0, 0.3])])
    index = range_image(points, (4, 8), vertical_fov=(-2.0, 2.0)).index
    # Elevation 0 is the edge between rows 1 and 2: it belongs to the lower.
    assert [np.argwhere(index == i).tolist() for i in range(5)] == [[[2, 4]], [[2, 2]], [[2, 0]], [[2, 6]], [[0, 4]]]


def test_directions_on_the_edges_of_columns():
    """A point exactly on the axes and diagonals belongs to the column that begins there."""
    x = np.float32([-1, -3, 0, 7, 5, 2, 0, -9, -2])
    y = np.float32([0, 3, 4, 7, 0, -2, -6, -9, -0.0])
    image = range_image(np.column_stack([x, y, 0 * x]), (1, 8), vertical_fov=(-1.0, 1.0))
    assert image.index[0].tolist() == [0, 1, 2, 3, 4, 5, 6, 7]


def test_of_equal_ranges_the_first_point_is_drawn():
    points = np.float32([[9, 0, 0, 1], [5, 0, 0, 2], [5, 0, 0, 3]])
    assert range_image(points, (1, 1)).channels[:, 0, 0].tolist() == [5, 5, 0, 0, 2]
    assert range_image(points[::-1], (1, 1)).channels[4, 0, 0] == 3


@pytest.mark.parametrize("scale", [1e-45, 1e-30, 1e-19, 1e5, 1e18, 1e30])
def test_far_and_tiny_coordinates(scale):
    """What has no range in float32 is left out; the rest is where it belongs."""
    points = (cloud(500, 5) * np.float32(scale)).astype(np.float32)
    assert_equal(range_image(points, (16, 64)), reference(points, (16, 64)))


def test_no_point_and_one_point():
    empty = range_image(np.zeros((0, 4), np.float32), (2, 4))
    assert not empty.channels.any()
    assert (empty.index == -1).all()
    assert (range_image(np.float32([[1, 0, 0]]), (2, 4)).index >= 0).sum() == 1
    assert (range_image(np.zeros((5, 3), np.float32), (2, 4)).index == -1).all()


def test_any_layout_of_the_input():
    points = cloud(1000, 6)
    expected = reference(points, (16, 64))
    frozen = points.copy()
    frozen.setflags(write=False)
    for given_points in (frozen, np.asfortranarray(points), points.astype(np.float64), np.repeat(points, 2, 0)[::2]):
        assert_equal(range_image(given_points, (16, 64)), expected)


def launched(points, parts=None, ring=None):
    before = thread_count()
    try:
        set_thread_count(parts or before)
        plan = RangeProjection(capacity=len(points), shape=(64, 1024), device="cpu")
    finally:
        set_thread_count(before)
    table = wp.array(points, dtype=wp.float32, device="cpu")
    ring = None if ring is None else wp.array(ring, dtype=wp.uint16, device="cpu")
    given_so = borrow_points(table)
    for _ in range(2):  # the second finds the workspace as the first leaves it
        plan.launch(given_so.xyz, given_so.intensity, wp.array([len(points)], dtype=wp.int32, device="cpu"), ring)
    return plan.channels.numpy().tobytes(), plan.index.numpy().tobytes()


@pytest.mark.parametrize("by_ring", [False, True])
def test_parts_and_many_threads_give_the_same_bytes(by_ring, monkeypatch):
    """Parts of a CPU, and the kernels of a GPU on a CPU."""
    points = cloud(70_000, 5)
    ring = np.random.default_rng(6).integers(0, 70, len(points)).astype(np.uint16) if by_ring else None
    expected = launched(points, 1, ring)
    for parts in (2, 3, 7):
        assert launched(points, parts, ring) == expected
    monkeypatch.setattr(range_module, "_in_parts", lambda _: False)
    assert launched(points, None, ring) == expected


def test_arrays_of_other_families():
    import torch

    points, ring = cloud(1000, 7), np.random.default_rng(1).integers(0, 16, 1000)
    expected = reference(points, (16, 64), ring=ring)
    image = range_image(torch.from_numpy(points), (16, 64), ring=torch.from_numpy(ring))
    assert isinstance(image.channels, torch.Tensor)
    assert np.array_equal(image.channels.numpy(), expected[0])
    assert np.array_equal(image.index.numpy(), expected[1])
    image = range_image(wp.array(points, dtype=wp.float32, device="cpu"), (16, 64), ring=ring)
    assert np.array_equal(image.channels.numpy(), expected[0])


def test_the_plan_reads_its_count_and_leaves_nothing_behind(device):
    first, second = cloud(4000, 1), cloud(3000, 2)
    plan = RangeProjection(capacity=4096, shape=(32, 512), device=device)
    for points, n in ((first, 4000), (second, 1000), (first, 2500), (first, 0)):
        plan.launch(
            wp.array(points[:, :3].copy(), dtype=wp.vec3, device=device),
            wp.array(points[:, 3].copy(), dtype=wp.float32, device=device),
            wp.array([n], dtype=wp.int32, device=device),
        )
        channels, index = reference(points[:n], (32, 512))
        assert np.array_equal(plan.channels.numpy(), channels)
        assert np.array_equal(plan.index.numpy(), index)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"shape": (0, 4)}, ValueError, "shape must be"),
        ({"shape": (4,)}, ValueError, "shape must be"),
        ({"shape": (1, 1 << 17)}, ValueError, "shape must be"),
        ({"vertical_fov": (3, -25)}, ValueError, "vertical_fov must be"),
        ({"vertical_fov": (-100, 3)}, ValueError, "vertical_fov must be"),
        ({"elevations": (1.0, 2.0)}, ValueError, "elevations must be"),
        ({"elevations": (1.0, 2.0, 2.0, 3.0)}, ValueError, "elevations must be"),
        ({"ring": np.zeros(3, int)}, ValueError, "ring must have shape"),
        ({"ring": np.zeros(5)}, TypeError, "ring must be of an integer type"),
    ],
)
def test_wrong_arguments_are_refused(arguments, error, message):
    with pytest.raises(error, match=message):
        range_image(np.zeros((5, 4), np.float32), **{"shape": (4, 8), **arguments})
