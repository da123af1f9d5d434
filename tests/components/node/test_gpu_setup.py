"""On a CPU there is nothing to set up; a GPU answers and tells its memory."""

import pytest

from warploom.components.execution import ExecutionContext
from warploom.components.node.gpu_setup import GpuSetup, GpuSetupConfig


def test_on_a_cpu_it_is_idle():
    one = GpuSetup("gpu", ExecutionContext(device="cpu"))
    one.init(GpuSetupConfig())
    one.start()
    one.stop()
    assert one.idle_because == "the profile's device is the CPU"
    assert one.state() == {"device": "cpu"}


@pytest.mark.cuda
def test_a_gpu_answers(device):
    if device == "cpu":
        pytest.skip("this is about a GPU")
    one = GpuSetup("gpu", ExecutionContext(device=device))
    one.init(GpuSetupConfig(keep_mib=64))
    one.start()
    assert one.idle_because is None
    assert one.state()["device"] == device
    assert one.state()["memory_mib"] > 0
