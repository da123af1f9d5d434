"""DataMesh: declarative, versioned sharing of data between components."""

from .counters import LossCounters
from .handle import Accessor, Change, Input, Output, declared_handles
from .mesh import DataMesh
from .payload import Freezable, freeze
from .status import Status
from .window import CommitPolicy, Entry, Miss, Snapshot, Window

__all__ = [
    "Accessor",
    "Change",
    "CommitPolicy",
    "DataMesh",
    "Entry",
    "Freezable",
    "Input",
    "LossCounters",
    "Miss",
    "Output",
    "Snapshot",
    "Status",
    "Window",
    "declared_handles",
    "freeze",
]
