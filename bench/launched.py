"""What the processes of a benchmarked node run: components that do nothing, and one that commits."""

from __future__ import annotations

import numpy as np

from ..dag import DataProcessComponent, Trigger
from ..datamesh import CommitPolicy, Output, Status

__all__ = ["Commits", "Nothing"]


class Nothing:
    """Has nothing to do."""

    idle_because = "it is there to be watched"


class Commits(DataProcessComponent):
    """Commits a small array at every tick."""

    out: Output[np.ndarray]

    def process(self, trigger: Trigger) -> Status:
        """Commits one."""
        with self.out.allocate_change() as change:
            change.set_version(trigger.version)
            change.value = np.zeros(16)
            return self.out.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
