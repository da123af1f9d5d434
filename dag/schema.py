"""The schema of a module file: a group of components and their configuration."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from .backlog import BacklogConfig

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
    trigger: str = ""
    """The input whose commits start a run."""
    backlog: BacklogConfig = BacklogConfig(policy="latest", depth=1, drop="oldest")
    inputs: dict[str, str] = {}
    """Input → topic."""
    outputs: dict[str, str] = {}
    """Output → topic."""
    workers: int = Field(1, ge=1, le=64)
    """Threads of a dag."""
    in_flight: int = Field(1, ge=1, le=64)
    """Frames that may be in a dag at once."""
    graph: dict[str, VertexSpec] = {}
    """The vertices of a dag, by name."""

    @model_validator(mode="after")
    def _fits_its_kind(self) -> ComponentSpec:
        dag = self.kind in ("dag", "monotonic_dag")
        if dag and not self.graph:
            raise ValueError(f"a component of kind {self.kind} needs a graph")
        if not dag and self.graph:
            raise ValueError(f"a component of kind {self.kind} has no graph: make it dag or monotonic_dag")
        if not dag and not self.class_name:
            raise ValueError(f"a component of kind {self.kind} needs a class")
        if self.kind != "generic" and self.trigger not in self.inputs:
            raise ValueError(
                f"trigger must name one of the inputs ({', '.join(self.inputs) or 'none'}), not {self.trigger!r}"
            )
        return self


class ModuleSpec(_Spec):
    """A module file."""

    module: str
    """Its name."""
    description: str = ""
    components: list[ComponentSpec]
