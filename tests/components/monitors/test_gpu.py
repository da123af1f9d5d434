# ruff: noqa: N802 – the names are those of NVML
"""The GPU monitor on recorded output of nvidia-smi, and on what NVML says; and where there is no GPU."""

import math
import types

import pytest

from warploom.components.monitors import gpu
from warploom.components.monitors.gpu import GpuMonitor, GpuMonitorConfig, find_reader, parse_nvidia_smi, read_nvml
from warploom.dag import Trigger
from warploom.datamesh import DataMesh, Status
from warploom.datamesh.clock import ManualClock

RECORDED = """\
0, NVIDIA H200, 87, 41234, 143771, 61, 498.27
1, NVIDIA H200, 0, 4, 143771, 30, 77.10
"""
EMBEDDED = "0, Orin (nvgpu), [N/A], [N/A], [N/A], [N/A], [N/A]\n"


def test_a_recorded_table_is_read():
    first, second = parse_nvidia_smi(RECORDED)
    assert (first.index, first.name, first.load_percent, first.memory_used_mib) == (0, "NVIDIA H200", 87.0, 41234.0)
    assert (second.memory_total_mib, second.temperature_c, second.power_w) == (143771.0, 30.0, 77.1)


def test_what_an_embedded_gpu_does_not_tell_is_nan():
    (only,) = parse_nvidia_smi(EMBEDDED)
    assert only.name == "Orin (nvgpu)"
    assert math.isnan(only.load_percent)
    assert math.isnan(only.power_w)


def test_a_name_with_a_comma_is_one_field():
    (only,) = parse_nvidia_smi('0, "Tesla, old", 1, 2, 3, 4, 5\n')
    assert only.name == "Tesla, old"


@pytest.mark.parametrize("text", ["NVIDIA-SMI has failed\n", "0, a, 1, 2\n", "x, a, 1, 2, 3, 4, 5\n"])
def test_another_text_is_refused(text):
    with pytest.raises(ValueError, match=r"fields|invalid literal"):
        parse_nvidia_smi(text)


def test_no_line_is_no_gpu():
    assert parse_nvidia_smi("\n") == []


class Nvml(types.SimpleNamespace):
    """What nvidia-ml-py offers, with one GPU that does not tell its power."""

    class NVMLError(Exception):
        pass

    NVML_TEMPERATURE_GPU = 0

    def nvmlInit(self):
        pass

    def nvmlDeviceGetCount(self):
        return 1

    def nvmlDeviceGetHandleByIndex(self, index):
        return f"handle {index}"

    def nvmlDeviceGetName(self, handle):
        return b"Orin"

    def nvmlDeviceGetUtilizationRates(self, handle):
        return types.SimpleNamespace(gpu=12, memory=3)

    def nvmlDeviceGetMemoryInfo(self, handle):
        return types.SimpleNamespace(used=3 << 20, total=8 << 30)

    def nvmlDeviceGetTemperature(self, handle, sensor):
        return 44

    def nvmlDeviceGetPowerUsage(self, handle):
        raise self.NVMLError


def test_nvml_is_read():
    (only,) = read_nvml(Nvml())
    assert (only.name, only.load_percent, only.memory_used_mib, only.memory_total_mib) == ("Orin", 12.0, 3.0, 8192.0)
    assert only.temperature_c == 44.0
    assert math.isnan(only.power_w)


def test_nvml_comes_before_the_program(monkeypatch):
    monkeypatch.setattr(gpu.importlib, "import_module", lambda name: Nvml())
    reader, name = find_reader()
    assert name == "nvml"
    assert reader()[0].name == "Orin"


def without_nvml(monkeypatch, which, output="", code=0):
    def missing(name):
        raise ImportError(name)

    monkeypatch.setattr(gpu.importlib, "import_module", missing)
    monkeypatch.setattr(gpu.shutil, "which", lambda name: which)
    done = types.SimpleNamespace(returncode=code, stdout=output, stderr="")
    monkeypatch.setattr(gpu.subprocess, "run", lambda *_, **__: done)


def test_without_either_there_is_no_gpu(monkeypatch):
    without_nvml(monkeypatch, None)
    assert find_reader() == (None, "there is no NVIDIA GPU here: neither NVML nor nvidia-smi is there")


def test_a_program_that_fails_is_told(monkeypatch):
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", "NVIDIA-SMI has failed because …\n", 9)
    assert find_reader() == (None, "nvidia-smi does not tell: NVIDIA-SMI has failed because …")
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", "")
    assert find_reader() == (None, "the driver knows no GPU")


def monitor():
    clock = ManualClock()
    mesh = DataMesh(clock=clock)
    one = GpuMonitor("gpus")
    one.bind(mesh, {"gpus": "g"})
    one.init(GpuMonitorConfig(warn_celsius=60))
    return one, mesh, clock


def test_readings_are_committed_and_a_hot_gpu_is_logged(monkeypatch, caplog):
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", RECORDED)
    one, mesh, _ = monitor()
    assert one.process(Trigger(1)) is Status.OK
    assert [reading.index for reading in mesh.window("g").snapshot().last().gpus] == [0, 1]
    assert one.idle_because is None
    assert one.state()["gpu 0"] == "87 %, 41234 of 143771 MiB, 61 °C, 498 W"
    assert "GPU 0 (NVIDIA H200) has 61 °C" in caplog.text
    assert "GPU 1" not in caplog.text


def test_where_there_is_none_it_is_idle_and_looks_again_once_a_minute(monkeypatch):
    without_nvml(monkeypatch, None)
    one, mesh, clock = monitor()
    assert one.process(Trigger(1)) is Status.MISS
    assert one.idle_because.startswith("there is no NVIDIA GPU here")
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", RECORDED)
    clock.advance(59_000_000_000)
    assert one.process(Trigger(2)) is Status.MISS
    clock.advance(2_000_000_000)
    assert one.process(Trigger(3)) is Status.OK
    assert len(mesh.window("g").snapshot()) == 1


def test_a_gpu_that_falls_off_the_bus_is_counted_and_said(monkeypatch):
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", RECORDED)
    one, mesh, _ = monitor()
    one.process(Trigger(1))
    without_nvml(monkeypatch, "/usr/bin/nvidia-smi", "Unable to determine the device handle\n", 15)
    assert one.process(Trigger(2)) is Status.MISS
    assert one.idle_because == "nvidia-smi cannot be read: Unable to determine the device handle"
    assert mesh.losses["gpus", "not_read"] == 1
