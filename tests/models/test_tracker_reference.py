"""The compiled tracker against a plain one: an object for each track, a loop for each step, SciPy's assignment."""

import dataclasses

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from warploom.models.classes import CLASSES, PEDESTRIAN, VEHICLE
from warploom.models.geometry import box_overlap, invert, rigid, transform_boxes, wrap_angle
from warploom.models.tracker import ClassConfig, Tracker, TrackerConfig

NS = 1_000_000_000


class Track:
    """One object: a Kalman filter of x y z l w h yaw vx vy from filterpy."""

    def __init__(self, number, box, score, label, kind, c: ClassConfig, now, confirmed):
        self.id, self.kind, self.seen, self.hits, self.age = number, kind, now, 1, 1
        self.confirmed, self.score, self.votes = confirmed, score, 1
        self.evidence = np.zeros(len(CLASSES))
        self.evidence[label] = max(score, 1e-3)
        self.filter = KalmanFilter(dim_x=9, dim_z=7)
        self.filter.x[:7, 0] = box
        self.filter.H = np.eye(7, 9)
        variances = np.square([c.position_std] * 3 + [c.size_std] * 3 + [c.yaw_std])
        self.filter.P = np.diag(np.r_[variances, [c.speed_std**2] * 2])

    def predict(self, dt, c: ClassConfig):
        F = np.eye(9)
        F[0, 7] = F[1, 8] = dt
        Q = np.diag(dt * np.square([0.0, 0.0, c.vertical_std] + [c.size_drift] * 3 + [c.yaw_drift, 0.0, 0.0]))
        for place, rate in ((0, 7), (1, 8)):
            pair = np.ix_([place, rate], [place, rate])
            Q[pair] += c.acceleration_std**2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        self.filter.predict(F=F, Q=Q)
        self.age += 1

    def correct(self, box, score, label, c: ClassConfig, background, now, memory, weight):
        box = box.copy()
        turn = wrap_angle(box[6] - self.filter.x[6, 0])
        if background:
            quarters = round(turn / (np.pi / 2))
            box[6], turn = box[6] - quarters * np.pi / 2, turn - quarters * np.pi / 2
            if quarters % 2:
                box[3], box[4] = box[4], box[3]
        if abs(turn) > np.pi / 2:
            self.votes -= 1
            if self.votes < 0:
                self.filter.x[6, 0] += np.pi
                self.votes = 1
            else:
                box[6] += np.pi
        else:
            self.votes = min(self.votes + 1, 5)
        box[6] = self.filter.x[6, 0] + wrap_angle(box[6] - self.filter.x[6, 0])
        self.filter.update(box, R=np.diag(np.square([c.position_std] * 3 + [c.size_std] * 3 + [c.yaw_std])))
        self.score += max(1 / (self.hits + 1), weight) * (score - self.score)
        self.evidence *= memory
        self.evidence[label] += max(score, 1e-3)
        self.hits, self.seen = self.hits + 1, now
        self.confirmed |= self.hits >= c.birth_hits
        if not background:
            self.kind = int(self.evidence.argmax())


