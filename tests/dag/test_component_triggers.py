"""Components that any or all of several inputs trigger, or time."""

import threading
import time

import pytest
from component_parts import BLOCK, WAIT, Holding, dag, doubler, joining

from warploom.datamesh import DataMesh, ManualClock, Status

pytestmark = pytest.mark.usefixtures("no_thread_left")


def test_any_runs_for_each_input_with_the_data_of_the_one_that_triggered(topic, started):
    mesh = DataMesh()
    component = joining(mesh, {"any": ["left", "right"]})
    left, right, result = (topic(mesh.window(name)) for name in ("left", "right", "output"))
    started(component)
    left.commit(10, "l")
    result.wait_for(10)
    right.commit(20, "r")
    result.wait_for(20)
    left.commit(20, "l")
    assert result.entries == {10: ("l", None), 20: (None, "r")}
    assert mesh.losses.as_dict() == {}


def test_all_runs_with_the_data_of_all_inputs_and_settles_what_stays_incomplete(topic, started):
    mesh = DataMesh(window_capacity=8)
    component = joining(mesh, {"all": ["left", "right"], "tolerance_ms": 2e-6})
    left, right, result = (topic(mesh.window(name)) for name in ("left", "right", "output"))
    started(component)
    for version in (10, 20, 30):
        left.commit(version, f"l{version}")
    right.commit(12, "r12")
    right.commit(29, "r29")
    result.wait_for(10, 20, 30)
    assert result.entries == {10: ("l10", "r12"), 30: ("l30", "r29")}
    assert result.settled == [20]
    assert mesh.losses.as_dict() == {"join": {"incomplete": 1}}


@pytest.mark.parametrize("kind", ["data", "dag"])
def test_a_component_runs_by_time_on_the_clock(kind, topic):
    clock = ManualClock(1_000_000_000)
    mesh, ran = DataMesh(clock=clock), []
    result = topic(mesh.window("output"))
    if kind == "data":
        component = doubler(mesh, topics=("input", "output"), trigger={"period_ms": 100})
        component.process = lambda trigger: ran.append((trigger.epoch, trigger.version)) or Status.OK
    else:
        component = dag(mesh, lambda t, v: ran.append((t.epoch, t.version)), trigger={"period_ms": 100}, reads=())
    component.start()
    expected = []
    for number in range(1, 4):
        clock.advance(100_000_000)
        expected.append((0, 1_000_000_000 + number * 100_000_000))
        assert result.wait_for_orders(expected[-1])
    clock.step(-2_000_000_000 + 700_000_000)
    clock.advance(100_000_000)
    assert result.wait_for_orders((1, 100_000_000))
    component.stop()
    assert ran == [*expected, (1, 100_000_000)]
    clock.advance(1_000_000_000)
    assert len(ran) == 4


def test_by_the_machines_clock_a_component_ticks_stops_and_leaves_no_thread(topic):
    mesh, ran = DataMesh(), []
    result = topic(mesh.window("output"))
    component = dag(mesh, lambda t, v: ran.append(t.version), trigger={"period_ms": 2}, reads=())
    for _ in range(2):
        component.start()
        seen = len(result.entries) + 3
        until = time.monotonic() + WAIT
        while len(result.entries) < seen and time.monotonic() < until:
            time.sleep(0.001)
        component.stop()
    assert ran == sorted(set(ran))
    assert len(ran) >= 6
    assert all(version > 1_700_000_000 * 10**9 for version in ran), "versions are the time of day"


@pytest.mark.parametrize(("overrun", "expected"), [("skip", [1, 5]), ("coalesce", [1, 4, 5])])
def test_a_component_slower_than_its_ticks_skips_or_coalesces_and_never_bursts(overrun, expected, topic):
    clock = ManualClock()
    mesh = DataMesh(clock=clock)
    hold = Holding(100_000_000)
    result = topic(mesh.window("output"))
    component = dag(mesh, hold, trigger={"period_ms": 100, "overrun": overrun}, reads=())
    component.start()
    clock.advance(100_000_000)
    hold.wait_until_held(100_000_000)
    clock.advance(300_000_000)
    hold.release(100_000_000)
    result.wait_for(*(number * 100_000_000 for number in range(1, 5)))
    while component._is_busy():
        threading.Event().wait(0.001)
    clock.advance(100_000_000)
    result.wait_for(500_000_000)
    component.stop()
    assert hold.started == [number * 100_000_000 for number in expected]
    lost = {"overrun": 3} if overrun == "skip" else {"backlog": 2}
    assert mesh.losses.as_dict() == {"dag": lost}


def test_all_inline_and_blocking_takes_several_versions_that_one_commit_completes(topic, started):
    """The backlog has room for one, and the thread that completes three runs them itself."""
    mesh = DataMesh()
    for hand_off in ("inline", "thread"):
        component = joining(mesh, {"all": ["left", "right"], "tolerance_ms": 5e-6}, BLOCK, hand_off, hand_off)
        started(component)
        left, right, result = (topic(mesh.window(f"{hand_off} {name}")) for name in ("left", "right", "output"))
        for version in (10, 12, 14):
            left.commit(version, version)
        assert result.events == []
        right.commit(13, "r")
        result.wait_for(10, 12, 14)
        assert result.entries == {10: (10, "r"), 12: (12, "r"), 14: (14, "r")}
