"""Signs of life: what a process tells of itself, and how it is seen that a part of it hangs."""

import json
import threading

import numpy as np
import pytest
from launch_nodes import DOUBLER, PLAIN

from warploom.dag import Process, load_module
from warploom.dag.launch.health import ProcessObserver, beat_period
from warploom.datamesh import CommitPolicy, Output


def test_several_beats_fit_into_the_timeout():
    assert beat_period(None) == 1.0
    assert beat_period(60.0) == 1.0
    assert beat_period(0.2) == pytest.approx(0.05)


@pytest.fixture
def process(module, tmp_path, run_base):
    doubler = module(DOUBLER, "doubler", sent="ticks", topic="doubled")
    plain = module(PLAIN, "plain", config="{idle: no receiver, starting: it warms up}")
    files = [load_module(tmp_path / name) for name in (doubler, plain)]
    return Process(files, external={"ticks": object})


def commit(process, version):
    output = Output()
    output.bind("ticks", process.mesh.window("ticks"))
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = np.ones(3)
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def test_a_beat_tells_commits_rates_losses_and_what_parts_say(process):
    now = [100.0]
    links = {"ticks": {"received": 3}}
    observer = ProcessObserver(process, hang_s=5.0, counters=lambda: links, clock=lambda: now[0])
    process.start()
    for version in (1, 2, 3, 4):
        commit(process, version)
        process.mesh.window("doubled")
        done = threading.Event()
        while process.mesh.window("doubled").snapshot().version_index(version) < 0:
            done.wait(0.01)
    now[0] += 2.0
    beat = observer.beat()
    assert beat["commits"] == {"doubled": 4}
    assert beat["rates"] == {"doubled": 2.0}
    assert beat["idle"] == {"plain": "no receiver"}
    assert beat["starting"] == {"plain": "it warms up"}
    assert beat["state"] == {"plain": {"answer": 42}}
    assert beat["links"] == links
    assert beat["hanging"] == []
    process.mesh.losses.count("doubler", "backlog", 1, 7)
    now[0] += 1.0
    beat = observer.beat()
    assert (beat["rates"], beat["losses"]) == ({"doubled": 0.0}, {"doubler": {"backlog": 7}})
    process.stop()


def test_what_is_at_one_frame_for_too_long_hangs(process, monkeypatch):
    now = [0.0]
    observer = ProcessObserver(process, hang_s=5.0, clock=lambda: now[0])
    at_work = {"process": 7}
    monkeypatch.setattr(process.components["doubler"], "at_work", lambda: dict(at_work))
    assert observer.beat()["hanging"] == []
    now[0] = 4.9
    assert observer.beat()["hanging"] == []
    now[0] = 5.0
    assert observer.beat()["hanging"] == ["doubler.process at version 7 for 5.0 s"]
    at_work["process"] = 8  # it goes on
    assert observer.beat()["hanging"] == []
    now[0] = 9.9
    assert observer.beat()["hanging"] == []


def test_the_first_frame_may_take_longer(process, monkeypatch):
    """Kernels may have to be compiled for it."""
    now = [0.0]
    observer = ProcessObserver(process, hang_s=5.0, first_s=300.0, clock=lambda: now[0])
    at_work = {"process": 7}
    monkeypatch.setattr(process.components["doubler"], "at_work", lambda: dict(at_work))
    observer.beat()
    now[0] = 299.0
    assert observer.beat()["hanging"] == []
    now[0] = 300.0
    assert observer.beat()["hanging"] == ["doubler.process at version 7 for 300.0 s"]
    at_work["process"] = 8
    process.components["doubler"].has_run = True
    observer.beat()
    now[0] = 305.0
    assert observer.beat()["hanging"] == ["doubler.process at version 8 for 5.0 s"]


def test_a_component_has_run_once_it_is_through_with_a_frame(process):
    component = process.components["doubler"]
    assert not component.has_run
    process.start()
    commit(process, 1)
    process.stop()
    assert component.has_run


def test_without_a_limit_nothing_hangs(process, monkeypatch):
    now = [0.0]
    observer = ProcessObserver(process, hang_s=None, clock=lambda: now[0])
    monkeypatch.setattr(process.components["doubler"], "at_work", lambda: {"process": 7})
    observer.beat()
    now[0] = 1e6
    assert observer.beat()["hanging"] == []


def test_a_part_that_cannot_tell_its_state_is_said_so(process, monkeypatch):
    def fails():
        raise OSError("the device is gone")

    monkeypatch.setattr(process.components["plain"].instance, "state", fails)
    beat = ProcessObserver(process, hang_s=None).beat()
    assert beat["state"]["plain"] == {"state failed": "OSError: the device is gone"}


def test_whatever_a_part_says_is_said_as_plain_values(process, monkeypatch):
    endless = {}
    endless["itself"] = endless
    says = {
        (0, 1): 3,
        np.int64(3): {np.int64(3): 5.0},
        "nan": float("nan"),
        "list": [np.float32(1), {2}],
        "end": endless,
    }
    monkeypatch.setattr(process.components["plain"].instance, "state", lambda: says)
    told = ProcessObserver(process, hang_s=None).beat()["state"]["plain"]
    json.dumps(told, allow_nan=False)
    assert told["(0, 1)"] == 3
    assert (told["3"], told["nan"], told["list"]) == ({"3": 5.0}, "nan", ["1.0", [2]])


def test_a_part_that_cannot_say_why_it_is_idle_is_said_so(process, monkeypatch):
    plain = process.components["plain"].instance
    kind = type(type(plain).__name__, (type(plain),), {"idle_because": property(lambda self: 1 / 0)})
    monkeypatch.setattr(plain, "__class__", kind)
    beat = ProcessObserver(process, hang_s=None).beat()
    assert beat["state"]["plain"] == {"state failed": "ZeroDivisionError: division by zero"}


def test_the_description_names_components_topics_and_types(process):
    description = ProcessObserver(process, hang_s=None).description()
    assert description["plain"]["kind"] == "generic Plain"
    assert description["doubler"] == {
        "kind": "Doubler",
        "inputs": {"ticks": "ndarray"},
        "outputs": {"doubled": "ndarray"},
        "homes": {"doubled": "numpy"},
    }
