"""A radar at object level: targets with range, azimuth, radial velocity and cross section, misses and false ones.

Detection falls with the fourth power of the range against the target's cross section, as in the radar equation.
Cross sections are of the order that measurements of road users at 77 GHz give: 10 dBm² for a car, −5 dBm² for a person.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..classes import BARRIER, CONE, CYCLIST, PEDESTRIAN, VEHICLE
from .arguments import check_numbers, check_pose
from .frame import SimulatedFrame

__all__ = ["Radar", "RadarFrame"]

_CROSS_SECTION = {VEHICLE: 10.0, PEDESTRIAN: -5.0, CYCLIST: 0.0, CONE: -15.0, BARRIER: 0.0}  # [dBm²]
_FLUCTUATION = 4.0  # [dB] of the cross section from one look to the next
_HEAVY, _HEAVY_GAIN = 7.0, 8.0  # [m] length of a truck or bus, and how much more it reflects [dB]


@dataclass(frozen=True, eq=False, kw_only=True)
class RadarFrame:
    """The targets of one cycle."""

    version: int
    """Time of the measurement [ns]."""
    positions: np.ndarray
    """x y z in the radar's frame [m], z = 0, shape (k, 3), float32."""
    radial_velocities: np.ndarray
    """Relative to the radar along the line of sight, positive for what goes away [m/s]; shape (k,), float32."""
    cross_section: np.ndarray
    """[dBm²], shape (k,), float32."""
    scores: np.ndarray
    """Probability that there is something, in [0, 1], shape (k,), float32."""
    ids: np.ndarray
    """Truth: the object of each target, −1 for a false one; shape (k,), int64."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Radar:
    """A radar and how well it measures."""

    name: str = "front"
    lidar_from_radar: np.ndarray = field(default_factory=lambda: np.eye(4))
    """Where it is; it looks along its x, with y to the left; shape (4, 4)."""
    field_of_view: float = 100.0
    """In azimuth [deg]."""
    max_range: float = 150.0
    """[m]."""
    reach: float = 110.0
    """Where a target of 0 dBm² is seen half of the time [m]."""
    range_noise: float = 0.15
    """Standard deviation [m]."""
    azimuth_noise: float = 0.6
    """Standard deviation [deg]."""
    velocity_noise: float = 0.1
    """Standard deviation [m/s]."""
    false_targets: float = 1.5
    """Mean number in a cycle."""

    def __post_init__(self):
        check_numbers(
            self, above_0=("field_of_view", "max_range", "reach"),
            from_0=("range_noise", "azimuth_noise", "velocity_noise", "false_targets"),
        )  # fmt: skip
        if self.field_of_view > 360:
            raise ValueError(f"field_of_view must be above 0 and at most 360 degrees, not {self.field_of_view}")
        check_pose(self.lidar_from_radar, "lidar_from_radar")

    def measure(self, frame: SimulatedFrame, *, velocity: np.ndarray, seed: int) -> RadarFrame:
        """What the radar sees of the objects of a frame.

        Args:
            frame: The truth; where it says `visible`, hidden objects give no target, else those without points.
            velocity: Of the LiDAR over ground, along the axes of its frame [m/s], shape (3,).
            seed: Of noise, misses and false targets.
        """
        random = np.random.default_rng([seed & 0x7FFFFFFF, 19])
        radar_from_lidar = np.linalg.inv(self.lidar_from_radar)
        turn = radar_from_lidar[:3, :3]
        boxes = frame.boxes.astype(np.float64)
        centre = boxes[:, :3] @ turn.T + radar_from_lidar[:3, 3]
        # The echo comes from the side that faces the radar.
        origin = self.lidar_from_radar[:3, 3]
        c, s = np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
        to_radar = origin[:2] - boxes[:, :2]
        local = np.stack([to_radar[:, 0] * c + to_radar[:, 1] * s, to_radar[:, 1] * c - to_radar[:, 0] * s], 1)
        nearest = np.clip(local, -0.5 * boxes[:, 3:5], 0.5 * boxes[:, 3:5])
        point = np.stack([boxes[:, 0] + nearest[:, 0] * c - nearest[:, 1] * s,
                          boxes[:, 1] + nearest[:, 0] * s + nearest[:, 1] * c, boxes[:, 2]], 1)  # fmt: skip
        point = point @ turn.T + radar_from_lidar[:3, 3]
        distance, azimuth = np.hypot(point[:, 0], point[:, 1]), np.arctan2(point[:, 1], point[:, 0])
        line = centre[:, :2] / np.maximum(np.linalg.norm(centre[:, :2], axis=1, keepdims=True), 1e-9)
        relative = np.zeros((len(boxes), 3))
        relative[:, :2] = frame.velocities - np.asarray(velocity, np.float64)[:2]
        radial = np.einsum("ij,ij->i", (relative @ turn.T)[:, :2], line)

        section = np.array([_CROSS_SECTION.get(int(k), 0.0) for k in frame.classes])
        section = section + _HEAVY_GAIN * (boxes[:, 3] > _HEAVY) + random.normal(0, _FLUCTUATION, len(boxes))
        shown = frame.visible if frame.visible is not None else (frame.counts > 0).astype(np.float32)
        signal = (
            section + 10 * np.log10(np.maximum(shown, 1e-3)) - 40 * np.log10(np.maximum(distance, 0.5) / self.reach)
        )
        chance = 1.0 / (1.0 + np.exp(-0.5 * signal))
        half = np.deg2rad(0.5 * self.field_of_view)
        seen = (distance < self.max_range) & (np.abs(azimuth) < half) & (shown > 0)
        seen &= random.random(len(boxes)) < chance
        distance = distance[seen] + random.normal(0, self.range_noise, seen.sum())
        azimuth = azimuth[seen] + random.normal(0, np.deg2rad(self.azimuth_noise), seen.sum())
        radial = radial[seen] + random.normal(0, self.velocity_noise, seen.sum())

        false = int(random.poisson(self.false_targets))
        distance = np.concatenate([distance, self.max_range * np.sqrt(random.random(false))])
        azimuth = np.concatenate([azimuth, random.uniform(-half, half, false)])
        # Most false targets stand still on the ground: they go as the ground goes past.
        ground = -(
            np.cos(azimuth[len(radial) :]) * (turn @ velocity)[0]
            + np.sin(azimuth[len(radial) :]) * (turn @ velocity)[1]
        )
        radial = np.concatenate([radial, ground + random.normal(0, 1.0, false)])
        section = np.concatenate([section[seen], random.normal(-8.0, _FLUCTUATION, false)])
        scores = np.concatenate([0.5 + 0.5 * chance[seen], random.uniform(0.2, 0.8, false)])
        positions = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), 0 * azimuth], 1)
        return RadarFrame(
            version=frame.version,
            positions=positions.astype(np.float32),
            radial_velocities=radial.astype(np.float32),
            cross_section=section.astype(np.float32),
            scores=scores.astype(np.float32),
            ids=np.concatenate([frame.ids[seen], np.full(false, -1)]).astype(np.int64),
        )
