"""`warploom eval fusion`: what cameras and radars add to the LiDAR, on drives of which all is known.

A pipeline finds the objects in the sweeps once; then its detections are fused with no other sensor, with the cameras,
with the radars and with both, and each is compared with the truth.
"""

from __future__ import annotations

import json
import pathlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ...errors import SourceError
from ...models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from ...models.detections import Detections
from ...models.fusion import FusedObjects, Fusion
from ..messages import SensorFrame
from ..pipeline import Pipeline
from .tracking_objects import drive_uris

__all__ = ["RANGES", "SENSOR_SETS", "FusionScore", "evaluate_fusion", "fusion_gains", "lines_of_gains"]

SENSOR_SETS = ((), ("cameras",), ("radars",), ("cameras", "radars"))
"""What joins the LiDAR."""
RANGES = ((0.0, 30.0), (30.0, 50.0), (50.0, 70.0), (70.0, 100.0))
"""Distances from the LiDAR for which recall is told [m]."""

_DETECTED = "perception/detected"
_COUNTED = (VEHICLE, PEDESTRIAN, CYCLIST)
_NEAR_ENOUGH = 3.0  # from the truth [m]
_BIRTH_FRAMES = 3
_MOVING = 2.0  # [m/s]

Frame = tuple[SensorFrame, Detections]


@dataclass(frozen=True, kw_only=True)
class FusionScore:
    """How well a set of sensors did."""

    sensors: tuple[str, ...]
    """Besides the LiDAR."""
    recall: tuple[float, ...]
    """For each of `RANGES`, of the road users on which there is a LiDAR point at all; NaN without any."""
    objects: tuple[int, ...]
    """How many these are, over all frames."""
    precision: float
    """Of known objects reported within the last range, how many are within 3 m of a true one."""
    existence_error: float
    """Mean square of the difference between the probability of existence and whether there is something (Brier)."""
    birth_velocity_error: float
    """Median length of the difference of velocities in the first three frames of an object that moves [m/s]."""
    velocity_error: float
    """In all frames [m/s]."""
    right_class: float
    """Of the true objects that were found, how many have their class."""
    id_switches: int
    """How often a true object goes on under another id."""

    def as_dict(self) -> dict[str, Any]:
        """As JSON has it."""
        values = {key: value if value == value else None for key, value in asdict(self).items()}
        ranges = [f"{low:g} to {high:g} m" for low, high in RANGES]
        values["recall"] = {name: r if r == r else None for name, r in zip(ranges, self.recall, strict=True)}
        values["objects"] = dict(zip(ranges, self.objects, strict=True))
        return values


def _found(truth: np.ndarray, objects: FusedObjects) -> np.ndarray:
    """The row of the object of each true one, −1 for none: nearest pairs first."""
    match = np.full(len(truth), -1)
    apart = np.linalg.norm(truth[:, None, :2] - objects.boxes[None, :, :2], axis=2)
    apart[:, objects.background] = np.inf
    while apart.size and apart.min() < _NEAR_ENOUGH:
        who, row = np.unravel_index(apart.argmin(), apart.shape)
        match[who] = row
        apart[who], apart[:, row] = np.inf, np.inf
    return match


