"""People on foot and on bicycles, at any phase of their step or pedal stroke."""

from __future__ import annotations

import numpy as np

from .labels import Material, PointClass, face_label
from .mesh import Shape, box, ellipsoid, join, loft, tube

__all__ = ["PHASES", "bicycle", "cyclist", "pedestrian"]

PHASES = 8
"""Poses of one double step, and of one turn of the pedals."""


def _torso(low: np.ndarray, high: np.ndarray, half_width: float, half_depth: float, label: int) -> Shape:
    """A trunk from hip to shoulder, wider above, with an elliptic section."""
    along = np.linspace(0, 1, 6)[:, None]
    spine = low + along * (high - low)
    scale = np.interp(along[:, 0], [0, 0.25, 0.75, 0.93, 1], [0.82, 0.78, 1.0, 0.85, 0.4])
    angle = np.arange(10) * (2 * np.pi / 10)
    ring = np.stack([half_depth * np.cos(angle), half_width * np.sin(angle), 0 * angle], 1)
    return loft(spine[:, None] + scale[:, None, None] * ring, label, closed=True, caps=label)


def _limb(points: list[np.ndarray], radii: list[float], label: int) -> Shape:
    return tube(np.array(points), np.array(radii), label, 6)


def pedestrian(phase: int, random: np.random.Generator, *, walking: bool = True) -> Shape:
    """A person facing +x at one of `PHASES` phases of the step; the same `random` gives the same person."""
    height = random.uniform(1.5, 1.92) if random.random() < 0.85 else random.uniform(1.05, 1.45)
    stout = random.uniform(0.88, 1.25)
    top = face_label(Material.CLOTH if random.random() < 0.6 else Material.DARK_CLOTH, PointClass.PEDESTRIAN)
    legs = face_label(Material.CLOTH if random.random() < 0.3 else Material.DARK_CLOTH, PointClass.PEDESTRIAN)
    skin = face_label(Material.SKIN, PointClass.PEDESTRIAN)
    stride = random.uniform(0.35, 0.5) if walking else random.uniform(0.0, 0.08)
    coat, bag, skirt = random.random() < 0.25, random.random() < 0.3, random.random() < 0.12
    lean = random.uniform(0.0, 0.05)
    hip, knee, shoulder = 0.50 * height, 0.27 * height, 0.82 * height
    swing = stride * np.sin(2 * np.pi * phase / PHASES)
    hip_half, shoulder_half = 0.055 * height * stout, 0.115 * height * stout
    parts = []
    for side in (-1.0, 1.0):
        angle = side * swing
        bend = 0.5 * stride * max(0.0, np.cos(2 * np.pi * phase / PHASES) * side) + 0.05
        thigh, shin = hip - knee, knee - 0.04 * height
        at_hip = np.array([0.0, side * hip_half, hip])
        at_knee = at_hip + thigh * np.array([np.sin(angle), 0.0, -np.cos(angle)])
        at_ankle = at_knee + shin * np.array([np.sin(angle - bend), 0.0, -np.cos(angle - bend)])
        toe = at_ankle + np.array([0.10 * height, side * 0.01, -0.02 * height])
        parts.append(
            _limb([at_hip, at_knee, at_ankle], [0.052 * height * stout, 0.034 * height * stout, 0.025 * height], legs)
        )
        parts.append(_limb([at_ankle - [0.03, 0, 0.01], toe], [0.026 * height, 0.02 * height], legs))
        reach = -0.75 * angle
        at_shoulder = np.array([lean, side * shoulder_half, shoulder - 0.03 * height])
        at_elbow = at_shoulder + 0.17 * height * np.array([np.sin(reach), side * 0.18, -np.cos(reach)])
        at_hand = at_elbow + 0.17 * height * np.array([np.sin(reach + 0.35), 0.0, -np.cos(reach + 0.35)])
        parts.append(
            _limb([at_shoulder, at_elbow, at_hand], [0.03 * height * stout, 0.025 * height, 0.02 * height], top)
        )
    parts.append(
        _torso(np.array([0, 0, hip - 0.04 * height]), np.array([lean, 0, shoulder + 0.03 * height]),
               shoulder_half + 0.01, 0.066 * height * stout, top)
    )  # fmt: skip
    if coat or skirt:
        parts.append(
            tube(np.array([[0, 0, knee * (0.9 if skirt else 1.15)], [0, 0, hip + 0.05]]),
                 np.array([0.12, 0.085]) * height * stout, top, 8)
        )  # fmt: skip
    if bag:
        parts.append(box((lean - 0.30, -0.15, 0.58 * height), (lean - 0.1, 0.15, 0.80 * height), legs))
    parts.append(
        _limb([np.array([lean, 0, shoulder]), np.array([lean + 0.01, 0, 0.88 * height])], [0.032 * height] * 2, skin)
    )
    parts.append(
        ellipsoid((lean + 0.015, 0, 0.932 * height), (0.058 * height, 0.045 * height, 0.068 * height), skin, 5)
    )
    return join(*parts).centred()


