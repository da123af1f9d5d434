"""The graph of a component: built from its configuration and checked before anything runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .configuration import ConfigFile, import_class, nearest
from .engine import Vertex
from .processor import In, Out, Processor
from .schema import ComponentSpec, ModuleSpec
from .sync import CommitDagProcessor

__all__ = [
    "DeclaredVertex",
    "check_payloads",
    "declare_vertices",
    "graph_payloads",
    "type_name",
    "vertex_order",
]


@dataclass(frozen=True)
class DeclaredVertex:
    """A vertex as the configuration and its class declare it, not initialised."""

    vertex: Vertex
    config: Any
    """An instance of the processor's `Config`."""


def declare_vertices(
    file: ConfigFile[ModuleSpec], keys: Sequence[str | int], component: ComponentSpec
) -> list[DeclaredVertex]:
    """The vertices of a component, in an order in which they can run.

    Args:
        file: The module file.
        keys: Where the component stands in it.
        component: Its specification.

    Raises:
        ConfigError: Unknown class, port or configuration key, missing or second producer, type mismatch, or cycle.
    """
    declared = {name: _declare(file, [*keys, "graph", name], name, component) for name in component.graph}
    vertices = {name: one.vertex for name, one in declared.items()}
    producers: dict[str, str] = dict.fromkeys(component.inputs, "")
    for name, vertex in vertices.items():
        for datum in vertex.outputs.values():
            if datum in producers:
                other = producers[datum]
                first = f"vertex {other!r}" if other else "the component's input of that name"
                raise file.error([*keys, "graph", name], f"datum {datum!r} has two producers: this and {first}")
            producers[datum] = name
    _check_inputs(file, keys, component, vertices, producers)
    _check_commits(file, keys, declared)
    order = vertex_order(vertices.values(), component.inputs)
    if len(order) < len(vertices):
        stuck = _cycle([vertex for name, vertex in vertices.items() if name not in order])
        raise file.error([*keys, "graph", stuck[0]], f"these vertices wait for each other in a cycle: {stuck}")
    return [declared[name] for name in order]


def _check_inputs(
    file: ConfigFile[ModuleSpec],
    keys: Sequence[str | int],
    component: ComponentSpec,
    vertices: Mapping[str, Vertex],
    producers: Mapping[str, str],
) -> None:
    """Every datum that is read comes from the trigger or another vertex, with a fitting type."""
    for name, vertex in vertices.items():
        for port, datum in vertex.inputs.items():
            if datum in component.inputs and datum not in component.trigger.inputs:
                triggers = ", ".join(component.trigger.inputs) or "of time"
                raise file.error(
                    [*keys, "graph", name, "in", port],
                    f"input {datum!r} is not among the triggers {triggers}, whose "
                    "data alone the graph is given: read it by GetRecentDagProcessor or AlignDagProcessor",
                )
            if datum not in producers:
                if vertex.processor.ports[port].optional:
                    continue
                raise file.error(
                    [*keys, "graph", name, "in", port],
                    f"nothing gives the datum {datum!r} for input {port!r}; {nearest(datum, producers)}",
                )
            if producers[datum]:
                source = vertices[producers[datum]]
                given = next(source.processor.ports[p].payload for p, d in source.outputs.items() if d == datum)
                wanted = vertex.processor.ports[port].payload
                if not check_payloads(given, wanted):
                    raise file.error(
                        [*keys, "graph", name, "in", port],
                        f"{producers[datum]!r} gives {type_name(given)} as {datum!r}, "
                        f"but input {port!r} takes {type_name(wanted)}",
                    )


def _check_commits(
    file: ConfigFile[ModuleSpec], keys: Sequence[str | int], declared: Mapping[str, DeclaredVertex]
) -> None:
    """Every output is committed once in a frame."""
    committing: dict[str, str] = {}
    for name, one in declared.items():
        if isinstance(one.vertex.processor, CommitDagProcessor):
            other = committing.setdefault(one.config.output, name)
            if other != name:
                message = f"output {one.config.output!r} is committed by vertex {other!r} already"
                raise file.error([*keys, "graph", name, "config", "output"], message)


