"""A process: module files built, checked against each other, started and stopped."""

import gc
import logging
import sys
import threading
import tracemalloc
from collections import deque
from pathlib import Path

import numpy as np
import pytest
from graph_parts import Plain

from warploom.dag import Process, load_module
from warploom.datamesh import DataMesh, Input, ManualClock, Status
from warploom.errors import ConfigError

pytestmark = pytest.mark.usefixtures("no_thread_left")

GOOD = """\
module: chain
components:
  - name: adder
    kind: dag
    trigger: number
    inputs: {number: sensor/number}
    outputs: {text: result/text}
    workers: 2
    in_flight: 2
    backlog: {policy: fifo, depth: 30}
    graph:
      add: {processor: graph_parts.Add, in: {value: number}, config: {amount: 1}}
      describe: {processor: graph_parts.Describe}
      commit:
        processor: warploom.dag.CommitDagProcessor
        in: {value: text}
        config: {output: text}
  - name: doubler
    kind: data
    class: graph_parts.Doubler
    trigger: number
    inputs:
      number: sensor/number
    outputs:
      double: result/double
  - name: plain
    kind: generic
    class: graph_parts.Plain
    config: {label: hello}
"""
OUTSIDE = {"sensor/number": int}


def build(path, external=OUTSIDE, changes=None, **options):
    return Process([load_module(path, changes)], external=external, **options)


def only(*names):
    """The module with some of its components."""
    head, *parts = GOOD.split("  - name: ")
    return head + "".join(f"  - name: {part}" for part in parts if part.split("\n")[0] in names)


@pytest.fixture(autouse=True)
def forget_events():
    Plain.events.clear()


def test_a_module_runs(write, topic):
    process = build(write(GOOD), offline=True)
    number, text, double = (topic(process.mesh.window(n)) for n in ("sensor/number", "result/text", "result/double"))
    process.start()
    for version in range(50):
        number.commit(version, version)
    process.stop()
    assert text.entries == {version: str(version + 1) for version in range(50)}
    assert double.entries == {version: version * 2 for version in range(50)}
    assert text.events == double.events == list(range(50))
    assert Plain.events == [("start", "hello"), ("stop", "hello")]
    assert process.mesh.losses.as_dict() == {}


@pytest.mark.parametrize("workers", [1, 2, 8])
def test_outputs_do_not_depend_on_the_number_of_workers(workers, write, topic, caplog):
    changes = {("adder", "workers"): workers, ("adder", "in_flight"): workers}
    timings = []
    process = build(write(GOOD), changes=changes, offline=True, context=("fail", 7), on_timing=timings.append)
    number, text = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("result/text"))
    process.start()
    for version in range(30):
        number.commit(version, version)
    process.stop()
    assert text.entries == {version: str(version + 1) for version in range(30) if version != 7}
    assert text.settled == [7]
    for name in ("add", "describe", "commit"):
        assert [timing.version for timing in timings if timing.vertex == name] == list(range(30))
    assert {timing.status for timing in timings if timing.version == 7} == {Status.FAILED, Status.SKIPPED}


def test_two_hundred_processes_start_and_stop_and_leave_no_thread(write, topic):
    before = threading.active_count()
    path = write(GOOD)
    module = load_module(path)
    for cycle in range(200):
        process = Process([module], external=OUTSIDE, offline=cycle % 2 == 0)
        number, text = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("result/text"))
        process.start()
        for version in range(cycle % 3):
            number.commit(version, version)
        process.stop()
        assert sorted(text.events) == list(range(cycle % 3))
        assert threading.active_count() == before


