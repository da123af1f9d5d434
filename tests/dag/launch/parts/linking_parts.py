"""Components of two processes, as module files name them."""

from __future__ import annotations

from warploom.dag import DataProcessComponent, In, Out, Processor
from warploom.datamesh import CommitPolicy, Input, Output, Status

__all__ = ["Add", "Double", "Listens", "Plain", "Says"]


class Double(DataProcessComponent):
    """Doubles a number."""

    number: Input[int]
    result: Output[int]

    def process(self, trigger):
        """Doubles it."""
        with self.number.access() as snapshot, self.result.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns)
            change.value = 2 * snapshot[snapshot.version_index(trigger.version)]
            return self.result.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


class Says(DataProcessComponent):
    """Commits a text."""

    text: Output[str]


class Listens(DataProcessComponent):
    """Takes a number, and another where there is one."""

    number: Input[int]
    other: Input[int] = Input(optional=True)

    def process(self, trigger):
        """Does nothing."""
        return Status.OK


class Plain:
    """A plain class, whose annotations are its own business."""

    number: Unknown  # type: ignore[name-defined]  # noqa: F821

    def start(self):
        """Does nothing."""


class Add(Processor):
    """Adds one."""

    number: In[int]
    sum: Out[int]

    def process(self, trigger):
        """Adds it."""
        self.sum.value = self.number.value + 1
        return Status.OK
