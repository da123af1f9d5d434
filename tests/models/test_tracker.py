"""The tracker against a textbook filter of one object, and on scenes whose outcome is known."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.classes import BARRIER, CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.geometry import invert, rigid, transform_boxes, wrap_angle
from warploom.models.tracker import ClassConfig, Tracker, TrackerConfig

NS = 100_000_000  # a frame at 10 Hz
CAR = np.array([0.0, 0, 0.8, 4.2, 1.8, 1.6, 0])


def car(x, y, yaw=0.0):
    return CAR + [x, y, 0, 0, 0, 0, yaw]  # noqa: RUF005


def vehicles(config: TrackerConfig | None = None, **changes) -> TrackerConfig:
    """A configuration with the vehicles' changed."""
    config = config or TrackerConfig()
    classes = list(config.classes)
    classes[VEHICLE] = dataclasses.replace(classes[VEHICLE], **changes)
    return dataclasses.replace(config, classes=tuple(classes))


def step(tracker, frame, boxes, kind=VEHICLE, score=0.9, **more):
    boxes = np.asarray(boxes, float).reshape(-1, 7)
    return tracker.update(frame * NS, boxes, np.full(len(boxes), score), np.full(len(boxes), kind), **more)


class TextbookFilter:
    """A Kalman filter with full matrices: state x y z l w h yaw and all their rates."""

    def __init__(self, box, c: ClassConfig):
        self.R = np.diag(np.square([c.position_std] * 3 + [c.size_std] * 3 + [c.yaw_std]))
        self.q = np.diag(np.square([c.acceleration_std] * 2 + [0.0] * 5))
        self.walk = np.diag(np.square([0.0, 0.0, c.vertical_std] + [c.size_drift] * 3 + [c.yaw_drift]))
        self.x = np.r_[box, np.zeros(7)]
        self.P = np.zeros((14, 14))
        self.P[:7, :7] = self.R
        self.P[7, 7] = self.P[8, 8] = c.speed_std**2
        self.H = np.eye(7, 14)

    def predict(self, dt):
        F = np.eye(14)
        F[:7, 7:] = dt * np.eye(7)
        Q = np.block([
            [dt**3 / 3 * self.q + dt * self.walk, dt**2 / 2 * self.q],
            [dt**2 / 2 * self.q, dt * self.q],
        ])  # fmt: skip
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def correct(self, z):
        innovation = z - self.H @ self.x
        innovation[6] = wrap_angle(innovation[6])
        K = self.P @ self.H.T @ np.linalg.inv(self.H @ self.P @ self.H.T + self.R)
        self.x = self.x + K @ innovation
        self.P = (np.eye(14) - K @ self.H) @ self.P


def test_filter_is_the_textbooks_matrix_filter():
    config = vehicles(report=0.5)
    rng = np.random.default_rng(0)
    tracker, reference, time = Tracker(config), None, 0
    for frame in range(40):
        dt = int(rng.integers(60, 180)) * 1_000_000
        time += dt
        box = car(0.8 * frame, 0.1 * frame, yaw=3.0 + 0.01 * frame) + rng.normal(0, 0.05, 7)
        if reference is not None:
            reference.predict(dt * 1e-9)
        if frame % 7 != 5:  # now and then nothing is seen
            if reference is None:
                reference = TextbookFilter(box, config.classes[VEHICLE])
            else:
                reference.correct(box)
        seen = box[None] if frame % 7 != 5 else np.empty((0, 7))
        tracks = tracker.update(time, seen, np.full(len(seen), 0.9), np.full(len(seen), VEHICLE), pose=np.eye(4))
        # 1e-9: two orders of the same float64 operations
        np.testing.assert_allclose(tracks.boxes[0, :6], reference.x[:6], atol=1e-9)
        np.testing.assert_allclose(wrap_angle(tracks.boxes[0, 6] - reference.x[6]), 0.0, atol=1e-9)
        np.testing.assert_allclose(tracks.velocities[0], reference.x[7:9], atol=1e-9)
        np.testing.assert_allclose(tracks.position_std[0] ** 2, reference.P[0, 0], atol=1e-9)
        np.testing.assert_allclose(tracks.velocity_std[0] ** 2, reference.P[7, 7], atol=1e-9)


