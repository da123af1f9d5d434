"""Tracking by detection: a Kalman filter for every track, all of them in one batch, and optimal association.

A frame is a few launches of compiled code (`kernels.track_step`), whose tables hold all tracks; here are their memory,
the ego's motion, and what goes in and out.

Tracks live in the world's frame where the ego pose is known, so that what stands still has no velocity, however the
vehicle moves; else in the sensor's, and then velocities are relative to it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from ..kernels.track_step import TrackStep
from ..kernels.track_table import COUNTS, PARAMETERS
from .geometry import invert, rotation_vector, transform_boxes, turned
from .track_config import ClassConfig, Parameters, TrackerConfig

__all__ = ["ClassConfig", "Tracker", "TrackerConfig", "Tracks"]

_USUAL_PERIOD = 0.1  # [s]
_SMALLEST_PLAN = 64
_MANY = 256  # detections from which on they are looked up in their order along x
_KIND, _MOVES = 1, 2
_NO_POSE = np.eye(4)[:3].ravel()
_DROPPED = COUNTS[3:7]
_TURN_VARIANCE = PARAMETERS.index("turn_variance")


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """The k tracks of one frame, oldest first, in the frame of the detections."""

    ids: np.ndarray
    """Never given to another object in the life of the tracker, shape (k,), int64."""
    boxes: np.ndarray
    """Filtered x y z l w h yaw [m, rad], shape (k, 7), float64."""
    velocities: np.ndarray
    """Along the frame's x and y [m/s]: over ground where the pose was given, else relative; shape (k, 2), float64."""
    turn_rates: np.ndarray
    """Of the heading [rad/s], 0 where the motion has none; shape (k,), float64."""
    scores: np.ndarray
    """Mean of the detections' scores, the latest weighing most; lower while coasting; shape (k,), float64."""
    classes: np.ndarray
    """The class most of the evidence speaks for, shape (k,), int32."""
    background: np.ndarray
    """True for tracks of background boxes, shape (k,), bool."""
    age: np.ndarray
    """Frames since birth, 1 at birth, shape (k,), int32."""
    hits: np.ndarray
    """Frames with a detection, shape (k,), int32."""
    coasted: np.ndarray
    """True where this frame had no detection: the box is a prediction; shape (k,), bool."""
    covariances: np.ndarray
    """Of x, y and the velocity along x and y, along the frame's axes, shape (k, 4, 4), float64."""
    detections: np.ndarray
    """Row of the detection that each took up, −1 while coasting; shape (k,), int64."""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def position_std(self) -> np.ndarray:
        """Standard deviation of the centre on the ground, its mean over the directions [m], shape (k,)."""
        return np.sqrt(0.5 * (self.covariances[:, 0, 0] + self.covariances[:, 1, 1]))

    @property
    def velocity_std(self) -> np.ndarray:
        """Likewise of the velocity [m/s]."""
        return np.sqrt(0.5 * (self.covariances[:, 2, 2] + self.covariances[:, 3, 3]))


