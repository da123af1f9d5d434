"""Modules as pictures: everything is there, nothing lies on another, and arrows lead from what gives to what takes."""

import re
import xml.etree.ElementTree as ET

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.dag import ConfigFile, ModuleSpec, draw_mermaid, draw_svg, draw_text
from warploom.dag.drawing import flow_of
from warploom.dag.svg import _GAP, _lay_out

SVG = "{http://www.w3.org/2000/svg}"
MODULE = """\
module: arithmetic
components:
  - name: adder & co
    kind: dag
    trigger: number
    inputs: {number: sensor/number, map: slow/map}
    outputs: {text: result/text}
    graph:
      shout: {processor: graph_parts.Shout}
      commit: {processor: warploom.dag.CommitDagProcessor, in: {value: loud}, config: {output: text}}
      describe: {processor: graph_parts.Describe, in: {total: sum}}
      add: {processor: graph_parts.Add, in: {value: number}, out: {total: sum}}
      look: {processor: warploom.dag.GetRecentDagProcessor, out: {value: chart, version: chart_version},
             config: {input: map}}
      join: {processor: graph_parts.Join, in: {left: sum, right: chart}}
  - name: doubler
    kind: data
    class: graph_parts.Doubler
    trigger: number
    inputs: {number: result/text}
    outputs: {double: result/double}
"""


@pytest.fixture
def module(write) -> ModuleSpec:
    return ConfigFile(write(MODULE), ModuleSpec).content


def test_a_flow_has_every_arrow_once(module):
    arrows = {(arrow.source, arrow.target, arrow.datum, arrow.weak) for arrow in flow_of([module]).arrows}
    assert arrows == {
        ("t_sensor_number", "c_adder___co_add", "", False),
        ("c_adder___co_add", "c_adder___co_describe", "sum", False),
        ("c_adder___co_add", "c_adder___co_join", "sum", False),
        ("c_adder___co_describe", "c_adder___co_shout", "text", False),
        ("c_adder___co_shout", "c_adder___co_commit", "loud", False),
        ("c_adder___co_commit", "t_result_text", "", False),
        ("t_slow_map", "c_adder___co_look", "", True),
        ("c_adder___co_look", "c_adder___co_join", "chart", False),
        ("t_result_text", "c_doubler", "", False),
        ("c_doubler", "t_result_double", "", False),
    }


def rectangles(element):
    return [tuple(float(rect.get(key)) for key in ("x", "y", "width", "height")) for rect in element.iter(f"{SVG}rect")]


def test_a_picture_shows_everything_and_nothing_lies_on_another(module):
    root = ET.fromstring(draw_svg(module))
    nodes = {}
    for group in root.iter(f"{SVG}g"):
        if group.get("class") in ("topic", "vertex", "component"):
            nodes[group.get("id")] = rectangles(group)[0]
    assert nodes.keys() == flow_of([module]).nodes.keys()
    texts = [text.text for text in root.iter(f"{SVG}text")]
    for name in ("adder & co (dag)", "add", "Add", "look", "sensor/number", "slow/map", "doubler", "sum", "chart"):
        assert name in texts
    (frame,) = [rectangles(group)[0] for group in root.iter(f"{SVG}g") if group.get("class") == "group"]
    boxes = list(nodes.items())
    for index, (name, (x, y, w, h)) in enumerate(boxes):
        for other, (u, v, p, q) in boxes[:index]:
            assert x + w <= u or u + p <= x or y + h <= v or v + q <= y, (name, other)
        inside = frame[0] <= x and x + w <= frame[0] + frame[2] and frame[1] <= y and y + h <= frame[1] + frame[3]
        assert inside is name.startswith("c_adder")
    width, height = (float(number) for number in root.get("viewBox").split()[2:])
    assert all(x >= 0 and y >= 0 and x + w <= width and y + h <= height for _, (x, y, w, h) in boxes)
    check_arrows(root, nodes, flow_of([module]).arrows)


def check_arrows(root, nodes, arrows):
    """Every arrow begins at the right side of its source, ends at the left of its target, and leads to the right."""
    paths = [path for path in root.iter(f"{SVG}path") if (path.get("class") or "").startswith("arrow")]
    assert len(paths) == len(arrows)
    for path, arrow in zip(paths, arrows, strict=True):
        numbers = [float(number) for number in re.findall(r"-?\d+\.\d", path.get("d"))]
        x, y, w, h = nodes[arrow.source]
        assert numbers[:2] == pytest.approx([x + w, y + h / 2], abs=0.11)
        x, y, w, h = nodes[arrow.target]
        assert numbers[-2:] == pytest.approx([x, y + h / 2], abs=0.11)
        assert numbers[0] < numbers[-2]
        assert ("weak" in path.get("class")) is arrow.weak


def test_weak_inputs_are_dotted_in_mermaid(module):
    lines = [line.strip() for line in draw_mermaid(module).splitlines()]
    assert "t_slow_map -.-> c_adder___co_look" in lines
    assert "t_sensor_number --> c_adder___co_add" in lines


def test_several_modules_share_their_topics(module, write):
    follower = ConfigFile(
        write(
            "module: follower\ncomponents:\n  - {name: last, kind: data, class: graph_parts.Doubler, trigger: number, "
            "inputs: {number: result/double}, outputs: {double: result/quadruple}}\n", "b.yaml"
        ),
        ModuleSpec,
    ).content  # fmt: skip
    flow = flow_of([module, follower])
    assert [node.label for node in flow.nodes.values()].count("result/double") == 1
    text = draw_text(module, follower).splitlines()
    assert text.index("module follower") > text.index("module arithmetic")
    assert draw_svg(module, follower) == draw_svg(module, follower)


def test_a_module_without_components_is_an_empty_picture(write):
    module = ConfigFile(write("module: nothing\ncomponents: []\n"), ModuleSpec).content
    ET.fromstring(draw_svg(module))


graphs = st.integers(1, 14).flatmap(
    lambda n: st.lists(st.tuples(st.integers(0, n - 1), st.integers(0, n - 1)), max_size=30).map(
        lambda arrows: (n, arrows)
    )
)


@given(graphs, st.randoms(use_true_random=False))
@settings(deadline=None, max_examples=100)
def test_any_graph_is_laid_out_apart_and_forward(graph, random):
    n, pairs = graph
    sizes = {f"n{i}": (random.uniform(10, 200), random.uniform(10, 60)) for i in range(n)}
    arrows = [(f"n{a}", f"n{b}") for a, b in pairs if a != b]
    layout = _lay_out(sizes, arrows, 40.0)
    boxes = list(layout.boxes.values())
    for index, one in enumerate(boxes):
        assert (one.width, one.height) == sizes[one.id]
        assert one.y >= -1e-6
        assert one.y + one.height <= layout.height + 1e-6
        for other in boxes[:index]:
            if one.layer == other.layer:
                assert one.y + one.height + _GAP <= other.y + 1e-6 or other.y + other.height + _GAP <= one.y + 1e-6
    for (source, target), way in layout.ways.items():
        layers = [layout.boxes[source].layer, *(box.layer for box in way), layout.boxes[target].layer]
        assert layers == list(range(layers[0], layers[-1] + 1))
        assert layers[0] < layers[-1]
