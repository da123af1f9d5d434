"""Point clouds and images as ROS lays out their bytes, against bytes that `struct` packed by that layout."""

import dataclasses
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warploom.datamesh.messages import sensor, std

HEADER = std.Header(std.Time(7, 5), "lidar")
FIELDS = (
    sensor.PointField("x", 0, 7),
    sensor.PointField("y", 4, 7),
    sensor.PointField("z", 8, 7),
    sensor.PointField("intensity", 16, 2),
    sensor.PointField("ring", 18, 4),
    sensor.PointField("time", 24, 8),
)
POINTS = [(1.5, -2.0, 0.25, 7, 300, 1e-3), (0.0, float("nan"), 3.0, 255, 65535, -2.5), (9.0, 8.0, 7.0, 0, 1, 0.0)]


def packed(order):
    """A point: three floats, 4 bytes of gap, a byte, a gap, 2 bytes, 4 of gap, a double."""
    return b"".join(struct.pack(f"{order}fff4xBxH4xd", *point) for point in POINTS)


def cloud(order="<", height=1, gap=0):
    data, width = packed(order), len(POINTS) // height
    rows = [data[row * width * 32 : (row + 1) * width * 32] + bytes(gap) for row in range(height)]
    return sensor.PointCloud(
        header=HEADER,
        height=height,
        width=width,
        fields=FIELDS,
        is_bigendian=order == ">",
        point_step=32,
        row_step=width * 32 + gap,
        data=np.frombuffer(b"".join(rows), np.uint8),
        is_dense=False,
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("height", "gap"), [(1, 0), (3, 0), (3, 8)])
def test_a_cloud_is_read_by_its_layout(order, height, gap):
    points = cloud(order, height, gap).to_array()
    assert points.shape == ((3,) if height == 1 else (3, 1))
    for point, wanted in zip(points.reshape(-1), POINTS, strict=True):
        assert np.array_equal(np.array(list(point.tolist())), np.array(wanted), equal_nan=True)


def test_a_cloud_without_gaps_is_not_copied():
    one = cloud()
    assert np.shares_memory(one.to_array(), one.data)
    points = np.zeros(5, np.dtype([("x", "f4"), ("y", "f4"), ("z", "f4")]))
    assert np.shares_memory(sensor.PointCloud.from_array(points).data, points)
    plain = np.zeros((5, 4), np.float32)
    assert np.shares_memory(sensor.PointCloud.from_array(plain).data, plain)


@pytest.mark.parametrize("order", ["<", ">"])
def test_positions_and_further_fields_are_taken_as_float32(order):
    xyz = cloud(order).to_xyz("intensity", "ring")
    assert xyz.dtype == np.float32
    assert np.array_equal(xyz, np.array([(*p[:3], p[3], p[4]) for p in POINTS], np.float32), equal_nan=True)


def test_a_plain_array_is_laid_out_as_ros_does():
    points = np.array([[1.0, 2.0, 3.0, 0.5], [4.0, 5.0, 6.0, 1.0]], np.float32)
    one = sensor.PointCloud.from_array(points, HEADER)
    assert one.fields == tuple(sensor.PointField(n, 4 * i, 7) for i, n in enumerate(("x", "y", "z", "intensity")))
    assert (one.header, one.height, one.width, one.point_step, one.row_step) == (HEADER, 1, 2, 16, 32)
    assert one.is_dense
    assert bytes(one.data) == struct.pack("<8f", *points.reshape(-1))
    assert np.array_equal(one.to_xyz("intensity"), points)
    points[1, 1] = np.inf
    assert not sensor.PointCloud.from_array(points).is_dense


number = st.sampled_from(["i1", "u1", "<i2", "<u2", "<i4", "<u4", "<f4", "<f8"])
layouts = st.lists(st.tuples(number, st.integers(1, 3)), min_size=1, max_size=5).map(
    lambda some: [(f"f{i}", code) if count == 1 else (f"f{i}", code, (count,)) for i, (code, count) in enumerate(some)]
)


