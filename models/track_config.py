"""What a tracker can be told, class by class."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from ..kernels.track_table import COSTS, MOTIONS, PARAMETERS
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
    motion: str = "cv"
    """How they move: `cv`, constant velocity along the axes of the ground; `ctrv`, constant speed and turn rate along
    the heading; `imm`, the likelier of going straight on and of turning, both along the heading."""
    cost: str = "mahalanobis"
    """What associates: `mahalanobis`, the distance of the centres in standard deviations, and the sizes' difference;
    `giou`, the generalised overlap in space; `distance`, that of the centres on the ground."""
    gate: float = 3.0
    """For `mahalanobis`: the largest distance of a detection from its track, in standard deviations."""
    gate_giou: float = -0.4
    """For `giou`: the least generalised overlap, above −1."""
    gate_distance: float = 2.5
    """For `distance`: the largest [m], where frames are 0.1 s apart; in proportion more where
    they are further apart."""
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
    """By how much a velocity changes within a second, along each axis of the ground or along the heading [m/s]."""
    slip_std: float = 0.0
    """By how much a place changes within a second by itself, along each axis of the ground [m]."""
    turn_rate_std: float = 0.3
    """Of the turn rate of an object seen for the first time, where the motion has one [rad/s]."""
    turn_acceleration_std: float = 0.5
    """By how much a turn rate changes within a second [rad/s]."""
    switch_rate: float = 0.5
    """For `imm`: how often an object goes over from going straight to turning, or back [1/s]."""
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

        for number in range(len(self.classes) + 1):
            _check(self.of(number), CLASSES[number] if number < len(CLASSES) else "background")

    def of(self, kind: int) -> ClassConfig:
        """The configuration of a class, or of the background for the number after the last class."""
        return self.background if kind == len(self.classes) else self.classes[kind]


def _check(kind: ClassConfig, name: str) -> None:
    for field_name, known in (("motion", MOTIONS), ("cost", COSTS)):
        if getattr(kind, field_name) not in known:
            raise ValueError(
                f"{name}: {field_name} must be one of {', '.join(known)}, not {getattr(kind, field_name)!r}"
            )
    for field_name in ("gate", "gate_distance", "position_std", "size_std", "yaw_std", "velocity_std"):
        if not getattr(kind, field_name) > 0.0:
            raise ValueError(f"{name}: {field_name} must be above 0, not {getattr(kind, field_name)}")
    if not -1.0 < kind.gate_giou < 1.0:
        raise ValueError(f"{name}: gate_giou must be above −1 and below 1, not {kind.gate_giou}")


class Parameters:
    """The configuration as a table with a row for each kind, the classes, then the background.

    Attributes:
        table: Columns as `kernels.track_table.PARAMETERS`, shape (kinds, 28), float64.
        min_score: Least score of each kind, shape (kinds,).
        initial_speed_variance: Of each kind [m²/s²], shape (kinds,).
    """

    def __init__(self, config: TrackerConfig, *, relative: bool):
        kinds = [config.of(kind) for kind in range(len(config.classes) + 1)]

        def each(name: str) -> np.ndarray:
            return np.array([getattr(kind, name) for kind in kinds], np.float64)

        def index(name: str, known: tuple[str, ...]) -> np.ndarray:
            return np.array([known.index(getattr(kind, name)) for kind in kinds], np.float64)

        speed, acceleration = each("speed_std"), each("acceleration_std")
        if relative:
            speed = np.maximum(speed, config.relative_speed_std)
            acceleration = np.maximum(acceleration, config.relative_acceleration_std)
        cost = index("cost", COSTS).astype(int)
        names = [kind.group or f"class {number}" for number, kind in enumerate(kinds)]
        names[-1] = "background"
        columns = {
            "min_score": each("min_score"),
            "high_score": each("high_score"),
            "birth_score": each("birth_score"),
            "birth_hits": each("birth_hits"),
            "tentative": np.rint(each("tentative") * 1e9),
            "coast": np.rint(each("coast") * 1e9),
            "report": np.rint(each("report") * 1e9),
            "group": np.array([names.index(name) for name in names]),
            "motion": index("motion", MOTIONS),
            "cost": cost,
            "limit": np.choose(cost, [each("gate"), each("gate_giou"), each("gate_distance")]),
            "association_variance": each("association_std") ** 2,
            "association_limit": each("association_limit") ** 2,
            "size_weight": np.full(len(kinds), config.size_weight),
            "position_variance": each("position_std") ** 2,
            "size_variance": each("size_std") ** 2,
            "yaw_variance": each("yaw_std") ** 2,
            "velocity_variance": each("velocity_std") ** 2,
            "speed_variance": speed**2,
            "acceleration": acceleration**2,
            "slip": each("slip_std") ** 2,
            "vertical_drift": each("vertical_std") ** 2,
            "size_drift": each("size_drift") ** 2,
            "yaw_drift": each("yaw_drift") ** 2,
            "turn_variance": each("turn_rate_std") ** 2,
            "turn_acceleration": each("turn_acceleration_std") ** 2,
            "switch_rate": each("switch_rate"),
            "is_background": np.arange(len(kinds)) == len(kinds) - 1,
        }
        self.table = np.stack([columns[name] for name in PARAMETERS], axis=1).astype(np.float64)
        self.min_score = each("min_score")
        self.initial_speed_variance = speed**2