def cycle_many_times(process, cycles, topic):
    """Starts, feeds and stops a process; gives threads, open files and memory in use after a third and at the end."""
    number, text = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("result/text"))
    measured = []
    for cycle in range(cycles):
        process.start()
        number.commit(cycle, cycle)
        process.stop()
        text.wait_for(cycle)
        for topic_seen in (number, text):
            topic_seen.forget()
        if cycle in (cycles // 3, cycles - 1):
            gc.collect()
            files = len(list(Path("/proc/self/fd").iterdir())) if Path("/proc/self/fd").is_dir() else 0
            measured.append((threading.active_count(), files, tracemalloc.get_traced_memory()[0]))
    assert process.mesh.losses.as_dict() == {}
    return measured


def test_runs_of_vertices_and_of_data_processes_are_told(write, topic):
    told = []
    process = build(write(GOOD), on_timing=lambda timing: told.append(f"{timing.component}.{timing.vertex}"))
    number = topic(process.mesh.window("sensor/number"))
    process.start()
    number.commit(1, 1)
    process.stop()
    assert sorted(told) == ["adder.add", "adder.commit", "adder.describe", "doubler.process"]


@pytest.fixture
def traced():
    tracemalloc.start()
    yield
    tracemalloc.stop()


def test_three_hundred_starts_and_stops_of_a_process_leave_nothing_behind(write, topic, traced):
    """The components start and stop again and again; memory may grow by what 200 log records would take."""
    process = build(write(GOOD), offline=True)
    (threads, files, memory), after = cycle_many_times(process, 300, topic)
    assert after[:2] == (threads, files)
    assert after[2] - memory < 200_000
    assert len(Plain.events) == 600


@pytest.mark.campaign
def test_ten_thousand_starts_and_stops_of_a_process_leave_nothing_behind(write, topic, traced, monkeypatch):
    monkeypatch.setattr(Plain, "events", deque(maxlen=4))
    process = build(write(GOOD), offline=True)
    (threads, files, memory), after = cycle_many_times(process, 10_000, topic)
    assert after[:2] == (threads, files)
    assert after[2] - memory < 200_000


def test_python_switches_threads_sooner_while_a_process_runs(write):
    before = sys.getswitchinterval()
    path = write(GOOD)
    first, second, third = build(path), build(path, switch_interval_s=50e-6), build(path, switch_interval_s=None)
    first.start()
    assert sys.getswitchinterval() == pytest.approx(100e-6)
    second.start()
    third.start()
    assert sys.getswitchinterval() == pytest.approx(50e-6)
    second.stop()
    assert sys.getswitchinterval() == pytest.approx(100e-6)
    first.stop()
    assert sys.getswitchinterval() == before
    third.stop()
    assert sys.getswitchinterval() == before


def test_a_process_that_checks_finds_a_processor_that_writes_to_its_input(write, topic, tmp_path, monkeypatch):
    (tmp_path / "writing_parts.py").write_text(
        "import numpy as np\n"
        "from warploom.dag import In, Processor\n"
        "from warploom.datamesh import Status\n\n\n"
        "class Writes(Processor):\n"
        "    value: In[object]\n\n"
        "    def process(self, trigger):\n"
        "        self.value.value.base[0] = 5.0\n"
        "        return Status.OK\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    text = (
        "module: m\ncomponents:\n  - {name: c, kind: dag, trigger: number, inputs: {number: sensor/number},\n"
        "     graph: {w: {processor: writing_parts.Writes, in: {value: number}}}}\n"
    )
    process = build(write(text), external={"sensor/number": object}, check=True, offline=True)
    number = topic(process.mesh.window("sensor/number", 1))
    process.start()
    number.commit(1, np.zeros(4)[:2])
    process.stop()
    number.commit(2, np.zeros(4)[:2])
    with Input.access(bound_input(process.mesh.window("sensor/number"))):
        pass
    for version in range(3, 40):
        number.commit(version, np.zeros(4)[:2])
    assert process.mesh.losses["sensor/number", "modified"] == 1


def bound_input(window):
    handle = Input()
    handle.bind("input", window)
    return handle


@pytest.mark.parametrize(
    "trigger", ["{any: [number, side]}", "{all: [number, side], tolerance_ms: 5}", "{period_ms: 10}"]
)
def test_every_kind_of_trigger_can_be_configured(trigger, write, topic):
    text = (
        f"module: m\ncomponents:\n  - name: c\n    kind: data\n    class: graph_parts.Doubler\n    trigger: {trigger}\n"
        "    hand_off: inline\n    inputs: {number: sensor/number}\n    outputs: {double: result/double}\n"
    )
    if "side" in trigger:
        text = text.replace("graph_parts.Doubler", "graph_parts.TwoInputs")
        text = text.replace("{number: sensor/number}", "{number: sensor/number, side: sensor/side}")
    clock = ManualClock(1000)
    outside = {"sensor/number": int, "sensor/side": int}
    process = build(write(text), external=outside, mesh=DataMesh(clock=clock), offline=True)
    number, side, double = (topic(process.mesh.window(n)) for n in ("sensor/number", "sensor/side", "result/double"))
    process.start()
    if "period" in trigger:
        clock.advance(30_000_000)
        process.stop()
        assert double.settled == [10_001_000, 20_001_000, 30_001_000]
        return
    number.commit(10, 1)
    side.commit(12, 2)
    process.stop()
    assert double.events == ([10, 12] if "any" in trigger else [10])


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("kind: data\n", "kind: data\n    deadline: {ms: 5}\n", 18, "a component of kind data has no deadline"),
        ("workers: 2", "workers: 2\n    deadline: {ms: 5, on_mis: cut}", 9, "deadline.on_mis: unknown key"),
        ("trigger: number\n    inputs: {", "trigger: {any: [numbr]}\n    inputs: {", 5,
         "the trigger must be one of the inputs, not 'numbr'; did you mean 'number'?"),
        ("trigger: number\n    inputs: {", "trigger: {any: [number], every: 3}\n    inputs: {",
         5, "trigger.every: unknown"),
        ("trigger: number\n    inputs: {", "trigger: {any: [number], period_ms: 3}\n    inputs: {", 5,
         "a trigger is one of any, all and period_ms"),
        ("trigger: number\n    inputs: {", "trigger: {period_ms: 3}\n    inputs: {", 12,
         "input 'number' is not among the triggers of time"),
        ("workers: 2", "workers: 2\n    hand_off: fast", 9, "hand_off: Input should be 'thread' or 'inline'"),
        ("config: {amount: 1}", "config: {amount: 1}, deadline_ms: 0", 12, "add.deadline_ms: Input should be greater"),
    ],
)  # fmt: skip
def test_mistakes_in_triggers_and_deadlines_are_told_with_their_place(write, old, new, line, said):
    assert GOOD.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        build(write(GOOD.replace(old, new)))
    told = str(caught.value)
    assert said in told, told
    assert f"module.yaml:{line}: " in told, told


