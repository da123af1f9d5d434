"""Which topics go from process to process, and the links over which they go."""

from __future__ import annotations

import importlib
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from ...datamesh import DataMesh, Input, Output, declared_handles
from ...datamesh.messages import message_type
from ...datamesh.transport import Exporter, ExportService, Importer, SharedMemoryConfig, ZenohConfig
from ...datamesh.transport.zenoh_links import ZenohExporter, ZenohImporter, ZenohSession
from ...errors import ConfigError
from ..configuration import ConfigFile, import_class, nearest
from ..graph import check_payloads, declare_vertices, graph_payloads, type_name
from ..process import Process
from ..schema import ComponentSpec, ModuleSpec
from .rehearsing import rehearsal

__all__ = ["LinkPlan", "Links", "plan_links"]

REMOTE = ("zenoh",)
"""The transports between hosts."""


@dataclass(frozen=True)
class LinkPlan:
    """What one process sends to others, and what it gets of them."""

    exports: tuple[str, ...] = ()
    """Topics committed here and read in another process, or on another host."""
    imports: tuple[str, ...] = ()
    """Topics read here and committed elsewhere."""
    blocking: tuple[str, ...] = ()
    """Of the imports, those whose producer waits where this process is not ready for more: backlog `block`."""
    remote: Mapping[str, str] = field(default_factory=dict)
    """Of both, those that go between hosts, and how."""
    homes: tuple[str, ...] = ()
    """Python modules that define the messages of the imports: a process that names none of them itself, as one that
    only records, could not read what comes."""

    @property
    def external(self) -> dict[str, Any]:
        """For `Process(external=…)`: the imports, whose types `plan_links` has checked."""
        return dict.fromkeys(self.imports, object)


@dataclass(frozen=True)
class _Use:
    """One handle of a component, as a module file maps it to a topic."""

    process: str
    file: ConfigFile[ModuleSpec]
    keys: tuple[str | int, ...]
    component: ComponentSpec
    topic: str
    payload: Any
    optional: bool


def plan_links(
    modules: Mapping[str, Sequence[ConfigFile[ModuleSpec]]], *, remote: Mapping[str, str] | None = None
) -> dict[str, LinkPlan]:
    """The links of all processes of a node.

    Args:
        modules: The module files of each process.
        remote: Topics that go between hosts, and how (`zenoh`): those committed here are sent there too, the others
            come from there.

    Raises:
        ConfigError: A topic has two producers in the node, or none; or is read as another type than it carries; or goes
            by a transport that there is not.
    """
    remote = remote or {}
    for topic, transport in remote.items():
        if transport not in REMOTE:
            raise ConfigError(
                f"topic {topic!r}: no transport {transport!r} between hosts; {nearest(transport, REMOTE)}"
            )
    outputs: list[_Use] = []
    inputs: list[_Use] = []
    for process, files in modules.items():
        for file in files:
            for index in range(len(file.content.components)):
                read, committed = _uses(process, file, index)
                inputs += read
                outputs += committed
    producers = _producers(outputs)
    for use in inputs:
        _check(use, producers, remote)
    plans = {}
    for process in modules:
        read = [use for use in inputs if use.process == process]
        own = {use.topic for use in outputs if use.process == process}
        wanted = {use.topic for use in inputs if use.process != process} | set(remote)
        imports = {
            use.topic for use in read if use.topic not in own and (use.topic in producers or use.topic in remote)
        }
        exports = own & wanted
        blocking = {use.topic for use in read if use.topic in imports and _blocks(use)}
        crossing = {topic: remote[topic] for topic in sorted(exports | (imports - set(producers))) if topic in remote}
        homes = {
            producers[topic].payload.__module__ for topic in imports & set(producers) if _is_message(producers[topic])
        }
        plans[process] = LinkPlan(
            tuple(sorted(exports)), tuple(sorted(imports)), tuple(sorted(blocking)), crossing, tuple(sorted(homes))
        )
    return plans


