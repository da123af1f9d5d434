"""LiDAR odometry: how the sensor moved, from its scans alone.

KISS-ICP (Vizzo et al., 2023) on the kernels of this package: a constant-velocity prediction, points brought to one
moment by it, registration against a map of voxels with a robust kernel, and a threshold that follows how wrong the
predictions are. That moment is the middle of the scan's points: there a wrong prediction bends a scan but does not
move it, so that it does not make the next one wrong in turn. Poses are of the scan's version, its first moment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from ..kernels.device import resolve_device
from ..kernels.downsample import VoxelDownsample
from ..kernels.filters import PointFilter
from ..kernels.interop import Points, borrow, borrow_points, count_on
from ..kernels.motion import compensate_motion
from ..kernels.registration import ScanRegistration
from ..kernels.voxel_map import VoxelMap
from .geometry import invert

__all__ = ["Odometry", "OdometryConfig"]

# Points are brought to their scan's moment along a path through these moments after it [s]: close enough together for
# the path between to be plain, and no sweep takes longer.
_MOMENTS = (-1.0, -0.5, 0.0, 0.5, 1.0)
_TIMES = 1024  # of a scan's points, as many of which are enough to tell their middle


@dataclass(frozen=True, kw_only=True)
class OdometryConfig:
    """The configuration of an `Odometry`."""

    voxel_size: float = 1.0
    """Edge of a voxel of the map [m]."""
    max_range: float = 100.0
    """Points farther along an axis are left out, and voxels farther leave the map [m]."""
    min_range: float = 2.0
    """Points nearer along all axes are left out: the vehicle's own [m]."""
    max_points: int = 20
    """Points that a voxel of the map can hold."""
    max_voxels: int = 65_536
    """Voxels that the map can hold."""
    map_share: float = 0.5
    """Edge of the voxels to which a scan is thinned out for the map, in voxels of the map."""
    source_share: float = 1.5
    """Edge of the voxels to which it is thinned out further for registration."""
    initial_threshold: float = 2.0
    """How wrong the first predictions are taken to be [m]."""
    min_deviation: float = 0.1
    """Predictions less wrong do not count for the threshold [m]."""
    max_iterations: int = 100
    """Steps of a registration at most."""
    tolerance: float = 1e-4
    """A step below is a registration's last: its translation [m] and rotation vector [rad] together."""
    min_matches: int = 50
    """With fewer points that have one of the map in reach the prediction stands."""
    capacity: int = 262_144
    """Points that a scan may have."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        for name in ("voxel_size", "max_range", "map_share", "source_share", "initial_threshold"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"{name} must be > 0 and finite, not {value}")
        if not 0 <= self.min_range < self.max_range:
            raise ValueError(f"min_range must be ≥ 0 and below max_range, not {self.min_range}")


class AdaptiveThreshold:
    """How wrong the predictions were, as one length: the root of their mean squared deviation."""

    def __init__(self, config: OdometryConfig):
        self._max_range = config.max_range
        self._min_deviation = config.min_deviation
        self._squares, self._samples = config.initial_threshold**2, 1

    @property
    def sigma(self) -> float:
        """The threshold [m]."""
        return math.sqrt(self._squares / self._samples)

    def update(self, deviation: np.ndarray) -> None:
        """Takes up one deviation of a pose from its prediction, shape (4, 4)."""
        angle = Rotation.from_matrix(deviation[:3, :3]).magnitude()
        # What the rotation moves a point at the range's end by.
        moved = 2.0 * self._max_range * math.sin(0.5 * angle) + float(np.linalg.norm(deviation[:3, 3]))
        if moved > self._min_deviation:
            self._squares += moved * moved
            self._samples += 1


class Odometry:
    """Where the sensor is, scan after scan, in the frame of the first scan.

    The same scans give the same poses, to the byte. Scans that could not be registered are counted in `lost` and get
    the predicted pose.
    """

    def __init__(self, config: OdometryConfig | None = None):
        self.config = config or OdometryConfig()
        c = self.config
        self._device = resolve_device(c.device)
        near, far = c.min_range, c.max_range
        sizes = {"capacity": c.capacity, "device": self._device}
        self._thin_for_map = VoxelDownsample(voxel_size=c.map_share * c.voxel_size, **sizes)
        self._in_range = PointFilter(
            point_range=(-far, -far, -far, far, far, far),
            ego_box=(-near, -near, -near, near, near, near) if near > 0 else None,
            **sizes,
        )
        self._thin_for_registration = VoxelDownsample(voxel_size=c.source_share * c.voxel_size, **sizes)
        self._registration = ScanRegistration(max_iterations=c.max_iterations, tolerance=c.tolerance, **sizes)
        self.voxel_map = VoxelMap(
            voxel_size=c.voxel_size,
            max_voxels=c.max_voxels,
            max_points=c.max_points,
            max_distance=c.max_range,
            **sizes,
        )
        """The map, in the frame of the first scan."""
        self.clear()

    def clear(self) -> None:
        """Forgets the map, the motion and the time, for a new recording."""
        self.voxel_map.clear()
        self._threshold = AdaptiveThreshold(self.config)
        self._version: int | None = None
        self._middle = 0.0  # of the last scan, after its version [s]
        self._pose = np.eye(4)  # at the last scan's middle
        self._velocity = np.zeros(6)  # translation and rotation vector, a second
        self._first: tuple[int, wp.array, wp.array] | None = None  # the first scan, until the motion in it is known
        self.lost = 0
        """Scans that could not be registered."""

    def update(self, version: int, points: Any, t: Any = None) -> np.ndarray:
        """Takes up one scan.

        Args:
            version: The scan's time [ns], later than the last one's.
            points: Positions in the sensor's frame [m], shape (n, 3 or more), floating; NumPy, torch, Warp or DLPack.
            t: Time of each point after `version` [s], shape (n,); None where all are of one moment, or their motion
                was compensated.

        Returns:
            First scan from this one, at the time `version`, shape (4, 4), float64.

        Raises:
            TypeError: `points` is not a floating array.
            ValueError: Time does not go forward, or a shape does not fit.
        """
        is_first = self._version is None
        pose = self._take(int(version), points, t)
        if self._first is not None:
            # The motion within the first scan is known only now.
            first, velocity, lost = self._first, self._velocity, self.lost
            self.clear()
            self._velocity = velocity
            self._take(*first)
            pose = self._take(int(version), points, t)
            self.lost = max(lost, self.lost)
        elif is_first and t is not None:
            self._first = (int(version), *_copied(points, t))
        return pose

    def _take(self, version: int, points: Any, t: Any) -> np.ndarray:
        """Takes up one scan; returns the pose at its version."""
        middle = 0.0 if t is None else _middle_of(t)
        seconds = self._seconds_since_last(version, middle)

        # Predict by constant velocity
        guess = self._pose @ _motion(seconds * self._velocity)

        # Bring all points to one moment, their middle
        scan = self._compensate(points, t, middle)

        # Thin the scan out, for the map and further for registration
        dense, sparse = self._downsample(scan)

        # Register against the map, within what predictions are off by
        pose = guess if self._version is None else self._register(sparse, guess, self._threshold.sigma)

        # Update the threshold, the map and the motion
        if pose is None:
            self.lost += 1
            pose = guess
        self._threshold.update(invert(guess) @ pose)
        self.voxel_map.launch(*dense, self._on_device(pose))
        if self._version is not None:
            self._velocity = _vector(invert(self._pose) @ pose) / seconds
        self._pose, self._version, self._middle = pose, version, middle
        return pose @ _motion(-middle * self._velocity)

    def _seconds_since_last(self, version: int, middle: float) -> float:
        if self._version is None:
            return middle
        if version <= self._version:
            raise ValueError(
                f"version is {version} ns, not after the last scan's {self._version} ns: odometry takes scans in the "
                "order of time; call clear() before a new recording"
            )
        seconds = (version - self._version) * 1e-9 + (middle - self._middle)
        if seconds <= 0.0:
            raise ValueError(
                f"t is {middle:.3g} s in the mean, which is not after the last scan's points with {self._middle:.3g} s "
                "and its version: t is the time of each point after its own scan's version"
            )
        return seconds

    def _compensate(self, points: Any, t: Any, middle: float) -> Points:
        """The points on the device, as they would be seen from where the sensor was at the scan's middle."""
        if t is not None and self._velocity.any():
            poses = np.stack([_motion(moment * self._velocity) for moment in _MOMENTS])
            points = compensate_motion(points, t, poses, _MOMENTS, middle)
        scan = borrow_points(points)
        if len(scan) > self.config.capacity:
            raise ValueError(
                f"points has {len(scan)} rows, more than the capacity of {self.config.capacity}; "
                "give OdometryConfig a larger one"
            )
        if scan.device != self._device:
            scan = borrow_points(wp.clone(scan.table, device=self._device))
        return scan

    def _downsample(self, scan: Points) -> tuple[tuple[wp.array, wp.array], tuple[wp.array, wp.array]]:
        """Points and their count for the map, and for registration."""
        self._thin_for_map.launch(scan.xyz, count_on(len(scan), scan.device))
        self._in_range.launch(self._thin_for_map.centroids, None, self._thin_for_map.centroid_count)
        dense = (self._in_range.xyz, self._in_range.count)
        self._thin_for_registration.launch(*dense)
        return dense, (self._thin_for_registration.centroids, self._thin_for_registration.centroid_count)

    def _register(self, sparse: tuple[wp.array, wp.array], guess: np.ndarray, sigma: float) -> np.ndarray | None:
        """The pose at which the points lie on the map, or None where too few have anything of it in reach."""
        # A kernel as wide as predictions are off finds the place; a narrow one is exact there.
        limits = wp.array([3.0 * sigma, sigma, sigma / 3.0], dtype=wp.float32, device=self._device)
        self._registration.launch(*sparse, self.voxel_map, self._on_device(guess), limits)
        matches = float(self._registration.fit.numpy()[0])
        return self._registration.pose.numpy()[0].copy() if matches >= self.config.min_matches else None

    def _on_device(self, pose: np.ndarray) -> wp.array:
        return wp.array(pose[None], dtype=wp.mat44d, device=self._device)


