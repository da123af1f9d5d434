"""A process: the components of several module files on one mesh, checked as a whole before anything starts."""

from __future__ import annotations

import logging
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar

from ..datamesh import DataMesh, Input
from ..errors import ConfigError
from .backlog import BacklogConfig
from .component import Component, DataProcessComponent, GenericComponent
from .configuration import ConfigFile, import_class, nearest
from .dag_component import DagComponent, MonotonicDagComponent
from .engine import VertexTiming
from .flags import load_flags
from .garbage import FrozenHeap
from .graph import DeclaredVertex, check_payloads, declare_vertices, graph_payloads, type_name
from .schema import ComponentSpec, ModuleSpec

__all__ = ["Process"]

_log = logging.getLogger(__name__)

_Place = tuple[ConfigFile[ModuleSpec], int]


class Process:
    """Runs the components of some module files.

    Building it validates everything: what is wrong raises ConfigError, and nothing has started.
    """

    def __init__(
        self,
        modules: Sequence[ConfigFile[ModuleSpec]],
        *,
        mesh: DataMesh | None = None,
        context: Any = None,
        external: Mapping[str, Any] | None = None,
        offline: bool = False,
        on_timing: Callable[[VertexTiming], None] | None = None,
        check: bool = False,
        switch_interval_s: float | None = 100e-6,
        freeze: bool = True,
        prepare: bool = True,
    ) -> None:
        """Builds, checks and initialises all components.

        Args:
            modules: The module files.
            mesh: Where their topics live; by default a mesh of its own.
            context: Given to every component and processor as `self.context`.
            external: Topics that are committed from outside the modules, with their payload types.
            offline: Every backlog blocks its producer, so that no frame is lost to a slow component; deadlines are
                counted and change nothing.
            on_timing: Is told of the run of every vertex, and of every data process.
            check: Payloads are compared with what they were at their commit; see `DataMesh`.
            switch_interval_s: How long a thread that computes in Python keeps others waiting, while this process runs
                (`sys.setswitchinterval`); None leaves it as it is. Python's own 5 ms are as much as a frame's share.
            freeze: Keep the garbage collector from all that is there when it starts, until it stops: a full pass would
                hold every thread up for 0.1 s; see `frozen_heap`.
            prepare: False only validates: nothing is initialised, so no kernel is compiled and no model loaded, and
                what was made cannot be started.

        Raises:
            ConfigError: A module does not fit its classes or the others.
        """
        self.mesh = mesh if mesh is not None else DataMesh(check=check)
        self.flags = load_flags(modules)
        self.components: dict[str, Component] = {}
        self._started: list[Component] = []
        self._switching = _SwitchInterval(switch_interval_s)
        self._heap = FrozenHeap() if freeze else None
        places = [(file, index) for file in modules for index in range(len(file.content.components))]
        built = [self._declare(place, context) for place in places]
        self._check_topics(places, external or {})
        for (file, index), (component, vertices) in zip(places, built, strict=True):
            self._prepare(file, index, component, vertices, offline, on_timing, prepare)
        self._prepared = prepare

    def _declare(self, place: _Place, context: Any) -> tuple[Component, list[DeclaredVertex]]:
        """Makes a component and its vertices, neither bound nor initialised."""
        file, index = place
        spec = file.content.components[index]
        keys = ["components", index]
        if spec.name in self.components:
            raise file.error([*keys, "name"], f"there is a component {spec.name!r} already")
        vertices: list[DeclaredVertex] = []
        if spec.kind == "generic":
            component = self._generic(place, spec, context)
        else:
            base = {"data": DataProcessComponent, "dag": DagComponent, "monotonic_dag": MonotonicDagComponent}[
                spec.kind
            ]
            component = self._made(place, spec, self._class_of(place, spec, base), context)
        if isinstance(component, DagComponent) != bool(spec.graph):
            raise file.error([*keys, "kind"], f"{spec.class_name} is a DagComponent: its kind is dag or monotonic_dag")
        for name in spec.outputs:
            if name in spec.inputs:
                raise file.error(
                    [*keys, "outputs", name], f"there is an input {name!r} too: give the output a name of its own"
                )
        if component.takes_any_input:
            for name in spec.inputs:
                component.inputs.setdefault(name, Input())
        if isinstance(component, DagComponent):
            component.add_handles(list(spec.inputs), list(spec.outputs))
            vertices = declare_vertices(file, keys, spec)
            read, committed = graph_payloads(vertices)
            for payloads, handles in ((read, component.inputs), (committed, component.outputs)):
                for name, handle in handles.items():
                    handle.payload = payloads.get(name, object) if handle.payload is object else handle.payload
            for declared in vertices:
                vertex, vertex_spec = declared.vertex, spec.graph[declared.vertex.name]
                vertex.config = declared.config
                vertex.expendable = vertex_spec.expendable
                if vertex_spec.deadline_ms is not None:
                    vertex.deadline_ns = round(vertex_spec.deadline_ms * 1e6)
                processor = vertex.processor
                processor.context = context
                processor.flags = self.flags
                processor.in_flight = spec.in_flight
                processor.component_inputs = component.inputs
                processor.component_outputs = component.outputs
        for direction, handles, topics in (
            ("inputs", component.inputs, spec.inputs),
            ("outputs", component.outputs, spec.outputs),
        ):
            for name in topics:
                if name not in handles:
                    raise file.error([*keys, direction, name], f"no such handle; {nearest(name, handles)}")
            for name, handle in handles.items():
                if name not in topics and not handle.optional:
                    raise file.error(keys, f"{direction}.{name} is not mapped to a topic")
        component.flags = self.flags
        self.components[spec.name] = component
        return component, vertices

    @staticmethod
    def _class_of(place: _Place, spec: ComponentSpec, base: type) -> type:
        file, index = place
        if not spec.class_name:
            return base
        try:
            found = import_class(spec.class_name)
        except ConfigError as error:
            raise file.error(["components", index, "class"], str(error)) from error
        if not issubclass(found, base):
            raise file.error(["components", index, "class"], f"{spec.class_name} is not a {base.__name__}")
        return found

    @staticmethod
    def _made(place: _Place, spec: ComponentSpec, component: type, context: Any) -> Component:
        try:
            return component(spec.name, context)
        except Exception as error:
            message = f"{spec.class_name} cannot be made: {type(error).__name__}: {error}"
            raise place[0].error(["components", place[1], "class"], message) from error

    def _generic(self, place: _Place, spec: ComponentSpec, context: Any) -> Component:
        plain = self._class_of(place, spec, object)
        if issubclass(plain, DataProcessComponent):
            keys = ["components", place[1], "kind"]
            raise place[0].error(keys, f"{spec.class_name} is a DataProcessComponent: its kind is data, or dag")
        if issubclass(plain, Component):
            return self._made(place, spec, plain, context)
        try:
            return GenericComponent(spec.name, plain, spec.config, context)
        except Exception as error:
            keys = ["components", place[1], "config"]
            raise place[0].error(keys, f"{spec.class_name} refused its configuration: {error}") from error

    def _check_topics(self, places: Sequence[_Place], external: Mapping[str, Any]) -> None:
        """Every topic that is read has exactly one producer, of a fitting type."""
        producers: dict[str, str] = dict.fromkeys(external, "outside")
        types: dict[str, Any] = dict(external)
        for file, index in places:
            spec = file.content.components[index]
            for name, topic in spec.outputs.items():
                if topic in producers:
                    raise file.error(
                        ["components", index, "outputs", name],
                        f"topic {topic!r} has two producers: {producers[topic]!r} and {spec.name!r}",
                    )
                producers[topic] = spec.name
                types[topic] = self.components[spec.name].outputs[name].payload
        for file, index in places:
            spec = file.content.components[index]
            for name, topic in spec.inputs.items():
                handle = self.components[spec.name].inputs[name]
                keys = ["components", index, "inputs", name]
                if topic not in producers and not handle.optional:
                    raise file.error(keys, f"nobody produces topic {topic!r}; {nearest(topic, producers)}")
                if not check_payloads(types.get(topic, object), handle.payload):
                    raise file.error(
                        keys, f"topic {topic!r} carries {type_name(types[topic])}, not {type_name(handle.payload)}"
                    )
        self._check_triggers(places)

    @staticmethod
    def _check_triggers(places: Sequence[_Place]) -> None:
        """No component waits for a trigger that only comes of its own outputs."""
        specs = [(file, index, file.content.components[index]) for file, index in places]
        producers = {topic: spec for _, _, spec in specs for topic in spec.outputs.values()}
        needs = {
            spec.name: [producers[t].name for t in map(spec.inputs.get, spec.trigger.inputs) if t in producers]
            for _, _, spec in specs
        }
        for file, index, spec in specs:
            chain = _path(needs, spec.name, spec.name)
            if chain:
                message = f"these components trigger each other in a cycle, so none ever runs: {chain}"
                raise file.error(["components", index, "trigger"], message)

    def _prepare(
        self,
        file: ConfigFile[ModuleSpec],
        index: int,
        component: Component,
        vertices: Sequence[DeclaredVertex],
        offline: bool,
        on_timing: Callable[[VertexTiming], None] | None,
        prepare: bool,
    ) -> None:
        """Binds a component to the mesh, checks it and initialises it."""
        spec = file.content.components[index]
        keys = ["components", index]
        topics = {**spec.inputs, **spec.outputs}
        unmapped = {
            name: f"{spec.name}/{name}" for name in (*component.inputs, *component.outputs) if name not in topics
        }
        component.bind(self.mesh, {**topics, **unmapped})
        for declared in vertices:
            vertex = declared.vertex
            vertex.processor.place = f"{spec.name}.{vertex.name}"
            vertex.processor.losses = self.mesh.losses
            try:
                vertex.processor.check(declared.config)
                if prepare:
                    vertex.processor.init(declared.config)
            except (ValueError, TypeError, KeyError) as error:
                raise file.error([*keys, "graph", vertex.name, "config"], str(error)) from error
        if isinstance(component, DagComponent):
            deadline = spec.deadline
            if offline and deadline is not None:
                deadline = deadline.model_copy(update={"on_miss": "count"})
            component.set_graph(
                [declared.vertex for declared in vertices],
                workers=spec.workers,
                in_flight=spec.in_flight,
                on_timing=on_timing,
                deadline=deadline,
            )
        if not isinstance(component, GenericComponent):
            config = file.validate([*keys, "config"], component.Config, spec.config)
            try:
                component.check(config)
                if prepare:
                    component.init(config)
            except (ValueError, TypeError, KeyError) as error:
                raise file.error([*keys, "config"], str(error)) from error
        if isinstance(component, DataProcessComponent):
            if not isinstance(component, DagComponent):
                component.on_timing = on_timing
            backlog = BacklogConfig(policy="block", depth=spec.backlog.depth) if offline else spec.backlog
            for window in (component.inputs[name].window for name in spec.trigger.inputs):
                if backlog.policy != "latest" and backlog.depth + 2 > window.capacity:
                    raise file.error(
                        [*keys, "backlog", "depth"],
                        f"{backlog.depth} triggers may wait, but the window of {window.topic!r} keeps "
                        f"{window.capacity} versions, so they would be evicted; at most {window.capacity - 2}",
                    )
            component.set_trigger(spec.trigger, backlog, spec.hand_off)

    @property
    def in_flight(self) -> int:
        """The most frames that one of the graphs lets in at once."""
        return max((c.in_flight for c in self.components.values() if isinstance(c, DagComponent)), default=1)

    def start(self) -> None:
        """Starts the components, those that consume before those that produce; all of them, or none. And again.

        Raises:
            RuntimeError: It was made to be validated, with `prepare=False`.
        """
        if not self._prepared:
            raise RuntimeError("this process was only validated: make it without prepare=False to start it")
        self._switching.hold()
        for component in self._consumers_first():
            try:
                component.start()
            except BaseException:
                self.stop()
                raise
            self._started.append(component)
        if self._heap is not None:  # last, as what starts again also initialises again
            self._heap.hold()

    def stop(self) -> None:
        """Stops the components, those that produce first, each after it has finished what waits for it."""
        while self._started:
            component = self._started.pop()
            try:
                component.stop()
            except Exception:  # the others must stop all the same
                _log.exception("%s failed to stop", component.name)
        if self._heap is not None:
            self._heap.release()
        self._switching.release()

    def _consumers_first(self) -> Iterable[Component]:
        order: list[Component] = []
        left = list(self.components.values())
        while left:
            # Where weak inputs close a cycle, what triggers whom decides; that has no cycle.
            free = [one for one in left if not _feeds(one, left)] or [one for one in left if not _triggers(one, left)]
            left.remove(free[0])
            order.append(free[0])
        return order


