"""Networks bound to Warp arrays: what is computed, which provider computes, and what is refused."""

import numpy as np
import pytest
import torch
import warp as wp

from warploom.errors import ModelError
from warploom.models.network import Network, provider_settings, said_fallback, wanted_providers
from warploom.models.onnx_file import stamp


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    """y = 2 x + 1, and the sum of x over its columns."""

    class Doubled(torch.nn.Module):
        def forward(self, x):
            return 2 * x + 1, x.sum(dim=1)

    path = tmp_path_factory.mktemp("model") / "doubled.onnx"
    torch.onnx.export(
        Doubled(), (torch.zeros(1, 3),), str(path), input_names=["x"], output_names=["y", "sum"], opset_version=17,
        dynamo=False, dynamic_axes={"x": {0: "rows"}, "y": {0: "rows"}, "sum": {0: "rows"}},
    )  # fmt: skip
    return path


SPEC = ({"x": (None, 3)}, {"y": (None, 3), "sum": (None,)})


def run(network, rows):
    x = wp.array(np.arange(3.0 * rows, dtype=np.float32).reshape(rows, 3), dtype=wp.float32, device="cpu")
    y, total = wp.zeros((rows, 3), dtype=wp.float32, device="cpu"), wp.zeros(rows, dtype=wp.float32, device="cpu")
    network.bind_input("x", x)
    network.bind_output("y", y)
    network.bind_output("sum", total)
    network.run()
    return x, y, total


def test_outputs_lie_in_the_arrays_that_were_bound(model):
    network = Network(model, *SPEC)
    x, y, total = run(network, 4)
    np.testing.assert_array_equal(y.numpy(), 2 * x.numpy() + 1)
    np.testing.assert_array_equal(total.numpy(), x.numpy().sum(axis=1))


def test_inputs_are_read_where_they_lie_at_each_run(model):
    network = Network(model, *SPEC)
    x, y, _ = run(network, 2)
    x.numpy()[:] = 7.0
    network.run()
    assert (y.numpy() == 15.0).all()


def test_arrays_may_be_bound_anew_with_another_length(model):
    network = Network(model, *SPEC)
    run(network, 2)
    x, y, _ = run(network, 5)
    np.testing.assert_array_equal(y.numpy(), 2 * x.numpy() + 1)


@pytest.mark.parametrize(
    ("inputs", "outputs", "message"),
    [
        ({"z": (None, 3)}, SPEC[1], r"its input is .*'x'.* but the card says .*'z'"),
        ({"x": (None, 4)}, SPEC[1], r"its input is .*3.* but the card says .*4"),
        ({"x": (None, 3, 1)}, SPEC[1], "its input is"),
        (SPEC[0], {"y": (None, 3)}, "its output is"),
        (SPEC[0], {"sum": (None,), "y": (None, 3)}, "its output is"),
    ],
)
def test_a_model_that_is_not_as_said_is_refused(model, inputs, outputs, message):
    with pytest.raises(ModelError, match=message):
        Network(model, inputs, outputs)


def test_a_model_of_other_classes_is_refused(model, tmp_path):
    stamped = tmp_path / "stamped.onnx"
    stamped.write_bytes(stamp(model.read_bytes(), classes="car,person"))
    Network(stamped, *SPEC, classes=("car", "person"))
    Network(stamped, *SPEC)
    with pytest.raises(ModelError, match="its classes are car,person, but the card says person,car"):
        Network(stamped, *SPEC, classes=("person", "car"))


def test_what_is_no_model_is_refused(tmp_path):
    path = tmp_path / "junk.onnx"
    path.write_bytes(b"\x08\x07" + bytes(100))
    with pytest.raises(ModelError, match="ONNX Runtime cannot load it"):
        Network(path, *SPEC)


def test_a_gpu_is_tried_first_and_the_cpu_last():
    assert wanted_providers("fp32", gpu=False) == ("cpu",)
    assert wanted_providers("fp32", gpu=True) == wanted_providers("tf32", gpu=True) == ("cuda", "cpu")
    assert wanted_providers("fp16", gpu=True) == ("tensorrt", "cuda", "cpu")


def test_a_provider_on_a_gpu_computes_in_the_precision_asked_for_on_warps_stream():
    place = {"device_id": 1, "user_compute_stream": "1234"}
    assert provider_settings("cpu", "fp32", 1, 1234) == "CPUExecutionProvider"
    assert provider_settings("cuda", "fp32", 1, 1234) == ("CUDAExecutionProvider", place | {"use_tf32": 0})
    assert provider_settings("cuda", "tf32", 1, 1234) == ("CUDAExecutionProvider", place | {"use_tf32": 1})
    assert provider_settings("cuda", "fp16", 1, 1234)[1]["use_tf32"] == 1
    assert provider_settings("tensorrt", "fp16", 1, 1234) == (
        "TensorrtExecutionProvider", place | {"trt_fp16_enable": True},
    )  # fmt: skip


def test_what_falls_back_is_said():
    assert said_fallback(("cuda", "cpu"), "cuda", "fp32") == ""
    assert said_fallback(("cuda", "cpu"), "cpu", "fp32") == "no provider cuda here: the network runs on cpu"
    assert said_fallback(("tensorrt", "cuda", "cpu"), "cuda", "fp16").endswith("runs on cuda, in tf32 in place of fp16")


def test_wrong_arguments_are_refused(model):
    with pytest.raises(ValueError, match="threads must be at least 1"):
        Network(model, *SPEC, threads=0)
    with pytest.raises(ValueError, match="precision must be one of"):
        Network(model, *SPEC, precision="int4")
    with pytest.raises(ValueError, match="providers must be some of"):
        Network(model, *SPEC, providers=("rocm",))
    with pytest.raises(ValueError, match="providers must be some of"):
        Network(model, *SPEC, providers=())
    with pytest.raises(ValueError, match="in a list, not 'cpu'"):
        Network(model, *SPEC, providers="cpu")
    with pytest.raises(ValueError, match=r"threads must be a whole number, not 1\.5"):
        Network(model, *SPEC, threads=1.5)
