"""The schema of module files."""

import pytest

from warploom.dag import BacklogConfig, ComponentSpec, ConfigFile, ModuleSpec
from warploom.errors import ConfigError

GOOD = """\
module: test
components:
  - name: perception
    kind: dag
    trigger: lidar
    inputs: {lidar: lidar/points}
    outputs: {obstacles: perception/obstacles}
    graph:
      ground:
        processor: some.package.Ground
        in: {cloud: lidar}
        out: {mask: ground}
  - name: map
    kind: data
    class: some.package.Map
    trigger: lidar
    inputs: {lidar: lidar/points}
"""


def test_a_component_takes_sensible_defaults(write):
    component, plain = ConfigFile(write(GOOD), ModuleSpec).content.components
    assert component.backlog == BacklogConfig(policy="latest", depth=1)
    assert (component.workers, component.in_flight) == (1, 1)
    assert component.graph["ground"].inputs == {"cloud": "lidar"}
    assert component.graph["ground"].outputs == {"mask": "ground"}
    assert plain.class_name == "some.package.Map"


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("trigger: lidar\n    inputs: {lidar: lidar/points}\n    out", "trigger: ldar\n    inputs: {lidar: a}\n    out",
         5,
         "components.0.trigger: the trigger must be one of the inputs, not 'ldar'; did you mean 'lidar'? known: lidar"),
        ("    trigger: lidar\n    inputs: {lidar: lidar/points}\n    out", "    inputs: {lidar: a}\n    out", 3,
         "components.0.trigger: the trigger must be one of the inputs, not ''"),
        ("kind: dag", "kind: graph", 4, "components.0.kind: Input should be 'generic', 'data', 'dag' or"),
        ("kind: dag", "kind: data", 3, "components.0: a component of kind data has no graph"),
        ("kind: data", "kind: dag", 13, "components.1: a component of kind dag needs a graph"),
        ("    class: some.package.Map\n", "", 13, "components.1: a component of kind data needs a class"),
        ("in: {cloud", "inn: {cloud", 11, "ground.inn: unknown key; did you mean 'in'? known: config, deadline_ms"),
        ("out: {mask: ground}", "out: [mask]", 12, "graph.ground.out: Input should be a valid dictionary"),
        ("processor: some.package.Ground", "processor: 5", 10, "ground.processor: Input should be a valid string"),
        ("class: some", "clas: some", 15, "components.1.clas: unknown key; did you mean 'class'?"),
        ("name: map", "name: ''", 13, "components.1.name: a name is 1 to 128 characters that can be shown, not ''"),
        ("name: map", 'name: "a\\nb"', 13, r"a name is 1 to 128 characters that can be shown, not 'a\nb'"),
        ("{obstacles: perception/obstacles}", "{obstacles: ''}", 7, "outputs.obstacles: a topic is 1 to 80 char"),
        ("{obstacles: perception/obstacles}", f"{{obstacles: {81 * 'a'}}}", 7, "a topic is 1 to 80 characters"),
        ("{obstacles: perception/obstacles}", f"{{obstacles: {14 * 'é'}}}", 7, "beyond ASCII fewer"),
        ("module: test", "module: ' '", 1, "module: a name is 1 to 128 characters that can be shown, not ' '"),
        ("module: test", "modul: test", 1, "modul: unknown key; did you mean 'module'?"),
        ("kind: dag", "kind: dag\n    workers: 0", 5, "workers: Input should be greater than or equal to 1, found 0"),
        ("kind: dag", "kind: dag\n    in_flight: 1.5", 5, "in_flight: Input should be a valid integer"),
        ("kind: dag", "kind: dag\n    backlog: {policy: lifo}", 5, "backlog.policy: Input should be 'latest', 'fifo'"),
        ("kind: dag", "kind: dag\n    deadline: {ms: .inf}", 5, "deadline.ms: Input should be a finite number"),
        ("    trigger: lidar\n    inputs: {lidar: lidar/points}\n    out", "    trigger: {period_ms: 1e+300}\n    out",
         5, "trigger.period_ms: Input should be less than or equal to 86400000"),
        ("kind: dag", "kind: dag\n    backlog: {dept: 3}", 5, "backlog.dept: unknown key; did you mean 'depth'?"),
    ],
)  # fmt: skip
def test_a_mistake_points_at_its_line(write, old, new, line, said):
    assert GOOD.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        ConfigFile(write(GOOD.replace(old, new)), ModuleSpec)
    told = str(caught.value).splitlines()
    assert len(told) <= 2, told
    assert any(f"module.yaml:{line}: " in one and said in one for one in told), told


def test_a_specification_can_be_written_in_code():
    spec = ComponentSpec(name="map", kind="data", class_name="a.B", inputs={"x": "t"}, trigger="x")
    assert spec.class_name == "a.B"
