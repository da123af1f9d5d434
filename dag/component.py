"""The kinds of components without a graph: generic, and data process. Those with one are in `dag_component`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Container, Mapping
from functools import partial
from typing import Any, ClassVar, Literal

from pydantic import BaseModel

from ..datamesh import (
    CURRENT_EPOCH,
    Clock,
    DataMesh,
    Entry,
    Input,
    LossCounters,
    Output,
    Status,
    SystemClock,
    Window,
    declared_handles,
)
from .backlog import Backlog, BacklogConfig
from .engine import VertexTiming
from .logs import component_logger
from .processor import ProcessorConfig
from .recorded_reads import Awaited
from .trigger import Trigger, TriggerConfig
from .triggering import AllTrigger, AnyTrigger, TimeTrigger, TriggerSource

__all__ = ["Component", "DataProcessComponent", "GenericComponent"]


class Component:
    """The base: a named part of a process, which the process starts and stops."""

    Config: ClassVar[type[BaseModel]] = ProcessorConfig
    """The model of its configuration; a subclass names its own."""

    takes_any_input: ClassVar[bool] = False
    """Whether the configuration may map inputs that the class does not declare, of any names and types."""

    def __init__(self, name: str, context: Any = None) -> None:
        """Makes an unbound component.

        Args:
            name: Unique in its process.
            context: What the process gives to all its components: devices, capacities, models.
        """
        self.name = name
        self.context = context
        self.inputs: dict[str, Input] = {}
        self.outputs: dict[str, Output] = {}
        for handle_name, handle in declared_handles(type(self)).items():
            (self.inputs if isinstance(handle, Input) else self.outputs)[handle_name] = handle  # type: ignore[assignment]
            setattr(self, handle_name, handle)
        self.log = component_logger(name)
        """Its own: `warploom.component.NAME`."""
        self.losses = LossCounters()
        self.clock: Clock = SystemClock()
        self.flags: Mapping[str, Any] = {}
        """What the flag loaders of the process found."""

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Connects the handles to their topics in the mesh.

        Args:
            mesh: Where the topics are.
            topics: Their names by handle.

        Raises:
            ValueError: A handle has no topic.
        """
        missing = [name for name in (*self.inputs, *self.outputs) if name not in topics]
        if missing:
            raise ValueError(f"{self.name}: {missing[0]!r} has no topic; topics are given for: {', '.join(topics)}")
        self.losses = mesh.losses
        self.clock = mesh.clock
        for name, handle in (*self.inputs.items(), *self.outputs.items()):
            handle.bind(name, mesh.window(topics[name]))

    def check(self, config: Any) -> None:
        """Says what in a configuration does not fit its surroundings; opens and starts nothing. Called before `init`.

        Raises:
            ValueError: Something does not.
        """

    def init(self, config: Any) -> None:
        """Prepares: `config` is an instance of `Config`."""

    def start(self) -> None:
        """Starts whatever runs."""

    def stop(self) -> None:
        """Finishes what waits, then stops; no thread of it is left."""


class GenericComponent(Component):
    """Any plain class as a component: it is made with the configuration, and its `start` and `stop`, if any, called."""

    def __init__(self, name: str, plain: type, config: Mapping[str, Any], context: Any = None) -> None:
        """Makes an instance of the class.

        Args:
            name: Unique in its process.
            plain: The class.
            config: Arguments for its constructor.
            context: As for every component.
        """
        super().__init__(name, context)
        self.instance = plain(**config)

    def start(self) -> None:
        """Calls the instance's `start`, if it has one."""
        getattr(self.instance, "start", lambda: None)()

    def stop(self) -> None:
        """Calls the instance's `stop`, if it has one."""
        getattr(self.instance, "stop", lambda: None)()