def _uses(process: str, file: ConfigFile[ModuleSpec], index: int) -> tuple[list[_Use], list[_Use]]:
    """The inputs and outputs of a component."""
    spec = file.content.components[index]
    keys: tuple[str | int, ...] = ("components", index)
    handles: dict[str, Input | Output] = {}
    if spec.class_name:
        try:
            handles = declared_handles(import_class(spec.class_name))
        except ConfigError as error:
            raise file.error([*keys, "class"], str(error)) from error
        except (NameError, TypeError):  # a plain class, whose annotations are its own business
            handles = {}
    payloads: dict[str, Any] = {}
    if spec.graph:
        read, committed = graph_payloads(declare_vertices(file, list(keys), spec))
        payloads = {**{name: read.get(name, object) for name in spec.inputs}, **committed}
    result: list[list[_Use]] = []
    for direction, topics in (("inputs", spec.inputs), ("outputs", spec.outputs)):
        uses = []
        for name, topic in topics.items():
            handle = handles.get(name)
            payload = handle.payload if handle is not None else object
            payload = payloads.get(name, object) if payload is object else payload
            optional = handle is not None and handle.optional
            uses.append(_Use(process, file, (*keys, direction, name), spec, topic, payload, optional))
        result.append(uses)
    return result[0], result[1]


def _producers(outputs: Sequence[_Use]) -> dict[str, _Use]:
    producers: dict[str, _Use] = {}
    for use in outputs:
        other = producers.setdefault(use.topic, use)
        if other is not use:
            where = "" if other.process == use.process else f" in process {other.process!r}"
            raise use.file.error(
                use.keys,
                f"topic {use.topic!r} has two producers: {other.component.name!r}{where} and {use.component.name!r}"
                + ("" if not where else f" in process {use.process!r}"),
            )
    return producers


def _check(use: _Use, producers: Mapping[str, _Use], remote: Mapping[str, str]) -> None:
    """There is somebody who commits what is read, as the type that it is read as."""
    producer = producers.get(use.topic)
    if producer is None:
        if use.topic not in remote and not use.optional:
            known = {*producers, *remote}
            raise use.file.error(use.keys, f"nobody produces topic {use.topic!r}; {nearest(use.topic, known)}")
    elif not check_payloads(producer.payload, use.payload):
        carried, wanted = type_name(producer.payload), type_name(use.payload)
        where = f" from process {producer.process!r}" if producer.process != use.process else ""
        raise use.file.error(use.keys, f"topic {use.topic!r} carries {carried}{where}, not {wanted}")


def _is_message(use: _Use) -> bool:
    return isinstance(use.payload, type) and message_type(use.payload) is not None


def _blocks(use: _Use) -> bool:
    return use.component.backlog.policy == "block" and use.keys[-1] in use.component.trigger.inputs


class _Link(Protocol):
    """An export or import, whatever its transport."""

    def stop(self) -> None: ...

    def counters(self) -> Mapping[str, int]: ...


