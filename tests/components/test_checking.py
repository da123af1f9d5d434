"""Every kind of mistake in a configuration is told with file, line, key and way out; and all that ships is good."""

import threading
import xml.etree.ElementTree as ET
from typing import Any

import pytest

from warploom.components.checking import FORMATS, check_file, draw_file
from warploom.components.profile import CONF
from warploom.dag import In, Out, Processor, Status
from warploom.errors import ConfigError

MODULE = """\
module: mine
components:
  - name: perception
    kind: dag
    trigger: sensor
    inputs: {sensor: lidar/points}
    outputs: {detected: perception/detected}
    graph:
      filter:
        processor: warploom.components.perception.FilterProcessor
      ground:
        processor: warploom.components.perception.GroundProcessor
      cluster:
        processor: warploom.components.perception.ClusterProcessor
        config:
          radius: 0.5
      merge:
        processor: warploom.components.perception.MergeProcessor
      commit:
        processor: warploom.dag.CommitDagProcessor
        in: {value: detected}
        config: {output: detected}
  - name: tracking
    kind: monotonic_dag
    trigger: detected
    inputs:
      detected: perception/detected
    outputs:
      obstacles: perception/obstacles
    graph:
      track:
        processor: warploom.components.perception.TrackingProcessor
      commit:
        processor: warploom.dag.CommitDagProcessor
        in: {value: obstacles}
        config: {output: obstacles}
"""

MISTAKES = {
    "an unknown class": ("perception.ClusterProcessor", "perception.ClusterProcesor", 14,
        "components.0.graph.cluster.processor: module 'warploom.components.perception' has no class "
        "'ClusterProcesor'; did you mean 'ClusterProcessor'? known: "),
    "an unknown package": ("warploom.components.perception.GroundProcessor", "my_robot.ground.GroundProcessor", 12,
        "components.0.graph.ground.processor: cannot import 'my_robot.ground': No module named 'my_robot'; "
        "is its folder on PYTHONPATH?"),
    "a class that is no processor": ("perception.ClusterProcessor", "perception.clustering.Clusters", 14,
        "cluster.processor: warploom.components.perception.clustering.Clusters is not a Processor: derive it from"),
    "a topic without a producer": ("      detected: perception/detected", "      detected: perception/detectd", 27,
        "inputs.detected: nobody produces topic 'perception/detectd'; did you mean 'perception/detected'? known: "),
    "a datum without a producer": ("in: {value: obstacles}", "in: {value: obstacle}", 35,
        "commit.in.value: nothing gives the datum 'obstacle' for input 'value'; did you mean 'obstacles'? known: "),
    "a topic with two producers": ("perception/obstacles", "perception/detected", 29,
        "components.1.outputs.obstacles: topic 'perception/detected' has two producers: 'perception' and 'tracking'"),
    "a topic that comes from outside": ("perception/obstacles", "lidar/points", 29,
        "components.1.outputs.obstacles: topic 'lidar/points' has two producers: 'outside' and 'tracking'"),
    "a datum with two producers": ("GroundProcessor", "GroundProcessor\n        out: {ground: filtered}", 11,
        "components.0.graph.ground: datum 'filtered' has two producers: this and vertex 'filter'"),
    "an output that is committed twice": ("  - name: tracking", "      again:\n        processor: "
        "warploom.dag.CommitDagProcessor\n        in: {value: ground}\n        config: {output: detected}\n"
        "  - name: tracking", 26,
        "graph.again.config.output: output 'detected' is committed by vertex 'commit' already"),
    "a datum of another type": ("        config:\n          radius: 0.5\n", "        in: {ground: filtered}\n", 15,
        "cluster.in.ground: 'filter' gives FilteredCloud as 'filtered', but input 'ground' takes GroundSurface"),
    "a topic of another type": ("      detected: perception/detected", "      detected: lidar/points", 27,
        "components.1.inputs.detected: topic 'lidar/points' carries SensorFrame, not DetectedObjects"),
    "a trigger that is no input": ("trigger: sensor", "trigger: sensr", 5,
        "0.trigger: the trigger must be one of the inputs, not 'sensr'; did you mean 'sensor'? known: sensor"),
    "a trigger of an unknown kind": ("trigger: sensor", "trigger: {al: [sensor]}", 5,
        "components.0.trigger.al: unknown key; did you mean 'all'? known: "),
    "a trigger of two kinds": ("trigger: sensor", "trigger: {all: [sensor], period_ms: 10}", 5,
        "a trigger is one of any, all and period_ms, not all and period_ms"),
    "an unknown key": ("    kind: dag\n", "    kind: dag\n    worker: 2\n", 5,
        "components.0.worker: unknown key; did you mean 'workers'? known: backlog"),
    "an unknown key of a processor": ("          radius", "          radious", 16,
        "cluster.config.radious: unknown key; did you mean 'radius'? known: "),
    "an unknown port": ("in: {value: detected}", "in: {valeu: detected}", 21,
        "commit.in.valeu: warploom.dag.CommitDagProcessor has no such port; did you mean 'value'? known: value"),
    "an unknown output": ("config: {output: detected}", "config: {output: detcted}", 22,
        "the component has no output 'detcted'; did you mean 'detected'? known: detected"),
    "a value with a unit": ("radius: 0.5", "radius: 50 cm", 16,
        "cluster.config.radius: Input should be a valid number, unable to parse string as a number, found '50 cm'; "
        "this is in m, so write 0.5"),
    "a key with a unit": ("radius: 0.5", "radius_cm: 50", 16,
        "cluster.config.radius_cm: unknown key; 'radius' is in m: write radius: 0.5; "),
    "a key with the wrong unit": ("    kind: dag\n", "    kind: dag\n    deadline: {total_s: 0.1}\n", 5,
        "components.0.deadline"),
    "a value out of its range": ("radius: 0.5", "radius: 50", 16,
        "cluster.config.radius: Input should be less than or equal to 10 [m], found 50"),
    "a missing key": ("    kind: dag\n", "", 3, "components.0.kind: this key is missing"),
    "a key twice": ("    kind: dag\n", "    kind: dag\n    kind: dag\n", 5, "key 'kind' stands twice in one mapping"),
    "what is no YAML": ("inputs: {sensor: lidar/points}", "inputs: {sensor: lidar/points", 7, "is not YAML: "),
}  # fmt: skip