def test_measured_velocity_is_taken_up_as_in_the_textbook():
    config = TrackerConfig()
    c = config.classes[VEHICLE]
    reference = TextbookFilter(car(0, 0), c)
    for axis, measured in ((7, 5.0), (8, -1.0)):
        h = np.eye(14)[axis]
        K = reference.P @ h / (h @ reference.P @ h + c.velocity_std**2)
        reference.x = reference.x + K * (measured - h @ reference.x)
        reference.P = reference.P - np.outer(K, h @ reference.P)
    tracks = step(Tracker(config), 0, [car(0, 0)], velocities=np.array([[5.0, -1.0]]), pose=np.eye(4))
    np.testing.assert_allclose(tracks.velocities[0], reference.x[7:9], atol=1e-12)
    np.testing.assert_allclose(tracks.velocity_std[0] ** 2, reference.P[7, 7], atol=1e-12)


def test_objects_that_pass_each_other_keep_their_ids():
    tracker, ids = Tracker(), []
    for frame in range(60):
        x = 1.2 * frame
        tracks = step(tracker, frame, [car(x, 1.6), car(70 - x, -1.6, yaw=np.pi)], pose=np.eye(4))
        ids.append(tracks.ids[np.argsort(tracks.boxes[:, 1])].tolist())
    assert all(pair == ids[0] for pair in ids)


def test_paths_that_cross_keep_their_ids():
    rng, tracker, ids = np.random.default_rng(5), Tracker(), []
    for frame in range(80):
        t = 0.1 * frame - 4.0
        walkers = np.array([[1.5 * t, 0.4, 0, 0.6, 0.6, 1.7, 0], [0.0, 1.5 * t, 0, 0.6, 0.6, 1.7, 0]])
        walkers[:, :2] += rng.normal(0, 0.03, (2, 2))
        tracks = step(tracker, frame, walkers, kind=PEDESTRIAN, pose=np.eye(4))
        ids.append(tracks.ids[np.argsort(np.abs(tracks.boxes[:, 0] - 1.5 * t))].tolist())
    assert ids[-1] == ids[0]
    assert len(tracker) == 2


def test_id_survives_an_occlusion_of_a_second():
    tracker, seen = Tracker(), []
    for frame in range(60):
        hidden = 20 <= frame < 30
        tracks = step(tracker, frame, [] if hidden else [car(1.0 * frame, 0.2)], pose=np.eye(4))
        seen.append((tracks.ids.tolist(), tracks.coasted.tolist()))
    assert seen[19] == seen[31] == ([1], [False])
    assert seen[20] == ([1], [True])
    assert seen[25] == seen[29] == ([], [])  # alive, but no longer reported
    assert seen[30] == ([1], [False])


def test_coasting_moves_on_and_its_score_falls():
    tracker = Tracker()
    for frame in range(20):
        before = step(tracker, frame, [car(1.0 * frame, 0)], pose=np.eye(4))
    after = step(tracker, 20, [], pose=np.eye(4))
    assert after.boxes[0, 0] == pytest.approx(before.boxes[0, 0] + 0.1 * before.velocities[0, 0])
    assert after.scores[0] < before.scores[0]
    assert after.position_std[0] > before.position_std[0]
    assert (after.age[0], after.hits[0], after.detections[0]) == (21, 20, -1)


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_what_stands_still_has_no_velocity_however_the_vehicle_moves(turn):
    rng, tracker = np.random.default_rng(1), Tracker()
    parked = np.array([car(30, 5, 0.1), car(45, -6, 2.0), car(20, 12, -1.0)])
    pose = np.eye(4)
    for frame in range(40):
        boxes = transform_boxes(parked, invert(pose)) + rng.normal(0, 0.02, (3, 7)) * [1, 1, 1, 0, 0, 0, 1]
        tracks = step(tracker, frame, boxes, pose=pose)
        pose = pose @ rigid((1.0, 0, 0), yaw=turn)
    assert len(tracks) == 3
    assert np.abs(tracks.velocities).max() < 0.4
    # The boxes come back in the sensor's frame.
    assert np.linalg.norm(tracks.boxes[:, :2] - boxes[:, :2], axis=1).max() < 0.1


