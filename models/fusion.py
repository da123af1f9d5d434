"""Fusion: what the LiDAR found, with what cameras and radars saw a little earlier, as objects that are sure to exist.

The LiDAR's detections are joined by the latest of each camera and radar before they are tracked: a camera's object
that overlaps a detection in the image makes it surer and votes on its class, and makes a person or a rider of a
cluster; a radar's target in or beside it makes it surer, and its radial speed goes into the filter, from birth on. So
what is too faint for the LiDAR alone begins a track where another sensor agrees. Moving targets are tracked by
themselves too, stand in for what the LiDAR does not see, and share the ids of its tracks.

Existence is a Bayesian filter for each object, in log-odds: what was and was not seen, by sensors that are taken to err
independently of each other, with a memory that fades. So is the class, as a probability of each.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from .classes import CLASSES, CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE
from .fusion_sensors import (
    CameraView,
    RadarView,
    Targets,
    camera_support,
    nearest_boxes,
    radar_support,
    radar_targets,
)
from .track_config import ClassConfig, TrackerConfig
from .tracker import Tracker, Tracks

__all__ = ["FusedObjects", "Fusion", "FusionConfig"]

_BACKGROUND_CLASS = UNKNOWN
_SUREST = 6.0  # log-odds: beyond, an object that is gone would stay for seconds
_FORGET_NS = 5_000_000_000
_MANY_NAMES = 4096
_RADAR_SIZE = (4.4, 1.9, 1.6)  # of what only a radar has seen [m]
# The longer side of what a camera can make of a cluster [m]. People and riders are one cluster each; of a vehicle a
# cluster is a side or a corner, which as an object of its own would be a second one beside the true one.
_WHOLE = {PEDESTRIAN: (0.2, 1.3), CYCLIST: (0.8, 2.4)}


@dataclass(frozen=True, kw_only=True)
class FusionConfig:
    """How sensors are joined."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    """Of the objects that the LiDAR sees."""
    sensors: tuple[str, ...] = ()
    """Names of the cameras and radars there should be: those without recent data are said to be missing, and so are
    those that gave data before."""
    max_age: float = 0.3
    """Older data of a camera or radar is not used [s]."""
    camera_overlap: float = 0.35
    """The least overlap in the image of what belongs together."""
    camera_weight: float = 0.7
    """How much of a camera's score counts for existence: the probability that what it sees is not an error."""
    camera_miss: float = 0.5
    """Log-odds that an object loses when a camera looks at it and sees nothing."""
    radar_weight: float = 0.5
    """As `camera_weight`."""
    radar_gate: float = 1.0
    """How far from a box its radar targets may be [m]."""
    radar_angle: float = 0.02
    """And besides, for each metre of distance [rad]."""
    radar_speed_std: float = 0.3
    """Of a radial speed [m/s]."""
    least_radar_speed: float = 1.5
    """Over ground, of a target that is an object without the LiDAR: what stands still may be a manhole cover [m/s]."""
    neutral_score: float = 0.25
    """The score of a LiDAR detection that speaks neither for nor against existence."""
    lidar_miss: float = 0.8
    """Log-odds that an object loses in a frame without a detection."""
    memory: float = 1.0
    """In which time log-odds fade by a factor e [s]."""
    class_memory: float = 0.9
    """What remains of the logarithm of a class's probability from one detection to the next."""
    least_existence: float = 0.5
    """Objects of lower probability of existence do not pass the gate."""

    def __post_init__(self):
        for name in ("camera_overlap", "camera_weight", "radar_weight", "class_memory", "neutral_score"):
            if not 0.0 < getattr(self, name) < 1.0:
                raise ValueError(f"{name} must be above 0 and below 1, not {getattr(self, name)}")
        for name in ("max_age", "radar_gate", "radar_speed_std", "memory"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"{name} must be above 0, not {getattr(self, name)}")


