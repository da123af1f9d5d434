"""What fusion gains over the LiDAR alone, on scenes made up for it: traffic out to 140 m, where the LiDAR sees little.

Cars come and go along a straight road on which the ego vehicle drives. The LiDAR's detector finds near ones surely and
misses more of them the farther they are, with lower scores, and finds false ones of low score as well; the camera knows
no distance, but finds cars as far as they have pixels, at a third of the LiDAR's rate of misses; the radar sees their
radial speed. All three err at random, apart from each other: the gains are what fusion can make of that, not what it
does in a real street.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...models.classes import VEHICLE
from ...models.fusion import FusedObjects, Fusion, FusionConfig
from ...models.geometry import box_corners, invert, rigid, transform_boxes
from ..messages import CameraObjects, RadarObjects

__all__ = ["SENSOR_SETS", "FusionScore", "fusion_gains", "lines_of_gains", "scene"]

SENSOR_SETS = ((), ("camera",), ("radar",), ("camera", "radar"))
"""What joins the LiDAR."""

_PERIOD_NS = 100_000_000
_FAR = 70.0  # [m]
_NEAR_ENOUGH = 3.0  # from the truth [m]
_BIRTH_FRAMES = 3
_IMAGE = (1280, 720)
_OPTICAL = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0]])
_PROJECTION = np.array([[1100.0, 0, 640], [0, 1100, 360], [0, 0, 1]]) @ _OPTICAL


@dataclass(frozen=True, kw_only=True)
class FusionScore:
    """How well a set of sensors did."""

    sensors: tuple[str, ...]
    """Besides the LiDAR."""
    recall: float
    """Of true cars in frames, within 70 m."""
    far_recall: float
    """Beyond 70 m."""
    precision: float
    """Of objects reported in frames, how many are true."""
    birth_velocity_error: float
    """Median length of the difference of velocities in the first three frames of an object [m/s]."""
    velocity_error: float
    """In all frames [m/s]."""
    id_switches: int
    """How often a true car goes on under another id."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SceneFrame:
    """One frame of a scene: what the sensors found, and what there is."""

    version: int
    pose: np.ndarray
    boxes: np.ndarray
    scores: np.ndarray
    camera: CameraObjects
    radar: RadarObjects
    truth: np.ndarray
    """Boxes in the LiDAR's frame, shape (k, 7)."""
    ids: np.ndarray
    velocities: np.ndarray
    """Over ground along the LiDAR's axes, shape (k, 2)."""


def scene(seed: int, frames: int = 120, cars: int = 14) -> list[SceneFrame]:
    """The frames of a scene, ten a second; camera and radar are 50 and 30 ms older than the LiDAR."""
    random = np.random.default_rng([seed, 23])
    lane = random.choice([-3.5, 0.0, 3.5, 7.0], cars)
    speed = np.where(lane > 1.0, -1.0, 1.0) * random.uniform(6, 16, cars)
    start = np.stack([random.uniform(-20, 220, cars), lane + random.normal(0, 0.2, cars)], axis=1)
    yaw = np.where(speed > 0, 0.0, np.pi)
    return [_frame(random, k, start, speed, yaw) for k in range(frames)]


