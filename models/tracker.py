"""Tracking by detection: a Kalman filter for every track, all of them in one batch, and Hungarian association.

The motion model is constant velocity. Noise is taken as independent along the world's axes, so the filter of a
track falls apart into seven filters of one axis each (x y z l w h yaw) with position and velocity, and a frame is
a dozen operations on arrays over all tracks instead of a loop over 10 × 10 matrices: the result is the same.

Tracks live in the world's frame where the ego pose is known, so that what stands still has no velocity, however the
vehicle moves; else in the sensor's, and then velocities are relative to it.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .association import assign, assign_sparse
from .geometry import invert, transform_boxes, wrap_angle
from .track_config import ClassConfig, Parameters, TrackerConfig

__all__ = ["ClassConfig", "Tracker", "TrackerConfig", "Tracks"]

# Columns of the table of tracks: seven each of state, rate, and their covariance; x y z l w h yaw within each.
_X, _V, _PXX, _PXV, _PVV = (slice(i, i + 7) for i in range(0, 35, 7))
_SCORE, _VOTES, _EVIDENCE = 35, 36, 37  # the evidence: a column a class, from here on
_YAW = 6
# Columns of the table of what is whole: ns, and counts of frames.
_ID, _KIND, _BORN, _SEEN, _HITS, _AGE, _CONFIRMED, _MATCHED = range(8)

_MOST_VOTES = 5.0  # for a heading: so many detections the other way turn it round
_USUAL_PERIOD = 0.1  # [s]
_DENSE_PAIRS = 40_000  # up to here every pair is looked at; beyond, neighbours only
_NEIGHBOURS = 12


@dataclass(frozen=True, eq=False, kw_only=True)
class Tracks:
    """The k tracks of one frame, oldest first, in the frame of the detections."""

    ids: np.ndarray
    """Never given to another object in the life of the tracker, shape (k,), int64."""
    boxes: np.ndarray
    """Filtered x y z l w h yaw [m, rad], shape (k, 7), float64."""
    velocities: np.ndarray
    """Along the frame's x and y [m/s]: over ground where the pose was given, else relative; shape (k, 2), float64."""
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
    position_std: np.ndarray
    """Standard deviation of the centre along each axis of the ground [m], shape (k,), float64."""
    velocity_std: np.ndarray
    """Of the velocity [m/s], shape (k,), float64."""
    detections: np.ndarray
    """Row of the detection that each took up, −1 while coasting; shape (k,), int64."""

    def __len__(self) -> int:
        return len(self.ids)


