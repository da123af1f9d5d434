"""Scans that are rendered already, of vehicles with straight flanks, made such as bowed and polished ones would give.

A car is narrower at its bumpers than amidships by some 0.3 m, and its paint mirrors beams away that graze it. Seen
along its flank, as parked cars are, the last metre of it turns from the sensor and returns little, and its bonnet or
boot nothing: on labelled KITTI scans the last points lie 0.6 m before the end of the label in the median. Scans that
show cars to the end teach a network that a car ends where its points do. The simulator has bowed and polished vehicles
since; a scan from before is mended by moving the points inward and keeping of them what the turned surface would
return.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..classes import VEHICLE
from .frames import TrainingFrame

__all__ = ["Bowing", "bowed"]

_LONG, _FLAT = 5.8, 0.2  # [m] from here on a vehicle is a truck or a bus, which is bowed by this share of a car's bow
_OVER_GROUND = 0.12  # [m] above the bottom of a box: what is lower is the road's
_REACH = np.array(
    [1.03, 1.08, 1.05]
)  # of half the length, half the width and the height: what is within is the vehicle's
_FLANK = 0.62  # of half the width: what is farther out on the sensor's side, and no roof, is flank
_LID, _SCREEN, _FRONT = 0.48, 0.88, 0.97  # of the height, of the height and of half the length: bonnet and boot
_CABIN = 0.5  # of half the length: where bonnet and boot begin
_ROOF = 0.94  # of the height: what is above is roof
_FALL = 0.07  # slope of bonnet and boot towards the bumpers


@dataclass(frozen=True, kw_only=True)
class Bowing:
    """How far vehicles are changed; each draws its own."""

    bow: float = 0.2
    """Largest share of its width that a car loses at either end."""
    mirror: tuple[float, float] = (0.02, 0.12)
    """Between which the cosine of incidence lies at which half of the echoes are mirrored away."""


def bowed(frame: TrainingFrame, rng: np.random.Generator, options: Bowing | None = None) -> TrainingFrame:
    """The scan as if the flanks of its vehicles were bowed and their paint polished.

    Args:
        frame: In the sensor's frame; one that is `bowed` stays as it is.
        rng: The same one gives the same scan.
        options: How far; None: as `Bowing()` says.

    Returns:
        A scan with fewer points and the same boxes; `points_in` counts what is left.
    """
    if frame.bowed:
        return frame
    options = options or Bowing()
    xyz, points_in = frame.xyz.copy(), frame.points_in.copy()
    keep = np.ones(len(xyz), bool)
    x, y = frame.xyz[:, 0].copy(), frame.xyz[:, 1].copy()
    for k in np.flatnonzero((points_in > 0) & (frame.classes == VEHICLE)):
        box = frame.boxes[k].astype(np.float64)
        reach = 0.5 * np.hypot(box[3], box[4]) + 0.1
        near = np.flatnonzero((np.abs(x - np.float32(box[0])) < reach) & (np.abs(y - np.float32(box[1])) < reach))
        place = _in_box(frame.xyz[near].astype(np.float64) - box[:3], box)
        mine = (np.abs(place) < _REACH).all(1) & (0.5 * (place[:, 2] + 1.0) * box[5] > _OVER_GROUND)
        near, place = near[mine], place[mine]
        ends, power, half = _drawn(rng, box, options)
        share = np.where(place[:, 0] > 0, ends[0], ends[1])
        narrower = 1.0 - share * np.abs(place[:, 0]) ** power
        back = _returned(place, narrower, share, power, half, box)
        keep[near[rng.random(len(near)) >= back]] = False
        moved = (narrower - 1.0) * place[:, 1] * 0.5 * box[4]
        xyz[near, 0] -= moved * np.sin(box[6])
        xyz[near, 1] += moved * np.cos(box[6])
        points_in[k] = max(int(points_in[k]) - int((~keep[near]).sum()), 0)
    return replace(frame, xyz=xyz[keep], ring=frame.ring[keep], points_in=points_in, bowed=True)


def _drawn(rng: np.random.Generator, box: np.ndarray, options: Bowing) -> tuple[np.ndarray, float, float]:
    """A vehicle's loss of width at front and rear, the power by which it grows to the ends, and its polish."""
    draws = rng.random(4)
    low, high = options.mirror
    return (
        options.bow * (1.0 if box[3] < _LONG else _FLAT) * draws[:2],
        2.2 + 1.8 * draws[2],
        low + (high - low) * draws[3],
    )


def _in_box(apart: np.ndarray, box: np.ndarray) -> np.ndarray:
    """Places in a box from −1 to 1 along its length, width and height, of offsets from its centre, shape (n, 3)."""
    c, s = np.cos(box[6]), np.sin(box[6])
    turned = np.stack([apart[:, 0] * c + apart[:, 1] * s, apart[:, 1] * c - apart[:, 0] * s, apart[:, 2]], 1)
    return turned / (0.5 * box[3:6])


def _returned(
    place: np.ndarray, narrower: np.ndarray, share: np.ndarray, power: float, half: float, box: np.ndarray
) -> np.ndarray:
    """The share of its echoes that each place on a vehicle returns once it is bowed and polished, 0 to 1."""
    size = 0.5 * box[3:6]
    sensor = _in_box(-box[None, :3], box)[0]
    ray = (sensor - place * np.stack([np.ones_like(narrower), narrower, np.ones_like(narrower)], 1)) * size
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    u, far, up = place[:, 0], np.abs(place[:, 0]), 0.5 * (place[:, 2] + 1.0)
    side = 1.0 if sensor[1] > 0 else -1.0
    flank = (side * place[:, 1] > _FLANK) & (up < _SCREEN)
    returned = np.ones(len(place))

    def seen(cosine: np.ndarray) -> np.ndarray:
        return cosine**3 / (cosine**3 + half**3)

    if abs(sensor[1]) > 1.0:
        slope = np.sign(u) * share * power * far ** (power - 1.0) * box[4] / box[3]
        cosine = np.maximum((slope * ray[:, 0] + side * ray[:, 1]) / np.sqrt(1.0 + slope**2), 0.0)
        thinner = np.minimum(cosine / np.maximum(side * ray[:, 1], 1e-3), 1.0)
        returned[flank] = (thinner * seen(cosine))[flank]
    # Bonnet and boot fall towards the bumpers: the near one leans to the sensor, the far one away from it.
    lid = ~flank & (up > _LID) & (up < _SCREEN) & (far > _CABIN) & ((u * sensor[0] < 0) | (far < _FRONT))
    level = lid | (up >= _ROOF)
    cosine = np.maximum(ray[:, 2] + np.where(lid, _FALL * np.sign(u) * ray[:, 0], 0.0), 0.0)
    returned[level] = seen(cosine)[level]
    return returned