class Links:
    """The links of a process: exports and imports of its mesh, from `start` to `stop`.

    links = Links(process, plan, node="demo", name="compute")
    links.start()          # the exports first: nothing that the process commits is missed
    process.start()
    …
    links.stop_imports()   # nothing new comes in
    process.stop()         # what waits is finished, and still sent
    links.stop()
    """

    def __init__(
        self,
        process: Process | DataMesh,
        plan: LinkPlan,
        *,
        node: str,
        name: str,
        shared_memory: SharedMemoryConfig | None = None,
        zenoh: ZenohConfig | None = None,
    ) -> None:
        """Prepares.

        Args:
            process: Whose topics they are.
            plan: Which.
            node: The name of the node: only processes of one node meet, and only those of one user.
            name: Of the process in it; the same in its next life.
            shared_memory: Sizes of the links on this host.
            zenoh: The links between hosts.
        """
        self._mesh = process.mesh if isinstance(process, Process) else process
        self._plan = plan
        self._node = node
        self._name = name
        self._shared = shared_memory or SharedMemoryConfig()
        self._zenoh = zenoh or ZenohConfig()
        self._lock = threading.RLock()
        self._service: ExportService | None = None
        self._session: ZenohSession | None = None
        self._exports: dict[str, list[_Link]] = {}
        self._imports: dict[str, _Link] = {}
        for home in plan.homes:
            importlib.import_module(home)

    def start(self) -> None:
        """Begins to send and to receive what the plan says.

        Raises:
            ConfigError: Another process exports one of the topics, or zenoh cannot be used; nothing has started.
        """
        try:
            for topic in self._plan.exports:
                self.export(topic)
            for topic in self._plan.imports:
                self.import_(topic)
        except BaseException:
            self.stop()
            raise

    def export(self, topic: str) -> None:
        """Sends a topic from now on, to whoever in the node asks; one that is sent already stays so.

        Raises:
            ConfigError: It comes from another process.
        """
        with self._lock:
            if topic in self._exports:
                return
            if topic in self._imports:
                raise ConfigError(f"topic {topic!r} comes from another process: it is exported there")
            if self._service is None:
                self._service = ExportService(f"links of {self._name}")
            window = self._mesh.window(topic)
            links: list[_Link] = self._exports.setdefault(topic, [])
            try:
                shared = Exporter(window, self._service, node=self._node, name=self._name, config=self._shared)
                links.append(shared)
                if topic in self._plan.remote:
                    links.append(ZenohExporter(self._session_of_zenoh(), window, shared.order))
            except BaseException:
                self.end_export(topic)
                raise

    def import_(self, topic: str) -> None:
        """Receives a topic from now on, whoever in the node commits it; one that is received already stays so.

        Raises:
            ConfigError: It is committed, and exported, by this process.
        """
        with self._lock:
            if topic in self._imports:
                return
            if topic in self._exports:
                raise ConfigError(f"topic {topic!r} is committed by this process: it has no need to import it")
            window = self._mesh.window(topic)
            if topic in self._plan.remote:
                link = ZenohImporter(self._session_of_zenoh(), window)
            else:
                blocks = topic in self._plan.blocking
                link = Importer(
                    window, node=self._node, name=self._name, config=self._shared, blocks=blocks, rehearsal=rehearsal
                )
                link.start()
            self._imports[topic] = link

    def end_export(self, topic: str) -> None:
        """Ends what `export` began."""
        with self._lock:
            for link in reversed(self._exports.pop(topic, [])):
                link.stop()

    def end_import(self, topic: str) -> None:
        """Ends what `import_` began; what was received stays in the window."""
        with self._lock:
            link = self._imports.pop(topic, None)
        if link is not None:
            link.stop()

    def stop_imports(self) -> None:
        """Ends receiving, before the process stops."""
        for topic in tuple(self._imports):
            self.end_import(topic)

    def stop(self) -> None:
        """Ends everything, after the process has stopped; `start` may follow."""
        self.stop_imports()
        for topic in tuple(self._exports):
            self.end_export(topic)
        with self._lock:
            service, self._service = self._service, None
            session, self._session = self._session, None
        if service is not None:
            service.stop()
        if session is not None:
            session.close()

    def counters(self) -> dict[str, dict[str, int]]:
        """What was sent and received so far, by topic.

        Of exports: commits, sent, sent_bytes (of messages, not of slabs), copied and copied_bytes (payloads that were
        not built in shared memory), slow, no_memory and not_encodable (what was dropped), kept (for readers that were
        killed) and away (of that, what was dropped), readers, connections, disconnections, slabs (in use). Of imports:
        received, received_bytes, missed, damaged, connections, connected.
        """
        with self._lock:
            exports = {topic: tuple(links) for topic, links in self._exports.items()}
            imports = {topic: (link,) for topic, link in self._imports.items()}
        counts: dict[str, dict[str, int]] = {}
        for topic, links in {**exports, **imports}.items():
            total: Counter[str] = Counter()
            for link in links:
                total.update(link.counters())
            counts[topic] = dict(total)
        return dict(sorted(counts.items()))

    def _session_of_zenoh(self) -> ZenohSession:
        if self._session is None:
            self._session = ZenohSession(self._zenoh, node=self._node)
        return self._session