def test_modules_of_a_process_share_its_topics(write, topic):
    follower = """\
module: follower
components:
  - {name: last, kind: data, class: graph_parts.Doubler, trigger: number,
     inputs: {number: result/double}, outputs: {double: result/quadruple}}
"""
    files = [load_module(write(follower, "a.yaml")), load_module(write(GOOD, "b.yaml"))]
    process = Process(files, external=OUTSIDE, offline=True)
    assert process.mesh.topics() == ["result/double", "result/quadruple", "result/text", "sensor/number"]
    number, last = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("result/quadruple"))
    process.start()
    for version in range(20):
        number.commit(version, version)
    process.stop()
    assert last.entries == {version: version * 4 for version in range(20)}


def test_consumers_start_before_producers_and_stop_after_them(write, monkeypatch):
    from warploom.dag import Component

    calls = []
    monkeypatch.setattr(Component, "start", lambda self: calls.append(("start", self.name)))
    monkeypatch.setattr(Component, "stop", lambda self: calls.append(("stop", self.name)))
    one = "{{name: {0}, kind: generic, class: graph_parts.Source, outputs: {{number: {1}}}}}"
    two = (
        "{{name: {0}, kind: data, class: graph_parts.Doubler, trigger: number, "
        "inputs: {{number: {1}}}, outputs: {{double: {2}}}}}"
    )
    parts = [two.format("middle", "a", "b"), one.format("source", "a"), two.format("sink", "b", "c")]
    text = "module: order\ncomponents:\n" + "".join(f"  - {part}\n" for part in parts)
    from graph_parts import Doubler

    for name in ("start", "stop"):
        monkeypatch.setattr(Doubler, name, getattr(Component, name), raising=False)
    process = build(write(text), external={})
    process.start()
    process.stop()
    assert [name for what, name in calls if what == "start"] == ["sink", "middle", "source"]
    assert [name for what, name in calls if what == "stop"] == ["source", "middle", "sink"]