def _frame(random: np.random.Generator, k: int, start: np.ndarray, speed: np.ndarray, yaw: np.ndarray) -> SceneFrame:
    now = 0.1 * k

    def seen(time: float) -> tuple[np.ndarray, np.ndarray]:
        """Boxes of all cars and the pose at a time."""
        pose = rigid((8.0 * time, 0.0, 1.7))
        world = np.zeros((len(start), 7))
        world[:, 0], world[:, 1], world[:, 2] = start[:, 0] + speed * time, start[:, 1], 0.8
        world[:, 3:6], world[:, 6] = (4.4, 1.9, 1.6), yaw
        return transform_boxes(world, invert(pose)), pose

    truth, pose = seen(now)
    away = np.linalg.norm(truth[:, :2], axis=1)
    there = (away < 140.0) & (truth[:, 0] > 5.0)
    chance = np.clip(1.15 - away / 110.0, 0.12, 0.98)
    found = there & (random.random(len(truth)) < chance)
    boxes = truth[found] + random.normal(0, 1, (found.sum(), 7)) * [0.12, 0.12, 0.05, 0.2, 0.1, 0.1, 0.06]
    scores = np.clip(chance[found] * random.uniform(0.55, 1.1, found.sum()), 0.05, 0.99)
    false = random.poisson(1.5)
    places = random.uniform([10, -20], [140, 20], (false, 2))
    shape = np.tile([-0.9, 4.2, 1.8, 1.6, 0.0], (false, 1))
    boxes = np.concatenate([boxes, np.concatenate([places, shape], axis=1)])
    scores = np.concatenate([scores, random.uniform(0.1, 0.4, false)])

    then, camera_pose = seen(now - 0.05)
    uvw = box_corners(then) @ _PROJECTION[:, :3].T + _PROJECTION[:, 3]
    uv = uvw[..., :2] / np.maximum(uvw[..., 2:], 0.1)
    image = np.clip(np.concatenate([uv.min(1), uv.max(1)], axis=1), 0, [*_IMAGE, *_IMAGE])
    tall = image[:, 3] - image[:, 1]
    visible = there & (tall > 6) & (random.random(len(truth)) < 1.0 - (1.0 - chance) / 3.0)
    camera = CameraObjects(
        version=round((now - 0.05) * 1e9) + 10**9,
        sensor="camera",
        boxes=(image[visible] + random.normal(0, 1.0, (visible.sum(), 4))).astype(np.float32),
        scores=random.uniform(0.5, 0.95, visible.sum()).astype(np.float32),
        classes=np.full(visible.sum(), VEHICLE, np.int32),
        projection=_PROJECTION,
        size=_IMAGE,
        pose=camera_pose,
    )
    then, radar_pose = seen(now - 0.03)
    echo = there & (random.random(len(truth)) < 0.85)
    points = then[echo, :3] + random.normal(0, 0.4, (echo.sum(), 3)) * [1, 1, 0]
    velocity = np.stack([speed[echo] - 8.0, np.zeros(echo.sum()), np.zeros(echo.sum())], axis=1)
    rays = points / np.linalg.norm(points, axis=1, keepdims=True)
    clutter = random.poisson(1.0)
    ghosts = random.uniform([5, -40, 0], [140, 40, 0.01], (clutter, 3))
    radar = RadarObjects(
        version=round((now - 0.03) * 1e9) + 10**9,
        sensor="radar",
        positions=np.concatenate([points, ghosts]).astype(np.float32),
        radial_velocities=np.concatenate(
            [(velocity * rays).sum(1) + random.normal(0, 0.1, echo.sum()), random.uniform(-20, 5, clutter)]
        ).astype(np.float32),
        scores=np.full(echo.sum() + clutter, 0.8, np.float32),
        mounting=np.eye(4),
        velocity=np.array([8.0, 0.0, 0.0]),
        pose=radar_pose,
    )
    return SceneFrame(
        version=k * _PERIOD_NS + 10**9,
        pose=pose,
        boxes=boxes,
        scores=scores,
        camera=camera,
        radar=radar,
        truth=truth[there],
        ids=np.flatnonzero(there),
        velocities=np.stack([speed, np.zeros_like(speed)], axis=1)[there],
    )


def _found(frame: SceneFrame, objects: FusedObjects) -> np.ndarray:
    """The row of the object of each true car, −1 for none: nearest pairs first."""
    match = np.full(len(frame.truth), -1)
    apart = np.linalg.norm(frame.truth[:, None, :2] - objects.boxes[None, :, :2], axis=2)
    while apart.size and apart.min() < _NEAR_ENOUGH:
        car, row = np.unravel_index(apart.argmin(), apart.shape)
        match[car] = row
        apart[car], apart[:, row] = np.inf, np.inf
    return match


def _score(sensors: tuple[str, ...], seeds: Sequence[int]) -> FusionScore:
    hit, total, reported, switches = np.zeros(2), np.zeros(2), 0, 0
    errors, births = [], []
    for seed in seeds:
        fusion = Fusion(FusionConfig(sensors=sensors))
        named: dict[int, int] = {}
        lived: dict[int, int] = {}
        for frame in scene(seed):
            objects = fusion.update(
                frame.version, frame.boxes, frame.scores, np.full(len(frame.boxes), VEHICLE), pose=frame.pose,
                cameras=[frame.camera] if "camera" in sensors else [],
                radars=[frame.radar] if "radar" in sensors else [],
            )  # fmt: skip
            match = _found(frame, objects)
            far = (np.linalg.norm(frame.truth[:, :2], axis=1) > _FAR).astype(int)
            total += np.bincount(far, minlength=2)
            hit += np.bincount(far[match >= 0], minlength=2)
            reported += len(objects)
            for car in np.flatnonzero(match >= 0):
                number, who = int(objects.ids[match[car]]), int(frame.ids[car])
                switches += named.get(who, number) != number
                named[who] = number
                lived[number] = lived.get(number, 0) + 1
                error = float(np.linalg.norm(objects.velocities[match[car]] - frame.velocities[car]))
                errors.append(error)
                if lived[number] <= _BIRTH_FRAMES:
                    births.append(error)
    return FusionScore(
        sensors=sensors,
        recall=hit[0] / total[0],
        far_recall=hit[1] / total[1],
        precision=hit.sum() / max(reported, 1),
        birth_velocity_error=float(np.median(births)),
        velocity_error=float(np.median(errors)),
        id_switches=switches,
    )


def fusion_gains(seeds: Sequence[int] = range(10)) -> list[FusionScore]:
    """The scores of each of `SENSOR_SETS` on the same scenes."""
    return [_score(sensors, seeds) for sensors in SENSOR_SETS]


def lines_of_gains(scores: Sequence[FusionScore]) -> list[str]:
    """A table for people."""
    lines = [f"{'LiDAR and':16} {'recall':>7} {'>70 m':>7} {'precision':>9} {'v birth':>8} {'v':>6} {'IDS':>5}"]
    for each in scores:
        lines.append(
            f"{' + '.join(each.sensors) or 'nothing else':16} {100 * each.recall:7.1f} {100 * each.far_recall:7.1f} "
            f"{100 * each.precision:9.1f} {each.birth_velocity_error:8.2f} {each.velocity_error:6.2f} "
            f"{each.id_switches:5d}"
        )
    return lines
