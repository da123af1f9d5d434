"""The cameras and radars of a simulated vehicle: what each found a little before a sweep, as messages."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ...models.geometry import invert, rigid, transform_boxes
from ...models.simulator import Camera, CameraDetector, Radar, SimulatedFrame, Simulator
from ..messages import CameraObjects, CameraSet, RadarObjects, RadarSet

__all__ = ["SensorSuite", "mounted_suite"]

_CAMERA_AGE, _RADAR_AGE = 0.05, 0.03  # before the sweep's reference time [s]
_REAR = rigid(yaw=np.pi)
_WIDE = {"width": 1280, "height": 720}


def _front_and_rear_cameras() -> dict[str, Camera]:
    return {
        "camera_front": Camera(name="camera_front", **_WIDE),
        "camera_rear": Camera(name="camera_rear", lidar_from_body=_REAR, **_WIDE),
    }


def _front_and_rear_radars() -> dict[str, Radar]:
    return {
        "radar_front": Radar(name="radar_front"),
        "radar_rear": Radar(name="radar_rear", lidar_from_radar=_REAR),
    }


@dataclass(frozen=True, kw_only=True)
class SensorSuite:
    """Cameras and radars by name; unless told otherwise one of each looks ahead and one behind."""

    cameras: Mapping[str, Camera] = field(default_factory=_front_and_rear_cameras)
    radars: Mapping[str, Radar] = field(default_factory=_front_and_rear_radars)
    detector: CameraDetector = field(default_factory=CameraDetector)

    def cameras_of(self, drive: Simulator, frame: SimulatedFrame) -> CameraSet | None:
        """What a detector finds in the images before a sweep."""
        if not self.cameras:
            return None
        then, pose, version = _earlier(drive, frame, _CAMERA_AGE)
        found = []
        for number, (name, camera) in enumerate(self.cameras.items()):
            seen = self.detector.detect(then, camera, seed=_seed(drive, frame, number))
            found.append(
                CameraObjects(
                    version=version,
                    sensor=name,
                    boxes=seen.boxes,
                    scores=seen.scores,
                    classes=seen.classes,
                    projection=camera.projection,
                    size=(camera.width, camera.height),
                    pose=pose,
                )
            )
        return CameraSet(version=version, cameras=tuple(found))

    def radars_of(self, drive: Simulator, frame: SimulatedFrame) -> RadarSet | None:
        """The targets of the radars before a sweep."""
        if not self.radars:
            return None
        then, pose, version = _earlier(drive, frame, _RADAR_AGE)
        velocity = drive.velocity(frame.index)
        found = []
        for number, (name, radar) in enumerate(self.radars.items()):
            targets = radar.measure(then, velocity=velocity, seed=_seed(drive, frame, 100 + number))
            found.append(
                RadarObjects(
                    version=version,
                    sensor=name,
                    positions=targets.positions,
                    radial_velocities=targets.radial_velocities,
                    scores=targets.scores,
                    mounting=radar.lidar_from_radar,
                    velocity=radar.lidar_from_radar[:3, :3].T @ velocity,
                    pose=pose,
                    cross_section=targets.cross_section,
                )
            )
        return RadarSet(version=version, radars=tuple(found))


def _seed(drive: Simulator, frame: SimulatedFrame, number: int) -> int:
    return (drive.seed * 1_000_003 + frame.index) * 211 + number


def _earlier(drive: Simulator, frame: SimulatedFrame, age: float) -> tuple[SimulatedFrame, np.ndarray, int]:
    """The truth some time before a sweep, as everything went since, the pose then, and its stamp."""
    pose = drive.pose(drive.time(frame.index) - age)
    gone = np.zeros_like(frame.boxes, np.float64)
    gone[:, :2] = age * frame.velocities
    boxes = transform_boxes(frame.boxes - gone, invert(pose) @ frame.pose)
    turned = (frame.velocities @ frame.pose[:2, :2].T) @ pose[:2, :2]
    then = replace(frame, boxes=boxes.astype(np.float32), velocities=turned.astype(np.float32), pose=pose)
    return then, pose, int(frame.version) - round(age * 1e9)


def mounted_suite(
    lidar: np.ndarray, cameras: Mapping[str, np.ndarray], radars: Mapping[str, np.ndarray]
) -> SensorSuite:
    """Cameras and radars where a vehicle has them.

    Args:
        lidar: Vehicle from LiDAR, shape (4, 4).
        cameras: Vehicle from each camera's body (x forward), shape (4, 4), by name.
        radars: Vehicle from each radar, likewise.
    """
    lidar_from_vehicle = invert(lidar)
    return SensorSuite(
        cameras={
            name: Camera(name=name, lidar_from_body=lidar_from_vehicle @ at, **_WIDE) for name, at in cameras.items()
        },
        radars={name: Radar(name=name, lidar_from_radar=lidar_from_vehicle @ at) for name, at in radars.items()},
    )
