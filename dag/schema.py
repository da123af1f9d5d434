"""The schema of a module file: a group of components and their configuration."""

from __future__ import annotations

from typing import Annotated, Any, Literal
from urllib.parse import quote

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from .backlog import BacklogConfig
from .configuration import nearest
from .deadline import DeadlineConfig
from .trigger import TriggerConfig

__all__ = ["ComponentSpec", "FlagLoaderSpec", "ModuleSpec", "VertexSpec"]


def _is_name(name: str) -> str:
    """Names are shown in tables, logs and pictures, and written on the command line."""
    if not name.strip() or not name.isprintable() or len(name) > 128:
        raise ValueError(f"a name is 1 to 128 characters that can be shown, not {name!r}")
    return name


def _is_topic(topic: str) -> str:
    """Topics between processes become the addresses of sockets."""
    if not topic.strip() or not topic.isprintable() or len(quote(topic)) > 80:
        raise ValueError(f"a topic is 1 to 80 characters that can be shown, beyond ASCII fewer, not {topic!r}")
    return topic


Name = Annotated[str, AfterValidator(_is_name)]
Topic = Annotated[str, AfterValidator(_is_topic)]


class _Spec(BaseModel):
    model_config = ConfigDict(extra="forbid", populate_by_name=True, allow_inf_nan=False)


class VertexSpec(_Spec):
    """One vertex of a graph."""

    processor: str
    """Dotted name of the processor's class."""
    config: dict[str, Any] = {}
    """What the processor's own `Config` takes."""
    inputs: dict[str, str] = Field(default={}, alias="in")
    """In port → name of the datum; a port that is left out takes the datum of its own name."""
    outputs: dict[str, str] = Field(default={}, alias="out")
    """Out port → name of the datum; a port that is left out gives the datum of its own name."""
    deadline_ms: float | None = Field(None, gt=0.0, le=86_400_000.0)
    """From when its inputs are there to its end; what takes longer is counted [ms]."""
    expendable: bool = False
    """Whether it is left out in a frame past the component's deadline, with `on_miss: degrade`."""


class ComponentSpec(_Spec):
    """One component."""

    name: Name
    """Unique in the process."""
    kind: Literal["generic", "data", "dag", "monotonic_dag"]
    class_name: str = Field(default="", alias="class")
    """Dotted name of the class; a dag needs none."""
    config: dict[str, Any] = {}
    """What the class takes."""
    inputs: dict[str, Topic] = {}
    """Input → topic."""
    outputs: dict[str, Topic] = {}
    """Output → topic."""
    trigger: TriggerConfig = Field(TriggerConfig(), validate_default=True)
    """What starts a run: an input whose commits do, or `any`, `all` or `period_ms`."""
    hand_off: Literal["thread", "inline"] = "thread"
    """Who runs it: threads of its own, or inline the thread that commits what triggers it."""
    deadline: DeadlineConfig | None = None
    """By when a dag is to be done with a frame."""
    backlog: BacklogConfig = BacklogConfig(policy="latest", depth=1, drop="oldest")
    workers: int = Field(1, ge=1, le=64)
    """Threads of a dag."""
    in_flight: int = Field(1, ge=1, le=64)
    """Frames that may be in a dag at once."""
    graph: dict[Name, VertexSpec] = {}
    """The vertices of a dag, by name."""

    @field_validator("trigger")
    @classmethod
    def _is_an_input(cls, trigger: TriggerConfig, info: ValidationInfo) -> TriggerConfig:
        inputs = info.data.get("inputs")
        if inputs is not None and info.data.get("kind", "generic") != "generic" and trigger.period_ms is None:
            for name in trigger.inputs or ("",):
                if name not in inputs:
                    raise ValueError(f"the trigger must be one of the inputs, not {name!r}; {nearest(name, inputs)}")
        return trigger

    @model_validator(mode="after")
    def _fits_its_kind(self) -> ComponentSpec:
        dag = self.kind in ("dag", "monotonic_dag")
        if dag and not self.graph:
            raise ValueError(f"a component of kind {self.kind} needs a graph")
        if not dag and self.graph:
            raise ValueError(f"a component of kind {self.kind} has no graph: make it dag or monotonic_dag")
        if not dag and self.deadline is not None:
            raise ValueError(f"a component of kind {self.kind} has no deadline: make it dag or monotonic_dag")
        if not dag and not self.class_name:
            raise ValueError(f"a component of kind {self.kind} needs a class")
        return self


class FlagLoaderSpec(_Spec):
    """Something that runs before everything else, and says what the components can look up."""

    class_name: str = Field(alias="class")
    """Dotted name of a class with a method `load() -> Mapping[str, Any]`."""
    config: dict[str, Any] = {}
    """Arguments for its constructor."""


class ModuleSpec(_Spec):
    """A module file."""

    module: Name
    """Its name."""
    description: str = ""
    flag_loaders: list[FlagLoaderSpec] = []
    """Run first, in their order; what they load, the components see as `self.flags`."""
    components: list[ComponentSpec]
