"""Sources of sensor frames: the simulator, folders of the KITTI family, files of scans."""

from .description import describe, describe_lines
from .kitti import KittiSource
from .opening import SCHEMES, open_source, read
from .scan import Scan
from .scan_files import ScanFileSource, read_scan
from .simulator import SimulatorSource
from .source import SkippedFrame, Source

__all__ = [
    "SCHEMES",
    "KittiSource",
    "Scan",
    "ScanFileSource",
    "SimulatorSource",
    "SkippedFrame",
    "Source",
    "describe",
    "describe_lines",
    "open_source",
    "read",
    "read_scan",
]