class _Tally:
    """Adds up the frames of one set of sensors."""

    def __init__(self, sensors: tuple[str, ...]):
        self.sensors = sensors
        self.hit, self.total = np.zeros(len(RANGES), int), np.zeros(len(RANGES), int)
        self.reported = self.right = self.classed = self.found = self.switches = 0
        self.brier: list[float] = []
        self.errors: list[float] = []
        self.births: list[float] = []

    def add_drive(self, frames: Iterable[Frame]) -> None:
        """Fuses one drive, from its beginning."""
        fusion = Fusion()
        named: dict[int, int] = {}
        lived: dict[int, int] = {}
        for sensor, found in frames:
            cameras = sensor.cameras.cameras if "cameras" in self.sensors and sensor.cameras is not None else ()
            radars = sensor.radars.radars if "radars" in self.sensors and sensor.radars is not None else ()
            objects = fusion.update(
                sensor.version, found.boxes, found.scores, found.classes, background=found.background,
                velocities=found.velocities, pose=sensor.pose, cameras=cameras, radars=radars,
            )  # fmt: skip
            self._add(sensor, objects, named, lived)

    def _add(self, sensor: SensorFrame, objects: FusedObjects, named: dict[int, int], lived: dict[int, int]) -> None:
        truth = sensor.truth
        if truth is None:
            raise SourceError(f"frame {sensor.index} comes without truth, which an evaluation needs")
        known = np.isin(truth.classes, _COUNTED)
        boxes, ids, velocities = truth.boxes[known].astype(float), truth.ids[known], truth.velocities[known]
        away = np.linalg.norm(boxes[:, :2], axis=1)
        counts = truth.points[known] > 0
        match = _found(boxes, objects)
        edges = [low for low, _ in RANGES] + [RANGES[-1][1]]
        self.total += np.histogram(away[counts], edges)[0]
        self.hit += np.histogram(away[counts & (match >= 0)], edges)[0]
        reach = ~objects.background & (np.linalg.norm(objects.boxes[:, :2], axis=1) < RANGES[-1][1])
        true = np.zeros(len(objects), bool)
        true[match[match >= 0]] = True
        self.reported += int(reach.sum())
        self.right += int((reach & true).sum())
        self.brier += ((objects.existence - true)[reach] ** 2).tolist()
        for number in objects.ids.tolist():
            lived[number] = lived.get(number, 0) + 1
        for who in np.flatnonzero(match >= 0):
            row, its = match[who], int(ids[who])
            number = int(objects.ids[row])
            self.switches += named.get(its, number) != number
            named[its] = number
            self.found += 1
            self.classed += int(objects.classes[row] == truth.classes[known][who])
            error = float(np.linalg.norm(objects.velocities[row] - velocities[who]))
            self.errors.append(error)
            if lived[number] <= _BIRTH_FRAMES and np.linalg.norm(velocities[who]) >= _MOVING:
                self.births.append(error)

    def score(self) -> FusionScore:
        """What came of all drives."""
        with np.errstate(invalid="ignore"):
            recall = self.hit / self.total
        return FusionScore(
            sensors=self.sensors,
            recall=tuple(recall.tolist()),
            objects=tuple(self.total.tolist()),
            precision=self.right / max(self.reported, 1),
            existence_error=_mean(self.brier),
            birth_velocity_error=_median(self.births),
            velocity_error=_median(self.errors),
            right_class=self.classed / max(self.found, 1),
            id_switches=self.switches,
        )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else float("nan")


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else float("nan")


def fusion_gains(drives: Iterable[Iterable[Frame]]) -> list[FusionScore]:
    """The scores of each of `SENSOR_SETS` on the same drives.

    Args:
        drives: Of each drive the sweeps with their truth, cameras and radars, and what was found in them.

    Raises:
        SourceError: A frame has no truth.
    """
    tallies = [_Tally(sensors) for sensors in SENSOR_SETS]
    for drive in drives:
        frames = list(drive)
        for tally in tallies:
            tally.add_drive(frames)
    return [tally.score() for tally in tallies]


def evaluate_fusion(
    uri: str, out: pathlib.Path, *, profile: str = "cpu", settings: Iterable[str] = ()
) -> list[FusionScore]:
    """Runs a profile's pipeline over drives of the simulator, fuses, writes `summary.json` and gives the scores.

    Args:
        uri: Such as `sim:street?seeds=1-4&duration=6`.
        out: Folder for what is written.
        profile: A hardware profile; its modules must give `perception/detected`.
        settings: Changes to it, as texts `key=value`.

    Raises:
        SourceError: The source cannot be read, or knows no truth.
        ConfigError: Profile or settings are bad.
    """
    from ..sources.opening import open_source

    with Pipeline.from_profile(profile, settings=settings) as pipeline:

        def run(each: str) -> Iterator[Frame]:
            for frame in pipeline.run(open_source(each), topics=[_DETECTED]):
                if not frame.failed:
                    yield frame.sensor, frame.data[_DETECTED].detections

        scores = fusion_gains(map(run, drive_uris(uri)))
    out.mkdir(parents=True, exist_ok=True)
    summary = {"data": uri, "scores": [score.as_dict() for score in scores]}
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    return scores


def lines_of_gains(scores: Sequence[FusionScore]) -> list[str]:
    """A table for people."""
    ranges = " ".join(f"{f'{low:g}-{high:g} m':>8}" for low, high in RANGES)
    lines = [f"{'LiDAR and':17} {ranges} {'precision':>9} {'Brier':>6} {'v birth':>8} {'v':>6} {'class':>6} {'IDS':>5}"]
    for each in scores:
        recall = " ".join(f"{100 * value:8.1f}" for value in each.recall)
        lines.append(
            f"{' + '.join(each.sensors) or 'nothing else':17} {recall} {100 * each.precision:9.1f} "
            f"{each.existence_error:6.3f} {each.birth_velocity_error:8.2f} {each.velocity_error:6.2f} "
            f"{100 * each.right_class:6.1f} {each.id_switches:5d}"
        )
    lines.append("recall of road users by distance [%] · v: median error of the velocity [m/s], at birth of what moves")
    return lines
