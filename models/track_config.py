"""What a tracker can be told, class by class."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from .classes import BARRIER, CLASSES, CONE, CYCLIST, PEDESTRIAN, UNKNOWN, VEHICLE

__all__ = ["ClassConfig", "Parameters", "TrackerConfig"]


@dataclass(frozen=True, kw_only=True)
class ClassConfig:
    """How the objects of one class move, how well they are measured, and when their tracks begin and end."""

    min_score: float = 0.1
    """Detections below are dropped."""
    high_score: float = 0.3
    """Detections from here on choose their tracks first; the others take what is left."""
    birth_score: float = 0.3
    """Detections from here on begin a track, if none takes them up."""
    birth_hits: int = 2
    """Detections until a track is confirmed and reported; in the first frame one is enough."""
    tentative: float = 0.15
    """A track not yet confirmed ends when it is not seen for longer than this [s]."""
    coast: float = 1.2
    """A confirmed one ends when it is not seen for longer than this [s]."""
    report: float = 0.15
    """It is reported, as coasted, until it was not seen for longer than this [s]."""
    gate: float = 3.0
    """The largest distance of a detection from its track, in standard deviations."""
    association_std: float = 0.45
    """Of a detection's centre about its track's along each axis, besides the track's own uncertainty [m]; larger than
    `position_std`, for detections that are off are off by more than the filter's Gaussian."""
    association_limit: float = 1.0
    """The most that the track's own uncertainty counts for in association [m], so that one that has long coasted does
    not reach out for the detections of others; in proportion more where frames are further apart than 0.1 s."""
    group: str = ""
    """Classes of the same group can continue each other's tracks; empty: the class by itself."""
    position_std: float = 0.1
    """Of a measured centre, along each axis [m]."""
    size_std: float = 0.3
    """Of a measured length, width, height [m]."""
    yaw_std: float = 0.2
    """Of a measured heading [rad]."""
    velocity_std: float = 1.0
    """Of a measured velocity, where detections bring one [m/s]."""
    speed_std: float = 10.0
    """Of the velocity of an object seen for the first time, along each axis of the ground [m/s]; 0: it never moves."""
    acceleration_std: float = 5.0
    """By how much a velocity changes within a second, along each axis of the ground [m/s]."""
    vertical_std: float = 0.3
    """By how much a height changes within a second [m]."""
    size_drift: float = 0.2
    """By how much a size changes within a second [m]."""
    yaw_drift: float = 0.8
    """By how much a heading changes within a second [rad]."""


def _class_defaults() -> dict[int, ClassConfig]:
    still = ClassConfig(speed_std=0.0, acceleration_std=0.0, yaw_drift=0.1, vertical_std=0.1)
    return {
        VEHICLE: ClassConfig(),
        PEDESTRIAN: ClassConfig(
            group="road users",
            position_std=0.2,
            size_std=0.2,
            yaw_std=0.6,
            speed_std=1.5,
            acceleration_std=1.5,
            yaw_drift=1.5,
        ),
        CYCLIST: ClassConfig(
            group="road users", position_std=0.25, size_std=0.2, speed_std=5.0, acceleration_std=2.0, yaw_drift=0.8
        ),
        CONE: still,
        BARRIER: still,
        UNKNOWN: ClassConfig(speed_std=3.0, acceleration_std=2.0),
    }


@dataclass(frozen=True, kw_only=True)
class TrackerConfig:
    """The configuration of a `Tracker`."""

    classes: tuple[ClassConfig, ...] = field(default_factory=lambda: tuple(_class_defaults().values()))
    """One for each of `models.classes.CLASSES`, in their order."""
    background: ClassConfig = ClassConfig(
        min_score=0.0,
        high_score=0.0,
        birth_score=0.0,
        birth_hits=2,
        coast=0.5,
        report=0.15,
        speed_std=0.0,
        acceleration_std=0.0,
        size_std=0.5,
        size_drift=1.0,
        yaw_drift=0.5,
        position_std=0.4,
    )
    """For background boxes, of whatever class: they stand still unless `speed_std` says otherwise."""
    relative_speed_std: float = 15.0
    """Of the velocity of an object seen for the first time while the ego pose is unknown [m/s]."""
    relative_acceleration_std: float = 4.0
    """The least `acceleration_std` while the ego pose is unknown: the vehicle adds its own [m/s]."""
    size_weight: float = 4.0
    """How much a difference in size counts beside distance: for a factor e, this many squared standard deviations."""
    longest_gap: float = 2.0
    """No track outlives a longer gap between frames [s]."""
    score_weight: float = 0.5
    """Least weight of the newest score in a track's mean."""
    coasted_score: float = 0.9
    """Factor on the score of a track that is coasting."""
    class_memory: float = 0.95
    """Factor on the evidence of earlier frames for a class, with every detection."""
    max_detections: int = 5000
    """More in one frame are dropped, those of lowest score."""
    max_tracks: int = 10000
    """No track is begun beyond."""

    def __post_init__(self):
        if len(self.classes) != len(CLASSES):
            raise ValueError(f"classes has {len(self.classes)} entries; expected one for each of {', '.join(CLASSES)}")

    def of(self, kind: int) -> ClassConfig:
        """The configuration of a class, or of the background for the number after the last class."""
        return self.background if kind == len(self.classes) else self.classes[kind]


class Parameters:
    """The configuration as arrays with a row for each kind: the classes, then the background.

    Those of seven columns are for x y z l w h yaw.
    """

    def __init__(self, config: TrackerConfig, *, relative: bool):
        kinds = [config.of(kind) for kind in range(len(config.classes) + 1)]

        def each(name: str) -> np.ndarray:
            return np.array([getattr(kind, name) for kind in kinds], np.float64)

        def nanoseconds(name: str) -> np.ndarray:
            return np.rint(each(name) * 1e9).astype(np.int64)

        def axes(ground, vertical, size, yaw) -> np.ndarray:
            columns = (ground, ground, vertical, size, size, size, yaw)
            return np.stack([np.broadcast_to(np.asarray(c, np.float64), len(kinds)) for c in columns], axis=1) ** 2

        speed, acceleration = each("speed_std"), each("acceleration_std")
        if relative:
            speed = np.maximum(speed, config.relative_speed_std)
            acceleration = np.maximum(acceleration, config.relative_acceleration_std)
        self.min_score, self.high_score, self.birth_score = each("min_score"), each("high_score"), each("birth_score")
        self.birth_hits = each("birth_hits").astype(np.int64)
        self.tentative, self.coast, self.report = nanoseconds("tentative"), nanoseconds("coast"), nanoseconds("report")
        self.gate = each("gate")
        self.association_limit = np.repeat(each("association_limit")[:, None] ** 2, 3, axis=1)
        self.association_noise = np.repeat(each("association_std")[:, None] ** 2, 3, axis=1)
        names = [kind.group or f"class {number}" for number, kind in enumerate(kinds)]
        names[-1] = "background"
        self.group = np.array([names.index(name) for name in names])
        self.noise = axes(each("position_std"), each("position_std"), each("size_std"), each("yaw_std"))
        self.drift = axes(0.0, each("vertical_std"), each("size_drift"), each("yaw_drift"))
        self.acceleration = axes(acceleration, 0.0, 0.0, 0.0)
        self.initial_pvv = axes(speed, 0.0, 0.0, 0.0)
        self.velocity_noise = each("velocity_std") ** 2
