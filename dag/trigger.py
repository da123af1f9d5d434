"""What starts a run: the trigger, and which events give one."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ConfigDict, Field, model_validator

from ..datamesh import CURRENT_EPOCH

__all__ = ["Trigger", "TriggerConfig"]


class Trigger(NamedTuple):
    """One event that a component runs for."""

    version: int
    """Version of the frame [ns]; frame data is read at exactly this version."""
    received_ns: int = 0
    """The clock's `monotonic_ns` when the sensor's data was received: latency counts from here."""
    settled: bool = False
    """True: there will be nothing at this version; the component passes that on instead of running."""
    epoch: int = CURRENT_EPOCH
    """Order is by epoch, then version."""
    at_ns: int | None = None
    """The clock's `monotonic_ns` when the trigger came: deadlines of waits count from here; None is now."""
    inputs: Mapping[str, int] = MappingProxyType({})
    """The versions that triggered, by input: several where `all` puts them together within a tolerance."""


class TriggerConfig(BaseModel):
    """Which events start a run: `lidar`, `{any: [a, b]}`, `{all: [a, b], tolerance_ms: 20}` or `{period_ms: 100}`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    any: tuple[str, ...] = ()
    """A commit to any of these inputs; a version that several of them have triggers once."""
    all: tuple[str, ...] = ()
    """When all of these inputs have the version of the first, or one near it; that of the first is the trigger's."""
    tolerance_ms: float = Field(0.0, ge=0.0, le=86_400_000.0)
    """How far from the version of the first the others of `all` may be [ms]."""
    period_ms: float | None = Field(None, ge=0.1, le=86_400_000.0)
    """Every so long, by the mesh's clock [ms]."""
    overrun: Literal["skip", "coalesce"] = "skip"
    """What happens to ticks of a period while the component is busy: skip drops them, coalesce keeps the newest."""

    @model_validator(mode="before")
    @classmethod
    def _name_of_an_input(cls, value: Any) -> Any:
        if not isinstance(value, (str, Mapping, TriggerConfig)):
            forms = "the name of an input, {any: [a, b]}, {all: [a, b]} or {period_ms: 100}"
            raise ValueError(f"a trigger is {forms}, not {value!r}")
        return {"any": (value,) if value else ()} if isinstance(value, str) else value

    @model_validator(mode="after")
    def _is_one_kind(self) -> TriggerConfig:
        kinds = [name for name in ("any", "all", "period_ms") if getattr(self, name)]
        if len(kinds) > 1:
            raise ValueError(f"a trigger is one of any, all and period_ms, not {' and '.join(kinds)}")
        if self.tolerance_ms and not self.all:
            raise ValueError("tolerance_ms belongs to a trigger of kind `all`")
        if self.overrun != "skip" and self.period_ms is None:
            raise ValueError("overrun belongs to a trigger with period_ms")
        return self

    @property
    def inputs(self) -> tuple[str, ...]:
        """The inputs whose data trigger; none where time does."""
        return self.any or self.all
