"""A LiDAR simulator: procedural streets, sensor models, ray casting, and ground truth for every point and object."""

from .labels import GROUND_CLASSES, PointClass
from .sensors import LIDARS, Lidar, lidar_model
from .simulator import SCENARIOS, SimulatedFrame, Simulator, sample_scene

__all__ = [
    "GROUND_CLASSES",
    "LIDARS",
    "SCENARIOS",
    "Lidar",
    "PointClass",
    "SimulatedFrame",
    "Simulator",
    "lidar_model",
    "sample_scene",
]
