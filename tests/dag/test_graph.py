"""Graphs: checked against the classes before anything runs, and drawn."""

from collections.abc import Sized
from typing import Any, Protocol

import numpy as np
import pytest
from graph_parts import Add, Shout

from warploom.dag import ConfigFile, ModuleSpec, draw_mermaid, draw_text
from warploom.dag.graph import check_payloads, declare_vertices, graph_payloads
from warploom.errors import ConfigError

GOOD = """\
module: arithmetic
components:
  - name: adder
    kind: dag
    trigger: number
    inputs: {number: sensor/number, side: sensor/side}
    outputs: {text: result/text, spare: result/spare}
    graph:
      shout:
        processor: graph_parts.Shout
      commit:
        processor: warploom.dag.CommitDagProcessor
        in: {value: loud}
        config: {output: text}
      describe:
        processor: graph_parts.Describe
        in:
          total: sum
      add:
        processor: graph_parts.Add
        config: {amount: 2}
        in: {value: number}
        out: {total: sum}
"""


def declare(path):
    file = ConfigFile(path, ModuleSpec)
    return declare_vertices(file, ["components", 0], file.content.components[0])


def test_vertices_come_in_an_order_in_which_they_can_run(write):
    declared = declare(write(GOOD))
    assert [one.vertex.name for one in declared] == ["add", "describe", "shout", "commit"]
    add = declared[0]
    assert isinstance(add.vertex.processor, Add)
    assert (add.vertex.processor.name, add.config.amount) == ("add", 2)
    assert (add.vertex.inputs, add.vertex.outputs) == ({"value": "number"}, {"total": "sum"})
    assert isinstance(declared[2].vertex.processor, Shout)
    assert declared[2].vertex.inputs == {"text": "text"}, "a port that is not mapped takes the datum of its name"


def test_a_graph_knows_the_types_of_its_inputs_and_outputs(write):
    read, committed = graph_payloads(declare(write(GOOD)))
    assert read["number"] is int
    assert committed == {"text": str}


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("graph_parts.Describe", "graph_parts.Descrbe", 16,
         "describe.processor: module 'graph_parts' has no class 'Descrbe'; did you mean 'Describe'?"),
        ("graph_parts.Describe", "no_such_package.Describe", 16, "describe.processor: cannot import 'no_such_package'"),
        ("graph_parts.Describe", "Describe", 16, "'Describe' is not a dotted name: write package.module.Class"),
        ("graph_parts.Describe", "graph_parts.NotAProcessor", 16,
         "graph_parts.NotAProcessor is not a Processor: derive it from warploom.dag.Processor"),
        ("graph_parts.Describe", "graph_parts.Unmakeable", 16,
         "describe.processor: graph_parts.Unmakeable cannot be made: OSError: no such camera"),
        ("{amount: 2}", "{amout: 2}", 21,
         "add.config.amout: unknown key; did you mean 'amount'? known: amount, label, parts"),
        ("{amount: 2}", "{amount: two}", 21, "add.config.amount: Input should be a valid integer"),
        ("          total: sum", "          totl: sum", 18,
         "describe.in.totl: graph_parts.Describe has no such port; did you mean 'total'? known: total"),
        ("out: {total: sum}", "out: {value: sum}", 23, "add.out.value: graph_parts.Add has no such port; known: total"),
        ("          total: sum", "          total: smu", 18,
         "describe.in.total: nothing gives the datum 'smu' for input 'total'; did you mean 'sum'? known: "),
        ("        in:\n          total: sum\n", "", 15,
         "describe.in.total: nothing gives the datum 'total' for input 'total'"),
        ("out: {total: sum}", "out: {total: text}", 19,
         "graph.add: datum 'text' has two producers: this and vertex 'describe'"),
        ("out: {total: sum}", "out: {total: side}", 19,
         "graph.add: datum 'side' has two producers: this and the component's input of that name"),
        ("          total: sum", "          total: loud", 18,
         "describe.in.total: 'shout' gives str as 'loud', but input 'total' takes int"),
        ("in: {value: number}", "in: {value: side}", 22, "add.in.value: input 'side' is not among the triggers number"),
    ],
)  # fmt: skip
def test_a_mistake_is_told_with_line_key_and_way_out(write, old, new, line, said):
    assert GOOD.count(old) == 1
    with pytest.raises(ConfigError) as caught:
        declare(write(GOOD.replace(old, new)))
    told = str(caught.value)
    assert f"module.yaml:{line}: components.0.graph." in told
    assert said in told