def test_velocity_is_over_ground_in_the_axes_of_the_sensor():
    tracker, pose = Tracker(), rigid((0, 0, 0), yaw=np.pi / 2)
    for frame in range(40):
        world = np.array([car(0.5 * frame, 10)])  # 5 m/s along the world's x
        tracks = step(tracker, frame, transform_boxes(world, invert(pose)), pose=pose)
        pose = pose @ rigid((1.0, 0, 0))
    np.testing.assert_allclose(tracks.velocities[0], [0, -5], atol=0.05)


def test_velocity_is_relative_without_pose():
    tracker = Tracker()
    for frame in range(40):
        tracks = step(tracker, frame, [car(60 - 1.0 * frame, 3)])
    np.testing.assert_allclose(tracks.velocities[0], [-10, 0], atol=0.1)


def test_a_frame_without_pose_goes_on_as_the_last_one():
    tracker, pose, parked = Tracker(), np.eye(4), np.array([car(40, 5)])
    for frame in range(30):
        given = None if frame in (12, 13, 20) else pose
        tracks = step(tracker, frame, transform_boxes(parked, invert(pose)), pose=given)
        pose = pose @ rigid((1.2, 0, 0), yaw=0.03)
    assert tracks.ids.tolist() == [1]
    assert np.abs(tracks.velocities).max() < 0.05


def test_ids_live_on_when_poses_begin():
    tracker, pose, parked = Tracker(), rigid((500, 200, 0), yaw=1.0), np.array([car(20, 5)])
    for frame in range(30):
        tracks = step(tracker, frame, transform_boxes(parked, rigid()), pose=pose if frame > 10 else None)
    assert tracks.ids.tolist() == [1]
    np.testing.assert_allclose(tracks.boxes[0], parked[0], atol=1e-3)


def test_ids_are_never_given_twice():
    rng, tracker, lives = np.random.default_rng(2), Tracker(vehicles(coast=0.2, birth_hits=1)), {}
    for frame in range(120):
        if frame == 60:
            tracker.clear()
        boxes = [car(x, y) for x, y in rng.uniform(-50, 50, (5, 2))]
        for i in step(tracker, frame, boxes).ids.tolist():
            lives.setdefault(i, []).append(frame)
    for frames in lives.values():  # each id lives once, without a gap longer than coasting
        assert np.diff(frames).max(initial=1) <= 3
        assert not (min(frames) < 60 <= max(frames))


def test_a_false_detection_is_not_reported():
    tracker = Tracker()
    for frame in range(10):
        boxes = [car(0, 0), car(30, 30)] if frame == 5 else [car(0, 0)]
        assert step(tracker, frame, boxes).ids.tolist() == [1]
    assert len(tracker) == 1


def test_weak_detections_carry_tracks_on_but_begin_none():
    tracker = Tracker()
    for frame in range(10):
        strong = step(tracker, frame, [car(0, 0)], score=0.9)
    for frame in range(10, 20):
        weak = step(tracker, frame, [car(0, 0), car(20, 0)], score=0.2)
        assert weak.ids.tolist() == strong.ids.tolist()
        assert not weak.coasted[0]
    assert len(tracker) == 1
    assert weak.scores[0] < strong.scores[0]


def test_a_sure_detection_goes_before_a_weak_one_that_is_nearer():
    tracker = Tracker()
    for frame in range(10):
        step(tracker, frame, [car(0, 0)], pose=np.eye(4))
    tracks = tracker.update(
        10 * NS, np.array([car(0.01, 0), car(0.3, 0)]), np.array([0.2, 0.9]), np.full(2, VEHICLE), pose=np.eye(4)
    )
    assert tracks.detections[0] == 1


def test_flipped_headings_do_not_turn_the_track():
    tracker = Tracker()
    for frame in range(30):
        yaw = 0.3 + (np.pi if frame % 4 == 3 else 0.0)
        tracks = step(tracker, frame, [car(1.0 * frame, 0, yaw)])
        assert abs(wrap_angle(tracks.boxes[0, 6] - 0.3)) < 1e-6


def test_a_heading_that_was_wrong_at_first_turns_round_at_once_and_not_through_the_side():
    tracker = Tracker()
    yaws = [step(tracker, frame, [car(0, 0, np.pi if frame == 0 else 0.0)]).boxes[0, 6] for frame in range(8)]
    assert all(min(abs(wrap_angle(yaw)), abs(wrap_angle(yaw - np.pi))) < 1e-6 for yaw in yaws)
    assert abs(yaws[-1]) < 1e-6