def test_a_component_that_does_not_start_stops_those_that_did(write):
    text = GOOD + "  - {name: bad, kind: generic, class: graph_parts.BadStart, config: {label: bad}}\n"
    process = build(write(text))
    with pytest.raises(RuntimeError, match="port in use"):
        process.start()
    assert Plain.events == [("start", "hello"), ("stop", "hello")]


def test_a_component_that_does_not_stop_keeps_no_other_from_it(write, caplog):
    text = GOOD.replace("graph_parts.Plain", "graph_parts.BadStop")
    process = build(write(text))
    process.start()
    with caplog.at_level(logging.ERROR):
        process.stop()
    assert "plain failed to stop" in caplog.text


def test_stop_may_be_called_twice_and_before_start(write):
    process = build(write(GOOD))
    process.stop()
    process.start()
    process.stop()
    process.stop()


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("number: sensor/number\n    outputs:\n      double", "number: sensor/numbr\n    outputs:\n      double", 23,
         "components.1.inputs.number: nobody produces topic 'sensor/numbr'; did you mean 'sensor/number'? known: r"),
        ("double: result/double", "double: result/text", 25,
         "components.1.outputs.double: topic 'result/text' has two producers: 'adder' and 'doubler'"),
        ("double: result/double", "double: sensor/number", 25, "has two producers: 'outside' and 'doubler'"),
        ("number: sensor/number\n    outputs:\n      double", "number: result/text\n    outputs:\n      double", 23,
         "components.1.inputs.number: topic 'result/text' carries str, not int"),
        ("double: result/double", "doubel: result/double", 25,
         "components.1.outputs.doubel: no such handle; did you mean 'double'? known: double"),
        ("    outputs:\n      double: result/double\n", "", 18, "components.1: outputs.double is not mapped to a"),
        ("graph_parts.Doubler", "graph_parts.Dubler", 20,
         "components.1.class: module 'graph_parts' has no class 'Dubler'; did you mean 'Doubler'?"),
        ("graph_parts.Doubler", "graph_parts.Plain", 20, "graph_parts.Plain is not a DataProcessComponent"),
        ("graph_parts.Doubler", "graph_parts.Graph", 19,
         "components.1.kind: graph_parts.Graph is a DagComponent: its kind is dag or monotonic_dag"),
        ("kind: dag", "kind: monotonic_dag\n    class: graph_parts.Graph", 5, "is not a MonotonicDagComponent"),
        ("graph_parts.Plain", "graph_parts.Doubler", 27, "components.2.kind: graph_parts.Doubler is a DataProcess"),
        ("{label: hello}", "{label: ''}", 29, "components.2.config: graph_parts.Plain refused its configuration: a l"),
        ("{label: hello}", "{lable: hello}", 29, "unexpected keyword argument 'lable'"),
        ("name: plain", "name: doubler", 26, "components.2.name: there is a component 'doubler' already"),
        ("{amount: 1}", "{amount: -1}", 12, "components.0.graph.add.config: amount must be >= 0, not -1"),
        ("{output: text}", "{output: txt}", 17,
         "commit.config: the component has no output 'txt'; did you mean 'text'? known: text"),
        ("outputs: {text: result/text}", "outputs: {number: result/text}", 7,
         "components.0.outputs.number: there is an input 'number' too"),
        ("depth: 30", "depth: 31", 10,
         "components.0.backlog.depth: 31 triggers may wait, but the window of 'sensor/number' keeps 32 versions"),
        ("class: graph_parts.Doubler", "class: graph_parts.Doubler\n    config: {speed: 3}", 21,
         "components.1.config.speed: unknown key; known: none"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_line_key_and_way_out_and_nothing_starts(write, old, new, line, said):
    assert GOOD.count(old) == 1
    before = threading.active_count()
    with pytest.raises(ConfigError) as caught:
        build(write(GOOD.replace(old, new)))
    told = str(caught.value)
    assert f"module.yaml:{line}: " in told
    assert said in told
    assert threading.active_count() == before


def test_components_that_trigger_each_other_are_refused(write):
    text = only("doubler").replace("number: sensor/number", "number: c") + (
        "  - {name: b, kind: data, class: graph_parts.Doubler, trigger: number, "
        "inputs: {number: result/double}, outputs: {double: c}}\n"
    )
    with pytest.raises(ConfigError, match=r"module\.yaml:6: .*trigger each other in a cycle.*\['doubler', 'b'\]"):
        build(write(text))


def test_what_comes_from_outside_has_a_type(write):
    with pytest.raises(ConfigError, match=r"module\.yaml:6: .*'sensor/number' carries str, not int"):
        build(write(GOOD), external={"sensor/number": str})


def test_a_class_of_the_users_own_package_runs(write, topic, tmp_path, monkeypatch):
    package = tmp_path / "own_package"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "steps.py").write_text(
        "from warploom.dag import In, Out, Processor\n"
        "from warploom.datamesh import Status\n\n\n"
        "class Negate(Processor):\n"
        "    value: In[int]\n"
        "    total: Out[int]\n\n"
        "    def process(self, trigger):\n"
        "        self.total.value = -self.value.value\n"
        "        return Status.OK\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    text = GOOD.replace("graph_parts.Add", "own_package.steps.Negate").replace(", config: {amount: 1}", "")
    process = build(write(text), offline=True)
    number, result = topic(process.mesh.window("sensor/number")), topic(process.mesh.window("result/text"))
    process.start()
    number.commit(1, 5)
    process.stop()
    assert result.entries == {1: "-5"}


def test_settings_reach_vertex_component_and_class(write):
    text = GOOD.replace("{label: hello}", "{label: hello}\n    workers: 1")
    changes = {
        ("adder", "add", "amount"): 10,
        ("adder", "workers"): 4,
        ("adder", "backlog", "depth"): 3,
        ("plain", "label"): "other",
        ("elsewhere", "key"): 1,
    }
    adder, _, plain = load_module(write(text), changes).content.components
    assert adder.graph["add"].config == {"amount": 10}
    assert (adder.workers, adder.backlog.depth, adder.backlog.policy) == (4, 3, "fifo")
    assert plain.config == {"label": "other"}
    swapped = load_module(write(text), {("doubler", "class"): "graph_parts.Other"}).content.components[1]
    assert swapped.class_name == "graph_parts.Other"


@pytest.mark.parametrize(
    ("keys", "value", "said"),
    [
        (
            ("adder", "ad", "amount"),
            1,
            "setting adder.ad.amount: component 'adder' has no vertex 'ad'; did you mean 'add'?",
        ),
        (
            ("adder", "workers"),
            "many",
            "components.0.workers (as set from outside the file): Input should be a valid int",
        ),
        (
            ("adder", "add", "amount"),
            "many",
            "add.config.amount (as set from outside the file): Input should be a valid",
        ),
        (
            ("adder", "add", "amout"),
            1,
            "add.config.amout (as set from outside the file): unknown key; did you mean 'amo",
        ),
    ],
)
def test_a_setting_that_makes_no_sense_is_told(keys, value, said, write):
    with pytest.raises(ConfigError) as caught:
        build(write(GOOD), changes={keys: value})
    assert said in str(caught.value)


def test_a_process_may_share_a_mesh(write):
    mesh = DataMesh(window_capacity=64)
    process = build(write(GOOD), mesh=mesh)
    assert process.mesh is mesh
    assert mesh.window("result/text").capacity == 64