def _wheel(x: float, radius: float, point_class: PointClass) -> list[Shape]:
    """A thin tyre and a disc of spokes that most beams pass."""
    angle = np.linspace(0, 2 * np.pi, 17)
    rim = np.stack([x + (radius - 0.02) * np.cos(angle), 0 * angle, radius + (radius - 0.02) * np.sin(angle)], 1)
    hub = tube(
        np.array([[x, -0.006, radius], [x, 0.006, radius]]), radius - 0.04, face_label(Material.SPOKES, point_class), 12
    )
    return [tube(rim, 0.022, face_label(Material.TYRE, point_class), 5, caps=False), hub]


def bicycle(point_class: PointClass = PointClass.OTHER) -> Shape:
    """A bicycle of 1.75 m facing +x; parked ones are clutter, class OTHER."""
    metal = face_label(Material.METAL, point_class)
    crank, saddle, head = np.array([-0.08, 0, 0.29]), np.array([-0.22, 0, 0.88]), np.array([0.38, 0, 0.82])
    rear, front = np.array([-0.54, 0, 0.34]), np.array([0.54, 0, 0.34])
    bars = [(crank, saddle), (crank, head), (saddle * 0.9 + crank * 0.1, head), (rear, crank),
            (rear, saddle * 0.8 + crank * 0.2), (front, head + np.array([-0.03, 0, 0.13]))]  # fmt: skip
    parts = [tube(np.array(pair), 0.018, metal, 5) for pair in bars]
    parts += [*_wheel(-0.54, 0.34, point_class), *_wheel(0.54, 0.34, point_class)]
    grip = head + np.array([-0.02, 0, 0.2])
    parts.append(tube(grip + np.array([[-0.08, -0.29, 0], [0, 0, 0], [-0.08, 0.29, 0]]), 0.015, metal, 5))
    parts.append(tube(np.array([head, grip]), 0.015, metal, 5))
    parts.append(box((-0.35, -0.07, 0.88), (-0.1, 0.07, 0.95), face_label(Material.DARK_CLOTH, point_class)))
    return join(*parts)


def cyclist(phase: int, random: np.random.Generator) -> Shape:
    """A rider on a bicycle facing +x at one of `PHASES` phases of the pedals."""
    top = face_label(Material.CLOTH if random.random() < 0.6 else Material.DARK_CLOTH, PointClass.CYCLIST)
    legs = face_label(Material.DARK_CLOTH if random.random() < 0.7 else Material.CLOTH, PointClass.CYCLIST)
    skin = face_label(Material.SKIN, PointClass.CYCLIST)
    size, stout = random.uniform(0.92, 1.08), random.uniform(0.9, 1.2)
    lean = random.uniform(0.12, 0.34)
    hip = np.array([-0.2, 0.0, 0.95])
    shoulder = hip + 0.52 * size * np.array([np.sin(lean), 0, np.cos(lean)])
    parts = [bicycle(PointClass.CYCLIST)]
    parts.append(_torso(hip, shoulder + np.array([0, 0, 0.06]), 0.19 * stout * size, 0.115 * stout * size, top))
    for k, side in enumerate((-1.0, 1.0)):
        angle = 2 * np.pi * phase / PHASES + np.pi * k
        pedal = np.array([-0.08 + 0.17 * np.cos(angle), side * 0.11, 0.29 + 0.17 * np.sin(angle)])
        at_hip = hip + np.array([0, side * 0.09, -0.02])
        reach = pedal - at_hip
        span = np.linalg.norm(reach)
        bone = max(0.44 * size, 0.505 * span)
        forward = np.array([-reach[2], 0, reach[0]]) / span
        at_knee = at_hip + 0.5 * reach + np.sqrt(max(bone**2 - 0.25 * span**2, 0.0)) * forward
        parts.append(_limb([at_hip, at_knee, pedal], [0.085 * stout, 0.058 * stout, 0.042], legs))
        parts.append(_limb([pedal - np.array([0.06, 0, 0]), pedal + np.array([0.15, 0, -0.02])], [0.04, 0.035], legs))
        hand = np.array([0.3, side * 0.26, 1.03])
        at_shoulder = shoulder + np.array([0, side * 0.18 * size, -0.02])
        elbow = 0.5 * (at_shoulder + hand) + np.array([-0.05, side * 0.07, -0.06])
        parts.append(_limb([at_shoulder, elbow, hand], [0.048 * stout, 0.042, 0.033], top))
    head = shoulder + np.array([0.06, 0, 0.24 * size])
    parts.append(_limb([shoulder, head], [0.055, 0.055], skin))
    parts.append(ellipsoid(tuple(head), (0.105, 0.08, 0.12), skin, 5))
    if random.random() < 0.3:
        parts.append(box((-0.75, -0.17, 0.45), (-0.35, 0.17, 0.75), legs))
    return join(*parts).centred()