def _feeds(component: Component, others: Iterable[Component]) -> bool:
    topics = {handle.topic for handle in component.outputs.values()}
    return any(handle.topic in topics for one in others if one is not component for handle in one.inputs.values())


def _triggers(component: Component, others: Iterable[Component]) -> bool:
    topics = {handle.topic for handle in component.outputs.values()}
    triggered = (one for one in others if isinstance(one, DataProcessComponent))
    return any(one.inputs[name].topic in topics for one in triggered for name in one.trigger_inputs)


def _path(needs: Mapping[str, Sequence[str]], start: str, end: str, seen: frozenset[str] = frozenset()) -> list[str]:
    """The names from one to another that it needs, directly or not, without the last; empty where there is no way."""
    for name in needs[start]:
        if name == end:
            return [start]
        way = _path(needs, name, end, seen | {start}) if name not in seen else []
        if way:
            return [start, *way]
    return []


class _SwitchInterval:
    """Python's switch interval, shortened while one of the processes that ask for it runs."""

    _lock: ClassVar[threading.Lock] = threading.Lock()
    _held: ClassVar[list[float]] = []
    _before: ClassVar[float] = 0.0

    def __init__(self, seconds: float | None) -> None:
        self._seconds = seconds
        self._holds = False

    def hold(self) -> None:
        """Shortens it, for the first one that holds it."""
        with self._lock:
            if self._seconds is None or self._holds:
                return
            if not self._held:
                _SwitchInterval._before = sys.getswitchinterval()
            self._held.append(self._seconds)
            self._holds = True
            sys.setswitchinterval(min(self._before, *self._held))

    def release(self) -> None:
        """Sets it to what the others ask for, or what it was."""
        with self._lock:
            if self._seconds is not None and self._holds:
                self._held.remove(self._seconds)
                self._holds = False
                sys.setswitchinterval(min([self._before, *self._held]))
