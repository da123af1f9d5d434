"""Mountings become matrices, which are committed as long as the component runs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from warploom.components.execution import ExecutionContext
from warploom.components.node.transforms import (
    StaticTransforms,
    TransformPublisher,
    TransformPublisherConfig,
    mounting_matrix,
)
from warploom.components.profile import MountingSpec, SensorSpec
from warploom.dag import Trigger
from warploom.datamesh import DataMesh, Status
from warploom.datamesh.messages.codec import decode, encode

angle = st.floats(-180, 180)


@given(st.tuples(*[st.floats(-10, 10)] * 3), st.tuples(angle, angle, angle))
def test_a_mounting_turns_about_x_then_y_then_z_as_scipy_does(xyz, rpy):
    """Within 1e-12: both compute in float64."""
    matrix = mounting_matrix(xyz, rpy)
    np.testing.assert_allclose(matrix[:3, :3], Rotation.from_euler("xyz", rpy, degrees=True).as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(matrix[:3, 3], xyz)
    np.testing.assert_array_equal(matrix[3], [0, 0, 0, 1])


def publisher(*sensors):
    one = TransformPublisher("tf", ExecutionContext(sensors={sensor.name: sensor for sensor in sensors}))
    mesh = DataMesh()
    one.bind(mesh, {"transforms": "tf"})
    one.init(TransformPublisherConfig())
    return one, mesh


def test_it_commits_the_mountings_of_the_profile():
    roof = SensorSpec(name="roof", mounting=MountingSpec(xyz=(1, 0, 2), rpy_deg=(0, 0, 90)))
    one, mesh = publisher(roof, SensorSpec(name="wheels"))
    for version in (1, 2):
        assert one.process(Trigger(version)) is Status.OK
    found = mesh.window("tf").snapshot().last()
    assert (found.parent, found.frames) == ("vehicle", ("roof",))
    np.testing.assert_allclose(found["roof"] @ [1, 0, 0, 1], [1, 1, 2, 1], atol=1e-12)
    assert one.state() == {"transforms": 1, "without mounting": "wheels"}
    assert one.idle_because is None
    with pytest.raises(KeyError, match="no transform of 'rof'; there are: roof"):
        found["rof"]


def test_without_any_mounting_it_is_idle_and_commits_nothing():
    one, mesh = publisher(SensorSpec(name="roof"))
    assert one.idle_because == "the profile gives no sensor a mounting"
    assert one.process(Trigger(1)) is Status.MISS
    assert len(mesh.window("tf").snapshot()) == 0


def test_transforms_are_a_message():
    sent = StaticTransforms(parent="vehicle", frames=("a",), matrices=np.eye(4)[None])
    back = decode(encode(sent))
    assert (back.parent, back.frames) == (sent.parent, sent.frames)
    np.testing.assert_array_equal(back.matrices, sent.matrices)
