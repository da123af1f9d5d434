"""The cloud: points as a structure of arrays on one device, with a fixed capacity and a count that lives there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from .device import resolve_device

__all__ = ["Cloud"]


@dataclass(eq=False)
class Cloud:
    """One sweep of a LiDAR, or any set of points, in the frame `frame_id`.

    Made by `Cloud.from_numpy`. The arrays have room for `capacity` points, of which the first `count[0]` are set.
    """

    xyz: wp.array
    """Positions [m], shape (capacity,), dtype vec3."""
    intensity: wp.array
    """Reflectance in [0, 1] where the sensor says so, shape (capacity,), float32."""
    ring: wp.array
    """The laser's number counted from below, shape (capacity,), uint16; zero where unknown."""
    t: wp.array
    """Time of the point after the cloud's version [s], shape (capacity,), float32; zero where unknown."""
    count: wp.array
    """How many points are set, shape (1,), int32, on the device."""
    frame_id: str = "lidar"
    """The frame of the positions."""
    dropped: int = 0
    """Points that were offered beyond the capacity, and are not here."""

    @classmethod
    def from_numpy(
        cls,
        points: np.ndarray,
        *,
        ring: np.ndarray | None = None,
        t: np.ndarray | None = None,
        capacity: int | None = None,
        device: str | None = None,
        frame_id: str = "lidar",
    ) -> Cloud:
        """Copies host points to a device.

        Args:
            points: Shape (n, 3 or more), floating: x y z [m] and, as the fourth column, intensity.
            ring: Laser numbers, shape (n,).
            t: Offsets from the cloud's version [s], shape (n,).
            capacity: Room for points; by default just n. Points beyond it are left out and counted in `dropped`.
            device: The Warp device; by default `cpu`.
            frame_id: The frame of the positions.

        Raises:
            ValueError: A shape does not fit.
            DeviceError: There is no such device.
        """
        points = np.asarray(points)
        if points.ndim != 2 or points.shape[1] < 3:
            raise ValueError(f"points must have shape (n, 3 or more), not {points.shape}")
        for name, column in (("ring", ring), ("t", t)):
            if column is not None and column.shape != (len(points),):
                raise ValueError(f"{name} must have shape ({len(points)},) as there are points, not {column.shape}")
        device = resolve_device(device)
        offered = len(points)
        capacity = offered if capacity is None else capacity
        n = min(offered, capacity)

        def upload(column: np.ndarray | None, dtype: type, shape: tuple[int, ...]) -> wp.array:
            host = np.zeros(shape, wp.dtype_to_numpy(dtype))
            if column is not None:
                host[:n] = column[:n]
            return wp.array(host, dtype=wp.vec3 if len(shape) == 2 else dtype, device=device)

        return cls(
            xyz=upload(points[:, :3], wp.float32, (capacity, 3)),
            intensity=upload(points[:, 3] if points.shape[1] > 3 else None, wp.float32, (capacity,)),
            ring=upload(ring, wp.uint16, (capacity,)),
            t=upload(t, wp.float32, (capacity,)),
            count=wp.array([n], dtype=wp.int32, device=device),
            frame_id=frame_id,
            dropped=offered - n,
        )

    @property
    def capacity(self) -> int:
        """Points that the arrays have room for."""
        return self.xyz.shape[0]

    @property
    def device(self) -> str:
        """The Warp name of the device."""
        return str(self.xyz.device)

    def __len__(self) -> int:
        """How many points are set. On a GPU this waits for the device and reads the count back."""
        return int(self.count.numpy()[0])

    def numpy(self) -> np.ndarray:
        """Positions and intensity on the host, shape (n, 4), float32, a copy."""
        n = len(self)
        points = np.empty((n, 4), np.float32)
        points[:, :3] = self.xyz.numpy()[:n]
        points[:, 3] = self.intensity.numpy()[:n]
        return points