class Tracker:
    """Keeps the objects of a stream of detections apart and together.

    One frame after the other goes through `update`; the same frames give the same tracks, to the byte. Detections
    that cannot be used are dropped and counted in `dropped` by reason: `not finite`, `size not positive`,
    `low score`, `over capacity`.
    """

    def __init__(self, config: TrackerConfig | None = None):
        self.config = config or TrackerConfig()
        self.dropped: Counter[str] = Counter()
        self._kinds = len(self.config.classes)  # the background's kind comes after those of the classes
        self._in_world = Parameters(self.config, relative=False)
        self._relative = Parameters(self.config, relative=True)
        self._next_id = 1
        self.clear()

    def clear(self) -> None:
        """Forgets all tracks and the time, for a new recording; ids go on."""
        self._f = np.empty((0, _EVIDENCE + self._kinds))
        self._i = np.empty((0, 8), np.int64)
        self._version: int | None = None
        self._pose: np.ndarray | None = None
        self._step = (np.eye(4), 1.0)  # the ego's last motion and the seconds it took
        self._frames = 0
        self._seconds = 0.0  # between this frame and the last

    def __len__(self) -> int:
        """Tracks alive, reported or not."""
        return len(self._i)

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
        z = self._measurements(boxes, scores, classes, background, velocities)
        seconds = 0.0 if self._version is None else (version - self._version) * 1e-9
        pose = self._move_to(pose, seconds)
        self._version = version
        self._frames += 1

        self._seconds = seconds
        self._predict(seconds)
        if pose is not None:
            z.boxes = transform_boxes(z.boxes, pose)
            z.velocities = z.velocities @ pose[:2, :2].T
        match = self._associate(z)
        self._correct(z, match, version)
        self._bury(version)
        self._give_birth(z, match, version)
        return self._report(version, pose)

    # What comes in

    def _measurements(self, boxes, scores, classes, background, velocities) -> _Measurements:
        """Checks the detections and keeps those that can be used."""
        boxes = np.asarray(boxes, np.float64)
        if boxes.size == 0:
            boxes = boxes.reshape(0, 7)
        n = len(boxes)
        if boxes.shape != (n, 7):
            raise ValueError(f"boxes has shape {boxes.shape}; expected (n, 7): x y z l w h yaw")
        scores = np.asarray(scores, np.float64).reshape(-1)
        classes = np.asarray(classes, np.int64).reshape(-1)
        background = np.zeros(n, bool) if background is None else np.asarray(background, bool).reshape(-1)
        velocities = np.full((n, 2), np.nan) if velocities is None else np.asarray(velocities, np.float64)
        velocities = velocities.reshape(-1, 2)
        for name, array in (("scores", scores), ("classes", classes), ("background", background)):
            if len(array) != n:
                raise ValueError(f"{name} has {len(array)} entries for {n} boxes")
        if len(velocities) != n:
            raise ValueError(f"velocities has {len(velocities)} rows for {n} boxes")
        if n and (classes.min() < 0 or classes.max() >= self._kinds):
            raise ValueError(f"classes holds {classes.min()} to {classes.max()}; expected 0 to {self._kinds - 1}")

        kinds = np.where(background, self._kinds, classes)
        finite = np.isfinite(boxes).all(1) & np.isfinite(scores)
        sized = (boxes[:, 3:6] > 0).all(1)
        strong = scores >= self._in_world.min_score[kinds]
        keep = finite & sized & strong
        if not keep.all():
            self.dropped["not finite"] += int((~finite).sum())
            self.dropped["size not positive"] += int((finite & ~sized).sum())
            self.dropped["low score"] += int((finite & sized & ~strong).sum())
        rows = np.flatnonzero(keep)
        if len(rows) > self.config.max_detections:
            self.dropped["over capacity"] += len(rows) - self.config.max_detections
            best = np.argsort(-scores[rows], kind="stable")[: self.config.max_detections]
            rows = np.sort(rows[best])
        return _Measurements(rows, boxes[rows], scores[rows], classes[rows], kinds[rows], velocities[rows])

    @property
    def _parameters(self) -> Parameters:
        return self._relative if self._pose is None else self._in_world

    def _move_to(self, pose: np.ndarray | None, seconds: float) -> np.ndarray | None:
        """The pose of this frame; where poses begin or fail, the tracks and the pose are made to fit."""
        if pose is not None:
            pose = np.array(pose, np.float64)
            if pose.shape != (4, 4) or not np.isfinite(pose).all():
                raise ValueError(f"pose has shape {pose.shape}; expected a finite (4, 4) matrix, world from sensor")
            if self._pose is None and len(self._i):
                # So far in the sensor's frame: carried over as they stand, their velocities unknown again.
                self._f[:, _X] = transform_boxes(self._f[:, _X] + seconds * self._f[:, _V], pose)
                self._f[:, _V] = self._f[:, _PXV] = 0.0
                self._f[:, _PVV] = self._in_world.initial_pvv[self._i[:, _KIND]]
            elif self._pose is not None and seconds > 0.0:
                self._step = (invert(self._pose) @ pose, seconds)
        elif self._pose is not None:
            step, over = self._step
            pose = self._pose @ _motion_to(_motion_of(step) * (seconds / over))
        self._pose = pose
        return pose

    # The filter

    def _predict(self, dt: float) -> None:
        """Moves all tracks forward by `dt` seconds."""
        if not len(self._i):
            return
        if dt > self.config.longest_gap:
            self._f, self._i = self._f[:0], self._i[:0]
            return
        f, kinds = self._f, self._i[:, _KIND]
        f[:, _X] += dt * f[:, _V]
        q = self._parameters.acceleration[kinds]
        f[:, _PXX] += dt * (2.0 * f[:, _PXV] + dt * f[:, _PVV] + dt * dt / 3.0 * q + self._parameters.drift[kinds])
        f[:, _PXV] += dt * (f[:, _PVV] + 0.5 * dt * q)
        f[:, _PVV] += dt * q
        self._i[:, _AGE] += 1
        self._i[:, _MATCHED] = -1

    def _correct(self, z: _Measurements, match: np.ndarray, version: int) -> None:
        """Corrects the tracks by their detections."""
        tracks = np.flatnonzero(match >= 0)
        if not len(tracks):
            return
        chosen = match[tracks]
        f, i = self._f[tracks], self._i[tracks]
        measured = z.boxes[chosen]
        kinds = i[:, _KIND]
        self._align_headings(f, measured, kinds)

        innovation = measured - f[:, _X]
        innovation[:, _YAW] = wrap_angle(innovation[:, _YAW])
        pxx, pxv = f[:, _PXX].copy(), f[:, _PXV].copy()
        gain = pxx / (pxx + self._parameters.noise[kinds])
        rate_gain = pxv / (pxx + self._parameters.noise[kinds])
        f[:, _X] += gain * innovation
        f[:, _V] += rate_gain * innovation
        f[:, _PXX] -= gain * pxx
        f[:, _PXV] -= gain * pxv
        f[:, _PVV] -= rate_gain * pxv
        f[:, _YAW] = wrap_angle(f[:, _YAW])
        self._correct_velocity(f, z.velocities[chosen], kinds)

        weight = np.maximum(1.0 / (i[:, _HITS] + 1), self.config.score_weight)
        f[:, _SCORE] += weight * (z.scores[chosen] - f[:, _SCORE])
        f[:, _EVIDENCE:] *= self.config.class_memory
        f[np.arange(len(f)), _EVIDENCE + z.classes[chosen]] += np.maximum(z.scores[chosen], 1e-3)
        foreground = kinds < self._kinds
        i[:, _KIND] = np.where(foreground, f[:, _EVIDENCE:].argmax(1), kinds)
        i[:, _SEEN] = version
        i[:, _HITS] += 1
        i[:, _MATCHED] = z.rows[chosen]
        i[:, _CONFIRMED] |= i[:, _HITS] >= self._parameters.birth_hits[kinds]
        self._f[tracks], self._i[tracks] = f, i

    def _align_headings(self, f: np.ndarray, measured: np.ndarray, kinds: np.ndarray) -> None:
        """Turns measured boxes to their track's heading, in place; a track outvoted by detections turns round."""
        turn = wrap_angle(measured[:, _YAW] - f[:, _YAW])
        # A cluster has no front, and which of its sides is the longer may change from frame to frame.
        square = kinds == self._kinds
        if square.any():
            quarters = np.where(square, np.rint(turn / (0.5 * np.pi)), 0.0)
            measured[:, _YAW] -= 0.5 * np.pi * quarters
            turn -= 0.5 * np.pi * quarters
            swapped = (quarters.astype(np.int64) & 1).astype(bool)
            measured[swapped, 3:5] = measured[swapped, 4:2:-1]
        opposite = np.abs(turn) > 0.5 * np.pi
        f[:, _VOTES] = np.minimum(f[:, _VOTES] + np.where(opposite, -1.0, 1.0), _MOST_VOTES)
        outvoted = f[:, _VOTES] < 0.0
        f[outvoted, _YAW] += np.pi
        f[outvoted, _VOTES] = 1.0
        measured[opposite & ~outvoted, _YAW] += np.pi

    def _correct_velocity(self, f: np.ndarray, measured: np.ndarray, kinds: np.ndarray) -> None:
        """Corrects x and y by a measured velocity, where there is one."""
        known = np.isfinite(measured).all(1)
        if not known.any():
            return
        rows = np.flatnonzero(known)
        for axis in (0, 1):
            x, v, pxx, pxv, pvv = (block.start + axis for block in (_X, _V, _PXX, _PXV, _PVV))
            total = f[rows, pvv] + self._parameters.velocity_noise[kinds[rows]]
            innovation = measured[rows, axis] - f[rows, v]
            gain, rate_gain = f[rows, pxv] / total, f[rows, pvv] / total
            f[rows, x] += gain * innovation
            f[rows, v] += rate_gain * innovation
            f[rows, pxx] -= gain * f[rows, pxv]
            f[rows, pxv] -= gain * f[rows, pvv]
            f[rows, pvv] -= rate_gain * f[rows, pvv]

    # Association, birth and death

    def _associate(self, z: _Measurements) -> np.ndarray:
        """The row of `z` for each track, −1 for none: first the sure detections, then the rest for those left."""
        match = np.full(len(self._i), -1)
        if not len(match) or not len(z.rows):
            return match
        sure = z.scores >= self._parameters.high_score[z.kinds]
        if sure.all():
            return self._assign(np.arange(len(match)), z, np.arange(len(z.rows)))
        first = np.flatnonzero(sure)
        chosen = self._assign(np.arange(len(match)), z, first)
        match[chosen >= 0] = first[chosen[chosen >= 0]]
        left, rest = np.flatnonzero(match < 0), np.flatnonzero(~sure)
        chosen = self._assign(left, z, rest)
        match[left[chosen >= 0]] = rest[chosen[chosen >= 0]]
        return match

    def _assign(self, tracks: np.ndarray, z: _Measurements, detections: np.ndarray) -> np.ndarray:
        """The cheapest assignment of some detections to some tracks: an index into `detections`, or −1."""
        n, m = len(tracks), len(detections)
        if not n or not m:
            return np.full(n, -1)
        groups, track_kinds = self._parameters.group, self._i[tracks, _KIND]
        limit = self._parameters.association_limit[track_kinds] * max(self._seconds / _USUAL_PERIOD, 1.0) ** 2
        spread = np.minimum(self._f[tracks, _PXX][:, :3], limit)
        spread += self._parameters.association_noise[track_kinds]
        scale = 1.0 / np.sqrt(spread[:, :2].max(1))
        if n * m <= _DENSE_PAIRS:
            same = groups[track_kinds][:, None] == groups[z.kinds[detections]]
            cost = self._cost(
                self._f[tracks][:, None, _X], spread[:, None], track_kinds[:, None], z.boxes[detections][None]
            )
            return assign(np.where(same, cost, 1.0))
        # Beyond: neighbours only, each kind of track within its own gate.
        tree = cKDTree(z.boxes[detections, :2])
        reach = float((self._parameters.gate[track_kinds] / scale).max())
        far, near = tree.query(self._f[tracks, :2], k=min(_NEIGHBOURS, m), distance_upper_bound=reach)
        near, far = near.reshape(n, -1), far.reshape(n, -1)
        rows, k = np.nonzero(np.isfinite(far))
        columns = near[rows, k]
        same = groups[track_kinds[rows]] == groups[z.kinds[detections[columns]]]
        rows, columns = rows[same], columns[same]
        cost = self._cost(self._f[tracks[rows], _X], spread[rows], track_kinds[rows], z.boxes[detections[columns]])
        return assign_sparse(rows, columns, cost, (n, m))

    def _cost(self, state, spread, kinds, boxes) -> np.ndarray:
        """Mahalanobis distance of the centres, and the sizes' difference, in units of the gate (broadcasting)."""
        away = boxes[..., :3] - state[..., :3]
        square = (away * away / spread).sum(-1)
        sizes = np.log(boxes[..., 3:6] / np.maximum(state[..., 3:6], 1e-2))
        square += self.config.size_weight * (sizes * sizes).sum(-1)
        return np.sqrt(square) / self._parameters.gate[kinds]

    def _bury(self, version: int) -> None:
        """Lets go of tracks that were not seen for too long; of unconfirmed ones sooner."""
        if not len(self._i):
            return
        i, kinds = self._i, self._i[:, _KIND]
        limit = np.where(i[:, _CONFIRMED] > 0, self._parameters.coast[kinds], self._parameters.tentative[kinds])
        alive = version - i[:, _SEEN] <= limit
        if not alive.all():
            self._f, self._i = self._f[alive], self._i[alive]

    def _give_birth(self, z: _Measurements, match: np.ndarray, version: int) -> None:
        """Begins a track with every sure detection that no track took up."""
        free = z.scores >= self._parameters.birth_score[z.kinds]
        free[match[match >= 0]] = False
        born = np.flatnonzero(free)
        room = max(self.config.max_tracks - len(self._i), 0)
        if len(born) > room:
            self.dropped["over capacity"] += len(born) - room
            born = np.sort(born[np.argsort(-z.scores[born], kind="stable")[:room]])
        if not len(born):
            return
        kinds = z.kinds[born]
        f = np.zeros((len(born), self._f.shape[1]))
        f[:, _X] = z.boxes[born]
        f[:, _PXX] = self._parameters.noise[kinds]
        f[:, _PVV] = self._parameters.initial_pvv[kinds]
        f[:, _SCORE] = z.scores[born]
        f[:, _VOTES] = 1.0
        f[np.arange(len(born)), _EVIDENCE + z.classes[born]] = np.maximum(z.scores[born], 1e-3)
        self._correct_velocity(f, z.velocities[born], kinds)
        i = np.zeros((len(born), 8), np.int64)
        i[:, _ID] = np.arange(self._next_id, self._next_id + len(born))
        i[:, _KIND] = kinds
        i[:, _BORN] = i[:, _SEEN] = version
        i[:, _HITS] = i[:, _AGE] = 1
        i[:, _MATCHED] = z.rows[born]
        # At the beginning there is nothing to wait for: what is there is there.
        i[:, _CONFIRMED] = (self._parameters.birth_hits[kinds] <= 1) | (self._frames == 1)
        self._next_id += len(born)
        self._f, self._i = np.concatenate([self._f, f]), np.concatenate([self._i, i])

    # What goes out

    def _report(self, version: int, pose: np.ndarray | None) -> Tracks:
        """The confirmed tracks, in the sensor's frame."""
        i = self._i
        unseen = version - i[:, _SEEN]
        shown = np.flatnonzero((i[:, _CONFIRMED] > 0) & (unseen <= self._parameters.report[i[:, _KIND]]))
        f, i, unseen = self._f[shown], i[shown], unseen[shown]
        boxes, velocities = f[:, _X], f[:, 7:10]
        if pose is not None:
            boxes = transform_boxes(boxes, invert(pose))
            velocities = velocities @ pose[:3, :3]
        background = i[:, _KIND] == self._kinds
        return Tracks(
            ids=i[:, _ID],
            boxes=boxes,
            velocities=velocities[:, :2].copy(),
            scores=f[:, _SCORE] * np.where(unseen > 0, self.config.coasted_score, 1.0),
            classes=f[:, _EVIDENCE:].argmax(1).astype(np.int32),
            background=background,
            age=i[:, _AGE].astype(np.int32),
            hits=i[:, _HITS].astype(np.int32),
            coasted=unseen > 0,
            position_std=np.sqrt(f[:, _PXX.start]),
            velocity_std=np.sqrt(f[:, _PVV.start]),
            detections=i[:, _MATCHED],
        )


@dataclass(slots=True)
class _Measurements:
    """The detections of a frame that can be used."""

    rows: np.ndarray  # in what was given
    boxes: np.ndarray
    scores: np.ndarray
    classes: np.ndarray
    kinds: np.ndarray  # the class, or for background the number after the last class
    velocities: np.ndarray


def _motion_of(step: np.ndarray) -> np.ndarray:
    """A small rigid motion as translation and rotation vector, shape (6,)."""
    return np.concatenate([step[:3, 3], Rotation.from_matrix(step[:3, :3]).as_rotvec()])


def _motion_to(motion: np.ndarray) -> np.ndarray:
    """The rigid motion of a translation and a rotation vector, shape (4, 4)."""
    step = np.eye(4)
    step[:3, :3] = Rotation.from_rotvec(motion[3:]).as_matrix()
    step[:3, 3] = motion[:3]
    return step