def _cycle(stuck: list[Vertex]) -> list[str]:
    """Of the vertices that can never run, those in a cycle or between cycles; the others only come after one."""
    while True:
        wanted = {datum for vertex in stuck for datum in vertex.inputs.values()}
        kept = [vertex for vertex in stuck if wanted & set(vertex.outputs.values())]
        if len(kept) == len(stuck):
            return [vertex.name for vertex in stuck]
        stuck = kept


def _declare(
    file: ConfigFile[ModuleSpec], keys: Sequence[str | int], name: str, component: ComponentSpec
) -> DeclaredVertex:
    spec = component.graph[name]
    try:
        processor_class = import_class(spec.processor)
    except Exception as error:
        raise file.error([*keys, "processor"], str(error)) from error
    if not issubclass(processor_class, Processor):
        raise file.error(
            [*keys, "processor"], f"{spec.processor} is not a Processor: derive it from warploom.dag.Processor"
        )
    config = file.validate([*keys, "config"], processor_class.Config, spec.config)
    try:
        processor = processor_class()
    except Exception as error:
        message = f"{spec.processor} cannot be made: {type(error).__name__}: {error}"
        raise file.error([*keys, "processor"], message) from error
    processor.name = name
    for direction, port_kind, mapping in (("in", In, spec.inputs), ("out", Out, spec.outputs)):
        ports = [p for p, port in processor.ports.items() if isinstance(port, port_kind)]
        for port in mapping:
            if port not in ports:
                raise file.error([*keys, direction, port], f"{spec.processor} has no such port; {nearest(port, ports)}")
    inputs = {p: spec.inputs.get(p, p) for p, port in processor.ports.items() if isinstance(port, In)}
    outputs = {p: spec.outputs.get(p, p) for p, port in processor.ports.items() if isinstance(port, Out)}
    return DeclaredVertex(Vertex(name, processor, inputs, outputs), config)


def vertex_order(vertices: Any, inputs: Mapping[str, str] | Sequence[str]) -> list[str]:
    """Names of the vertices in an order in which they can run; those in a cycle are left out."""
    vertices = list(vertices)
    produced = {datum for vertex in vertices for datum in vertex.outputs.values()}
    there = set(inputs)
    order: dict[str, None] = {}
    progress = True
    while progress:
        progress = False
        for vertex in vertices:
            if vertex.name not in order and all(d in there or d not in produced for d in vertex.inputs.values()):
                order[vertex.name] = None
                there.update(vertex.outputs.values())
                progress = True
    return list(order)


def graph_payloads(declared: Sequence[DeclaredVertex]) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a graph says about the types of its component's inputs and outputs.

    Returns:
        Datum → type that the vertices read it as; output → type that is committed to it.
    """
    read: dict[str, Any] = {}
    given: dict[str, Any] = {}
    committed: dict[str, Any] = {}
    for one in declared:
        ports = one.vertex.processor.ports
        for port, datum in one.vertex.inputs.items():
            if ports[port].payload not in (object, Any):
                read.setdefault(datum, ports[port].payload)
        given.update({datum: ports[port].payload for port, datum in one.vertex.outputs.items()})
        if isinstance(one.vertex.processor, CommitDagProcessor):
            committed[one.config.output] = given.get(one.vertex.inputs["value"], object)
    return read, committed


def check_payloads(given: Any, wanted: Any) -> bool:
    """Whether a payload of type `given` may be read as `wanted`; what is not a class fits everything."""
    if not isinstance(given, type) or not isinstance(wanted, type) or {object, Any} & {given, wanted}:
        return True
    try:
        return issubclass(given, wanted)
    except TypeError:  # a protocol that cannot be checked
        return True


def type_name(payload: Any) -> str:
    """How messages call a payload's type."""
    return payload.__name__ if isinstance(payload, type) else str(payload)
