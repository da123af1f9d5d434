"""Profiles: all that ship are good, what they change, and how mistakes are told."""

import subprocess
import sys

import pytest

from warploom.components import pipeline
from warploom.components import profile as profiles
from warploom.components.profile import (
    CONF,
    Profile,
    SensorSpec,
    execution_context,
    load_profile,
    may_have_gpu,
    profile_device,
    use_threads,
)
from warploom.errors import ConfigError, DeviceError
from warploom.kernels import device, threads

SHIPPED = sorted(path.stem for path in (CONF / "profiles").glob("*.yaml"))
NAMED = ("cpu", "cpu-min", "gpu", "h200", "orin", "taichi-cpu", "taichi-vulkan", "hw50_pandar90_13_600")


def test_all_that_were_named_ship():
    assert set(NAMED) <= set(SHIPPED)


@pytest.mark.parametrize("name", SHIPPED)
def test_each_says_what_it_is_for(name):
    if name.startswith("taichi"):
        pytest.importorskip("taichi")
    content = load_profile(name).content
    assert content.profile == name
    assert content.description.endswith(".")
    assert content.latency_budget_ms <= 100


def written(tmp_path, text):
    path = tmp_path / "mine.yaml"
    path.write_text(f"profile: mine\nmodules: [perception]\n{text}\n")
    return path


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("precision: fp16", 1, "precision fp16 is of a GPU; with device cpu leave it out"),
        ("device: cuda:0\nprecision: fp8", 4, "precision: Input should be 'fp32', 'tf32' or 'fp16', found 'fp8'"),
        ("backends: {grund: taichi}", 3, "no kernel 'grund' has a choice of backends; did you mean 'ground'?"),
        ("backends: {ground: taichi:cdua}", 3, "ground: no backend 'taichi:cdua'; did you mean 'taichi:cuda'?"),
        ("threads: {kernels: 0}", 3, "threads.kernels: Input should be greater than or equal to 1"),
        ("threads: {kernel: 2}", 3, "threads.kernel: unknown key; did you mean 'kernels'?"),
        ("threads: {switch_ms: 0}", 3, "threads.switch_ms: Input should be greater than 0"),
        ("sensors:\n  lidar: [top]\n  camera: [top]", 3, "two sensors are called 'top'"),
        ("sensors:\n  lidar:\n    - {name: top, modl: vlp16}", 5, "modl: unknown key; did you mean 'model'?"),
        ("sensors:\n  lidar: [9top]", 4, "String should match pattern"),
        ("sensors:\n  lidar:\n    - {model: vlp16}", 5, "lidar.0.name: this key is missing"),
        ("sensors:\n  lidar:\n    - {name: a, mounting: {xyz: [1, 2]}}", 5, "mounting.xyz.2: this key is missing"),
        (
            "sensors:\n  lidar:\n    - {name: a, mounting: {xyz: [1, 2, .nan]}}",
            5,
            "xyz.2: Input should be a finite number",
        ),
        ("sensors:\n  lidar:\n    - {name: a, mounting: {xyz: [1, 2e9, 0]}}", 5, "less than or equal to 1000"),
        ("sensors:\n  lidar:\n    - {name: a, mounting: {rpy_deg: [.inf, 0, 0]}}", 5, "should be a finite number"),
        ("latency_budget_ms: .inf", 3, "latency_budget_ms: Input should be a finite number"),
        (f"sensors:\n  lidar: [{65 * 'a'}]", 4, "String should match pattern"),
        ("memory_gib: -1", 3, "Input should be greater than 0"),
    ],
)
def test_a_mistake_is_told_with_its_line_and_the_way_out(tmp_path, text, line, said):
    with pytest.raises(ConfigError) as caught:
        load_profile(str(written(tmp_path, text)))
    assert said in str(caught.value)
    assert f"mine.yaml:{line}: " in str(caught.value)


