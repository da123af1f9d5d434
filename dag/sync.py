"""Processors that connect a graph to the DataMesh."""

from __future__ import annotations

from typing import Any

from ..datamesh import CommitPolicy, Status
from .processor import In, Processor, ProcessorConfig
from .trigger import Trigger

__all__ = ["CommitDagProcessor"]


class _CommitConfig(ProcessorConfig):
    output: str
    """The component's output to commit to."""


class CommitDagProcessor(Processor):
    """A vertex that sends a datum to the mesh, at the version of the trigger."""

    Config = _CommitConfig

    value: In[Any]

    def init(self, config: _CommitConfig) -> None:
        """Finds the output.

        Raises:
            ValueError: The component has no such output.
        """
        if config.output not in self.component_outputs:
            known = ", ".join(self.component_outputs) or "none"
            raise ValueError(f"the component has no output {config.output!r}; it has: {known}")
        self._output = self.component_outputs[config.output]

    def process(self, trigger: Trigger) -> Status:
        """Commits; an older version than the newest is discarded and counted."""
        with self._output.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns)
            change.value = self.value.value
            return self._output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
