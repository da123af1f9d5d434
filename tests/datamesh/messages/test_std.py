"""The messages of ROS: their fields are those of its definitions, and they come back from bytes as they were."""

import dataclasses
import math
import typing

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from warploom.datamesh.messages import decode, encode, geometry, message_type, nav, sensor, std

KINDS = [
    getattr(module, name)
    for module in (std, geometry, nav, sensor)
    for name in module.__all__
    if dataclasses.is_dataclass(getattr(module, name))
]

# From the .msg files of ROS 2 (common_interfaces, Humble), in their order.
FIELDS = {
    "builtin_interfaces.Time": "sec nanosec",
    "std_msgs.Header": "stamp frame_id",
    "std_msgs.Byte": "data",
    "std_msgs.String": "data",
    "std_msgs.Int32": "data",
    "std_msgs.Int64": "data",
    "std_msgs.Float64": "data",
    "geometry_msgs.Point32": "x y z",
    "geometry_msgs.Point": "x y z",
    "geometry_msgs.Vector3": "x y z",
    "geometry_msgs.Quaternion": "x y z w",
    "geometry_msgs.Pose": "position orientation",
    "geometry_msgs.PoseStamped": "header pose",
    "geometry_msgs.Twist": "linear angular",
    "geometry_msgs.PoseWithCovariance": "pose covariance",
    "geometry_msgs.TwistWithCovariance": "twist covariance",
    "nav_msgs.Odometry": "header child_frame_id pose twist",
    "nav_msgs.Path": "header poses",
    "sensor_msgs.PointField": "name offset datatype count",
    "sensor_msgs.PointCloud2": "header height width fields is_bigendian point_step row_step data is_dense",
    "sensor_msgs.Image": "header height width encoding is_bigendian step data",
    "sensor_msgs.CompressedImage": "header format data",
    "sensor_msgs.Imu": "header orientation orientation_covariance angular_velocity angular_velocity_covariance "
    "linear_acceleration linear_acceleration_covariance",
    "sensor_msgs.NavSatStatus": "status service",
    "sensor_msgs.NavSatFix": "header status latitude longitude altitude position_covariance position_covariance_type",
}

RANGES = {"Byte": (0, 255), "Int32": (-(2**31), 2**31 - 1), "Int64": (-(2**63), 2**63 - 1)}
SIZES = {"PoseWithCovariance": 36, "TwistWithCovariance": 36, "Imu": 9, "NavSatFix": 9}


def of_kind(kind):
    """Any message of a type, with fields of the types that it declares."""
    hints = typing.get_type_hints(kind)
    fields = {}
    for one in dataclasses.fields(kind):
        fields[one.name] = of_hint(hints[one.name], kind.__name__, one.name)
    return st.builds(kind, **fields)


def of_hint(hint, kind, name):
    if dataclasses.is_dataclass(hint):
        return of_kind(hint)
    if typing.get_origin(hint) is tuple:
        inner = typing.get_args(hint)[0]
        size = SIZES.get(kind)
        if size is not None:
            return st.tuples(*[st.floats()] * size)
        return st.lists(of_hint(inner, kind, name), max_size=3).map(tuple)
    if hint is np.ndarray:
        return hnp.arrays(np.uint8, st.integers(0, 20))
    if hint is int:
        low, high = (0, 999_999_999) if name == "nanosec" else RANGES.get(kind, (-(2**31), 2**31 - 1))
        return st.integers(low, high)
    return {float: st.floats(), str: st.text(max_size=8), bool: st.booleans()}[hint]


def same(a, b):
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and bool(np.all(a == b))
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a == b or (isinstance(a, float) and math.isnan(a) and math.isnan(b))


def test_the_fields_are_those_of_ros():
    known = {message_type(kind).name: " ".join(message_type(kind).fields) for kind in KINDS}
    assert known == FIELDS


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_every_message_comes_back_from_its_bytes(kind, data):
    one = data.draw(of_kind(kind))
    again = decode(encode(one))
    assert same(one, again)
    assert encode(again) == encode(one)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_message_but_a_field_has_defaults_and_cannot_be_changed(kind):
    one = kind("x") if kind is sensor.PointField else kind()
    name = dataclasses.fields(kind)[0].name
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(one, name, None)


@given(st.integers(-(2**62), 2**62))
def test_a_time_is_a_version_and_back(ns):
    time = std.Time.from_ns(ns)
    assert time.ns == ns
    assert 0 <= time.nanosec < 1_000_000_000
    assert std.Time(3, 5) > std.Time(2, 999_999_999)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: std.Byte(256), "data must be from 0 to 255, not 256"),
        (lambda: std.Byte(-1), "not -1"),
        (lambda: std.Int32(2**31), "not 2147483648"),
        (lambda: std.Int64(2**63), "not 9223372036854775808"),
        (lambda: std.Time(0, 1_000_000_000), "nanosec must be from 0 to 999999999"),
        (lambda: geometry.PoseWithCovariance(covariance=(0.0,) * 9), "36 values, 6 × 6 row by row, not 9"),
        (lambda: geometry.TwistWithCovariance(covariance=()), "not 0"),
        (lambda: sensor.Imu(angular_velocity_covariance=(0.0,)), "angular_velocity_covariance must have 9 values"),
        (lambda: sensor.NavSatFix(position_covariance=(0.0,)), "position_covariance must have 9 values"),
    ],
)
def test_values_that_do_not_fit_are_refused(make, said):
    with pytest.raises(ValueError, match=said):
        make()
