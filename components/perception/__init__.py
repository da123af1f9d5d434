"""The stages of perception as processors, each of which can be named in a module file and run alone."""

from .background import BackgroundProcessor
from .chain import ChainProcessor
from .cluster_boxes import ClusterBoxProcessor
from .clustering import ClusterProcessor
from .detection import DetectionProcessor
from .filtering import FilterProcessor
from .fusion import FusionProcessor
from .ground import GroundProcessor
from .merging import MergeProcessor
from .point_labels import PointLabelsProcessor
from .tracking import TrackingComponent, TrackingProcessor

__all__ = [
    "BackgroundProcessor",
    "ChainProcessor",
    "ClusterBoxProcessor",
    "ClusterProcessor",
    "DetectionProcessor",
    "FilterProcessor",
    "FusionProcessor",
    "GroundProcessor",
    "MergeProcessor",
    "PointLabelsProcessor",
    "TrackingComponent",
    "TrackingProcessor",
]