def vertices(**data):
    """A module of vertices `name=(left, right, output)`, all of one processor."""
    graph = "".join(
        f"      {name}: {{processor: graph_parts.Join, in: {{left: {left}, right: {right}}}, out: {{joined: {out}}}}}\n"
        for name, (left, right, out) in data.items()
    )
    return GOOD[: GOOD.index("      shout")] + graph


def test_an_output_is_committed_by_one_vertex(write):
    again = "      again: {processor: warploom.dag.CommitDagProcessor, in: {value: sum}, config: {output: text}}\n"
    with pytest.raises(
        ConfigError, match=r":24: .*again\.config\.output: output 'text' is committed by vertex 'commit'"
    ):
        declare(write(GOOD + again))


def test_a_cycle_names_those_in_it_and_no_other(write):
    text = vertices(
        after=("c", "number", "d"), one=("c", "number", "a"), two=("a", "x", "b"), three=("b", "x", "c"),
        apart=("number", "x", "e"),
    )  # fmt: skip
    with pytest.raises(
        ConfigError, match=r"module\.yaml:10: components\.0\.graph\.one: .* cycle: \['one', 'two', 'three'\]"
    ):
        declare(write(text))


def test_a_vertex_that_waits_for_itself_is_a_cycle(write):
    with pytest.raises(ConfigError, match=r"cycle: \['self'\]"):
        declare(write(vertices(self=("number", "again", "again"))))


def test_an_optional_port_needs_no_producer(write):
    assert len(declare(write(vertices(only=("number", "nowhere", "out"))))) == 1


def test_a_long_chain_declared_backwards_is_sorted(write):
    chain = {f"v{i}": ("number" if i == 0 else f"d{i - 1}", "x", f"d{i}") for i in reversed(range(150))}
    declared = declare(write(vertices(**chain)))
    assert [one.vertex.name for one in declared] == [f"v{i}" for i in range(150)]


class Speaks(Protocol):
    def speak(self) -> str: ...


@pytest.mark.parametrize(
    ("given", "wanted", "fits"),
    [
        (int, int, True),
        (bool, int, True),
        (int, bool, False),
        (int, str, False),
        (np.ndarray, object, True),
        (object, np.ndarray, True),
        (int, Any, True),
        (Any, int, True),
        (list[int], list[str], True),
        (list, Sized, True),
        (int, Sized, False),
        (int, Speaks, True),
    ],
)
def test_a_payload_may_be_read_as_its_base_and_what_cannot_be_checked_passes(given, wanted, fits):
    assert check_payloads(given, wanted) is fits


def test_a_module_is_drawn_as_text(write):
    text = draw_text(ConfigFile(write(GOOD), ModuleSpec).content)
    assert text.splitlines() == [
        "module arithmetic",
        "  adder (dag): sensor/number, sensor/side -> result/text, result/spare",
        "    text -> [shout] -> loud",
        "    loud -> [commit] -> -",
        "    sum -> [describe] -> text",
        "    number -> [add] -> sum",
    ]


def test_a_module_is_drawn_as_a_mermaid_flow_chart(write):
    text = GOOD.replace("adder", "add-er.1") + "  - {name: clock, kind: generic, class: graph_parts.Silent}\n"
    lines = [line.strip() for line in draw_mermaid(ConfigFile(write(text), ModuleSpec).content).splitlines()]
    assert lines[0] == "flowchart LR"
    for line in (
        'subgraph c_add_er_1["add-er.1 (dag)"]',
        'c_add_er_1_describe["describe"]',
        "c_add_er_1_add -- sum --> c_add_er_1_describe",
        "t_sensor_number --> c_add_er_1_add",
        "c_add_er_1_commit --> t_result_text",
        't_result_text(["result/text"])',
        'c_clock["clock"]',
        "end",
    ):
        assert line in lines
    assert lines.count("end") == 1
