"""The ego vehicle: a smooth ride along its lane, as springs and tyres make of the ground below."""

from __future__ import annotations

import numpy as np

from .street import travelled
from .terrain import Ground
from .world import on_slope

__all__ = ["EgoPath", "mounting"]

_STEP = 0.2  # [m] between the points where the ground is felt
_SMOOTH = 1.5  # [m] standard deviation of the window over which wheels and springs average it


class EgoPath:
    """World poses of the vehicle over time: straight along a lane, twice differentiable in height and attitude."""

    def __init__(self, ground: Ground, lane: float, motion: np.ndarray, duration: float):
        """Feels the ground along the lane.

        Args:
            ground: What the vehicle drives on.
            lane: To the left of the centre line [m].
            motion: Speed [m/s], and amplitude [m], angular rate [rad/s] and phase [rad] of its variation.
            duration: How long it drives [s].
        """
        from scipy.interpolate import CubicSpline

        self._ground, self._lane = ground, lane
        self.motion = np.asarray(motion, np.float64)
        reach = travelled(self.motion, np.linspace(-1.0, duration + 1.0, 200))
        s = np.arange(reach.min() - 5.0, reach.max() + 5.0, _STEP)
        half = round(4 * _SMOOTH / _STEP)
        window = np.exp(-0.5 * (np.arange(-half, half + 1) * _STEP / _SMOOTH) ** 2)
        wide = np.arange(-half, len(s) + half) * _STEP + s[0]
        one = np.ones(len(wide))
        felt = np.stack([ground.height(wide, lane * one), ground.slope(wide, lane * one)[1]])
        smooth = [np.convolve(row, window / window.sum(), mode="valid") for row in felt]
        self._height, self._across = (CubicSpline(s, row) for row in smooth)
        self._along = self._height.derivative()

    def pose(self, t: float) -> np.ndarray:
        """World from vehicle at time t [s], shape (4, 4)."""
        s = np.atleast_1d(travelled(self.motion, t))
        x, y, bend = self._ground.to_world(s, np.full(1, self._lane))
        return on_slope(x, y, self._height(s), bend, bend, self._along(s), self._across(s), np.ones((1, 3)))[0]


def mounting(height: float, pitch: float, roll: float) -> np.ndarray:
    """Vehicle from sensor [m, rad], shape (4, 4)."""
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]) @ np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pose[2, 3] = height
    return pose