@pytest.mark.parametrize("kind", MISTAKES)
def test_a_mistake_is_told_with_file_line_key_and_way_out_and_nothing_starts(kind, tmp_path):
    old, new, line, said = MISTAKES[kind]
    assert MODULE.count(old) == 1
    path = tmp_path / "mine.yaml"
    path.write_text(MODULE.replace(old, new))
    before = set(threading.enumerate())
    with pytest.raises(ConfigError) as caught:
        check_file(str(path))
    told = str(caught.value)
    assert f"mine.yaml:{line}: " in told
    assert said in told
    # The kernels' own pool serves the whole process, from the first kernel on.
    assert not [t for t in set(threading.enumerate()) - before if not t.name.startswith("warploom-kernels")]


def test_the_module_without_a_mistake_is_good(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(MODULE)
    lines = check_file(str(path))
    assert lines[0].endswith("module 'mine' is good")
    assert lines[1:] == ["  perception (dag), 5 vertices", "  tracking (monotonic_dag), 2 vertices"]


class Loop(Processor):
    """Takes anything and gives it on."""

    value: In[Any]
    other: In[Any] = In(optional=True)
    result: Out[Any]

    def process(self, trigger):
        self.result.value = self.value.value
        return Status.OK


LOOPS = f"""\
module: loops
components:
  - name: first
    kind: dag
    trigger: value
    inputs: {{value: lidar/points}}
    outputs: {{result: a}}
    graph:
      one: {{processor: {__name__}.Loop, out: {{result: first}}}}
      two:
        processor: {__name__}.Loop
        in: {{value: first, other: third}}
        out: {{result: second}}
      three: {{processor: {__name__}.Loop, in: {{value: second}}, out: {{result: third}}}}
      commit: {{processor: warploom.dag.CommitDagProcessor, in: {{value: first}}, config: {{output: result}}}}
"""
NEXT = """\
  - name: second
    kind: dag
    trigger: value
    inputs: {{value: {0}}}
    outputs: {{result: {1}}}
    graph:
      commit: {{processor: warploom.dag.CommitDagProcessor, config: {{output: result}}}}
"""


def test_vertices_that_wait_for_each_other_are_told(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(LOOPS)
    message = (
        r"mine\.yaml:10: components\.0\.graph\.two: these vertices wait for each other in a cycle: \['two', 'three'\]"
    )
    with pytest.raises(ConfigError, match=message):
        check_file(str(path))


def test_components_that_trigger_each_other_are_told(tmp_path):
    path = tmp_path / "mine.yaml"
    sound = LOOPS.replace(", other: third", "")
    path.write_text(sound + NEXT.format("a", "b"))
    assert "  second (dag), 1 vertices" in check_file(str(path))
    path.write_text(sound.replace("lidar/points", "b") + NEXT.format("a", "b"))
    message = r"mine\.yaml:5: components\.0\.trigger: these components trigger each other in a cycle, so none ever runs"
    with pytest.raises(ConfigError, match=message):
        check_file(str(path))


PROFILE = """\
profile: mine
device: cpu
latency_budget_ms: 100
lidar:
  mounting_height: 1.7
sensors: {camera: [front]}
modules: [perception]
settings:
  perception.cluster.radius: 0.6
"""


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("latency_budget_ms: 100", "latency_budget_s: 0.1", 3,
         "latency_budget_s: unknown key; 'latency_budget_ms' is in ms: write latency_budget_ms: 100; "),
        ("latency_budget_ms: 100", "latency_budget_ms: 0.1 s", 3, "found '0.1 s'; this is in ms, so write 100"),
        ("mounting_height: 1.7", "mounting_height: 170", 5, "Input should be less than 20 [m], found 170"),
        ("camera: [front]", "camra: [front]", 6, "sensors.camra: Input should be 'lidar', 'camera', 'radar'"),
        ("modules: [perception]", "modules: [perceptoin]", 7, "no module 'perceptoin'"),
        ("modules: [perception]", "modules: []", 7, "modules: List should have at least 1 item"),
        ("perception.cluster.radius", "perceptoin.cluster.radius", 9,
         "settings.perceptoin.cluster.radius: no component 'perceptoin'; did you mean 'perception'?"),
        ("profile: mine", "profile: mine\ndevcie: cpu", 2, "devcie: unknown key; did you mean 'device'?"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_profile_is_told_too(tmp_path, old, new, line, said):
    path = tmp_path / "mine.yaml"
    path.write_text(PROFILE.replace(old, new))
    with pytest.raises(ConfigError) as caught:
        check_file(str(path))
    told = str(caught.value)
    assert said in told
    assert f"mine.yaml:{line}: " in told


def test_a_name_that_is_neither_names_those_there_are():
    with pytest.raises(ConfigError, match=r"no profile 'cpuu'.*no module 'cpuu'"):
        check_file("cpuu")


SHIPPED = sorted((kind, path.stem) for kind in ("modules", "profiles") for path in (CONF / kind).glob("*.yaml"))


@pytest.mark.parametrize(("kind", "name"), SHIPPED)
def test_all_that_ships_is_drawn_in_every_form(kind, name):
    path = str(CONF / kind / f"{name}.yaml")
    for form in FORMATS:
        drawing = draw_file(path, form)
        assert "filter" in drawing or kind == "modules"
        assert drawing == draw_file(path, form), "the same file makes the same bytes"
    root = ET.fromstring(draw_file(path, "svg"))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"


def test_a_mistake_is_told_before_anything_is_drawn(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(MODULE.replace("perception.ClusterProcessor", "perception.ClusterProcesor"))
    with pytest.raises(ConfigError, match=r"mine\.yaml:14: .*did you mean 'ClusterProcessor'"):
        draw_file(str(path), "svg")
