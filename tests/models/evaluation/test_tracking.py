"""CLEAR MOT and its averages: by hand, and against a plain loop."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linear_sum_assignment

from warploom.models.evaluation.tracking import TrackTable, average_mot, clear_mot, tracking_summary


def table(rows, **more):
    """Rows of frame, id, x: boxes 4 × 2 × 1.5 m along x."""
    rows = np.asarray(rows, float).reshape(-1, 3)
    boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (len(rows), 1))
    boxes[:, 0] = rows[:, 2]
    return TrackTable(frames=rows[:, 0].astype(int), ids=rows[:, 1].astype(int), boxes=boxes, **more)


def test_counts_of_a_case_done_by_hand():
    truth = table([(0, 1, 0), (0, 2, 50), (1, 1, 1), (1, 2, 50), (2, 1, 2), (3, 1, 3)])
    # Object 1: found, found, missed, found by another track; object 2: found once, then a track 6 m off.
    tracks = table([(0, 10, 0.2), (0, 20, 50), (1, 10, 1), (1, 20, 56), (3, 11, 3)])
    score = clear_mot(truth, tracks, measure="distance", threshold=2.0)
    assert (score.true_positives, score.misses, score.false_positives, score.objects) == (4, 2, 1, 6)
    # A gap lies between 10 and 11, so KITTI counts no switch but a fragmentation.
    assert (score.id_switches, score.fragmentations) == (0, 1)
    assert score.mota == pytest.approx(1 - 3 / 6)
    assert score.motp == pytest.approx(0.2 / 4)
    assert score.recall == pytest.approx(4 / 6)
    assert score.precision == pytest.approx(4 / 5)


def test_a_track_that_changes_its_object_without_gap_is_a_switch():
    truth = table([(0, 1, 0), (1, 1, 0), (2, 1, 0)])
    tracks = table([(0, 5, 0), (1, 6, 0), (2, 6, 0)])
    score = clear_mot(truth, tracks, threshold=0.5)
    assert (score.id_switches, score.fragmentations) == (1, 1)
    assert score.mota == pytest.approx(1 - 1 / 3)
    assert score.motp == pytest.approx(1.0)


def test_ignored_truth_is_neither_found_nor_missed_and_ignored_tracks_are_not_wrong():
    truth = table([(0, 1, 0), (0, 2, 20), (0, 3, 40)], ignored=np.array([False, True, True]))
    tracks = table([(0, 1, 0), (0, 2, 20), (0, 4, 60), (0, 5, 80)], ignored=np.array([False, False, True, False]))
    score = clear_mot(truth, tracks)
    assert (score.true_positives, score.misses, score.false_positives, score.objects) == (1, 0, 1, 1)


def plain_mota(truth, tracks, limit):
    """The definition, frame by frame, without ignored objects."""
    bad = 0
    last = {}
    for frame in sorted({*truth.frames.tolist(), *tracks.frames.tolist()}):
        g, t = np.flatnonzero(truth.frames == frame), np.flatnonzero(tracks.frames == frame)
        cost = np.abs(truth.boxes[g, 0][:, None] - tracks.boxes[t, 0][None])
        rows, columns = linear_sum_assignment(np.where(cost <= limit, cost, 1e4))
        pairs = [(g[r], t[c]) for r, c in zip(rows, columns, strict=True) if cost[r, c] <= limit]
        bad += len(g) + len(t) - 2 * len(pairs)
        now = {truth.ids[a]: tracks.ids[b] for a, b in pairs}
        for object_id in truth.ids[g]:
            if object_id in now and object_id in last and last[object_id] not in (None, now[object_id]):
                bad += 1
            last[object_id] = now.get(object_id)
    return 1 - bad / len(truth.frames)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000))
def test_mota_is_that_of_a_plain_loop(seed):
    rng = np.random.default_rng(seed)

    def scene(ids):
        rows = [(f, i, 6 * i + rng.normal(0, 1.5)) for f in range(12) for i in ids if rng.random() < 0.8]
        return table(rows or [(0, 0, 0)])

    truth, tracks = scene(range(4)), scene(rng.permutation(5))
    ours = clear_mot(truth, tracks, measure="distance", threshold=2.0)
    assert ours.mota == pytest.approx(plain_mota(truth, tracks, 2.0))


def test_perfect_tracks_have_perfect_figures():
    rows = [(f, i, 10 * i + f) for f in range(10) for i in range(8)]
    truth = table(rows)
    tracks = table(rows, scores=np.array([0.1 + 0.1 * i for _, i, _ in rows]))
    average = average_mot(truth, tracks, threshold=0.7)
    assert average.best.mota == 1.0
    assert average.amotp == pytest.approx(1.0, abs=0.03)  # the values of recall are 1/40 apart
    assert average.samota == pytest.approx(1.0, abs=0.03)
    assert (np.diff(average.recalls) > 0).all()
    assert (np.diff(average.thresholds) <= 0).all()


def test_weak_false_tracks_cost_less_on_average_than_strong_ones():
    rows = [(f, i, 10 * i) for f in range(10) for i in range(8)]
    truth = table(rows)
    false = [(f, 99, 500) for f in range(10)]
    everything = sorted([*rows, *false], key=lambda r: r[0])

    def samota(score_of_false):
        scores = np.array([score_of_false if i == 99 else 0.5 + 0.01 * i for _, i, _ in everything])
        return average_mot(truth, table(everything, scores=scores)).samota

    assert samota(0.1) > samota(0.9)


def test_summary_names_recall_precision_and_the_error_of_velocities():
    truth = table([(f, 1, f) for f in range(5)], velocities=np.tile([10.0, 0], (5, 1)))
    tracks = table([(f, 3, f + 0.5) for f in range(1, 5)], velocities=np.tile([9.7, 0.4], (4, 1)))
    summary = tracking_summary(truth, tracks)
    assert (summary.recall, summary.precision) == (0.8, 1.0)
    assert summary.velocity_error == pytest.approx(0.5)
    assert summary.position_error == pytest.approx(0.5)
    assert (summary.id_switches, summary.objects) == (0, 5)


def test_no_tracks_and_no_truth():
    empty, some = table([]), table([(0, 1, 0)], scores=np.array([0.5]))
    assert clear_mot(some, empty).recall == 0.0
    assert np.isnan(clear_mot(empty, some).mota)
    assert average_mot(some, table([], scores=np.empty(0))).samota == 0.0
    assert np.isnan(tracking_summary(some, empty).velocity_error)


def test_wrong_arguments_are_refused():
    some = table([(0, 1, 0)])
    with pytest.raises(ValueError, match="no measure 'iou'"):
        clear_mot(some, some, measure="iou")
    with pytest.raises(ValueError, match="2 recordings of truth, 1 of tracks"):
        clear_mot([some, some], some)
    with pytest.raises(ValueError, match="no scores"):
        average_mot(some, some)
    with pytest.raises(ValueError, match="sort the table"):
        table([(1, 1, 0), (0, 1, 0)])
    with pytest.raises(ValueError, match="scores has 2 rows"):
        dataclasses.replace(some, scores=np.zeros(2))
