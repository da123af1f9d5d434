"""A LiDAR simulator: procedural streets, sensor models, ray casting, and ground truth for every point and object."""

from .frame import SimulatedFrame
from .labels import GROUND_CLASSES, PointClass
from .scenarios import SCENARIOS
from .scenes import SceneBatch, sample_scene
from .sensors import LIDARS, Lidar, lidar_model
from .simulator import Simulator
from .sweep import compensated

__all__ = [
    "GROUND_CLASSES",
    "LIDARS",
    "SCENARIOS",
    "Lidar",
    "PointClass",
    "SceneBatch",
    "SimulatedFrame",
    "Simulator",
    "compensated",
    "lidar_model",
    "sample_scene",
]