def _stamps(t: Any) -> tuple[wp.array, Any]:
    """The times of a scan's points, and the owner of their memory."""
    wide = str(t.dtype).endswith(("float64", "float64'>"))
    return borrow(t, wp.float64 if wide else wp.float32, (None,), "t")


def _copied(points: Any, t: Any) -> tuple[wp.array, wp.array]:
    scan = borrow_points(points)
    stamps, _owner = _stamps(t)
    return wp.clone(scan.table), wp.clone(stamps)


def _middle_of(t: Any) -> float:
    """The mean time of a scan's points [s], by some of them."""
    stamps, _owner = _stamps(t)
    some = stamps[:: max(stamps.shape[0] // _TIMES, 1)].numpy().astype(np.float64)
    some = some[np.isfinite(some)]
    return float(np.clip(some.mean(), _MOMENTS[0], _MOMENTS[-1])) if len(some) else 0.0


def _motion(vector: np.ndarray) -> np.ndarray:
    """The motion of a translation and a rotation vector, shape (6,), as a matrix, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(vector[3:]).as_matrix()
    T[:3, 3] = vector[:3]
    return T


def _vector(T: np.ndarray) -> np.ndarray:
    """The inverse of `_motion`."""
    return np.concatenate([T[:3, 3], Rotation.from_matrix(T[:3, :3]).as_rotvec()])
