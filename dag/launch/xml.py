"""The reference's form of a launch file, read as the one in YAML.

    <cybertron>
      <module>
        <name>compute3d_sched</name> <type>energon</type> <process_name>compute3d_sched</process_name>
        <cgroup>app/compute3d_sched</cgroup> <exception_handler>respawn</exception_handler>
        <dag_conf>a.yaml</dag_conf> <dag_conf>b.yaml</dag_conf>
      </module>
    </cybertron>

A `<module>` is a process, each `<dag_conf>` one of its module files. What the reference does not have are the elements
of the same names as the keys in YAML: `<node>`, `<profile>`, `<hardware><hw>hw50</hw>…</hardware>` beside the modules,
`<cpus>0,1</cpus>`, `<nice>`, `<environment><NAME>value</NAME></environment>`, `<back_off><first_s>…` within one. The
node is called as the file where it is not said.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

from pydantic import ValidationError

from ...errors import ConfigError
from ..configuration import ConfigFile, nearest, override
from .schema import BackOffSpec, HardwareSpec, LaunchSpec, LimitsSpec, ProcessSpec, RestartsSpec

__all__ = ["XmlLaunchFile"]

_DEPTH = 8
_BYTES = 1_000_000

_NESTED = {"hardware": HardwareSpec, "back_off": BackOffSpec, "restarts": RestartsSpec, "limits": LimitsSpec}
_OF_NODE = tuple(name for name in LaunchSpec.model_fields if name in ("node", "description", "hardware", "profile"))
_OF_PROCESS = tuple("dag_conf" if name == "modules" else name for name in ProcessSpec.model_fields)
_ELEMENTS = {"processes": "module", "modules": "dag_conf"}
"""Keys in YAML that elements do not have the names of."""

Place = tuple[str | int, ...]


@dataclass
class _Element:
    name: str
    line: int
    text: str = ""
    children: list[_Element] = field(default_factory=list)


class XmlLaunchFile(ConfigFile[LaunchSpec]):
    """A launch file in XML: the same content as one in YAML; messages call its parts as they stand in it."""

    part_name = "element"

    def __init__(self, path: str | Path, changes: Mapping[Place, Any] | None = None) -> None:
        """Reads and validates a file.

        Args:
            path: The XML file.
            changes: Values that replace those of the file, by the path of their keys as in YAML.

        Raises:
            ConfigError: It cannot be read, is not XML, declares entities, or does not fit; the message names the file,
                the line, the key, what was expected and the nearest known name.
        """
        self.path = Path(path)
        self._changes = tuple(changes or {})
        self._lines: dict[Place, int] = {}
        data = self._node(self._read())
        for keys, value in (changes or {}).items():
            override(data, keys, value)
        try:
            self.content = LaunchSpec.model_validate(data)
        except ValidationError as error:
            raise ConfigError("\n".join(self._explain(error, LaunchSpec))) from error

    def line(self, keys: Sequence[str | int]) -> int:
        """The line, from 1, of the element of a key; that of its nearest parent where it is not in the file."""
        for length in range(len(keys), 0, -1):
            if tuple(keys[:length]) in self._lines:
                return self._lines[tuple(keys[:length])]
        return 1

    def place(self, keys: Sequence[str | int]) -> str:
        """A path of elements as XPath writes it, numbers from 1: `module[2]/dag_conf[1]`."""
        steps: list[str] = []
        for key in keys:
            if isinstance(key, int) and steps:
                steps[-1] += f"[{key + 1}]"
            else:
                steps.append(_ELEMENTS.get(str(key), str(key)))
        return "/".join(steps) or "cybertron"

    def _refuse(self, line: int, message: str) -> ConfigError:
        return ConfigError(f"{self.path}:{line}: {message}")

    def _read(self) -> _Element:
        try:
            data = self.path.read_bytes()
        except OSError as error:
            raise ConfigError(f"{self.path}: cannot be read: {error.strerror}") from error
        if len(data) > _BYTES:
            raise ConfigError(f"{self.path}: is {len(data):,} bytes; a launch file has at most {_BYTES:,}")
        parser = expat.ParserCreate()
        top = _Element("", 1)
        open_elements = [top]

        def start(name: str, attributes: dict[str, str]) -> None:
            line = parser.CurrentLineNumber
            if attributes:
                raise self._refuse(
                    line, f"<{name}> has the attribute {next(iter(attributes))!r}; expected elements alone"
                )
            if len(open_elements) > _DEPTH:
                raise self._refuse(line, f"<{name}> is more than {_DEPTH} elements deep")
            element = _Element(name, line)
            open_elements[-1].children.append(element)
            open_elements.append(element)

        def end(_: str) -> None:
            element = open_elements.pop()
            element.text = element.text.strip()
            if element.text and element.children:
                raise self._refuse(element.line, f"<{element.name}> holds both text and elements")

        def text(characters: str) -> None:
            open_elements[-1].text += characters

        def refuse_declarations(*_: object) -> None:
            # Entities can make a small file a huge one, or read other files.
            raise self._refuse(parser.CurrentLineNumber, "a document type or an entity is declared; both are refused")

        parser.StartElementHandler, parser.EndElementHandler, parser.CharacterDataHandler = start, end, text
        parser.StartDoctypeDeclHandler = parser.EntityDeclHandler = refuse_declarations
        try:
            parser.Parse(data, True)
        except expat.ExpatError as error:
            problem = expat.errors.messages[error.code]
            raise self._refuse(error.lineno, f"is not XML: {problem}") from error
        except ConfigError:
            raise
        except (LookupError, ValueError) as error:  # an encoding that Python has not, or not for this
            raise self._refuse(1, f"cannot be read: {error}; write it in UTF-8") from error
        return top.children[0]

    def _node(self, root: _Element) -> dict[str, Any]:
        if root.name != "cybertron":
            raise self._refuse(root.line, f"<{root.name}>: expected <cybertron> around the modules")
        processes: list[dict[str, Any]] = []
        rest = []
        for child in root.children:
            if child.name == "module":
                processes.append(self._process(child, ("processes", len(processes))))
            else:
                rest.append(child)
        node = self._mapping(rest, (), (*_OF_NODE, "module"))
        node.setdefault("node", self.path.name.split(".")[0])
        return {**node, **({"processes": processes} if processes else {})}

    def _process(self, module: _Element, place: Place) -> dict[str, Any]:
        self._lines[place] = module.line
        files = [child for child in module.children if child.name == "dag_conf"]
        for index, file in enumerate(files):
            self._lines.setdefault((*place, "modules"), file.line)
            self._lines[*place, "modules", index] = file.line
            if file.children or not file.text:
                raise self._refuse(file.line, "<dag_conf>: expected the name of a module file")
        rest = [child for child in module.children if child.name != "dag_conf"]
        process = self._mapping(rest, place, _OF_PROCESS)
        if isinstance(process.get("cpus"), str):
            process["cpus"] = [cpu.strip() for cpu in process["cpus"].split(",") if cpu.strip()]
        return {**process, **({"modules": [file.text for file in files]} if files else {})}

    def _mapping(self, elements: Sequence[_Element], place: Place, known: Sequence[str]) -> dict[str, Any]:
        """Elements as keys and values; each once, all known; `known` empty takes any."""
        values: dict[str, Any] = {}
        for element in elements:
            at = (*place, element.name)
            if known and element.name not in known:
                raise self._refuse(element.line, f"unknown element <{element.name}>; {nearest(element.name, known)}")
            if element.name in values:
                raise self._refuse(
                    element.line,
                    f"<{element.name}> stands twice; the first is on line {self._lines[at]}",
                )
            self._lines[at] = element.line
            if element.name in _NESTED:
                values[element.name] = self._mapping(element.children, at, tuple(_NESTED[element.name].model_fields))
            elif element.name == "environment":
                values[element.name] = self._mapping(element.children, at, ())
            elif element.children:
                inner = element.children[0]
                raise self._refuse(inner.line, f"<{element.name}> holds <{inner.name}>; expected a text")
            else:
                values[element.name] = element.text
        return values
