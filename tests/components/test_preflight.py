"""Preflight: what is missing is named, each with the way out."""

import importlib.util
import json
import shutil
import socket

import pytest

from warploom.components import preflight
from warploom.components.preflight import (
    check_backends,
    check_device,
    check_memory,
    check_models,
    check_ports,
    check_remote,
    check_sensors,
    check_settings,
)
from warploom.components.profile import load_profile
from warploom.dag import load_module
from warploom.dag.launch.lookup import CommandLine, load_launch_file
from warploom.dag.launch.plan import LaunchPlan
from warploom.dag.launch.preflight import registered_checks
from warploom.models.card import DEFAULT_CARD

MODULE = """\
module: mine
components:
  - name: metrics
    kind: generic
    class: warploom.components.node.metric_agent.MetricAgent
    config: {{ port: {port} }}
  - name: driver
    kind: generic
    class: warploom.components.node.lidar.LidarDriver
    config: {{ sensor: roof{more} }}
    outputs: {{ cloud: raw }}
"""


@pytest.fixture
def plan(tmp_path):
    """Makes a plan of one process from the keys of a profile and of the module above."""

    def make(text="", port="null", more=""):
        (tmp_path / "p.yaml").write_text(f"profile: mine\nmodules: [perception]\n{text}\n")
        (tmp_path / "mine.yaml").write_text(MODULE.format(port=port, more=more))
        module = load_module(tmp_path / "mine.yaml")
        return LaunchPlan(
            CommandLine("process", ["mine.yaml"]), {"process": (module,)}, load_profile(str(tmp_path / "p.yaml"))
        )

    return make


def one(findings, ok):
    (found,) = findings
    assert found.ok is ok, found
    assert bool(found.way_out) is not ok, "what is missing comes with the way out"
    return found.message + " → " + found.way_out


def test_all_checks_are_registered():
    assert {"device", "backend", "memory", "models", "ports", "sensors", "remote"} <= set(registered_checks())


def test_a_device_that_is_there_and_one_that_is_not(plan):
    assert "cpu for profile 'mine'" in one(check_device(plan()), True)
    said = one(check_device(plan("device: cuda:77")), False)
    assert "no device 'cuda:77' here" in said
    assert "--set profile.device=cpu" in said


def test_the_cpu_in_the_place_of_a_gpu_is_said(plan, monkeypatch):
    monkeypatch.setattr(preflight, "profile_device", lambda profile: "cpu")
    assert "no CUDA device is here, so the kernels run on the CPU" in one(check_device(plan("device: auto")), True)


@pytest.mark.parametrize(
    ("providers", "precision", "said"),
    [
        (["CPUExecutionProvider"], "fp32", "networks run on the CPU beside cuda:0"),
        (["CUDAExecutionProvider"], "fp16", "networks compute in tf32, not fp16"),
        (["CUDAExecutionProvider"], "tf32", "networks run on cuda:0 in tf32"),
    ],
)
def test_what_networks_run_on_is_said(plan, monkeypatch, providers, precision, said):
    import onnxruntime

    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: providers)
    monkeypatch.setattr(preflight, "profile_device", lambda profile: "cuda:0")
    first, second = check_device(plan(f"device: cuda:0\nprecision: {precision}"))
    assert first.ok
    assert second.ok
    assert said in second.message


def test_memory(plan, monkeypatch):
    gib = 2**30
    monkeypatch.setattr(preflight, "memory_limit_bytes", lambda: round(3.9 * gib))
    assert "3.9 GiB" in one(check_memory(plan("memory_gib: 4")), True)
    said = one(check_memory(plan("memory_gib: 8")), False)
    assert "has 3.9 GiB; profile 'mine' asks for 8" in said
    assert "--profile cpu-min" in said
    assert list(check_memory(plan())) == []
    monkeypatch.setattr(preflight, "memory_limit_bytes", lambda: None)
    assert "does not tell" in one(check_memory(plan("memory_gib: 8")), True)
    assert list(check_memory(plan("device: cuda:77\nmemory_gib: 8"))) == [], "the check of the device says it"