@dataclass(frozen=True, eq=False, kw_only=True)
class FusedObjects:
    """The k objects that passed the gate, in the LiDAR's frame."""

    ids: np.ndarray
    """Never given to another object, shape (k,), int64."""
    boxes: np.ndarray
    """x y z l w h yaw [m, rad], shape (k, 7), float64."""
    velocities: np.ndarray
    """Along the frame's x and y [m/s]: over ground where the pose was given, else relative; shape (k, 2), float64."""
    covariances: np.ndarray
    """Of x, y and the velocity, shape (k, 4, 4), float64."""
    classes: np.ndarray
    """The likeliest class, shape (k,), int32."""
    class_probabilities: np.ndarray
    """Of each of `models.classes.CLASSES`, shape (k, 6), float64."""
    existence: np.ndarray
    """Probability that the object exists, shape (k,), float64."""
    background: np.ndarray
    """True for clusters of which no camera has made a person or a rider, shape (k,), bool."""
    lidar: np.ndarray
    """Row of the detection in this frame, −1 for none, shape (k,), int64."""
    camera: np.ndarray
    """Whether a camera saw it, shape (k,), bool."""
    radar: np.ndarray
    """Whether a radar saw it, shape (k,), bool."""
    ages: dict[str, float]
    """How old the data of each sensor was that was used [s]."""
    missing: tuple[str, ...]
    """Sensors that there should be, of which there was nothing recent."""

    def __len__(self) -> int:
        return len(self.ids)


class _Memory:
    """What is known of objects by id: log-odds of existence, logarithms of class probabilities."""

    def __init__(self):
        self.ids = np.empty(0, np.int64)
        self.existence = np.empty(0)
        self.classes = np.empty((0, len(CLASSES)))
        self.seen = np.empty(0, np.int64)

    def rows(self, ids: np.ndarray, now: int) -> np.ndarray:
        """The rows of objects, with new ones for those not known, and without those not asked for in a long time."""
        kept = now - self.seen <= _FORGET_NS
        new = np.setdiff1d(ids, self.ids[kept])
        everyone = np.concatenate([self.ids[kept], new])
        order = np.argsort(everyone)
        n = len(new)
        self.existence = np.concatenate([self.existence[kept], np.zeros(n)])[order]
        self.classes = np.concatenate([self.classes[kept], np.zeros((n, len(CLASSES)))])[order]
        self.seen = np.concatenate([self.seen[kept], np.full(n, now)])[order]
        self.ids = everyone[order]
        rows = np.searchsorted(self.ids, ids)
        self.seen[rows] = now
        return rows