class PlainTracker:
    """What `Tracker` does, without any thought of speed."""

    def __init__(self, config: TrackerConfig):
        self.config, self.tracks, self.now, self.next, self.frames = config, [], None, 1, 0

    def update(self, now, boxes, scores, classes, background, pose):
        config, background_kind = self.config, len(CLASSES)
        dt = 0.0 if self.now is None else (now - self.now) / NS
        self.now, self.frames = now, self.frames + 1
        kinds = np.where(background, background_kind, classes)
        boxes = transform_boxes(boxes, pose)
        for track in self.tracks:
            track.predict(dt, config.of(track.kind))
        least = np.array([config.of(k).min_score for k in kinds])
        sure = scores >= np.array([config.of(k).high_score for k in kinds])
        free, taken = list(self.tracks), {}
        for stage in (sure, ~sure):
            rows = np.flatnonzero(stage & (scores >= least))
            cost = np.ones((len(free), len(rows)))
            overlaps = self.overlaps(free, boxes[rows])
            for i, track in enumerate(free):
                for k, row in enumerate(rows):
                    cost[i, k] = min(self.cost(track, boxes[row], kinds[row], overlaps[i, k], dt), 1.0)
            for i, k in zip(*linear_sum_assignment(cost), strict=True):
                if cost[i, k] < 1.0:
                    taken[free[i].id] = rows[k]
            free = [track for track in free if track.id not in taken]
        for track in self.tracks:
            if track.id in taken:
                row = taken[track.id]
                track.correct(
                    boxes[row], scores[row], classes[row], config.of(track.kind), bool(background[row]), now,
                    config.class_memory, config.score_weight,
                )  # fmt: skip

        def life(track):
            c = config.of(track.kind)
            return c.coast if track.confirmed else c.tentative

        self.tracks = [track for track in self.tracks if now - track.seen <= round(life(track) * NS)]
        for row in np.flatnonzero(scores >= least):
            c = config.of(kinds[row])
            if row not in taken.values() and scores[row] >= c.birth_score:
                confirmed = c.birth_hits <= 1 or self.frames == 1
                self.tracks.append(
                    Track(self.next, boxes[row], scores[row], classes[row], kinds[row], c, now, confirmed)
                )
                taken[self.next] = row
                self.next += 1
        shown = [t for t in self.tracks if t.confirmed and now - t.seen <= round(config.of(t.kind).report * NS)]
        found = np.array([t.filter.x[:, 0] for t in shown]).reshape(-1, 9)
        return {
            "ids": np.array([t.id for t in shown], int),
            "boxes": transform_boxes(found[:, :7], invert(pose)),
            "velocities": found[:, 7:] @ pose[:2, :2],
            "scores": np.array([t.score * (1.0 if t.id in taken else config.coasted_score) for t in shown]),
            "classes": np.array([t.evidence.argmax() for t in shown], int),
            "background": np.array([t.kind == background_kind for t in shown], bool),
            "age": np.array([t.age for t in shown], int),
            "hits": np.array([t.hits for t in shown], int),
            "detections": np.array([taken.get(t.id, -1) for t in shown], int),
            "velocity_std": np.sqrt([t.filter.P[7, 7] for t in shown]),
        }

    def overlaps(self, tracks, boxes):
        """Generalised overlap of all pairs."""
        states = np.array([track.filter.x[:7, 0] for track in tracks]).reshape(-1, 7)
        i, k = np.mgrid[: len(states), : len(boxes)].reshape(2, -1)
        return box_overlap(states[i], boxes[k])[2].reshape(len(states), len(boxes))

    def cost(self, track, box, kind, overlap, dt):
        c, other = self.config.of(track.kind), self.config.of(kind)
        background = len(CLASSES)
        alike = c.group == other.group != "" or track.kind == kind
        if not alike or (track.kind == background) != (kind == background):
            return 1.0
        state, wider = track.filter.x[:, 0], max(dt / 0.1, 1.0)
        if c.cost == "distance":
            return np.hypot(*(box[:2] - state[:2])) / (c.gate_distance * wider)
        if c.cost == "giou":
            return (1.0 - overlap) / (1.0 - c.gate_giou)
        spread = np.minimum(np.diag(track.filter.P)[:3], (c.association_limit * wider) ** 2) + c.association_std**2
        square = ((box[:3] - state[:3]) ** 2 / spread).sum()
        square += self.config.size_weight * (np.log(box[3:6] / np.maximum(state[3:6], 1e-2)) ** 2).sum()
        return np.sqrt(square) / c.gate


def configured(**changes):
    """The usual configuration with something changed for every class."""
    usual = TrackerConfig()
    classes = tuple(dataclasses.replace(c, **changes) for c in usual.classes)
    return dataclasses.replace(usual, classes=classes, background=dataclasses.replace(usual.background, **changes))


def compare(tracks, expected):
    for name in ("ids", "classes", "background", "age", "hits", "detections"):
        np.testing.assert_array_equal(getattr(tracks, name), expected[name], err_msg=name)
    # 1e-7: float64 in another order, over some dozen frames, with a matrix inverted in one of the two
    for name in ("velocities", "scores", "velocity_std"):
        np.testing.assert_allclose(getattr(tracks, name), expected[name], atol=1e-7, err_msg=name)
    np.testing.assert_allclose(tracks.boxes[:, :6], expected["boxes"][:, :6], atol=1e-7)
    np.testing.assert_allclose(wrap_angle(tracks.boxes[:, 6] - expected["boxes"][:, 6]), 0.0, atol=1e-7)


