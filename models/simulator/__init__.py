"""A LiDAR simulator: procedural streets, sensor models, ray casting, and ground truth for every point and object."""

from .camera_objects import CameraDetections, CameraDetector
from .cameras import Camera, CameraFrame
from .ego_sensors import GnssModel, ImuModel, WheelSpeedModel, local_from_geodetic
from .frame import SimulatedFrame
from .labels import GROUND_CLASSES, PointClass
from .radar import Radar, RadarFrame
from .scenarios import SCENARIOS
from .scenes import SceneBatch, sample_scene, sample_views
from .sensors import LIDARS, Lidar, lidar_model
from .simulator import Simulator
from .sweep import compensated

__all__ = [
    "GROUND_CLASSES",
    "LIDARS",
    "SCENARIOS",
    "Camera",
    "CameraDetections",
    "CameraDetector",
    "CameraFrame",
    "GnssModel",
    "ImuModel",
    "Lidar",
    "PointClass",
    "Radar",
    "RadarFrame",
    "SceneBatch",
    "SimulatedFrame",
    "Simulator",
    "WheelSpeedModel",
    "compensated",
    "lidar_model",
    "local_from_geodetic",
    "sample_scene",
    "sample_views",
]