class Fusion:
    """Joins sensors, tracks, and lets through what exists. The LiDAR's frames set the pace.

    What is out of the ordinary is counted in `incidents`: `stale` and `from the future` for data of sensors that was
    not used, besides what the tracker counts in `tracker.dropped` and `tracker.incidents`.
    """

    def __init__(self, config: FusionConfig | None = None):
        """Starts without objects."""
        self.config = config or FusionConfig()
        self.tracker = Tracker(self.config.tracker)
        self.radar_tracker = Tracker(_radar_config(self.config))
        self.incidents: Counter[str] = Counter()
        self._next_id = 1
        self.clear()

    def clear(self) -> None:
        """Forgets all objects and the time, for a new recording; ids go on."""
        self.tracker.clear()
        self.radar_tracker.clear()
        self._memory = _Memory()
        self._names: dict[
            tuple[str, int], tuple[int, int]
        ] = {}  # id and time last seen, of the tracks of both trackers
        self._last: tuple[int, np.ndarray | None] | None = None
        self._sensors = dict.fromkeys(self.config.sensors)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the cameras and radars there should be: those of the configuration, and those that gave data."""
        return tuple(self._sensors)

    def update(
        self,
        version: int,
        boxes: np.ndarray,
        scores: np.ndarray,
        classes: np.ndarray,
        *,
        background: np.ndarray | None = None,
        velocities: np.ndarray | None = None,
        pose: np.ndarray | None = None,
        cameras: Sequence[CameraView] = (),
        radars: Sequence[RadarView] = (),
    ) -> FusedObjects:
        """Takes up the LiDAR's detections of one frame, and the latest of the other sensors.

        Args:
            version: The frame's time [ns], later than the last one's.
            boxes: x y z l w h yaw in the LiDAR's frame [m, rad], shape (n, 7).
            scores: Shape (n,).
            classes: Indices into `models.classes.CLASSES`, shape (n,).
            background: True for boxes from clusters, shape (n,).
            velocities: As `Tracker.update` takes them, shape (n, 2).
            pose: World from LiDAR, shape (4, 4); None where unknown.
            cameras: The latest of each camera, not after `version`.
            radars: The latest of each radar, not after `version`.

        Raises:
            ValueError: As `Tracker.update`.
        """
        version, config = int(version), self.config
        boxes = np.asarray(boxes, np.float64).reshape(-1, 7)
        n = len(boxes)
        scores = np.array(scores, np.float64).reshape(-1)
        classes = np.array(classes, np.int64).reshape(-1)
        background = np.zeros(n, bool) if background is None else np.array(background, bool).reshape(-1)
        for name, array in (("scores", scores), ("classes", classes), ("background", background)):
            if len(array) != n:
                raise ValueError(f"{name} has {len(array)} entries for {n} boxes")
        ages = {each.sensor: (version - each.version) * 1e-9 for each in (*cameras, *radars)}
        cameras = [each for each in cameras if self._is_recent(ages[each.sensor])]
        radars = [each for each in radars if self._is_recent(ages[each.sensor])]
        used = {each.sensor: ages[each.sensor] for each in (*cameras, *radars)}
        self._sensors.update(dict.fromkeys(used))
        usable = np.isfinite(boxes).all(1) & np.isfinite(scores) & (boxes[:, 3:6] > 0).all(1)
        safe = np.where(usable[:, None], boxes, 0.0)

        likely = _class_evidence(classes, np.where(background, 0.0, np.nan_to_num(scores)))
        images = camera_support(
            safe, usable & ~background, cameras, pose=pose, ages=[used[each.sensor] for each in cameras],
            least_overlap=config.camera_overlap, velocities=velocities,
        )  # fmt: skip
        camera, box = np.nonzero(images.seen & usable)
        sure, kinds = _said_of(cameras, images.row, camera, box)
        np.add.at(likely, box, _class_evidence(kinds, sure))
        _make_surer(scores, box, config.camera_weight * sure)
        by_camera = (images.seen & usable).any(0)
        camera_miss = config.camera_miss * (images.expected & usable & ~images.seen).sum(0)
        # Cameras vote on the class of an object over time, in `_gate`: a class that changed with one image would tear
        # its track. A cluster becomes an object at once where a camera knows what it is and it is one as a whole.
        named = by_camera & background & _fits(likely.argmax(1), safe)
        classes[named] = likely[named].argmax(1)
        background[named] = False

        radial = np.full((n, 4), np.nan)
        ego_velocity = self._ego_velocity(version, pose)
        targets = radar_targets(radars, pose, [used[each.sensor] for each in radars], ego_velocity)
        echoes = radar_support(
            safe, targets, radars=len(radars), gate=config.radar_gate, angle=config.radar_angle
        )  # fmt: skip
        radar, box = np.nonzero(echoes.seen & usable)
        row = echoes.row[radar, box]
        _make_surer(scores, box, config.radar_weight * np.clip(targets.scores[row], 0.0, 1.0))
        radial[box, :2], radial[box, 2] = targets.directions[row], targets.speeds[row]  # of several radars the last
        radial[box, 3] = config.radar_speed_std
        by_radar = (echoes.seen & usable).any(0)

        tracks = self.tracker.update(
            version, boxes, scores, classes, background=background, velocities=velocities, radial=radial, pose=pose
        )
        level = float(np.median(safe[usable, 2])) if usable.any() else 0.0
        own = self._track_radar(version, targets, pose, level)
        seconds = 0.0 if self._last is None else (version - self._last[0]) * 1e-9
        self._last = (version, pose)
        return self._gate(version, seconds, tracks, own, scores, likely, by_camera, camera_miss, by_radar, used)

    def _is_recent(self, age: float) -> bool:
        if age < 0.0:
            self.incidents["from the future"] += 1
        elif age > self.config.max_age:
            self.incidents["stale"] += 1
        return 0.0 <= age <= self.config.max_age

    def _ego_velocity(self, version: int, pose: np.ndarray | None) -> np.ndarray | None:
        """Along the LiDAR's axes, from the last two poses."""
        if pose is None or self._last is None or self._last[1] is None or version <= self._last[0]:
            return None
        return pose[:3, :3].T @ (pose[:3, 3] - self._last[1][:3, 3]) / ((version - self._last[0]) * 1e-9)

    def _track_radar(self, version: int, targets: Targets, pose: np.ndarray | None, level: float) -> Tracks:
        """Tracks of moving targets, whether the LiDAR sees them or not, at a height of `level`."""
        places, directions, speeds, scores = targets.positions, targets.directions, targets.speeds, targets.scores
        # Without the ego's motion nobody can tell what moves.
        moving = np.abs(speeds) >= self.config.least_radar_speed if pose is not None else np.zeros(len(speeds), bool)
        places, directions, speeds, scores = places[moving], directions[moving], speeds[moving], scores[moving]
        n = len(places)
        boxes = np.zeros((n, 7))
        boxes[:, :2], boxes[:, 2], boxes[:, 3:6] = places, level, _RADAR_SIZE
        boxes[:, 6] = np.arctan2(np.sign(speeds) * directions[:, 1], np.sign(speeds) * directions[:, 0])
        radial = np.column_stack([directions, speeds, np.full(n, self.config.radar_speed_std)])
        return self.radar_tracker.update(version, boxes, scores, np.full(n, VEHICLE), radial=radial, pose=pose)

    def _gate(
        self,
        version: int,
        seconds: float,
        tracks: Tracks,
        own: Tracks,
        scores: np.ndarray,
        likely: np.ndarray,
        by_camera: np.ndarray,
        camera_miss: np.ndarray,
        by_radar: np.ndarray,
        used: dict[str, float],
    ) -> FusedObjects:
        """Existence and class of every object, and those that pass."""
        config = self.config
        own = self._hand_on(version, tracks, own)
        ids = self._names_of(version, tracks, own)
        rows = self._memory.rows(ids, version)
        row = np.concatenate([tracks.detections, np.full(len(own), -1)])
        has = row >= 0
        of_radar = np.arange(len(ids)) >= len(tracks)
        fade = np.exp(-seconds / config.memory)
        odds = self._memory.existence[rows] * fade
        sure = np.clip(scores[row[has]], 0.02, 0.98)
        neutral = np.log(config.neutral_score / (1.0 - config.neutral_score))
        odds[has] += np.log(sure / (1.0 - sure)) - neutral - camera_miss[row[has]]
        odds[~has & ~of_radar] -= config.lidar_miss
        fresh = ~np.concatenate([tracks.coasted, own.coasted])
        odds[of_radar & fresh] += np.log1p(2.0 * config.radar_weight)
        odds[of_radar & ~fresh] -= config.lidar_miss
        self._memory.existence[rows] = odds = np.clip(odds, -_SUREST, _SUREST)
        evidence = self._memory.classes[rows] * config.class_memory
        evidence[has] += likely[row[has]]
        evidence[of_radar, VEHICLE] += 0.2
        self._memory.classes[rows] = evidence
        probabilities = np.exp(evidence - evidence.max(1, keepdims=True, initial=0.0))
        probabilities /= probabilities.sum(1, keepdims=True)

        existence = 1.0 / (1.0 + np.exp(-odds))
        background = np.concatenate([tracks.background, np.zeros(len(own), bool)])
        boxes = np.concatenate([tracks.boxes, own.boxes])
        through = (existence >= config.least_existence) & ~_covered(boxes, background)
        camera, radar = np.zeros(len(ids), bool), of_radar & fresh
        camera[has], radar[has] = by_camera[row[has]], by_radar[row[has]]
        classes = probabilities.argmax(1).astype(np.int32)
        classes[background] = _BACKGROUND_CLASS
        return FusedObjects(
            ids=ids[through],
            boxes=boxes[through],
            velocities=np.concatenate([tracks.velocities, own.velocities])[through],
            covariances=np.concatenate([tracks.covariances, own.covariances])[through],
            classes=classes[through],
            class_probabilities=probabilities[through],
            existence=existence[through],
            background=background[through],
            lidar=row[through],
            camera=camera[through],
            radar=radar[through],
            ages=used,
            missing=tuple(name for name in self._sensors if name not in used),
        )

    def _hand_on(self, version: int, tracks: Tracks, own: Tracks) -> Tracks:
        """The radar's tracks that are none of the LiDAR's; the others share their ids with these."""
        if not len(own) or not len(tracks):
            return own
        gate = self.config.radar_gate + self.config.radar_angle * np.hypot(own.boxes[:, 0], own.boxes[:, 1])
        nearest = nearest_boxes(own.boxes[:, :2], tracks.boxes, gate + own.position_std)
        same = nearest >= 0
        for k in np.flatnonzero(same):
            radar, lidar = ("radar", int(own.ids[k])), ("lidar", int(tracks.ids[nearest[k]]))
            if lidar in self._names:
                self._names[radar] = (self._names[lidar][0], version)
            elif radar in self._names:
                self._names[lidar] = (self._names[radar][0], version)
        return _some(own, np.flatnonzero(~same))

    def _names_of(self, version: int, tracks: Tracks, own: Tracks) -> np.ndarray:
        """The ids of the objects behind the tracks of both trackers."""
        names: dict[int, None] = {}
        for each in [*(("lidar", i) for i in tracks.ids.tolist()), *(("radar", i) for i in own.ids.tolist())]:
            name, _ = self._names.get(each, (0, 0))
            if not name or name in names:
                name, self._next_id = self._next_id, self._next_id + 1
            self._names[each] = (name, version)
            names[name] = None
        if len(self._names) > _MANY_NAMES:
            self._names = {k: v for k, v in self._names.items() if version - v[1] <= _FORGET_NS}
        return np.array(list(names), np.int64)


