"""DataMesh: declarative, versioned sharing of data between components."""

from .clock import Clock, ManualClock, SystemClock, Timer
from .counters import LossCounters
from .handle import Accessor, Change, Input, Output, declared_handles
from .mesh import DataMesh
from .payload import Completion, Freezable, checksum, freeze
from .policy import CommitPolicy, EqualVersion, Reorder
from .snapshot import CURRENT_EPOCH, Entry, Miss, Snapshot
from .status import Outcome, Status
from .waiting import Waiting
from .window import Window

__all__ = [
    "CURRENT_EPOCH",
    "Accessor",
    "Change",
    "Clock",
    "CommitPolicy",
    "Completion",
    "DataMesh",
    "Entry",
    "EqualVersion",
    "Freezable",
    "Input",
    "LossCounters",
    "ManualClock",
    "Miss",
    "Outcome",
    "Output",
    "Reorder",
    "Snapshot",
    "Status",
    "SystemClock",
    "Timer",
    "Waiting",
    "Window",
    "checksum",
    "declared_handles",
    "freeze",
]
