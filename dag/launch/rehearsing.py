"""What a datum goes through in a process that receives it, gone through once more to no effect."""

from __future__ import annotations

from typing import Any

from ...datamesh import DataMesh, Input, Status, Window
from ..backlog import BacklogConfig
from ..component import DataProcessComponent
from ..trigger import Trigger

__all__ = ["rehearsal"]


class _Rehearsal(DataProcessComponent):
    """Reads what triggers it."""

    data: Input[Any]

    def process(self, trigger: Trigger) -> Status:
        with self.data.access() as snapshot:
            snapshot[snapshot.version_index(trigger.version)]
        return Status.OK


def rehearsal() -> Window[Any]:
    """A window that nobody else knows: what is committed to it triggers a component that does nothing with it."""
    mesh = DataMesh(1)
    component = _Rehearsal("rehearsal")
    component.bind(mesh, {"data": "rehearsal"})
    component.set_trigger("data", BacklogConfig(), "inline")
    return mesh.window("rehearsal")
