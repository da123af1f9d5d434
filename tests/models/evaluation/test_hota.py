"""HOTA: by hand, against its authors' program where that is installed, and what changes it."""

import dataclasses

import numpy as np
import pytest

from warploom.models.evaluation.hota import hota
from warploom.models.evaluation.tracking import TrackTable, overlaps_by_frame


def table(rows, **more):
    """Rows of frame, id, x: boxes 4 × 2 × 1.5 m along x."""
    rows = np.asarray(rows, float).reshape(-1, 3)
    boxes = np.tile([0.0, 0, 0, 4, 2, 1.5, 0], (len(rows), 1))
    boxes[:, 0] = rows[:, 2]
    return TrackTable(frames=rows[:, 0].astype(int), ids=rows[:, 1].astype(int), boxes=boxes, **more)


def street(seed, objects=12, frames=40):
    """Objects side by side, and tracks that miss, waver, swap ids and invent some."""
    random = np.random.default_rng(seed)
    true, found = [], []
    ids = np.arange(objects)
    for frame in range(frames):
        if random.random() < 0.1:
            a, b = random.choice(objects, 2, replace=False)
            ids[[a, b]] = ids[[b, a]]
        for k in range(objects):
            true.append((frame, k, 6.0 * k + 0.3 * frame))
            if random.random() < 0.85:
                found.append((frame, ids[k] + 100, 6.0 * k + 0.3 * frame + random.normal(0, 0.8)))
        if random.random() < 0.3:
            found.append((frame, 500 + frame // 3, 6.0 * objects + 40 + random.normal()))
    return table(true), table(found)


def test_perfect_tracks_have_hota_one():
    truth, _ = street(1)
    score = hota(truth, truth)
    assert (score.hota, score.detection, score.association) == pytest.approx((1.0, 1.0, 1.0))


def test_a_track_cut_in_half_costs_association_alone():
    truth = table([(frame, 1, 0) for frame in range(10)])
    tracks = table([(frame, 1 + frame // 5, 0) for frame in range(10)])
    score = hota(truth, tracks)
    # Each match belongs to a track that shares 5 of the object's 10 frames.
    assert score.detection == pytest.approx(1.0)
    assert score.association == pytest.approx(0.5)
    assert score.hota == pytest.approx(np.sqrt(0.5))


def test_thresholds_of_overlap_are_averaged():
    # Moved by 1 m of 4: the overlap is 3/5, which reaches 12 of the 19 thresholds.
    score = hota(table([(0, 1, 0)]), table([(0, 1, 1)]))
    assert score.hota == pytest.approx(12 / 19)


def test_ignored_objects_and_what_finds_them_are_left_out():
    truth, tracks = street(2)
    more = table([*zip(truth.frames, truth.ids, truth.boxes[:, 0], strict=True), (39, 900, 300)])
    more = dataclasses.replace(more, ignored=more.ids == 900)
    found = table([*zip(tracks.frames, tracks.ids, tracks.boxes[:, 0], strict=True), (39, 901, 300), (39, 902, 400)])
    found = dataclasses.replace(found, ignored=found.ids == 902)
    assert hota(more, found) == hota(truth, tracks)


def test_no_tracks_and_no_objects():
    truth, tracks = street(3)
    nothing = table(np.empty((0, 3)))
    assert hota(truth, nothing).hota == 0.0
    assert hota(nothing, tracks).hota == 0.0
    assert hota([], []).hota == 0.0


def test_recordings_must_pair_up():
    truth, tracks = street(4)
    with pytest.raises(ValueError, match="2 recordings of truth, 1 of tracks"):
        hota([truth, truth], [tracks])


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_the_authors_program(seed):
    """To 1e-9: the same sums in another order."""
    metrics = pytest.importorskip("trackeval.metrics", reason="trackeval is not installed")
    pairs = [street(seed), street(seed + 50, objects=5)]
    program = metrics.HOTA()
    results = {}
    for number, (truth, tracks) in enumerate(pairs):
        _, objects = np.unique(truth.ids, return_inverse=True)
        _, ids = np.unique(tracks.ids, return_inverse=True)
        frames = range(int(truth.frames.max()) + 1)
        overlaps = {int(truth.frames[i[0]]): overlap for i, _, overlap in overlaps_by_frame(truth, tracks)}
        results[str(number)] = program.eval_sequence({
            "num_timesteps": len(frames),
            "num_gt_ids": objects.max() + 1,
            "num_tracker_ids": ids.max() + 1,
            "num_gt_dets": len(truth.frames),
            "num_tracker_dets": len(tracks.frames),
            "gt_ids": [objects[truth.frames == f] for f in frames],
            "tracker_ids": [ids[tracks.frames == f] for f in frames],
            "similarity_scores": [
                overlaps.get(f, np.zeros(((truth.frames == f).sum(), (tracks.frames == f).sum()))) for f in frames
            ],
        })  # fmt: skip
    theirs = program.combine_sequences(results)
    ours = hota(*zip(*pairs, strict=True))
    assert ours.hota == pytest.approx(theirs["HOTA"].mean(), abs=1e-9)
    assert ours.detection == pytest.approx(theirs["DetA"].mean(), abs=1e-9)
    assert ours.association == pytest.approx(theirs["AssA"].mean(), abs=1e-9)