def scene(seed, frames, n):
    """Objects that wander, come and go among others and false ones."""
    rng = np.random.default_rng(seed)
    place, speed = rng.uniform(-25, 25, (n, 2)), rng.normal(0, 4, (n, 2))
    label = rng.integers(0, len(CLASSES), n)
    size = np.where(label[:, None] == VEHICLE, [4.2, 1.8, 1.6], [0.8, 0.7, 1.7])
    yaw, now = rng.uniform(-4, 4, n), 0
    for _ in range(frames):
        dt = int(rng.choice([50, 100, 100, 100, 300])) * 1_000_000
        now, place = now + dt, place + speed * dt / NS
        seen = rng.random(n) < 0.8
        flip = np.where(rng.random(n) < 0.15, np.pi, 0.0)
        boxes = np.c_[place, np.zeros(n), size, yaw + flip] + rng.normal(0, 0.08, (n, 7))
        false = np.c_[rng.uniform(-25, 25, (4, 2)), np.zeros(4), rng.uniform(0.5, 3, (4, 3)), rng.uniform(-3, 3, 4)]
        labels = np.where(rng.random(n) < 0.15, rng.integers(0, len(CLASSES), n), label)
        yield (
            now,
            np.concatenate([boxes[seen], false]),
            np.concatenate([rng.uniform(0.05, 1.0, seen.sum()), rng.uniform(0, 0.5, 4)]),
            np.concatenate([labels[seen], rng.integers(0, len(CLASSES), 4)]),
            np.concatenate([label[seen] == 5, rng.random(4) < 0.3]),
        )


@pytest.mark.parametrize("cost", ["mahalanobis", "giou", "distance"])
@settings(deadline=None, max_examples=4)
@given(st.integers(0, 10_000))
def test_a_plain_tracker_gives_the_same(cost, seed):
    config = configured(cost=cost, report=0.35)
    tracker, plain = Tracker(config), PlainTracker(config)
    for frame, given_frame in enumerate(scene(seed, 25, 14)):
        pose = rigid((0.9 * frame, 0.2 * frame, 0.0), yaw=0.02 * frame)
        now, boxes, scores, classes, background = given_frame
        tracks = tracker.update(now, boxes, scores, classes, background=background, pose=pose)
        compare(tracks, plain.update(now, boxes, scores, classes, background, pose))
    assert len(tracks)


@pytest.mark.parametrize("cost", ["mahalanobis", "distance"])
def test_crowds_that_are_looked_up_in_order_are_assigned_as_by_the_plain_tracker(cost):
    """From 256 detections on they are looked up along x."""
    config, rng = configured(cost=cost), np.random.default_rng(7)
    tracker, plain = Tracker(config), PlainTracker(config)
    place = rng.uniform(-60, 60, (270, 2))
    for frame in range(2):
        boxes = np.c_[place + rng.normal(0, 0.15, place.shape), np.zeros(270), np.tile([0.8, 0.7, 1.7, 0.0], (270, 1))]
        given_frame = boxes, np.full(270, 0.9), np.full(270, PEDESTRIAN)
        pose = rigid((0.0, 0.0, 0.0), yaw=2.0)
        tracks = tracker.update(frame * NS // 10, *given_frame, pose=pose)
        compare(tracks, plain.update(frame * NS // 10, *given_frame, np.zeros(270, bool), pose))


@pytest.mark.real
def test_a_plain_tracker_gives_the_same_on_real_detections(shared_data):
    from warploom.components.evaluation.kitti_tracking import TYPES, TrackingSequence
    from warploom.components.perception.tracker_settings import load_tracker

    kind = next(kind for kind in TYPES if kind.name == "Pedestrian")
    data = shared_data / "kitti_tracking"
    sequence = TrackingSequence.read(data, data / "pointrcnn_Pedestrian", "0012", kind, logits=True)
    config = load_tracker("pointrcnn")
    tracker, plain = Tracker(config), PlainTracker(config)
    for k, frame in enumerate(sequence.frames):
        boxes, scores, pose = sequence.boxes[k], sequence.scores[k], sequence.poses[k]
        classes = np.full(len(boxes), kind.class_index)
        now = int(frame) * NS // 10
        tracks = tracker.update(now, boxes, scores, classes, pose=pose)
        expected = plain.update(now, boxes, scores, classes, np.zeros(len(boxes), bool), pose)
        np.testing.assert_array_equal(tracks.ids, expected["ids"])
        np.testing.assert_array_equal(tracks.detections, expected["detections"])
        # 1e-6: the vertical axis of the pose is tilted, and the plain tracker turns velocities on the ground only
        np.testing.assert_allclose(tracks.boxes[:, :6], expected["boxes"][:, :6], atol=1e-6)
