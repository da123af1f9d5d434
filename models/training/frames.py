"""Frames to learn from: simulated scenes kept in files, varied anew each time they are drawn.

A frame file holds points in steps of 2 mm (int16), so that 2,000 scans take 1.5 GB and load in a millisecond.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from ..classes import CYCLIST, PEDESTRIAN
from ..geometry import points_in_boxes

__all__ = [
    "Augmentation",
    "TrainingFrame",
    "augment",
    "labelled_boxes",
    "labelled_frame",
    "load_frame",
    "save_frame",
    "simulate_frame",
    "simulate_views",
]

_STEP = 0.002  # [m]
_REACH = 32767 * _STEP


@dataclass(frozen=True, kw_only=True)
class TrainingFrame:
    """One scan with its objects, in the sensor's frame."""

    xyz: np.ndarray
    """Shape (n, 3), float32 [m]."""
    ring: np.ndarray
    """Shape (n,), uint8."""
    boxes: np.ndarray
    """Shape (k, 7), float32."""
    classes: np.ndarray
    """Shape (k,), int32, indices into `models.classes.CLASSES`."""
    points_in: np.ndarray
    """Points that each object returned, shape (k,), int32."""
    sensor_height: float
    """Above the ground around the sensor [m]."""
    velocities: np.ndarray = field(default_factory=lambda: np.empty((0, 2), np.float32))
    """Over ground along x and y [m/s], shape (k, 2), float32; of no rows where they are unknown."""
    bowed: bool = False
    """Whether its vehicles are bowed in plan and polished, as real ones are and those of earlier renderings are not."""
    tight: bool = True
    """Whether boxes are tight, as the simulator's are, or have the room that people who label scans leave."""


class _Simulated(Protocol):
    points: np.ndarray
    ring: np.ndarray
    ground: np.ndarray
    boxes: np.ndarray
    classes: np.ndarray
    counts: np.ndarray
    velocities: np.ndarray


def height_over_ground(points: np.ndarray, ground: np.ndarray, radius: float = 12.0) -> float:
    """The sensor's height [m] over the ground points within a radius of it, which is what a pipeline would measure."""
    near = ground & (np.hypot(points[:, 0], points[:, 1]) < radius)
    return float(-np.median(points[near if near.any() else ground, 2])) if ground.any() else 1.7


def simulate_frame(seed: int) -> TrainingFrame:
    """The simulator's random scene of this seed, with a random sensor."""
    from ..simulator import sample_scene

    frame = sample_scene(seed)
    return _training_frame(frame)


def simulate_views(seed: int, count: int) -> list[TrainingFrame]:
    """`count` scans of the street of this seed, from different places with random sensors.

    Most of the time of a scene goes into building its street, so that views of one cost a fraction of as many streets.
    """
    from ..simulator import sample_views

    return [_training_frame(frame) for frame in sample_views(seed, count)]


def _training_frame(frame: _Simulated) -> TrainingFrame:
    inside = (np.abs(frame.points[:, :3]) < _REACH).all(axis=1)
    points = frame.points[inside]
    return TrainingFrame(
        xyz=points[:, :3].astype(np.float32),
        ring=frame.ring[inside].astype(np.uint8),
        boxes=np.asarray(frame.boxes, np.float32).reshape(-1, 7),
        classes=np.asarray(frame.classes, np.int32),
        points_in=np.asarray(frame.counts, np.int32),
        sensor_height=height_over_ground(points, np.asarray(frame.ground, bool)[inside]),
        velocities=np.asarray(frame.velocities, np.float32).reshape(-1, 2),
        bowed=True,
    )


def labelled_frame(
    points: np.ndarray,
    boxes: np.ndarray,
    classes: np.ndarray,
    sensor_height: float,
    velocities: np.ndarray | None = None,
) -> TrainingFrame:
    """A real scan with its labels, to learn from.

    Lasers are told by the beams' elevations, in 64 steps, as few data sets say them.

    Args:
        points: Where there are labels, in the sensor's frame, shape (n, 3 or more) [m].
        boxes: Shape (k, 7).
        classes: Indices into `models.classes.CLASSES`, shape (k,).
        sensor_height: Above the ground [m].
        velocities: Over ground along x and y, NaN where unknown, shape (k, 2) [m/s].
    """
    xyz = np.asarray(points, np.float32)[:, :3]
    xyz = xyz[(np.abs(xyz) < _REACH).all(axis=1)]
    boxes = np.asarray(boxes, np.float32).reshape(-1, 7)
    elevation = np.arctan2(xyz[:, 2], np.hypot(xyz[:, 0], xyz[:, 1]))
    low, high = (elevation.min(), elevation.max()) if len(xyz) else (0.0, 1.0)
    return TrainingFrame(
        xyz=xyz,
        ring=np.clip((elevation - low) / max(high - low, 1e-6) * 64, 0, 63).astype(np.uint8),
        boxes=boxes,
        classes=np.asarray(classes, np.int32),
        points_in=points_in_boxes(xyz, boxes, margin=0.05).sum(axis=1).astype(np.int32),
        sensor_height=float(sensor_height),
        velocities=np.empty((0, 2), np.float32) if velocities is None else np.asarray(velocities, np.float32),
        bowed=True,
        tight=False,
    )