class Tracker:
    """Keeps the objects of a stream of detections apart and together.

    One frame after the other goes through `update`; the same frames give the same tracks, to the byte. What is out of
    the ordinary is counted: in `dropped` the detections that cannot be used, by reason (`not finite`, `size not
    positive`, `low score`, `over capacity`); in `incidents` frames, by what came to pass (`gap`: too long after the
    last one for any track to live on; `pose missing`; `cut short`: so many objects in one place that some were assigned
    one after the other, not at the least cost of all).
    """

    def __init__(self, config: TrackerConfig | None = None, *, device: str = "cpu"):
        """Starts without tracks.

        Args:
            config: How objects move and are associated, class by class.
            device: The Warp device that the tracks live on.
        """
        self.config = config or TrackerConfig()
        self.device = device
        self.dropped: Counter[str] = Counter()
        self.incidents: Counter[str] = Counter()
        self._kinds = len(self.config.classes)  # the background's kind comes after those of the classes
        self._in_world = Parameters(self.config, relative=False)
        self._relative = Parameters(self.config, relative=True)
        self._next_id = 1
        self._count = 0
        self._step = self._plan(_SMALLEST_PLAN, _SMALLEST_PLAN)
        self.clear()

    def clear(self) -> None:
        """Forgets all tracks and the time, for a new recording; ids go on."""
        self._count = 0
        self._version: int | None = None
        self._pose: np.ndarray | None = None
        self._motion: tuple[np.ndarray, np.ndarray, float] | None = None  # the last two poses, seconds between them
        self._frames = 0

    def __len__(self) -> int:
        """Tracks alive, reported or not."""
        return self._count

    def update(
        self,
        version: int,
        boxes: np.ndarray,
        scores: np.ndarray,
        classes: np.ndarray,
        *,
        background: np.ndarray | None = None,
        velocities: np.ndarray | None = None,
        radial: np.ndarray | None = None,
        pose: np.ndarray | None = None,
    ) -> Tracks:
        """Takes up the detections of one frame.

        Args:
            version: The frame's time [ns], later than the last one's.
            boxes: x y z l w h yaw in the sensor's frame [m, rad], shape (n, 7).
            scores: Shape (n,).
            classes: Indices into `models.classes.CLASSES`, shape (n,).
            background: True for boxes from clusters; these make and continue background tracks only; shape (n,).
            velocities: Measured velocities along the sensor's x and y [m/s], over ground if a pose is given, else
                relative; NaN where unknown; shape (n, 2).
            radial: Measured speeds along one direction, as of a radar: the direction along the sensor's x and y, the
                speed along it (over ground or relative, as above), and its standard deviation [m/s]; NaN where unknown;
                shape (n, 4).
            pose: World from sensor, shape (4, 4); None where unknown. Without it in one frame after others with
                it, the last motion is taken to go on.

        Returns:
            The tracks that are confirmed, and seen now or a short time ago.

        Raises:
            ValueError: Time does not go forward, shapes do not fit, or a class does not exist.
        """
        version = int(version)
        if self._version is not None and version <= self._version:
            raise ValueError(
                f"version is {version} ns, not after the last frame's {self._version} ns: a tracker takes frames in "
                "the order of time; call clear() before a new recording"
            )
        boxes = np.asarray(boxes, np.float64)
        if boxes.size == 0:
            boxes = boxes.reshape(0, 7)
        n = len(boxes)
        if boxes.shape != (n, 7):
            raise ValueError(f"boxes has shape {boxes.shape}; expected (n, 7): x y z l w h yaw")
        scores, classes = _rows("scores", scores, n), _rows("classes", classes, n)
        if n and (classes.min() < 0 or classes.max() >= self._kinds):
            raise ValueError(f"classes holds {classes.min()} to {classes.max()}; expected 0 to {self._kinds - 1}")
        background = None if background is None else _rows("background", background, n)
        velocities = None if velocities is None else _rows("velocities", velocities, n, 2)
        radial = None if radial is None else _rows("radial", radial, n, 4)
        if pose is not None:
            pose = np.array(pose, np.float64)
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise ValueError(f"pose has shape {pose.shape}; expected a finite (4, 4) matrix, world from sensor")

        rows = None
        if n > self.config.max_detections:
            rows = self._best(boxes, scores, classes, background)
            boxes, scores, classes = boxes[rows], scores[rows], classes[rows]
            background, velocities, radial = (a if a is None else a[rows] for a in (background, velocities, radial))
            n = len(rows)
        seconds = 0.0 if self._version is None else (version - self._version) * 1e-9
        if seconds > self.config.longest_gap and self._count:
            self._count = 0
            self.incidents["gap"] += 1
        pose = self._move_to(pose, seconds)
        self._version = version
        self._frames += 1
        self._make_room(n)

        step = self._step
        given, whole = step.given, step.given_whole
        given[:n, :7], given[:n, 7] = boxes, scores
        given[:n, 8:10] = np.nan if velocities is None else velocities
        given[:n, 10:14] = np.nan if radial is None else radial
        whole[:n, 0], whole[:n, 1] = classes, 0 if background is None else background
        in_order = n > _MANY
        step.frame_real[:5] = (
            seconds,
            max(seconds / _USUAL_PERIOD, 1.0),
            self.config.coasted_score,
            self.config.class_memory,
            self.config.score_weight,
        )
        step.frame_real[6:] = _NO_POSE if pose is None else pose[:3].ravel()
        step.frame_whole[:] = (
            version, self._count, n, self._next_id, self._frames, in_order, self.config.max_tracks,
        )  # fmt: skip
        if in_order:
            with np.errstate(invalid="ignore", over="ignore"):  # of detections of no use
                along = boxes[:, :3] @ step.frame_real[6:9] + step.frame_real[9]
                step.frame_real[5] = np.nanmax(boxes[:, 3:6].prod(1), initial=0.0)
            step.order[:n] = np.argsort(along, kind="stable")
            step.send("order")
        step.send("given", "given_whole", "frame_real", "frame_whole")
        step.launch()
        step.fetch("counts")
        return self._report(rows)

    # What comes in

    def _best(
        self, boxes: np.ndarray, scores: np.ndarray, classes: np.ndarray, background: np.ndarray | None
    ) -> np.ndarray:
        """Of more detections than there is room for the rows of the best that can be used; the others are counted."""
        kinds = classes.astype(np.int64)
        if background is not None:
            kinds = np.where(background, self._kinds, kinds)
        finite = np.isfinite(boxes).all(1) & np.isfinite(scores)
        sized = (boxes[:, 3:6] > 0).all(1)
        strong = scores >= self._in_world.min_score[kinds]
        rows = np.flatnonzero(finite & sized & strong)
        over = max(len(rows) - self.config.max_detections, 0)
        if over:
            best = np.argsort(-scores[rows], kind="stable")[: self.config.max_detections]
            rows = np.sort(rows[best])
        self._count_dropped((~finite).sum(), (finite & ~sized).sum(), (finite & sized & ~strong).sum(), over)
        return rows

    def _count_dropped(self, *counts: int) -> None:
        self.dropped.update({reason: int(n) for reason, n in zip(_DROPPED, counts, strict=True) if n})

    def _move_to(self, pose: np.ndarray | None, seconds: float) -> np.ndarray | None:
        """The pose of this frame; where poses begin or fail, the tracks and the pose are made to fit."""
        if (pose is None) is not (self._pose is None) or not self._frames:
            self._use_parameters(pose is None and self._pose is None)
        if pose is not None:
            if self._pose is None:
                if self._count:
                    self._into_world(pose, seconds)
            elif seconds > 0.0:
                self._motion = (self._pose, pose, seconds)
        elif self._pose is not None:
            self.incidents["pose missing"] += 1
            pose = self._pose
            if self._motion is not None:
                before, after, over = self._motion
                pose = pose @ _motion_to(_motion_of(invert(before) @ after) * (seconds / over))
        self._pose = pose
        return pose

    def _into_world(self, pose: np.ndarray, seconds: float) -> None:
        """Tracks so far in the sensor's frame are carried over as they stand, their velocities unknown again."""
        real, whole = self._step.table()
        real, whole = real[: self._count], whole[: self._count]
        placed = real[:, :7].copy()
        placed[:, :2] += seconds * real[:, 7:9]
        placed = transform_boxes(placed, pose)
        speeds = self._in_world.initial_speed_variance[whole[:, _KIND]]
        turning = whole[:, _MOVES] > 0
        rates = self._in_world.table[whole[:, _KIND], _TURN_VARIANCE]
        real[:, :7], real[:, 7:10] = placed, 0.0
        for first in (19, 49):
            real[:, first : first + 3] = placed[:, [0, 1, 6]]
            real[:, first + 3 : first + 5] = 0.0
            covariance = real[:, first + 5 : first + 30].reshape(-1, 5, 5)
            covariance[:, 3:, :] = covariance[:, :, 3:] = 0.0
            covariance[:, 3, 3] = speeds
            covariance[:, 4, 4] = np.where(turning, rates, speeds)
            real[:, first + 5 : first + 30] = covariance.reshape(-1, 25)
        self._step.set_table(real, whole)

    # Memory

    def _plan(self, tracks: int, detections: int) -> TrackStep:
        return TrackStep(tracks=tracks, detections=detections, kinds=self._kinds + 1, device=self.device)

    def _use_parameters(self, relative: bool) -> None:
        self._step.parameters[:] = (self._relative if relative else self._in_world).table
        self._step.send("parameters")

    def _make_room(self, detections: int) -> None:
        """A larger plan where there may be more tracks or detections than fit."""
        tracks = min(self._count + detections, max(self.config.max_tracks, self._count))
        step = self._step
        if tracks <= step.tracks and detections <= step.detections:
            return
        larger = self._plan(_room(tracks, step.tracks), _room(detections, step.detections))
        larger.parameters[:] = step.parameters
        larger.counts[:] = step.counts
        larger.send("parameters", "counts")
        larger.set_table(*(rows[: self._count] for rows in step.table()))
        self._step = larger

    # What goes out

    def _report(self, rows: np.ndarray | None) -> Tracks:
        """The confirmed tracks, in the sensor's frame."""
        step = self._step
        self._count, shown, born, *dropped, cut_short = step.counts.tolist()
        self._next_id += born
        if cut_short or any(dropped):
            self._count_dropped(*dropped)
            step.counts[:] = 0
            step.send("counts")
        if cut_short:
            self.incidents["cut short"] += 1
        step.fetch("report", "report_whole")
        real, whole = step.report[:shown].copy(), step.report_whole[:shown].copy()
        detections = whole[:, 6]
        if rows is not None:
            detections = np.append(rows, -1)[detections]
        return Tracks(
            ids=whole[:, 0],
            boxes=real[:, :7],
            velocities=real[:, 7:9],
            turn_rates=real[:, 9],
            scores=real[:, 10],
            classes=whole[:, 1].astype(np.int32),
            background=whole[:, 2].astype(bool),
            age=whole[:, 3].astype(np.int32),
            hits=whole[:, 4].astype(np.int32),
            coasted=whole[:, 5].astype(bool),
            covariances=real[:, 11:].reshape(-1, 4, 4),
            detections=detections,
        )


def _rows(name: str, array: np.ndarray, n: int, columns: int = 0) -> np.ndarray:
    """An argument with an entry for each box, or a row."""
    array = np.asarray(array)
    if columns:
        array = np.asarray(array, np.float64).reshape(-1, columns)
        if len(array) != n:
            raise ValueError(f"{name} has {len(array)} rows for {n} boxes")
        return array
    if array.ndim != 1:
        array = array.reshape(-1)
    if len(array) != n:
        raise ValueError(f"{name} has {len(array)} entries for {n} boxes")
    return array


def _room(needed: int, now: int) -> int:
    """Rows for as many as are needed and more, or as many as there are."""
    return now if needed <= now else 1 << (needed - 1).bit_length()


def _motion_of(step: np.ndarray) -> np.ndarray:
    """A small rigid motion as translation and rotation vector, shape (6,)."""
    return np.concatenate([step[:3, 3], rotation_vector(step[:3, :3])])


def _motion_to(motion: np.ndarray) -> np.ndarray:
    """The rigid motion of a translation and a rotation vector, shape (4, 4)."""
    step = np.eye(4)
    step[:3, :3] = turned(motion[3:])
    step[:3, 3] = motion[:3]
    return step
