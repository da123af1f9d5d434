"""What is read from, and set in, an ONNX file, against the onnx package; damage of any kind is an error, and soon."""

import numpy as np
import onnx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from warploom.models.onnx_file import NotOnnxError, external_data, opset, stamp, with_batch


def small_model(version=17):
    weight = numpy_helper.from_array(np.ones((4, 3, 1, 1), np.float32), "w")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["x", "w"], ["y"])],
        "g",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 4, 8, 8])],
        [weight],
    )
    opsets = [helper.make_opsetid("custom.domain", 3), helper.make_opsetid("", version)]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


MODEL = small_model().SerializeToString()


@pytest.mark.parametrize("version", [11, 17])
def test_the_opset_is_that_of_the_default_domain(version):
    assert opset(small_model(version).SerializeToString()) == version


def test_weights_elsewhere_are_noticed():
    assert not external_data(MODEL)
    model = small_model()
    model.graph.initializer[0].data_location = TensorProto.EXTERNAL
    assert external_data(model.SerializeToString())


def test_a_batch_is_set_in_all_shapes_and_nowhere_else():
    changed = onnx.load_model_from_string(with_batch(MODEL, 5))
    assert [d.dim_value for d in changed.graph.input[0].type.tensor_type.shape.dim] == [5, 3, 8, 8]
    assert [d.dim_value for d in changed.graph.output[0].type.tensor_type.shape.dim] == [5, 4, 8, 8]
    onnx.checker.check_model(changed, full_check=True)
    assert with_batch(MODEL, 1) == MODEL
    with pytest.raises(ValueError, match="batch must be 1 to 127"):
        with_batch(MODEL, 128)


def test_notes_are_metadata():
    noted = onnx.load_model_from_string(stamp(MODEL, classes="car," * 100, by="me"))
    assert {entry.key: entry.value for entry in noted.metadata_props} == {"classes": "car," * 100, "by": "me"}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, len(MODEL) - 1), st.integers(0, 255), st.booleans())
def test_damage_is_an_error_or_harmless(at, value, cut):
    data = MODEL[:at] if cut else MODEL[:at] + bytes([value]) + MODEL[at + 1 :]
    for read in (opset, external_data, lambda some: with_batch(some, 2)):
        try:
            read(data)
        except NotOnnxError:
            continue


def test_endless_numbers_end():
    """Were it to read on, the number would grow to 35 million bits, a byte at a time."""
    with pytest.raises(NotOnnxError, match="more than ten bytes"):
        opset(b"\xff" * 5_000_000)


@pytest.mark.parametrize("data", [b"", b"\x00", b"GIF89a" * 50, bytes(1000)])
def test_what_is_no_model_is_said(data):
    with pytest.raises(NotOnnxError):
        opset(data)