def test_everything_reaches_the_components(tmp_path):
    path = written(
        tmp_path,
        """\
device: cuda:0
precision: tf32
backends: {cluster: warp}
capacity: 1234
latency_budget_ms: 33
threads: {inference: 3, kernels: 5}
models: {detector: head.yaml}
sensors:
  lidar:
    - {name: roof, model: vlp16, rate_hz: 20, mounting: {xyz: [1, 0, 1.5], rpy_deg: [0, 5, 0]}}
  camera: [front, rear]""",
    )
    file = load_profile(str(path))
    context = execution_context(file, "cuda:0")
    assert (context.device, context.precision, context.capacity) == ("cuda:0", "tf32", 1234)
    assert (context.inference_threads, context.latency_budget_ms) == (3, 33)
    assert context.detector == tmp_path / "head.yaml"
    assert context.mounting_height == 1.5, "that of the first LiDAR's mounting"
    assert dict(context.backends) == {"cluster": "warp"}
    assert context.sensor_kinds == {"lidar": ("roof",), "camera": ("front", "rear")}
    assert context.sensors["roof"].model == "vlp16"
    assert context.sensors["front"] == SensorSpec(name="front")
    assert file.content.sensor_names == {"lidar": ["roof"], "camera": ["front", "rear"]}
    assert execution_context(file, "cpu").precision == "fp32", "on a CPU there is no other"


@pytest.mark.parametrize(
    ("text", "seconds"), [("", 1e-4), ("threads: {switch_ms: 2}", 2e-3), ("threads: {switch_ms: null}", None)]
)
def test_how_soon_python_switches_threads_reaches_the_process(tmp_path, monkeypatch, text, seconds):
    given = []
    monkeypatch.setattr(pipeline, "Process", lambda *_, switch_interval_s, **__: given.append(switch_interval_s))
    pipeline.Pipeline.from_profile(str(written(tmp_path, text)))
    assert given == [seconds if seconds is None else pytest.approx(seconds)]


def test_a_height_that_is_said_goes_before_the_mounting(tmp_path):
    path = written(
        tmp_path, "lidar: {mounting_height: 2.5}\nsensors:\n  lidar:\n    - {name: a, mounting: {xyz: [0, 0, 1]}}"
    )
    assert load_profile(str(path)).content.mounting_height == 2.5
    assert load_profile("cpu").content.mounting_height is None


def profile(**more):
    return Profile.model_validate({"profile": "p", "modules": ["perception"], **more})


def test_auto_is_the_first_cuda_device_or_the_cpu(monkeypatch):
    monkeypatch.setattr(profiles, "may_have_gpu", lambda: True)
    monkeypatch.setattr(device, "device_names", lambda: ["cpu", "cuda:0", "cuda:1"])
    assert profile_device(profile(device="auto")) == "cuda:0"
    assert profile_device(profile(device="auto"), "cpu") == "cpu"
    monkeypatch.setattr(device, "device_names", lambda: ["cpu"])
    assert profile_device(profile(device="auto")) == "cpu"
    assert profile_device(profile()) == "cpu"


def test_where_there_can_be_no_gpu_nobody_is_asked(monkeypatch):
    def refuse():
        raise AssertionError("Warp takes seconds to start")

    monkeypatch.setattr(profiles, "may_have_gpu", lambda: False)
    monkeypatch.setattr(device, "device_names", refuse)
    assert profile_device(profile(device="auto")) == "cpu"


def test_no_gpu_can_be_there_where_warp_finds_none_or_a_driver_is():
    """What says that there is none must be right; that there may be one is allowed to be wrong."""
    if any(name.startswith("cuda") for name in device.device_names()):
        assert may_have_gpu()


def test_a_device_that_is_not_there_is_told_with_the_profile():
    with pytest.raises(DeviceError, match="profile 'p': no device 'cuda:77' here"):
        profile_device(profile(device="cuda:77"))
    with pytest.raises(DeviceError, match=r"^no device 'cuda:77' here"):
        profile_device(profile(), "cuda:77")


def test_the_threads_of_kernels_are_set_only_where_it_says_so():
    before = threads.thread_count()
    try:
        use_threads(profile(threads={"kernels": 3}))
        assert threads.thread_count() == 3
        use_threads(profile())
        assert threads.thread_count() == 3
    finally:
        threads.set_thread_count(before)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="/proc tells the peak on Linux")
def test_cpu_min_runs_the_demo_within_a_gibibyte(tmp_path):
    """In a process of its own: its peak of resident memory, kernels compiled in it where there is no cache."""
    code = f"""
import sys
from warploom.cli import main
sys.argv = ["warploom", "demo", "--profile", "cpu-min", "--seconds", "3", "--out", {str(tmp_path / "out")!r}]
try:
    main()
except SystemExit as ended:
    assert not ended.code
# Of this program alone: ru_maxrss would be that of the process it was forked from.
peak = next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM"))
sys.stderr.write(f"PEAK {{peak}}")
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    peak = int(done.stderr.rpartition("PEAK ")[2]) / 1024
    assert peak <= 1024, f"{peak:.0f} MiB"
