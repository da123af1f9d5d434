"""The processor: one vertex of a graph, one class, which can be imported and tested alone.

class NearestObject(Processor):
    objects: In[Obstacles]
    distance: Out[float]

    def process(self, trigger: Trigger) -> Status:
        self.distance.value = float(np.linalg.norm(self.objects.value.boxes[:, :2], axis=1).min(initial=np.inf))
        return Status.OK
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any, ClassVar, Generic, Self, TypeVar, get_args, get_origin, get_type_hints

from pydantic import BaseModel, ConfigDict

from ..datamesh import Input, LossCounters, Output, Status
from .logs import component_logger
from .recorded_reads import Read, RecordedReads
from .trigger import Trigger

__all__ = ["In", "Out", "Processor", "ProcessorConfig", "ProcessorHarness", "Wiring", "declared_ports"]

T = TypeVar("T")
_ABSENT: Any = object()


class _Port(Generic[T]):
    """A port of a processor; the engine fills those for input before a run, and reads those for output after it."""

    def __init__(self, *, optional: bool = False) -> None:
        """Declares a port.

        Args:
            optional: The processor also runs in a frame in which this is absent.
        """
        self.optional = optional
        self.name = ""
        self.payload: Any = object
        self._value: T = _ABSENT

    @property
    def present(self) -> bool:
        """Whether it has a value in this run."""
        return self._value is not _ABSENT

    @property
    def value(self) -> T:
        """The value in this run.

        Raises:
            LookupError: It is absent.
        """
        if self._value is _ABSENT:
            raise LookupError(f"{type(self).__name__} {self.name!r} has no value in this run")
        return self._value

    @value.setter
    def value(self, value: T) -> None:
        self._value = value

    def clear(self) -> None:
        """Makes it absent."""
        self._value = _ABSENT


class In(_Port[T]):
    """What a processor reads."""


class Out(_Port[T]):
    """What a processor writes; not written in a run, it is absent for those after it."""


class ProcessorConfig(BaseModel):
    """The base of configurations: unknown keys are refused, and numbers that are not finite."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def declared_ports(processor: type) -> dict[str, In | Out]:
    """The ports that a class declares, by name, as new ports with their payload types.

    A declaration is an annotation `name: In[Payload]`, with `= In(optional=True)` where options are wanted.
    """
    ports: dict[str, In | Out] = {}
    for name, hint in get_type_hints(processor).items():
        kind = get_origin(hint) or hint
        if kind not in (In, Out):
            continue
        options = getattr(processor, name, None)
        port = kind(optional=options.optional if isinstance(options, _Port) else False)
        port.name = name
        port.payload = (get_args(hint) or (object,))[0]
        ports[name] = port
    return ports


class Processor:
    """The base of all vertices. A processor serves one run at a time, and sees the frames in the order of versions."""

    Config: ClassVar[type[BaseModel]] = ProcessorConfig
    """The model of its configuration; a subclass names its own."""
    waits: ClassVar[bool] = False
    """Whether it may have to wait for data of the mesh, so that `begin` is called before `process`."""

    def __init__(self) -> None:
        self.name = type(self).__name__
        self.context: Any = None
        self.in_flight = 1
        """Frames that may be in the graph at once: a processor whose outputs are workspace needs as many of them."""
        self.place = self.name
        """Where losses are counted: component.vertex."""
        self.losses = LossCounters()
        self.flags: Mapping[str, Any] = {}
        """What the flag loaders of the process found."""
        self.reads: dict[str, Read] = {}
        """What this run read of inputs that did not trigger it, by input; the timings tell it."""
        self.recorded: RecordedReads | None = None
        """In a replay: what the recorded run read."""
        self.component_inputs: Mapping[str, Input] = {}
        self.component_outputs: Mapping[str, Output] = {}
        self.ports = declared_ports(type(self))
        for name, port in self.ports.items():
            setattr(self, name, port)

    @cached_property
    def log(self) -> logging.Logger:
        """Its logger, from `init` on: `warploom.component.COMPONENT.VERTEX`."""
        return component_logger(self.place)

    def check(self, config: Any) -> None:
        """Says what in a configuration does not fit its surroundings; compiles and loads nothing. Called before `init`.

        Raises:
            ValueError: Something does not.
        """

    def init(self, config: Any) -> None:
        """Prepares for the first run: builds plans, loads models. `config` is an instance of `Config`."""

    def begin(self, trigger: Trigger, resume: Callable[[], None]) -> bool:
        """Begins to wait, where `waits` is set, and gives the worker back meanwhile.

        Args:
            trigger: Of the frame.
            resume: To be called once, from any thread, when the wait is over; `process` runs then.

        Returns:
            Whether it waits. If not, `process` runs at once, and `resume` is not called.
        """
        return False

    def process(self, trigger: Trigger) -> Status:
        """Runs for one frame: reads its In ports, writes its Out ports.

        An exception fails this frame alone: it is counted, and the next frame runs.
        """
        raise NotImplementedError

    def close(self) -> None:
        """Lets go of what `init` took."""


