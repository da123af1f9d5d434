"""Placeholders: one component, input or item for each sensor, and messages that still point at the file's lines."""

import pytest

from warploom.dag import load_module
from warploom.dag.placeholders import expand_sensors
from warploom.errors import ConfigError

SENSORS = {"camera": ["front", "left"], "radar": ["rear"], "lidar": ["main"]}
MODULE = """\
module: features
components:
  - name: "{camera}_features"
    kind: data
    class: graph_parts.Doubler
    trigger: number
    inputs: {number: "camera/{camera}"}
    outputs: {double: "features/{camera}"}
  - name: batch
    kind: dag
    trigger: {all: ["{camera}"], tolerance_ms: 20}
    inputs: {"{camera}": "features/{camera}"}
    outputs: {out: features/batch}
    graph:
      "add_{camera}":
        processor: graph_parts.Add
        in: {value: "{camera}"}
        out: {total: "sum_{camera}"}
  - name: "{sensor}_quality"
    kind: generic
    class: graph_parts.Plain
    config: {label: "of {sensor}, {braces} stay"}
"""


def test_a_component_is_made_for_each_sensor_of_the_profile(write):
    components = load_module(write(MODULE), sensors=SENSORS).content.components
    assert [one.name for one in components] == [
        "front_features", "left_features", "batch", "main_quality", "front_quality", "left_quality", "rear_quality"
    ]  # fmt: skip
    assert components[1].inputs == {"number": "camera/left"}
    assert components[1].outputs == {"double": "features/left"}
    assert components[6].config == {"label": "of rear, {braces} stay"}


def test_within_a_component_entries_are_repeated(write):
    batch = load_module(write(MODULE), sensors=SENSORS).content.components[2]
    assert batch.inputs == {"front": "features/front", "left": "features/left"}
    assert batch.trigger.all == ("front", "left")
    assert list(batch.graph) == ["add_front", "add_left"]
    assert batch.graph["add_left"].inputs == {"value": "left"}
    assert batch.graph["add_left"].outputs == {"total": "sum_left"}


def test_alone_a_placeholder_stands_for_one_sensor_of_its_name(write):
    components = load_module(write(MODULE)).content.components
    assert [one.name for one in components] == ["camera_features", "batch", "sensor_quality"]
    assert components[0].inputs == {"number": "camera/camera"}


def test_without_sensors_of_a_kind_nothing_is_made(write):
    head, first, _, last = MODULE.split("  - name: ")
    components = load_module(write(f"{head}  - name: {first}  - name: {last}"), sensors={"radar": ["rear"]}).content
    assert [one.name for one in components.components] == ["rear_quality"]
    assert load_module(write(f"{head}  - name: {first}"), sensors={}).content.components == []


def test_settings_name_what_was_made(write):
    changes = {("left_features", "workers"): 3, ("rear_quality", "label"): "other"}
    components = load_module(write(MODULE), changes, SENSORS).content.components
    assert [one.workers for one in components[:3]] == [1, 3, 1]
    assert components[6].config["label"] == "other"


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ('inputs: {number: "camera/{camera}"}', 'inputs: {number: "camera/{camera}"}\n    worker: 1', 8,
         "components.1.worker: unknown key; did you mean 'workers'?"),
        ("kind: generic", "kind: genric", 20, "components.6.kind: Input should be"),
        ('in: {value: "{camera}"}', 'inn: {value: "{camera}"}', 17, "add_left.inn: unknown key; did you mean 'in'?"),
        ("{camera}_features", "{camera}_{radar}", 3, "name: '{camera}_{radar}' holds placeholders of several kinds"),
        ("{camera}_features", "{camrea}_features", 3, "name: no placeholder {camrea}; did you mean 'camera'?"),
        ("features/batch", "\"features/{camera}\"", 13, "out: {camera} in 'features/{camera}' stands for nothing here"),
        ("features/batch", "\"features/{frame}\"", 13, "out: no placeholder {frame}; did you mean 'camera'? known: "),
    ],
)  # fmt: skip
def test_a_mistake_points_at_its_line_in_the_file(write, old, new, line, said):
    assert MODULE.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        load_module(write(MODULE.replace(old, new)), sensors=SENSORS)
    told = str(caught.value).splitlines()
    assert any(f"module.yaml:{line}: " in one and said in one for one in told), told


@pytest.mark.parametrize("data", [{}, {"components": None}, {"components": ["text", 5, {"name": 3}]}])
def test_what_is_no_module_is_left_to_the_schema(data):
    assert expand_sensors(data, SENSORS)[0] == data
