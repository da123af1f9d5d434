"""The typed interfaces of what ships: its topics, its components with their handles, and the messages, as stub files.

Who writes a component of his own reads in them what there is to read and to commit; a type checker does too.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import textwrap
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args, get_type_hints

from ..dag import ConfigFile, DagComponent, ModuleSpec, Process, load_module
from ..dag.graph import type_name
from .execution import ExecutionContext
from .messages import CameraSet, RadarSet, SensorFrame
from .pipeline import CAMERAS_TOPIC, LIDAR_TOPIC, RADARS_TOPIC
from .profile import CONF

__all__ = ["TopicInterface", "shipped_topics", "stub_of", "write_interfaces"]

_OF_A_PIPELINE = {LIDAR_TOPIC: SensorFrame, CAMERAS_TOPIC: CameraSet, RADARS_TOPIC: RadarSet}
"""What a pipeline commits of its source: no module does."""


@dataclasses.dataclass
class TopicInterface:
    """One topic of the module files."""

    topic: str
    payload: Any
    """The type of what is committed to it."""
    producers: list[str] = dataclasses.field(default_factory=list)
    """Who commits to it, as `module/component`; of alternatives a node has one."""
    readers: list[str] = dataclasses.field(default_factory=list)
    """Who reads it, likewise."""


def _declared(files: Iterable[ConfigFile[ModuleSpec]]) -> list[tuple[str, Process]]:
    """Each module by itself, declared and not prepared; topics of others come from outside."""
    files = list(files)
    given = {topic for file in files for one in file.content.components for topic in one.outputs.values()}
    declared = []
    for file in files:
        own = {topic for one in file.content.components for topic in one.outputs.values()}
        outside = _OF_A_PIPELINE | dict.fromkeys(given - own - set(_OF_A_PIPELINE), object)
        declared.append(
            (file.content.module, Process([file], context=ExecutionContext(), external=outside, prepare=False))
        )
    return declared


def _shipped_modules() -> list[ConfigFile[ModuleSpec]]:
    return [load_module(path) for path in sorted((CONF / "modules").rglob("*.yaml"))]


def shipped_topics() -> dict[str, TopicInterface]:
    """The topics of all module files that ship, by name."""
    return _topics(_declared(_shipped_modules()))


def _topics(declared: Iterable[tuple[str, Process]]) -> dict[str, TopicInterface]:
    topics = {name: TopicInterface(name, kind, ["the source of a pipeline"]) for name, kind in _OF_A_PIPELINE.items()}
    for module, process in declared:
        for name, component in process.components.items():
            for handle in component.outputs.values():
                topic = topics.setdefault(handle.topic, TopicInterface(handle.topic, handle.payload))
                topic.producers.append(f"{module}/{name}")
                if topic.payload is object:
                    topic.payload = handle.payload
            for handle in component.inputs.values():
                topic = topics.setdefault(handle.topic, TopicInterface(handle.topic, object))
                topic.readers.append(f"{module}/{name}")
    return dict(sorted(topics.items()))


def write_interfaces(folder: Path) -> list[Path]:
    """Writes `topics.md`, `messages.pyi` and `components.pyi`.

    Args:
        folder: It is made where it is not there.

    Returns:
        The files.
    """
    folder.mkdir(parents=True, exist_ok=True)
    declared = _declared(_shipped_modules())
    topics = _topics(declared)
    messages = _with_parts(topic.payload for topic in topics.values())
    components = {type(one): one for _, process in declared for one in process.components.values()}
    texts = {
        "topics.md": _topic_table(topics),
        "messages.pyi": _messages(messages),
        "components.pyi": _components(components, messages),
    }
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")
    return [folder / name for name in texts]


def _topic_table(topics: Mapping[str, TopicInterface]) -> str:
    lines = ["# Topics", "", "| topic | type | committed by | read by |", "|---|---|---|---|"]
    for topic in topics.values():
        row = (topic.topic, type_name(topic.payload), ", ".join(topic.producers), ", ".join(topic.readers) or "–")
        lines.append("| " + " | ".join(row) + " |")
    return "\n".join(lines) + "\n"


def _with_parts(types: Iterable[Any]) -> list[type]:
    """The message classes among some types, and those that they consist of, parts first."""
    found: dict[type, None] = {}

    def take(one: Any) -> None:
        for argument in get_args(one):
            take(argument)
        if not isinstance(one, type) or one in found or not one.__module__.startswith("warploom."):
            return
        if not (dataclasses.is_dataclass(one) or issubclass(one, (enum.Enum, tuple))):
            return
        for hint in get_type_hints(one).values():
            take(hint)
        found[one] = None

    for one in types:
        take(one)
    return list(found)


def _messages(messages: Iterable[type]) -> str:
    head = (
        '"""What is committed to the topics. Generated."""\n\n'
        "from collections.abc import Iterator, Mapping\n"
        "from dataclasses import dataclass\n"
        "from typing import Any, NamedTuple\n\n"
        "import numpy as np\n"
    )
    return head + "".join(f"\n{stub_of(one)}\n" for one in messages)


def _components(components: Mapping[type, Any], messages: Iterable[type]) -> str:
    known = {one.__name__ for one in messages}
    body, used = [], set()
    for kind, component in sorted(components.items(), key=lambda pair: pair[0].__name__):
        if isinstance(component, DagComponent):  # its handles are those that the module file names
            continue
        lines = [f"class {kind.__name__}:", f'    """{inspect.getdoc(kind) or ""}"""']
        for direction, handles in (("Input", component.inputs), ("Output", component.outputs)):
            for name, handle in handles.items():
                payload = type_name(handle.payload)
                used |= {payload} & known
                lines.append(f"    {name}: {direction}[{payload if payload in known else 'Any'}]")
        lines.append(f"    # {kind.__module__}.{kind.__qualname__}")
        body.append("\n".join(lines))
    head = (
        '"""The components that module files name, with their handles. Generated."""\n\n'
        "from typing import Any\n\nfrom warploom.datamesh import Input, Output\n\n"
        + (f"from .messages import {', '.join(sorted(used))}\n" if used else "")
    )
    return head + "".join(f"\n{text}\n" for text in body)


class _Bare(ast.NodeTransformer):
    """Takes the bodies of functions away, and decorators that are not of the standard library."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST | None:
        if node.name.startswith("_") and not node.name.startswith("__"):
            return None
        told = [statement for statement in node.body[:1] if _is_text(statement)]
        node.body = [*told, ast.Expr(ast.Constant(...))]
        return node

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        if _is_text(node):  # what is said of a field, on one line
            node.value = ast.Constant(" ".join(node.value.value.split()))  # type: ignore[attr-defined]
        return node

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.AST:
        kept = ("dataclass", "dataclasses.dataclass")
        node.decorator_list = [one for one in node.decorator_list if _name_of(one) in kept]
        return self.generic_visit(node)


def _is_text(statement: ast.stmt) -> bool:
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


def _name_of(decorator: ast.expr) -> str:
    return ast.unparse(decorator.func if isinstance(decorator, ast.Call) else decorator)


def stub_of(kind: type) -> str:
    """The declaration of a class: its fields with what is said of them, its methods without their bodies."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    return ast.unparse(ast.fix_missing_locations(_Bare().visit(tree)))
