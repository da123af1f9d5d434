"""nuScenes' metrics against the definition of its development kit, written anew as loops, and the kit where it is.

Both are double precision: 1e-9 is for the order of sums.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.evaluation.nuscenes_ap import (
    DISTANCES,
    ERRORS,
    NuscenesClass,
    NuscenesFrame,
    NuscenesMetrics,
    detection_score,
    nuscenes_metrics,
)

VEHICLE = NuscenesClass(index=0, farthest=50.0)
BARRIER = NuscenesClass(index=0, farthest=50.0, half_turn=True)


def random_frame(rng, objects):
    def boxes(n):
        return np.column_stack(
            [rng.uniform(-45, 45, (n, 2)), rng.normal(0, 0.3, n), rng.uniform(3, 5, n), rng.uniform(1, 2, n),
             rng.uniform(1, 2, n), rng.uniform(-7, 7, n)]
        )  # fmt: skip

    truth = boxes(objects)
    near = np.repeat(truth, rng.integers(0, 3, objects), axis=0)
    near = near + rng.normal(0, 0.6, near.shape) * (1, 1, 1, 0.3, 0.1, 0.1, 0.5)
    found = np.concatenate([near, boxes(rng.integers(0, 4))])
    found[:, 3:6] = np.abs(found[:, 3:6])
    k = len(found)
    return NuscenesFrame(
        boxes=found,
        scores=rng.random(k),
        classes=rng.choice([0, 0, 0, 1], k),
        velocities=rng.normal(0, 3, (k, 2)),
        truth=truth,
        truth_classes=np.zeros(objects, int),
        truth_velocities=rng.normal(0, 3, (objects, 2)),
    )


def slow_metrics(frames, kind):
    """accumulate, calc_ap and calc_tp of nuscenes.eval.detection.algo."""
    result, errors = {}, {}
    objects = [(i, m) for i, f in enumerate(frames) for m in range(len(f.truth))
               if f.truth_classes[m] == kind.index and np.hypot(*f.truth[m, :2]) < kind.farthest]  # fmt: skip
    ranked = [(f.scores[k], i, k) for i, f in enumerate(frames) for k in range(len(f.boxes))
              if f.classes[k] == kind.index and np.hypot(*f.boxes[k, :2]) < kind.farthest]  # fmt: skip
    ranked.sort(key=lambda each: -each[0])
    for distance in DISTANCES:
        taken, tp, data = set(), [], []
        for score, i, k in ranked:
            best, nearest = None, np.inf
            for frame, m in objects:
                if frame == i and (i, m) not in taken:
                    apart = np.linalg.norm(frames[i].boxes[k, :2] - frames[i].truth[m, :2])
                    if apart < nearest:
                        best, nearest = m, apart
            tp.append(nearest < distance)
            if tp[-1]:
                taken.add((i, best))
                a, b = frames[i].boxes[k], frames[i].truth[best]
                common = np.prod(np.minimum(a[3:6], b[3:6]))
                period = np.pi if kind.half_turn else 2 * np.pi
                turn = (a[6] - b[6]) % period
                data.append(
                    (score, nearest, 1 - common / (np.prod(a[3:6]) + np.prod(b[3:6]) - common),
                     min(turn, period - turn),
                     np.linalg.norm(frames[i].velocities[k] - frames[i].truth_velocities[best]))
                )  # fmt: skip
        if not any(tp):
            result[distance] = 0.0
            if distance == 2.0:
                errors = dict.fromkeys(ERRORS, 1.0)
            continue
        hits = np.cumsum(tp)
        recall, precision = hits / len(objects), hits / np.arange(1, len(tp) + 1)
        grid = np.linspace(0, 1, 101)
        at = np.interp(grid, recall, precision, right=0)
        confidence = np.interp(grid, recall, [each[0] for each in ranked], right=0)
        result[distance] = np.mean(np.clip(at[11:] - 0.1, 0, None)) / 0.9
        if distance == 2.0:
            last = max(np.flatnonzero(confidence), default=0)
            for column, name in enumerate(ERRORS, 1):
                means = [np.mean([each[column] for each in data[: n + 1]]) for n in range(len(data))]
                sampled = np.interp(confidence[::-1], [each[0] for each in data][::-1], means[::-1])[::-1]
                errors[name] = 1.0 if last < 11 else np.mean(sampled[11 : last + 1])
    return result, errors, len(objects)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([VEHICLE, BARRIER]))
def test_agrees_with_the_definition(seed, kind):
    rng = np.random.default_rng(seed)
    frames = [random_frame(rng, int(rng.integers(1, 6))) for _ in range(5)]
    found = nuscenes_metrics(frames, kind)
    ap, errors, objects = slow_metrics(frames, kind)
    assert found.objects == objects
    assert found.ap == pytest.approx(ap, abs=1e-9)
    assert found.errors == pytest.approx(errors, abs=1e-9)


def test_agrees_with_the_kit_itself():
    """Where nuscenes-devkit is installed."""
    algo = pytest.importorskip("nuscenes.eval.detection.algo")
    from nuscenes.eval.common.data_classes import EvalBoxes
    from nuscenes.eval.common.utils import center_distance
    from nuscenes.eval.detection.data_classes import DetectionBox
    from pyquaternion import Quaternion

    def box(token, row, velocity, score):
        return DetectionBox(
            sample_token=token, translation=tuple(row[:3]), size=(row[4], row[3], row[5]),
            rotation=tuple(Quaternion(axis=[0, 0, 1], angle=row[6])), velocity=tuple(velocity),
            detection_name="car", detection_score=float(score), attribute_name="",
        )  # fmt: skip

    rng = np.random.default_rng(3)
    frames = [random_frame(rng, 6) for _ in range(8)]
    truth, found = EvalBoxes(), EvalBoxes()
    for number, frame in enumerate(frames):
        token = str(number)
        own = (frame.classes == 0) & (np.hypot(*frame.boxes[:, :2].T) < 50)
        there = np.hypot(*frame.truth[:, :2].T) < 50
        truth.add_boxes(
            token,
            [box(token, *row, -1.0) for row in zip(frame.truth[there], frame.truth_velocities[there], strict=True)],
        )
        rows = zip(frame.boxes[own], frame.velocities[own], frame.scores[own], strict=True)
        found.add_boxes(token, [box(token, *row) for row in rows])
    ours = nuscenes_metrics(frames, VEHICLE)
    names = {"translation": "trans_err", "scale": "scale_err", "orientation": "orient_err", "velocity": "vel_err"}
    for distance in DISTANCES:
        data = algo.accumulate(truth, found, "car", center_distance, distance)
        assert ours.ap[distance] == pytest.approx(algo.calc_ap(data, 0.1, 0.1), abs=1e-9)
        if distance == 2.0:
            theirs = {name: algo.calc_tp(data, 0.1, key) for name, key in names.items()}
            assert ours.errors == pytest.approx(theirs, abs=1e-9)


def test_without_objects_there_is_no_figure():
    rng = np.random.default_rng(0)
    metrics = nuscenes_metrics([random_frame(rng, 0)], VEHICLE)
    assert metrics.objects == 0
    assert np.isnan(metrics.mean_ap)
    assert all(np.isnan(value) for value in metrics.errors.values())


def test_unknown_velocities_give_no_velocity_error():
    rng = np.random.default_rng(1)
    frame = random_frame(rng, 5)
    frame.velocities[:] = np.nan
    metrics = nuscenes_metrics([frame], VEHICLE)
    assert np.isnan(metrics.errors["velocity"])
    assert np.isfinite(metrics.errors["translation"])


def test_the_score_counts_what_is_not_known_as_wrong():
    whole = NuscenesMetrics(
        ap=dict.fromkeys(DISTANCES, 1.0), errors=dict.fromkeys(ERRORS, 0.0) | {"velocity": np.nan}, objects=3
    )
    nothing = NuscenesMetrics(ap=dict.fromkeys(DISTANCES, np.nan), errors=dict.fromkeys(ERRORS, np.nan), objects=0)
    assert detection_score([whole, nothing]) == pytest.approx((5 + 3) / 10)
    assert np.isnan(detection_score([nothing]))