class DataProcessComponent(Component):
    """Computes: reads and writes the mesh, once for each trigger.

    A subclass declares handles and overrides `process`. An exception in it costs that frame, is counted and logged.
    """

    stop_timeout_s: ClassVar[float] = 30.0
    """How long the frames that wait or run may take when it stops; what hangs longer is left to itself, and counted."""

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self.trigger_inputs: tuple[str, ...] = ()
        self.has_run = False
        """Whether it is through with a frame: the first may take long, as kernels are compiled for it."""
        self.backlog: Backlog | None = None
        """The triggers that wait; None before `set_trigger`."""
        self._source = TriggerSource(self._offer)
        self._windows: dict[str, Window[Any]] = {}
        self._inline = self._runs_later = False
        self._thread: threading.Thread | None = None
        self._serving = threading.Lock()
        self.running: Trigger | None = None
        """What it runs for now."""
        self.after_run: Callable[[Trigger], None] | None = None
        """Is told of each run that is over, before its version is settled."""
        self.on_timing: Callable[[VertexTiming], None] | None = None
        """Is told how long each run waited and took, as that of a vertex `process`."""

    @property
    def trigger_input(self) -> str | None:
        """The input whose versions are those of the triggers; None where time gives them."""
        return self.trigger_inputs[0] if self.trigger_inputs else None

    def at_work(self) -> dict[str, int]:
        """The parts that are at work now, and the versions that they are at work on."""
        running = self.running
        return {} if running is None else {"process": running.version}

    def process(self, trigger: Trigger) -> Status:
        """Runs for one trigger."""
        raise NotImplementedError

    def set_trigger(
        self,
        trigger: TriggerConfig | str,
        backlog: BacklogConfig,
        hand_off: Literal["thread", "inline"] = "thread",
    ) -> None:
        """Says what starts a run. The component must be bound.

        Args:
            trigger: Which events do, or the name of the one input whose commits do.
            backlog: What happens when they come faster than it runs; triggers of time wait by their `overrun`.
            hand_off: thread: it runs in a thread of its own; inline: in the thread that commits, which for that long
                does not come back from its commit.

        Raises:
            ValueError: The component has no such input, or there is no such hand-off.
        """
        config = TriggerConfig.model_validate(trigger)
        unknown = [name for name in config.inputs if name not in self.inputs]
        if unknown:
            raise ValueError(f"{self.name} has no input {unknown[0]!r}; it has: {', '.join(self.inputs) or 'none'}")
        if hand_off not in ("thread", "inline"):
            raise ValueError(f"hand_off must be thread or inline, not {hand_off!r}")
        self._inline = hand_off == "inline"
        self.trigger_inputs = config.inputs
        if config.period_ms is not None:
            backlog = BacklogConfig()
            coalesce = config.overrun == "coalesce"
            self._source = TimeTrigger(
                self.clock,
                self._offer,
                period_ns=round(config.period_ms * 1e6),
                is_busy=lambda: not coalesce and self._is_busy(),
                place=self.name,
                losses=self.losses,
            )
        self.backlog = Backlog(self.name, backlog, self.losses)
        self.backlog.on_dropped = self._on_dropped
        inputs = {name: self.inputs[name] for name in config.inputs}
        # Inline it runs when the commit is through: no other one to the topic waits for it.
        self._runs_later = self._inline and backlog.policy != "block" and bool(inputs)
        offer, after = (self._takes_within_commit(), self._advance) if self._runs_later else (self._offer, None)
        self._windows = {name: one.window for name, one in inputs.items()}
        if config.any:
            self._source = AnyTrigger(inputs, offer, after)
        elif config.all:
            tolerance = round(config.tolerance_ms * 1e6)
            self._source = AllTrigger(inputs, offer, after, tolerance_ns=tolerance, place=self.name, losses=self.losses)

    @property
    def triggers_together(self) -> bool:
        """Whether its inputs trigger together, at the versions of the first."""
        return isinstance(self._source, AllTrigger)

    def follow(self, wanted: Container[tuple[int, int]], awaited: Awaited) -> None:
        """Lets a replay give the triggers: from here on those of the mesh and of time start no run.

        Args:
            wanted: Epochs and versions that will be given; the other versions of the mesh are settled.
            awaited: Whether something in the replay waits for what is still to be played.
        """
        # It blocks, also where ticks of time would replace each other: nothing of what is given may be lost.
        self.backlog = Backlog(self.name, BacklogConfig(policy="block"), self.losses)
        self.backlog.on_dropped = self._on_dropped
        self.backlog.gives_way = awaited.__bool__
        awaited.on_first.append(self.backlog.look_again)
        # Nor may the thread that plays serve a run which waits for what it plays next.
        self._inline = self._runs_later = False
        self._source.offer = partial(self._offer_unwanted, wanted)
        if not self.trigger_inputs:
            self._source = TriggerSource(self._offer)

    def _offer_unwanted(self, wanted: Container[tuple[int, int]], trigger: Trigger) -> None:
        if trigger.settled:
            self._offer(trigger)
        elif (trigger.epoch, trigger.version) not in wanted:
            self.settle(trigger.version, trigger.epoch)

    def give(self, trigger: Trigger, data: Mapping[str, Entry]) -> None:
        """Gives a trigger to a component that follows a replay; waits until there is room for it.

        Args:
            trigger: Of the log.
            data: What triggered, by input: it may leave the window before the run.
        """
        self._offer(trigger)
        self._advance()

    def _takes_within_commit(self) -> Callable[[Trigger], object]:
        """What takes a trigger while others cannot commit, where `_advance` is called as soon as they can."""
        assert self.backlog is not None
        return self.backlog.offer

    def _offer(self, trigger: Trigger) -> None:
        assert self.backlog is not None
        if self.backlog.offer(trigger) is not trigger:
            self._advance()

    def _on_dropped(self, trigger: Trigger) -> None:
        self.settle(trigger.version, trigger.epoch)

    def _advance(self) -> None:
        """Serves what waits in the calling thread, where that is how it runs and no other thread serves it already."""
        backlog = self.backlog
        assert backlog is not None
        while self._inline and backlog.waiting and self._serving.acquire(blocking=False):
            try:
                while (trigger := backlog.take_now()) is not None:
                    self._run(trigger)
            finally:
                self._serving.release()

    def _is_busy(self) -> bool:
        return self.running is not None or bool(self.backlog and self.backlog.waiting)

    def settle(self, version: int, epoch: int = CURRENT_EPOCH) -> None:
        """Says on every output that was not committed at `version` that there will be nothing."""
        for output in self.outputs.values():
            output.settle(version, epoch)

    def start(self) -> None:
        """Starts the thread that serves the triggers, and the ticks where time triggers. After a stop, once more.

        Raises:
            RuntimeError: What ran at the last stop still hangs.
        """
        if self.running is not None:
            raise RuntimeError(f"{self.name} cannot start again: it hangs at version {self.running.version}")
        for handle in self.inputs.values():
            handle.allow_waits()
        if self.backlog is not None:
            self.backlog.open()
            self._start_serving()
        self._source.start()

    def _start_serving(self) -> None:
        if not self._inline:
            self._thread = threading.Thread(target=self._serve, name=self.name, daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Serves what waits, then ends the thread. Waits for data end at once, with SHUTDOWN."""
        self._source.stop()
        if self.backlog is not None:
            self.backlog.close()
        for handle in self.inputs.values():
            handle.end_waits()
        self._finish()
        for output in self.outputs.values():
            if output.is_bound:
                output.flush()
        self.clock.tidy()

    def _finish(self) -> None:
        """Waits until all is served."""
        if self._inline:
            if self._serving.acquire(timeout=self.stop_timeout_s):
                self._serving.release()
            self._advance()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(self.stop_timeout_s)
        running = self.running
        if running is not None:
            self._hangs({"process": running.version})
            self._drop_waiting()

    def _hangs(self, where: Mapping[str, int]) -> None:
        for part, version in where.items():
            self.log.error("%s: %s hangs at version %d since the stop, and is left to itself", self.name, part, version)
            self.losses.count(self.name, "hung", version)

    def _drop_waiting(self) -> None:
        """Settles what waits behind something that hangs."""
        while self.backlog is not None and (trigger := self.backlog.take_now()) is not None:
            if not trigger.settled:
                self.losses.count(self.name, "shutdown", trigger.version)
            self.settle(trigger.version, trigger.epoch)

    def _serve(self) -> None:
        assert self.backlog is not None
        while (trigger := self.backlog.take()) is not None:
            self._run(trigger)

    def _run(self, trigger: Trigger) -> None:
        if trigger.settled:
            self.settle(trigger.version, trigger.epoch)
            return
        self.running = trigger
        for handle in self.outputs.values():
            handle.epoch = trigger.epoch
        for name in self.trigger_inputs:
            self.inputs[name].epoch = trigger.epoch
        status, start = Status.FAILED, self.clock.monotonic_ns()
        try:
            status = self.process(trigger)
        except BaseException:  # also SystemExit: only the process as a whole may end the thread
            self.log.exception("%s failed at version %d", self.name, trigger.version)
            self.losses.count(self.name, "failed", trigger.version)
        if self.on_timing is not None:
            self._tell(self.on_timing, trigger, start, status)
        if self.after_run is not None:
            self.after_run(trigger)
        self.settle(trigger.version, trigger.epoch)
        self.running = None
        self.has_run = True

    def _tell(self, on_timing: Callable[[VertexTiming], None], trigger: Trigger, start: int, status: Status) -> None:
        ready, end = start if trigger.at_ns is None else trigger.at_ns, self.clock.monotonic_ns()
        if not isinstance(status, Status):  # one that says nothing is through
            status = Status.OK
        try:
            on_timing(
                VertexTiming(self.name, "process", trigger.version, ready, start, end, status, False, trigger.epoch)
            )
        except Exception:
            self.log.exception("%s: a callback failed", self.name)