def test_a_clusters_sides_may_change_places():
    tracker = Tracker()
    box = np.array([10, 5, 0.5, 1.2, 1.0, 1.0, 0.2])
    for frame in range(20):
        seen = box.copy()
        if frame % 2:
            seen[3:5], seen[6] = box[4:2:-1], box[6] + np.pi / 2
        tracks = step(tracker, frame, [seen], background=np.array([True]), pose=np.eye(4))
    np.testing.assert_allclose(tracks.boxes[0], box, atol=1e-6)


def test_background_stands_still_and_never_takes_up_a_known_object():
    rng, tracker = np.random.default_rng(3), Tracker()
    for frame in range(30):
        boxes = np.array([car(20, 0), car(20, 0)])
        boxes[:, :2] += rng.normal(0, 0.2, (2, 2))
        tracks = step(tracker, frame, boxes, background=np.array([False, True]), pose=np.eye(4))
    assert sorted(tracks.background.tolist()) == [False, True]
    assert len(tracker) == 2
    assert (tracks.velocities[tracks.background] == 0).all()
    assert (tracks.velocity_std[tracks.background] == 0).all()


def test_the_class_is_what_most_detections_say():
    tracker = Tracker()
    for frame in range(12):
        kind = CYCLIST if frame in (0, 5) else PEDESTRIAN
        tracks = step(tracker, frame, [[10, 0.1 * frame, 0, 0.8, 0.6, 1.7, 0]], kind=kind, pose=np.eye(4))
    assert tracks.ids.tolist() == [1]
    assert tracks.classes.tolist() == [PEDESTRIAN]
    other = step(tracker, 12, [[10, 1.2, 0, 0.8, 0.6, 1.7, 0]], kind=BARRIER, pose=np.eye(4))
    assert other.coasted.tolist() == [True]


def test_what_cannot_be_used_is_dropped_and_counted():
    tracker = Tracker()
    boxes = np.array([car(0, 0), car(np.nan, 0), car(10, 0), car(20, 0), car(30, 0), car(40, np.inf)])
    boxes[2, 4], boxes[3, 5] = 0.0, -1.0
    tracks = tracker.update(0, boxes, np.array([0.9, 0.9, 0.9, 0.9, np.nan, 0.9]), np.zeros(6, int))
    assert tracks.detections.tolist() == [0]
    step(tracker, 1, [car(0, 0), car(50, 0)], score=0.01)
    assert tracker.dropped == {"not finite": 3, "size not positive": 2, "low score": 2}


def test_more_than_the_capacity_keeps_the_best():
    tracker = Tracker(TrackerConfig(max_detections=3, max_tracks=2))
    scores = np.array([0.5, 0.9, 0.4, 0.8, 0.7])
    tracks = tracker.update(0, np.array([car(10 * k, 0) for k in range(5)]), scores, np.zeros(5, int))
    assert tracks.detections.tolist() == [1, 3]
    assert tracker.dropped == {"over capacity": 3}


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": 0}, "not after the last frame"),
        ({"boxes": np.zeros((1, 6))}, r"boxes has shape \(1, 6\)"),
        ({"scores": [0.5, 0.5]}, "scores has 2 entries for 1 boxes"),
        ({"classes": [99]}, "classes holds 99"),
        ({"background": [True, False]}, "background has 2"),
        ({"velocities": np.zeros((2, 2))}, "velocities has 2 rows"),
        ({"pose": np.eye(3)}, r"pose has shape \(3, 3\)"),
    ],
)
def test_wrong_arguments_are_refused_and_the_next_frame_goes_on(change, says):
    tracker = Tracker()
    step(tracker, 0, [car(0, 0)])
    arguments = {"version": NS, "boxes": car(0, 0)[None], "scores": [0.9], "classes": [VEHICLE]}
    with pytest.raises(ValueError, match=says):
        tracker.update(**{**arguments, **change})
    assert tracker.update(**arguments).ids.tolist() == [1]


def test_nothing_for_minutes_and_gaps_of_seconds():
    tracker = Tracker()
    assert len(step(tracker, 0, [])) == 0
    for frame in range(1, 10):
        step(tracker, frame, [car(0, 0)])
    for frame in range(10, 1500):
        step(tracker, frame, [])
    assert len(tracker) == 0
    for frame in range(1500, 1510):
        tracks = step(tracker, frame, [car(0, 0)])
    assert tracks.ids.tolist() == [2]
    tracks = step(tracker, 1600, [car(0, 0)])  # ten seconds later: another object, for all we know
    assert len(tracker) == 1
    assert 2 not in tracks.ids


