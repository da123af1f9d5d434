"""warploom: perception for vehicles and robots, from raw LiDAR points to tracked objects.

import warploom as wl

labels = wl.cluster(points, radius=0.5, min_size=10)
with wl.Pipeline.from_profile("cpu") as pipeline:
    for frame in pipeline.run(wl.read("scans/")):
        print(len(frame.objects), frame.latency.total_ms)

Names are loaded when they are first used, so that importing the package is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .components.pipeline import Latency, PerceptionFrame, Pipeline
    from .components.sources import open_source, read
    from .errors import ConfigError, DeviceError, ModelError, SourceError, WarploomError
    from .kernels.bev import BevMaps, bev
    from .kernels.boxes import FitBoxes, fit_boxes
    from .kernels.chain import ChainConfig, KernelChain
    from .kernels.chain_result import ChainDropped, ChainResult
    from .kernels.cloud import Cloud
    from .kernels.cluster import EuclideanCluster, cluster
    from .kernels.dbscan import Dbscan, dbscan
    from .kernels.downsample import VoxelDownsample, voxel_downsample
    from .kernels.dynamic_voxel import DynamicVoxelize, DynamicVoxels, dynamic_voxelize
    from .kernels.filters import Filtered, PointFilter, filter_points
    from .kernels.grid_cluster import GridCluster, grid_cluster
    from .kernels.ground import Ground, GroundSegment, segment_ground
    from .kernels.inverse_perspective import GroundImage, InversePerspective, inverse_perspective
    from .kernels.iou import giou_3d, iou_3d, rotated_iou_bev
    from .kernels.kalman import KalmanFilter, KalmanUpdate, kalman_predict, kalman_update
    from .kernels.motion import MotionCompensation, compensate_motion
    from .kernels.outliers import RadiusOutliers, StatisticalOutliers, radius_outliers, statistical_outliers
    from .kernels.projection import Painted, PointPainting, PointProjection, Projected, paint_points, project_points
    from .kernels.range_image import RangeImage, RangeProjection, range_image
    from .kernels.registration import Registration, ScanRegistration, register
    from .kernels.roi import PolygonMask, in_polygons
    from .kernels.voxel import Voxelize, Voxels, voxelize
    from .kernels.voxel_map import VoxelMap
    from .models.fusion import FusedObjects, Fusion, FusionConfig
    from .models.head import DetectionHead
    from .models.odometry import Odometry, OdometryConfig
    from .models.tracker import Tracker, TrackerConfig, Tracks

__version__ = "0.1.0"

_HOMES = {
    "components.pipeline": ("Latency", "PerceptionFrame", "Pipeline"),
    "components.sources": ("open_source", "read"),
    "errors": ("ConfigError", "DeviceError", "ModelError", "SourceError", "WarploomError"),
    "kernels.bev": ("BevMaps", "bev"),
    "kernels.boxes": ("FitBoxes", "fit_boxes"),
    "kernels.chain": ("ChainConfig", "KernelChain"),
    "kernels.chain_result": ("ChainDropped", "ChainResult"),
    "kernels.cloud": ("Cloud",),
    "kernels.cluster": ("EuclideanCluster", "cluster"),
    "kernels.dbscan": ("Dbscan", "dbscan"),
    "kernels.downsample": ("VoxelDownsample", "voxel_downsample"),
    "kernels.dynamic_voxel": ("DynamicVoxelize", "DynamicVoxels", "dynamic_voxelize"),
    "kernels.filters": ("Filtered", "PointFilter", "filter_points"),
    "kernels.grid_cluster": ("GridCluster", "grid_cluster"),
    "kernels.ground": ("Ground", "GroundSegment", "segment_ground"),
    "kernels.inverse_perspective": ("GroundImage", "InversePerspective", "inverse_perspective"),
    "kernels.iou": ("giou_3d", "iou_3d", "rotated_iou_bev"),
    "kernels.kalman": ("KalmanFilter", "KalmanUpdate", "kalman_predict", "kalman_update"),
    "kernels.motion": ("MotionCompensation", "compensate_motion"),
    "kernels.outliers": ("RadiusOutliers", "StatisticalOutliers", "radius_outliers", "statistical_outliers"),
    "kernels.projection": (
        "Painted",
        "PointPainting",
        "PointProjection",
        "Projected",
        "paint_points",
        "project_points",
    ),
    "kernels.range_image": ("RangeImage", "RangeProjection", "range_image"),
    "kernels.registration": ("Registration", "ScanRegistration", "register"),
    "kernels.roi": ("PolygonMask", "in_polygons"),
    "kernels.voxel": ("Voxelize", "Voxels", "voxelize"),
    "kernels.voxel_map": ("VoxelMap",),
    "models.fusion": ("FusedObjects", "Fusion", "FusionConfig"),
    "models.head": ("DetectionHead",),
    "models.odometry": ("Odometry", "OdometryConfig"),
    "models.tracker": ("Tracker", "TrackerConfig", "Tracks"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "BevMaps",
    "ChainConfig",
    "ChainDropped",
    "ChainResult",
    "Cloud",
    "ConfigError",
    "Dbscan",
    "DetectionHead",
    "DeviceError",
    "DynamicVoxelize",
    "DynamicVoxels",
    "EuclideanCluster",
    "Filtered",
    "FitBoxes",
    "FusedObjects",
    "Fusion",
    "FusionConfig",
    "GridCluster",
    "Ground",
    "GroundImage",
    "GroundSegment",
    "InversePerspective",
    "KalmanFilter",
    "KalmanUpdate",
    "KernelChain",
    "Latency",
    "ModelError",
    "MotionCompensation",
    "Odometry",
    "OdometryConfig",
    "Painted",
    "PerceptionFrame",
    "Pipeline",
    "PointFilter",
    "PointPainting",
    "PointProjection",
    "PolygonMask",
    "Projected",
    "RadiusOutliers",
    "RangeImage",
    "RangeProjection",
    "Registration",
    "ScanRegistration",
    "SourceError",
    "StatisticalOutliers",
    "Tracker",
    "TrackerConfig",
    "Tracks",
    "VoxelDownsample",
    "VoxelMap",
    "Voxelize",
    "Voxels",
    "WarploomError",
    "bev",
    "cluster",
    "compensate_motion",
    "dbscan",
    "dynamic_voxelize",
    "filter_points",
    "fit_boxes",
    "giou_3d",
    "grid_cluster",
    "in_polygons",
    "inverse_perspective",
    "iou_3d",
    "kalman_predict",
    "kalman_update",
    "open_source",
    "paint_points",
    "project_points",
    "radius_outliers",
    "range_image",
    "read",
    "register",
    "rotated_iou_bev",
    "segment_ground",
    "statistical_outliers",
    "voxel_downsample",
    "voxelize",
]


def __getattr__(name: str) -> object:
    home = _HOME_OF.get(name)
    if home is None:
        raise AttributeError(f"module 'warploom' has no attribute {name!r}")
    value = getattr(importlib.import_module(f".{home}", __name__), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME_OF])