def save_frame(path: Path, frame: TrainingFrame) -> None:
    """Writes a frame file; a reader never sees half of one."""
    partial = path.with_suffix(".partial.npz")
    np.savez(
        partial,
        xyz=np.rint(frame.xyz / _STEP).astype(np.int16),
        ring=frame.ring,
        boxes=frame.boxes,
        classes=frame.classes,
        points_in=frame.points_in,
        sensor_height=np.float32(frame.sensor_height),
        velocities=frame.velocities,
        bowed=np.bool_(frame.bowed),
        tight=np.bool_(frame.tight),
    )
    os.replace(partial, path)


def load_frame(path: Path) -> TrainingFrame:
    """Reads a frame file."""
    with np.load(path) as stored:
        return TrainingFrame(
            xyz=stored["xyz"].astype(np.float32) * np.float32(_STEP),
            ring=stored["ring"],
            boxes=stored["boxes"],
            classes=stored["classes"],
            points_in=stored["points_in"],
            sensor_height=float(stored["sensor_height"]),
            velocities=stored["velocities"] if "velocities" in stored else np.empty((0, 2), np.float32),
            bowed="bowed" in stored and bool(stored["bowed"]),
            tight="tight" not in stored or bool(stored["tight"]),
        )


def labelled_boxes(boxes: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Boxes of people and riders as those who label scans draw them: with room for limbs and gait, not tight.

    Data sets agree on some 0.8 x 0.6 x 1.73 m for a pedestrian and 1.76 x 0.6 to 0.8 m for a rider (the anchors that
    detectors have for KITTI); tight boxes of the simulator's are 0.3 m less, and a person overlaps half with neither.

    Args:
        boxes: Tight ones, shape (k, 7).
        classes: Indices into `models.classes.CLASSES`, shape (k,).

    Returns:
        New boxes, on the same ground and round the same places.
    """
    boxes = np.array(boxes)
    walks, rides = np.asarray(classes) == PEDESTRIAN, np.asarray(classes) == CYCLIST
    boxes[walks, 3] = np.maximum(boxes[walks, 3] + 0.15, 0.7)
    boxes[walks, 4] = np.maximum(boxes[walks, 4] + 0.1, 0.6)
    boxes[rides, 4] += 0.1
    people = walks | rides
    boxes[people, 5] += 0.05
    boxes[people, 2] += 0.025
    return boxes


@dataclass(frozen=True, kw_only=True)
class Augmentation:
    """How a frame is varied each time it is drawn."""

    shift: float = 20.0
    """Largest displacement along x and y [m]: the window learnt from is smaller than the scan."""
    scale: float = 0.04
    """Largest relative change of all lengths."""
    height: float = 0.15
    """Largest error of the sensor's height [m]."""
    tilt: float = 0.015
    """Largest slope of the ground about x and y [rad]."""
    thin_rings: float = 0.1
    """Share of the frames that lose every second, or three of four, of their rings."""
    thin_points: float = 0.2
    """Share of the frames that lose a random part of their points, up to 60 %."""


def augment(frame: TrainingFrame, rng: np.random.Generator, options: Augmentation) -> TrainingFrame:
    """The frame turned by any angle, mirrored, shifted, scaled, tilted and thinned at random."""
    keep = np.ones(len(frame.xyz), bool)
    share = 1.0
    if rng.random() < options.thin_rings:
        step = 2 if rng.random() < 0.7 else 4
        keep &= frame.ring % step == rng.integers(step)
        share /= step
    if rng.random() < options.thin_points:
        part = rng.uniform(0.4, 1.0)
        keep &= rng.random(len(keep), dtype=np.float32) < part
        share *= part

    angle = rng.uniform(-np.pi, np.pi)
    mirror = 1.0 if rng.random() < 0.5 else -1.0
    scale = 1.0 + rng.uniform(-options.scale, options.scale)
    shift = rng.uniform(-options.shift, options.shift, 2)
    slope = rng.uniform(-options.tilt, options.tilt, 2)
    c, s = np.cos(angle), np.sin(angle)
    # Heights are about the ground under the sensor, so that scale and tilt leave the ground at zero there.
    A = np.array([[c, -s * mirror, 0.0], [s, c * mirror, 0.0], [slope[0], slope[1], 1.0]]) * scale
    offset = np.array([shift[0], shift[1], scale * frame.sensor_height])
    matrix, offset = A.astype(np.float32), offset.astype(np.float32)

    boxes = frame.boxes.copy()
    boxes[:, :3] = boxes[:, :3] @ matrix.T + offset
    boxes[:, 3:6] *= scale
    boxes[:, 6] = angle + mirror * boxes[:, 6]
    return TrainingFrame(
        xyz=(frame.xyz if share == 1.0 else frame.xyz[keep]) @ matrix.T + offset,
        ring=frame.ring if share == 1.0 else frame.ring[keep],
        boxes=boxes,
        classes=frame.classes,
        points_in=np.floor(frame.points_in * share).astype(np.int32),
        sensor_height=rng.uniform(-options.height, options.height),
        velocities=frame.velocities @ (matrix[:2, :2] / np.float32(scale)).T,
        bowed=frame.bowed,
        tight=frame.tight,
    )