def test_many_objects_are_assigned_as_few_are():
    """Beyond a size only neighbours are compared; among objects that lie apart it makes no difference."""
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(np.arange(18), np.arange(18)), -1).reshape(-1, 2) * 12.0
    tracker = Tracker()
    for frame in range(5):
        order = rng.permutation(len(grid))
        boxes = np.tile(CAR, (len(grid), 1))
        boxes[:, :2] = grid[order] + rng.normal(0, 0.1, (len(grid), 2))
        tracks = step(tracker, frame, boxes, pose=np.eye(4))
        np.testing.assert_array_equal(order[tracks.detections], np.arange(len(grid)) if frame else order)
        if frame == 0:
            grid = grid[order]
    assert len(tracks) == len(grid)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 10_000), st.integers(0, 12), st.booleans())
def test_same_frames_same_bytes_and_inputs_stay(seed, n, with_pose):
    def run():
        rng, tracker, out = np.random.default_rng(seed), Tracker(), []
        for frame in range(6):
            boxes = np.c_[rng.normal(0, 4, (n, 2)), np.zeros(n), rng.uniform(0.3, 5, (n, 3)), rng.uniform(-9, 9, n)]
            kept = boxes.copy()
            tracks = tracker.update(
                frame * NS,
                boxes,
                rng.random(n),
                rng.integers(0, 6, n),
                background=rng.random(n) < 0.3,
                pose=rigid((frame, 0, 0)) if with_pose else None,
            )
            np.testing.assert_array_equal(boxes, kept)
            assert len(set(tracks.ids.tolist())) == len(tracks)
            assert np.isfinite(tracks.boxes).all()
            assert (tracks.boxes[:, 3:6] > 0).all()
            taken = tracks.detections[tracks.detections >= 0]
            assert len(set(taken.tolist())) == len(taken)
            out += [getattr(tracks, field.name).tobytes() for field in dataclasses.fields(tracks)]
        return out

    assert run() == run()


def test_configuration_needs_every_class():
    with pytest.raises(ValueError, match="classes has 1 entries"):
        TrackerConfig(classes=(ClassConfig(),))


def test_gaps_and_missing_poses_are_counted():
    tracker = Tracker()
    for frame in (0, 1, 2, 3, 90):
        step(tracker, frame, [car(0, 0)], pose=None if frame == 2 else np.eye(4))
    assert tracker.incidents == {"gap": 1, "pose missing": 1}


def test_five_thousand_in_one_place_are_tracked_and_what_was_cut_short_is_counted():
    rng, tracker = np.random.default_rng(6), Tracker()
    for frame in range(2):
        boxes = np.tile(CAR, (5000, 1))
        boxes[:, :2] = rng.normal(0, 1.0, (5000, 2))
        boxes[::50] = np.nan
        tracks = step(tracker, frame, boxes, pose=np.eye(4))
    assert tracker.incidents["cut short"] == 1  # nothing is assigned in the first frame
    assert tracker.dropped == {"not finite": 200}
    taken = tracks.detections[tracks.detections >= 0]
    assert len(set(taken.tolist())) == len(taken) > 4000
    assert np.isfinite(tracks.boxes).all()


def test_detections_of_no_use_do_not_disturb_the_order_of_many():
    """From 256 on detections are looked up along x, whatever stands in between."""
    rng, clean, dirty = np.random.default_rng(8), Tracker(), Tracker()
    place = rng.uniform(-80, 80, (300, 2))
    for frame in range(3):
        boxes = np.tile(CAR, (300, 1))
        boxes[:, :2] = place + rng.normal(0, 0.1, place.shape)
        bad = boxes[::3].copy()
        bad[0::3, 0], bad[1::3, 4], bad[2::3, 1] = np.nan, -1.0, np.inf
        a, b = step(clean, frame, boxes), step(dirty, frame, np.concatenate([bad, boxes]))
        np.testing.assert_array_equal(a.ids, b.ids)
        np.testing.assert_array_equal(a.boxes, b.boxes)
        np.testing.assert_array_equal(a.detections + len(bad), b.detections)