def test_the_shipped_model_is_the_one_of_its_card(plan):
    assert "has the sha256 of its card" in one(check_models(plan()), True)


def test_a_model_that_was_changed_is_told(plan, tmp_path):
    card = tmp_path / "head.yaml"
    shutil.copy(DEFAULT_CARD, card)
    model = DEFAULT_CARD.with_suffix(".onnx")
    (tmp_path / model.name).write_bytes(model.read_bytes()[:-1] + b"\0")
    said = one(check_models(plan("models: {detector: head.yaml}")), False)
    assert "its sha256 is" in said
    assert "fetch model and card again" in said


def test_a_model_that_is_not_there_is_told(plan):
    assert "cannot read the head's card" in one(check_models(plan("models: {detector: nowhere.yaml}")), False)


def test_ports(plan):
    assert list(check_ports(plan(port="null"))) == []
    assert list(check_ports(plan(port=0))) == []
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        said = one(check_ports(plan(port=port)), False)
    assert f"process/metrics: port {port} is taken" in said
    assert "--set metrics.port=N takes another, 0 any that is free" in said
    assert "is free" in one(check_ports(plan(port=port)), True)


def test_two_components_on_one_port_are_told(plan):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    whole = plan(port=port)
    both = LaunchPlan(whole.file, {"a": whole.modules["process"], "b": whole.modules["process"]}, whole.profile)
    first, second = check_ports(both)
    assert first.ok
    assert not second.ok
    assert f"b/metrics: a/metrics is to answer on port {port} already" in second.message


@pytest.fixture
def sends(plan, tmp_path):
    """Makes the same plan with topics that go between hosts."""

    def make(*topics, listen=()):
        whole = plan()
        text = f"node: one\nprocesses: [{{name: process, modules: [mine.yaml]}}]\nremote: {{{', '.join(topics)}}}\n"
        (tmp_path / "l.yaml").write_text(f"{text}zenoh: {json.dumps({'listen': listen})}\n")
        return LaunchPlan(load_launch_file(tmp_path / "l.yaml"), whole.modules, whole.profile)

    return make


def test_a_topic_between_hosts_that_the_node_has_no_use_for_is_told(sends):
    assert list(check_remote(sends())) == []
    assert list(check_remote(sends("raw: zenoh"))) == []
    said = one(check_remote(sends("raw: zenoh", "rwa: zenoh")), False)
    assert "topic 'rwa'; did you mean 'raw'?" in said
    assert "l.yaml" in said


def test_an_endpoint_that_cannot_be_listened_at_is_told(sends):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        assert list(check_remote(sends(listen=[where]))) == []  # nothing goes between hosts
        said = one(check_remote(sends("raw: zenoh", listen=[where])), False)
        everywhere = f"tcp/0.0.0.0:{taken.getsockname()[1]}"
        assert f"zenoh: {everywhere} is taken" in one(check_remote(sends("raw: zenoh", listen=[everywhere])), False)
    assert f"zenoh: {where} is taken: Address already in use" in said
    assert "correct zenoh.listen of" in said
    assert "is free" in one(check_remote(sends("raw: zenoh", listen=[where])), True)
    assert "is free" in one(check_remote(sends("raw: zenoh", listen=["tcp/[::1]:0#iface=lo"])), True)
    assert list(check_remote(sends("raw: zenoh", listen=["udp/127.0.0.1:7447", "unixsock-stream//tmp/x"]))) == []


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("tcp/192.0.2.1:7447", "cannot be listened at: Cannot assign requested address"),
        ("tcp/127.0.0.1:65536", "is no endpoint: Port out of range"),
        ("tcp/127.0.0.1", "has no port"),
        ("tls/[::1:7447", "is no endpoint: Invalid IPv6 URL"),
    ],
)
def test_an_endpoint_that_is_none_of_this_host_is_told(sends, endpoint, said):
    assert f"zenoh: {endpoint} {said}" in one(check_remote(sends("raw: zenoh", listen=[endpoint])), False)


