"""The first look at a sweep: leaves out what is no point or on the vehicle itself, and adds where the sensor was."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import Field, model_validator

from ...dag import DataProcessComponent, ProcessorConfig, Trigger
from ...datamesh import CommitPolicy, DataMesh, Input, Output, Status
from ...datamesh.messages.nav import Odometry
from ..execution import ExecutionContext
from ..messages import SensorFrame
from .ego_poses import odometry_matrix, pose_at_reference, poses_about
from .transforms import mounting_matrix

__all__ = ["LidarPreprocess", "LidarPreprocessConfig", "usable_points"]

_ODOMETRY_HISTORY = 64  # messages: 0.6 s at 100 Hz

Bounds = tuple[float, float, float, float, float, float]


class LidarPreprocessConfig(ProcessorConfig):
    """What is left out, in the sensor's frame."""

    ego_box: Bounds | None = None
    """xmin ymin zmin xmax ymax zmax of the vehicle [m], whose points are left out; null where it is not seen."""
    min_range: float = Field(0.0, ge=0.0)
    """Returns nearer than that are left out, such as those of the sensor's own housing [m]."""
    sensor: str | None = None
    """Name of the sensor in the profile, whose mounting takes the vehicle's poses of the odometry to the sensor's own;
    null: they are the sensor's."""

    @model_validator(mode="after")
    def _in_order(self) -> LidarPreprocessConfig:
        box = self.ego_box
        if box is not None and not all(box[axis] < box[axis + 3] for axis in range(3)):
            raise ValueError(f"ego_box must be xmin ymin zmin xmax ymax zmax, each min below its max, not {box}")
        return self


def usable_points(points: np.ndarray, config: LidarPreprocessConfig) -> tuple[np.ndarray, dict[str, int]]:
    """Which points of a sweep can be used.

    Args:
        points: x y z [m] and more, in the sensor's frame, shape (n, 3 or more).
        config: What is left out.

    Returns:
        True where a point stays, shape (n,), bool; and how many were left out, by reason; a point has one reason, the
        first of non_finite, near, ego.
    """
    xyz = points[:, :3]
    finite = np.isfinite(xyz).all(axis=1)
    dropped = {"non_finite": len(points) - int(finite.sum()), "near": 0, "ego": 0}
    kept = finite
    with np.errstate(invalid="ignore", over="ignore"):
        if config.min_range > 0.0:
            far = np.einsum("ij,ij->i", xyz, xyz) >= config.min_range**2
            dropped["near"] = int((kept & ~far).sum())
            kept = kept & far
        if config.ego_box is not None:
            low, high = config.ego_box[:3], config.ego_box[3:]
            inside = np.ones(len(points), bool)
            for axis in range(3):
                inside &= (xyz[:, axis] >= low[axis]) & (xyz[:, axis] < high[axis])
            dropped["ego"] = int((kept & inside).sum())
            kept = kept & ~inside
    return kept, dropped


def _selected(frame: SensorFrame, kept: np.ndarray) -> SensorFrame:
    """The frame with some of its points, and what belongs to them."""
    truth = frame.truth
    if truth is not None:
        ground = None if truth.ground is None else truth.ground[kept]
        scored = None if truth.ground_scored is None else truth.ground_scored[kept]
        truth = replace(truth, ground=ground, ground_scored=scored)
    return replace(
        frame,
        points=frame.points[kept],
        ring=None if frame.ring is None else frame.ring[kept],
        t=None if frame.t is None else frame.t[kept],
        truth=truth,
    )


class LidarPreprocess(DataProcessComponent):
    """Gives each sweep on without the points that cannot be used; a sweep without such points is not copied.

    Where odometry is connected, a sweep whose points have times and whose source knew no poses gets those of the
    odometry, so that perception can undo the sensor's own motion. It does not wait for them: where odometry ends
    before the sweep, the vehicle is taken to go on as it did.
    """

    Config = LidarPreprocessConfig
    context: ExecutionContext | None

    raw: Input[SensorFrame]
    odometry: Input[Odometry] = Input(optional=True)
    points: Output[SensorFrame]

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = LidarPreprocessConfig()
        self._dropped: Counter[str] = Counter()
        self._sweeps = self._without_poses = 0
        self._mounting = np.eye(4)

    def bind(self, mesh: DataMesh, topics: Mapping[str, str]) -> None:
        """Binds the handles; odometry's window is to reach back to the beginning of a sweep."""
        mesh.window(topics["odometry"], _ODOMETRY_HISTORY)
        super().bind(mesh, topics)

    def init(self, config: LidarPreprocessConfig) -> None:
        """Keeps what is left out, and where the sensor is.

        Raises:
            ValueError: The profile has no such sensor, or does not say where it is.
        """
        self._config = config
        if config.sensor is not None:
            at = getattr((self.context or ExecutionContext()).sensors.get(config.sensor), "mounting", None)
            if at is None:
                raise ValueError(f"sensor {config.sensor!r} has no mounting in the profile")
            self._mounting = mounting_matrix(at.xyz, at.rpy_deg)

    def process(self, trigger: Trigger) -> Status:
        """Filters one sweep."""
        with self.raw.access() as snapshot:
            index = snapshot.version_index(trigger.version)
            if index < 0:
                return Status.MISS
            frame = snapshot[index]
        kept, dropped = usable_points(frame.points, self._config)
        self._dropped.update(dropped)
        self._sweeps += 1
        if any(dropped.values()):
            frame = _selected(frame, kept)
        if frame.poses is None and frame.t is not None and frame.t.any():
            frame = self._with_poses(frame)
        with self.points.allocate_change() as change:
            change.set_version(trigger.version, trigger.received_ns, epoch=trigger.epoch)
            change.value = frame
            return self.points.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def _with_poses(self, frame: SensorFrame) -> SensorFrame:
        """The frame with the poses that odometry knows about the time of its sweep."""
        assert frame.t is not None
        with self.odometry.access() as snapshot:
            times = [(version - frame.version) / 1e9 for version in snapshot.versions]
            known = [odometry_matrix(one) @ self._mounting for one in snapshot]
        found = poses_about(times, known, min(float(frame.t.min()), 0.0), max(float(frame.t.max()), 0.0))
        if found is None:
            if len(times):  # else none is connected, and who needs the poses says so
                self._without_poses += 1
                self.losses.count(self.name, "no_odometry", frame.version)
            return frame
        at, poses = found
        pose = pose_at_reference(at, poses) if frame.pose is None else frame.pose
        return replace(frame, pose=pose, poses=poses, pose_times=at)

    def state(self) -> Mapping[str, str | float | int]:
        """Sweeps so far, those that odometry knew no poses for, and points left out by reason."""
        bare = {"sweeps without poses": self._without_poses} if self._without_poses else {}
        return {
            "sweeps": self._sweeps,
            **bare,
            **{f"points {reason}": count for reason, count in self._dropped.items()},
        }