class Wiring:
    """How the ports of a processor and the data of a frame are connected."""

    __slots__ = ("_ports", "_reads", "_writes")

    def __init__(self, processor: Processor, inputs: Mapping[str, str], outputs: Mapping[str, str]) -> None:
        """Connects them.

        Args:
            processor: Whose ports they are.
            inputs: In port → name of the datum.
            outputs: Out port → name of the datum.
        """
        self._ports = tuple(processor.ports.values())
        self._reads = tuple((processor.ports[port], datum) for port, datum in inputs.items())
        self._writes = tuple((processor.ports[port], datum) for port, datum in outputs.items())

    def fill(self, data: Mapping[str, Any]) -> bool:
        """Gives the In ports, which are clear, what is there; tells whether all that is needed is."""
        for port, datum in self._reads:
            if datum in data:
                port._value = data[datum]
            elif not port.optional:
                return False
        return True

    def collect(self, data: dict[str, Any]) -> None:
        """Takes what was written to the Out ports."""
        for port, datum in self._writes:
            if port._value is not _ABSENT:
                data[datum] = port._value

    def clear(self) -> None:
        """Makes all ports absent."""
        for port in self._ports:
            port._value = _ABSENT


class ProcessorHarness:
    """Runs a processor alone, without graph or runtime.

    outputs = ProcessorHarness(MyProcessor, {"radius": 0.5}).feed(cloud=cloud).run(version=0)
    """

    def __init__(
        self,
        processor: type[Processor],
        config: Mapping[str, Any] | None = None,
        context: Any = None,
        *,
        inputs: Mapping[str, Input] | None = None,
        outputs: Mapping[str, Output] | None = None,
    ):
        """Makes and initialises the processor.

        Args:
            processor: Its class.
            config: Its configuration, validated by the class's `Config`.
            context: What the runtime would give as `self.context`.
            inputs: The component's inputs, bound, for a processor that reads the mesh.
            outputs: The component's outputs, bound, for a processor that commits to the mesh.

        Raises:
            TypeError: It is no class of a processor.
        """
        if not (isinstance(processor, type) and issubclass(processor, Processor)):
            raise TypeError(f"ProcessorHarness takes the class of a processor, not {processor!r}")
        self.processor = processor()
        self.processor.context = context
        self.processor.component_inputs = inputs or {}
        self.processor.component_outputs = outputs or {}
        validated = processor.Config.model_validate(dict(config or {}))
        self.processor.check(validated)
        self.processor.init(validated)
        self.status: Status | None = None

    def feed(self, **inputs: Any) -> Self:
        """Sets In ports by name; they keep their values for the runs that follow.

        Raises:
            ValueError: There is no In port of that name.
        """
        for name, value in inputs.items():
            port = self.processor.ports.get(name)
            if not isinstance(port, In):
                known = ", ".join(n for n, p in self.processor.ports.items() if isinstance(p, In))
                raise ValueError(f"{type(self.processor).__name__} has no input {name!r}; it has: {known}")
            port.value = value
        return self

    def run(self, version: int | Trigger = 0) -> dict[str, Any]:
        """Runs once and gives the Out ports that were written, by name; `.status` tells how it ended.

        Args:
            version: Of the frame [ns], or the whole trigger.

        Raises:
            TypeError: `process` returned no Status.
        """
        outputs = {name: port for name, port in self.processor.ports.items() if isinstance(port, Out)}
        for port in outputs.values():
            port.clear()
        trigger = version if isinstance(version, Trigger) else Trigger(version)
        if self.processor.waits:
            resumed = threading.Event()
            if self.processor.begin(trigger, resumed.set):
                resumed.wait()
        self.status = self.processor.process(trigger)
        if not isinstance(self.status, Status):
            raise TypeError(f"process of {type(self.processor).__name__} returned {self.status!r}, not a Status")
        return {name: port.value for name, port in outputs.items() if port.present}
