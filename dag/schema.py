"""The schema of a module file: a group of components and their configuration."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationInfo, field_validator, model_validator

from .backlog import BacklogConfig
from .configuration import nearest

__all__ = ["ComponentSpec", "ModuleSpec", "VertexSpec"]


class _Spec(BaseModel):
    model_config = ConfigDict(extra="forbid", populate_by_name=True)


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


class ComponentSpec(_Spec):
    """One component."""

    name: str
    """Unique in the process."""
    kind: Literal["generic", "data", "dag", "monotonic_dag"]
    class_name: str = Field(default="", alias="class")
    """Dotted name of the class; a dag needs none."""
    config: dict[str, Any] = {}
    """What the class takes."""
    inputs: dict[str, str] = {}
    """Input → topic."""
    outputs: dict[str, str] = {}
    """Output → topic."""
    trigger: str = Field("", validate_default=True)
    """The input whose commits start a run."""
    backlog: BacklogConfig = BacklogConfig(policy="latest", depth=1, drop="oldest")
    workers: int = Field(1, ge=1, le=64)
    """Threads of a dag."""
    in_flight: int = Field(1, ge=1, le=64)
    """Frames that may be in a dag at once."""
    graph: dict[str, VertexSpec] = {}
    """The vertices of a dag, by name."""

    @field_validator("trigger")
    @classmethod
    def _is_an_input(cls, trigger: str, info: ValidationInfo) -> str:
        inputs = info.data.get("inputs")
        if inputs is not None and info.data.get("kind", "generic") != "generic" and trigger not in inputs:
            raise ValueError(f"the trigger must be one of the inputs, not {trigger!r}; {nearest(trigger, inputs)}")
        return trigger

    @model_validator(mode="after")
    def _fits_its_kind(self) -> ComponentSpec:
        dag = self.kind in ("dag", "monotonic_dag")
        if dag and not self.graph:
            raise ValueError(f"a component of kind {self.kind} needs a graph")
        if not dag and self.graph:
            raise ValueError(f"a component of kind {self.kind} has no graph: make it dag or monotonic_dag")
        if not dag and not self.class_name:
            raise ValueError(f"a component of kind {self.kind} needs a class")
        return self


class ModuleSpec(_Spec):
    """A module file."""

    module: str
    """Its name."""
    description: str = ""
    components: list[ComponentSpec]