def test_topics_between_hosts_without_what_carries_them_are_told(sends, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert list(check_remote(sends())) == []
    said = one(check_remote(sends("raw: zenoh")), False)
    assert "need zenoh" in said
    assert "pip install 'warploom[net]'" in said


@pytest.mark.parametrize(
    ("profile", "more", "said"),
    [
        ("", ", source: sim:steet", "no scenario 'steet'; did you mean 'street'?"),
        ("sensors: {lidar: [{name: roof, model: vlp61}]}", "", "lidar must be one of"),
        ("sensors: {lidar: [{name: roof, source: kitti:/nowhere}]}", "", "kitti:/nowhere"),
        ("", ", source: mcap:/nowhere.mcap", "/nowhere.mcap"),
    ],
)
def test_a_sensor_that_nobody_can_play_is_told(plan, profile, more, said):
    found = one(check_sensors(plan(profile, more=more)), False)
    assert said in found
    assert "name another source for sensor 'roof'" in found


def test_a_sensor_whose_name_is_not_that_of_the_profile_is_told(plan):
    said = one(check_sensors(plan("sensors: {lidar: [{name: rof, mounting: {xyz: [1, 0, 2]}}]}")), False)
    assert "process/driver: the profile has no lidar 'roof'; did you mean 'rof'?" in said
    assert "--set driver.sensor=rof" in said
    assert one(check_sensors(plan("sensors: {radar: [{name: rof}]}")), True), "a profile without a lidar is for any"


def test_a_sensor_whose_name_is_none_is_left_to_the_building(plan):
    whole = plan("sensors: {lidar: [{name: roof, source: 'sim:street'}]}")
    component = whole.modules["process"][0].content.components
    for one_of in component:
        if "sensor" in one_of.config:
            one_of.config["sensor"] = ["roof"]
    assert list(check_sensors(whole)) == []


def test_settings_of_the_profile_for_nothing_in_the_node_are_told(plan):
    said = one(check_settings(plan("settings: {drivr.rate_hz: 5, driver.rate_hz: 5}")), True)
    assert "drivr.rate_hz of " in said
    assert "p.yaml is left out: the node has no component 'drivr'; did you mean 'driver'?" in said


def test_the_simulator_is_looked_at_but_not_built(plan, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("its world takes seconds")

    monkeypatch.setattr("warploom.components.sources.open_source", refuse)
    assert "sim:street?seed=7&lidar=pandar90" in one(check_sensors(plan()), True)


def test_a_calibration_that_is_not_there_is_told(plan, tmp_path):
    text = "sensors: {camera: [{name: front, calibration: front.yaml}]}"
    first, _ = check_sensors(plan(text))
    assert not first.ok
    assert f"its calibration {tmp_path / 'front.yaml'} is not there" in first.message
    (tmp_path / "front.yaml").write_text("{}")
    assert "driver" in one(check_sensors(plan(text)), True)


def test_a_backend_that_cannot_compute_is_told(plan, monkeypatch):
    from warploom.errors import DeviceError
    from warploom.kernels import backend

    def refuse(name):
        raise DeviceError(f"Taichi cannot compute on {name!r} here")

    pytest.importorskip("taichi")
    monkeypatch.setattr(backend, "uses_taichi", refuse)
    said = one(check_backends(plan("backends: {ground: taichi:vulkan, cluster: warp}")), False)
    assert "ground: Taichi cannot compute on 'taichi:vulkan' here → --set profile.backends.ground=warp" in said


def test_without_a_profile_only_the_ports_and_sensors_are_looked_at(plan):
    whole = plan()
    bare = LaunchPlan(whole.file, whole.modules, None)
    for check in (check_device, check_memory, check_models, check_backends):
        assert list(check(bare)) == []
    assert len(list(check_sensors(bare))) == 1