def _radar_config(config: FusionConfig) -> TrackerConfig:
    """Of targets without a box: far off, seen as points, with their radial speed."""
    vehicle = ClassConfig(
        cost="distance",
        gate_distance=4.0,
        birth_hits=3,
        tentative=0.25,
        coast=0.6,
        report=0.25,
        position_std=0.8,
        acceleration_std=2.0,
        yaw_std=1.0,
    )
    classes = list(TrackerConfig().classes)
    classes[VEHICLE] = vehicle
    return replace(config.tracker, classes=tuple(classes))


def _some(table: Any, rows: np.ndarray) -> Any:
    """Some rows of a table of targets or tracks."""
    return replace(table, **{name: getattr(table, name)[rows] for name in vars(table)})


def _said_of(
    cameras: Sequence[CameraView], rows: np.ndarray, camera: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Scores in [0, 1] and classes of the detections that cameras have of boxes, each of shape (m,).

    Args:
        cameras: With their detections.
        rows: Which detection of a camera belongs to a box, shape (c, n).
        camera: Of each pair, shape (m,).
        box: Likewise.
    """
    none = np.empty(0)
    scores = np.concatenate([none, *(np.reshape(each.scores, -1) for each in cameras)])
    kinds = np.concatenate([none, *(np.reshape(each.classes, -1) for each in cameras)]).astype(np.int64)
    counts = np.array([np.size(each.scores) for each in cameras], np.int64)
    at = (np.cumsum(counts) - counts)[camera] + rows[camera, box]
    return np.clip(scores[at], 0.0, 1.0), kinds[at]


def _make_surer(scores: np.ndarray, rows: np.ndarray, others: np.ndarray) -> None:
    """Makes of each score the probability that it or one of the others in its row is right."""
    doubt = 1.0 - np.clip(scores, 0.0, 1.0)
    np.multiply.at(doubt, rows, 1.0 - others)
    scores[rows] = 1.0 - doubt[rows]


def _class_evidence(classes: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Logarithms of the likelihood of each class, where a detector said one with a score, shape (n, 6)."""
    others = (1.0 - np.clip(scores, 0.0, 0.95)) / len(CLASSES)
    table = np.tile(np.log(others)[:, None], (1, len(CLASSES)))
    table[np.arange(len(classes)), classes] = np.log(1.0 - (len(CLASSES) - 1) * others)
    return table


def _fits(classes: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Whether boxes of clusters are as long as a whole object of these classes, shape (n,), bool."""
    least, most = (np.array([_WHOLE.get(k, (np.inf, 0.0))[end] for k in range(len(CLASSES))]) for end in (0, 1))
    length = boxes[:, 3:5].max(1, initial=0.0)
    return (length > least[classes]) & (length < most[classes])


def _covered(boxes: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Background boxes whose centre is in the box of a known object, shape (k,), bool."""
    covered = np.zeros(len(boxes), bool)
    known, other = boxes[~background], np.flatnonzero(background)
    if len(known) and len(other):
        dx, dy = (boxes[other, None, k] - known[None, :, k] for k in (0, 1))
        c, s = np.cos(known[:, 6]), np.sin(known[:, 6])
        inside = (np.abs(c * dx + s * dy) < 0.5 * known[:, 3]) & (np.abs(c * dy - s * dx) < 0.5 * known[:, 4])
        covered[other] = inside.any(1)
    return covered
