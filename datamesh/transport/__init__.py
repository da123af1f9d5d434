"""Topics across processes: over shared memory on one host, over zenoh between hosts. Linux only."""

from .config import SharedMemoryConfig, ZenohConfig
from .exporting import Exporter
from .importing import Importer
from .places import exported_topics, reap, run_folder
from .service import ExportService

__all__ = [
    "ExportService",
    "Exporter",
    "Importer",
    "SharedMemoryConfig",
    "ZenohConfig",
    "exported_topics",
    "reap",
    "run_folder",
]
