"""Modules drawn: as text, as a Mermaid flow chart, and as the flow that `dag.svg` makes a picture of."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from .configuration import import_class
from .processor import In, Out
from .schema import ComponentSpec, ModuleSpec

__all__ = ["Arrow", "Flow", "Node", "draw_mermaid", "draw_text", "flow_of"]


@dataclass(frozen=True, slots=True)
class Node:
    """A topic, a vertex, or a component without a graph."""

    id: str
    """Unique in the flow; letters, digits and underscores."""
    label: str
    kind: str
    """topic, vertex or component."""
    detail: str = ""
    """Its class."""


@dataclass(frozen=True, slots=True)
class Arrow:
    """Data that go from one node to another."""

    source: str
    target: str
    datum: str = ""
    """Their name within a component; empty for a topic's."""
    weak: bool = False
    """Read when something else triggers."""


@dataclass(frozen=True)
class Flow:
    """What there is to draw."""

    nodes: dict[str, Node]
    groups: dict[str, tuple[str, list[str]]]
    """Components with a graph: id → label, and the ids of their vertices."""
    arrows: list[Arrow]


def flow_of(modules: Sequence[ModuleSpec]) -> Flow:
    """The components, vertices and topics of some modules, and what goes between them.

    Raises:
        ConfigError: A class of a processor cannot be imported.
    """
    nodes: dict[str, Node] = {}
    groups: dict[str, tuple[str, list[str]]] = {}
    arrows: list[Arrow] = []
    components = [component for module in modules for component in module.components]
    for topic in dict.fromkeys(t for c in components for t in (*c.inputs.values(), *c.outputs.values())):
        nodes[_topic(topic)] = Node(_topic(topic), topic, "topic")
    for component in components:
        box = _node("c", component.name)
        if not component.graph:
            nodes[box] = Node(box, component.name, "component", component.class_name)
            for name, topic in component.inputs.items():
                arrows.append(Arrow(_topic(topic), box, weak=name not in component.trigger.inputs))
            arrows += [Arrow(box, _topic(topic)) for topic in component.outputs.values()]
            continue
        groups[box] = f"{component.name} ({component.kind})", [_node(box, name) for name in component.graph]
        edges = _vertex_edges(component)
        producers = {datum: name for name, _, given in edges for datum in given}
        for name, _, _ in edges:
            node = _node(box, name)
            nodes[node] = Node(node, name, "vertex", component.graph[name].processor.rpartition(".")[2])
        for name, read, _ in edges:
            node = _node(box, name)
            for datum in read:
                if datum in producers:
                    arrows.append(Arrow(_node(box, producers[datum]), node, datum))
                elif datum in component.inputs:
                    arrows.append(Arrow(_topic(component.inputs[datum]), node))
            config = component.graph[name].config
            for other in _named(config, "input", "inputs"):
                if other in component.inputs:
                    arrows.append(
                        Arrow(_topic(component.inputs[other]), node, weak=other not in component.trigger.inputs)
                    )
            for output in _named(config, "output", "outputs"):
                if output in component.outputs:
                    arrows.append(Arrow(node, _topic(component.outputs[output])))
    return Flow(nodes, groups, list(dict.fromkeys(arrows)))


def _named(config: dict, *keys: str) -> list[str]:
    """The inputs or outputs of the component that a vertex names in its configuration."""
    found: list[str] = []
    for key in keys:
        value = config.get(key)
        found += [value] if isinstance(value, str) else [one for one in value or () if isinstance(one, str)]
    return found


def _vertex_edges(component: ComponentSpec) -> list[tuple[str, list[str], list[str]]]:
    """Per vertex: its name, the data it reads, the data it gives."""
    edges = []
    for name, spec in component.graph.items():
        ports = import_class(spec.processor)().ports
        inputs = [spec.inputs.get(p, p) for p, port in ports.items() if isinstance(port, In)]
        outputs = [spec.outputs.get(p, p) for p, port in ports.items() if isinstance(port, Out)]
        edges.append((name, inputs, outputs))
    return edges


def draw_text(*modules: ModuleSpec) -> str:
    """The components and vertices as indented text: inputs → name → outputs."""
    lines = []
    for module in modules:
        lines.append(f"module {module.module}")
        for component in module.components:
            inputs = ", ".join(component.inputs.values()) or "-"
            outputs = ", ".join(component.outputs.values()) or "-"
            lines.append(f"  {component.name} ({component.kind}): {inputs} -> {outputs}")
            for name, inputs_of, outputs_of in _vertex_edges(component):
                lines.append(f"    {', '.join(inputs_of) or '-'} -> [{name}] -> {', '.join(outputs_of) or '-'}")
    return "\n".join(lines)


def draw_mermaid(*modules: ModuleSpec) -> str:
    """A Mermaid flow chart: a box per component, in it the vertices, arrows named by their data."""
    flow = flow_of(modules)
    grouped = {node for _, members in flow.groups.values() for node in members}
    lines = ["flowchart LR"]
    for box, (label, members) in flow.groups.items():
        lines.append(f'  subgraph {box}["{label}"]')
        lines += [f'    {node}["{flow.nodes[node].label}"]' for node in members]
        lines.append("  end")
    for node in flow.nodes.values():
        if node.id not in grouped:
            lines.append(f'  {node.id}(["{node.label}"])' if node.kind == "topic" else f'  {node.id}["{node.label}"]')
    for arrow in flow.arrows:
        line = f"-- {arrow.datum} -->" if arrow.datum else "-.->" if arrow.weak else "-->"
        lines.append(f"  {arrow.source} {line} {arrow.target}")
    return "\n".join(lines)


def _topic(topic: str) -> str:
    return _node("t", topic)


def _node(prefix: str, name: str) -> str:
    """A name as Mermaid takes it: letters, digits and underscores."""
    return prefix + "_" + re.sub(r"\W", "_", name)