@settings(deadline=None)
@given(st.data(), layouts, st.sampled_from("<>"), st.booleans())
def test_any_structured_array_comes_back(data, layout, order, aligned):
    kind = np.dtype(layout, align=aligned).newbyteorder(order)
    shape = data.draw(hnp.array_shapes(min_dims=1, max_dims=2, min_side=1, max_side=4))
    size = int(np.prod(shape)) * kind.itemsize
    points = np.frombuffer(data.draw(st.binary(min_size=size, max_size=size)), kind).reshape(shape)
    one = sensor.PointCloud.from_array(points)
    again = one.to_array()
    assert again.shape == (shape if len(shape) == 1 or shape[0] > 1 else shape[1:])
    for name in kind.names:
        a, b = points[name].reshape(-1), again[name].reshape(-1)
        assert a.tobytes() == b.astype(a.dtype).tobytes() or np.array_equal(a, b, equal_nan=True)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"fields": ()}, "of no field"),
        ({"fields": (sensor.PointField("x", 0, 9),)}, "field 'x' has datatype 9, which is none of 1 to 8"),
        ({"fields": (sensor.PointField("x", 30, 7),)}, "field 'x' reaches beyond its point of 32 bytes"),
        ({"fields": (sensor.PointField("x", -1, 7),)}, "reaches beyond"),
        ({"width": 4}, "need 128 bytes each; row_step is 96, and there are 96 bytes"),
        ({"height": 2}, "2 rows of 3 points"),
    ],
)
def test_a_layout_that_does_not_fit_is_refused(change, said):
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(cloud(), **change).to_array()


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.zeros(5), "points must be structured, or of shape"),
        (np.zeros((5, 9)), "k at most 4"),
        (np.zeros((2, 2, 2), [("x", "f4")]), "must be of shape"),
        (np.zeros(2, [("x", "f2")]), "field 'x' is of float16"),
        (np.zeros(2, [("t", "i8")]), "field 't' is of int64"),
        (np.zeros(2, [("x", "<f4"), ("y", ">f4")]), "one byte order"),
    ],
)
def test_points_that_have_no_layout_are_refused(points, said):
    with pytest.raises(ValueError, match=said):
        sensor.PointCloud.from_array(points)


def test_a_field_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="no field 'velocity'; it has: x, y, z, intensity, ring, time"):
        cloud().to_xyz("velocity")


@pytest.mark.parametrize(
    ("encoding", "kind", "channels"),
    [("mono8", "u1", 1), ("mono16", "u2", 1), ("bgr8", "u1", 3), ("rgba8", "u1", 4), ("32FC1", "f4", 1)],
)
def test_an_image_goes_to_opencv_and_back(encoding, kind, channels):
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 255, (4, 6, channels)).astype(kind)
    pixels = pixels[..., 0] if channels == 1 else pixels
    one = sensor.Image.from_array(pixels, encoding, HEADER)
    assert (one.height, one.width, one.step) == (4, 6, 6 * channels * np.dtype(kind).itemsize)
    again = one.to_array()
    assert again.dtype == pixels.dtype
    assert np.array_equal(again, pixels)
    assert np.shares_memory(again, pixels)


def test_an_image_with_gaps_and_of_another_byte_order_is_read():
    rows = b"".join(struct.pack(">3H2x", *row) for row in ((1, 2, 3), (400, 500, 65535)))
    one = sensor.Image(HEADER, 2, 3, "mono16", True, 8, np.frombuffer(rows, np.uint8))
    assert one.to_array().tolist() == [[1, 2, 3], [400, 500, 65535]]


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: sensor.Image.from_array(np.zeros((2, 2, 3), "u1"), "bayer"), "encoding 'bayer' is not known; known"),
        (lambda: sensor.Image.from_array(np.zeros((2, 2), "u1"), "bgr8"), "bgr8 is 3 of uint8 for each pixel"),
        (lambda: sensor.Image.from_array(np.zeros((2, 2, 3)), "bgr8"), "not float64"),
        (lambda: sensor.Image(HEADER, 2, 3, "mono8", False, 2, np.zeros(9, "u1")).to_array(), "step is 2"),
        (lambda: sensor.Image(HEADER, 2, 3, "mono8", False, 3, np.zeros(5, "u1")).to_array(), "there are 5 bytes"),
    ],
)  # fmt: skip
def test_images_that_do_not_fit_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
