"""KITTI's average precision against its development kit's definition, written anew here as loops over shapely polygons.

Precision is a ratio of counts, which must be equal; 1e-9 is for the sums of 40 of them.
"""

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.evaluation.kitti_ap import (
    DIFFICULTIES,
    KITTI_TYPES,
    KittiDetections,
    KittiTruth,
    kitti_average_precision,
)

CAR, PEDESTRIAN, CYCLIST = KITTI_TYPES
EASY, MODERATE, HARD = DIFFICULTIES


# ---- the kit: evaluate_object_3d_offline.cpp, function by function, with N_SAMPLE_PTS = 41

MIN_HEIGHT, MAX_OCCLUSION, MAX_TRUNCATION = (40, 25, 25), (0, 1, 2), (0.15, 0.3, 0.5)
NEIGHBOUR = {"Car": "Van", "Pedestrian": "Person_sitting", "Cyclist": None}


def polygon(box):
    x, y, _, length, width, _, yaw = box
    rectangle = shapely.box(-length / 2, -width / 2, length / 2, width / 2)
    c, s = np.cos(yaw), np.sin(yaw)
    return shapely.affinity.affine_transform(rectangle, [c, -s, s, c, x, y])


def kit_overlap(metric, a, a_image, b, b_image, criterion=-1):
    if metric == "image":
        w = min(a_image[2], b_image[2]) - max(a_image[0], b_image[0])
        h = min(a_image[3], b_image[3]) - max(a_image[1], b_image[1])
        if w <= 0 or h <= 0:
            return 0.0
        area = [(each[2] - each[0]) * (each[3] - each[1]) for each in (a_image, b_image)]
        return w * h / (area[0] + area[1] - w * h) if criterion == -1 else w * h / area[0]
    if min(a[3:6]) <= 0 or min(b[3:6]) <= 0:
        return 0.0
    common = polygon(a).intersection(polygon(b)).area
    if metric == "bev":
        return common / (a[3] * a[4] + b[3] * b[4] - common)
    height = min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2)
    volume = common * max(height, 0.0)
    return volume / (np.prod(a[3:6]) + np.prod(b[3:6]) - volume)


def clean(truth, found, name, level):
    ignored_truth, dont_care = [], []
    for k, kind in enumerate(truth.types):
        valid = 1 if kind == name else 0 if kind == NEIGHBOUR[name] else -1
        height = truth.image_boxes[k][3] - truth.image_boxes[k][1]
        ignore = (
            truth.occlusion[k] > MAX_OCCLUSION[level]
            or truth.truncation[k] > MAX_TRUNCATION[level]
            or height <= MIN_HEIGHT[level]
        )
        if valid == 1 and not ignore:
            ignored_truth.append(0)
        elif valid == 0 or (ignore and valid == 1):
            ignored_truth.append(1)
        else:
            ignored_truth.append(-1)
        if kind == "DontCare":
            dont_care.append(truth.image_boxes[k])
    ignored_found = []
    for k, kind in enumerate(found.types):
        height = int(abs(found.image_boxes[k][1] - found.image_boxes[k][3]))
        ignored_found.append(1 if height < MIN_HEIGHT[level] else 0 if kind == name else -1)
    return ignored_truth, dont_care, ignored_found


def statistics(truth, found, cleaned, metric, least, compute_fp, threshold=0.0):
    ignored_truth, dont_care, ignored_found = cleaned
    assigned = [False] * len(found.types)
    below = [compute_fp and score < threshold for score in found.scores]
    tp, fp, hits = 0, 0, []
    for i in range(len(truth.types)):
        if ignored_truth[i] == -1:
            continue
        index, valid, best, took_ignored = -1, None, 0.0, False
        for j in range(len(found.types)):
            if ignored_found[j] == -1 or assigned[j] or below[j]:
                continue
            value = kit_overlap(metric, found.boxes[j], found.image_boxes[j], truth.boxes[i], truth.image_boxes[i])
            if not compute_fp and value > least and (valid is None or found.scores[j] > valid):
                index, valid = j, found.scores[j]
            elif compute_fp and value > least and (value > best or took_ignored) and ignored_found[j] == 0:
                best, index, valid, took_ignored = value, j, 1, False
            elif compute_fp and value > least and valid is None and ignored_found[j] == 1:
                index, valid, took_ignored = j, 1, True
        if valid is None:
            continue
        assigned[index] = True
        if ignored_truth[i] == 0 and ignored_found[index] != 1:
            tp += 1
            hits.append(found.scores[index])
    if compute_fp:
        for j in range(len(found.types)):
            if not (assigned[j] or ignored_found[j] in (-1, 1) or below[j]):
                fp += 1
        if metric == "image":
            for area in dont_care:
                for j in range(len(found.types)):
                    if assigned[j] or ignored_found[j] in (-1, 1) or below[j]:
                        continue
                    if kit_overlap("image", None, found.image_boxes[j], None, area, 0) > least:
                        assigned[j] = True
                        fp -= 1
    return tp, fp, hits


def kit_ap(frames, name, level, metric, least):
    cleaned = [clean(truth, found, name, level) for truth, found in frames]
    objects = sum(each[0].count(0) for each in cleaned)
    scores = []
    for (truth, found), each in zip(frames, cleaned, strict=True):
        scores += statistics(truth, found, each, metric, least, False)[2]
    scores.sort(reverse=True)
    thresholds, recall = [], 0.0
    for i, score in enumerate(scores):
        left = (i + 1) / objects
        right = (i + 2) / objects if i < len(scores) - 1 else left
        if (right - recall) < (recall - left) and i < len(scores) - 1:
            continue
        thresholds.append(score)
        recall += 1 / 40
    precision = [0.0] * 41
    for i, threshold in enumerate(thresholds):
        tp = fp = 0
        for (truth, found), each in zip(frames, cleaned, strict=True):
            t, f, _ = statistics(truth, found, each, metric, least, True, threshold)
            tp, fp = tp + t, fp + f
        precision[i] = tp / (tp + fp) if tp + fp else 0.0
    for i in range(41):
        precision[i] = max(precision[i:])
    return 100 * sum(precision[1:]) / 40, objects


# ---- frames


def scene(rng, name, objects):
    """Labels and detections as they come: near misses, doubles, low ones, other types, areas without labels."""
    neighbour = NEIGHBOUR[name] or "Tram"
    types = rng.choice([name, neighbour, "DontCare", "Truck"], objects, p=[0.7, 0.1, 0.1, 0.1])
    boxes = np.column_stack(
        [rng.uniform(0, 60, objects), rng.uniform(-20, 20, objects), np.zeros(objects), rng.uniform(3, 5, objects),
         rng.uniform(1.4, 2, objects), rng.uniform(1.3, 1.8, objects), rng.uniform(-3, 3, objects)]
    )  # fmt: skip
    corner = np.column_stack([rng.uniform(0, 1000, objects), rng.uniform(100, 250, objects)])
    image = np.hstack([corner, corner + np.column_stack([rng.uniform(20, 90, objects), rng.uniform(15, 70, objects)])])
    boxes[types == "DontCare"] = (-1000, -1000, -1000, -1, -1, -1, -10)
    truth = KittiTruth(
        types=tuple(types.tolist()),
        boxes=boxes,
        image_boxes=image,
        truncation=rng.choice([0.0, 0.1, 0.2, 0.4, 0.8], objects),
        occlusion=rng.choice([0, 0, 1, 2, 3], objects),
    )
    source = rng.integers(0, objects, 2 * objects) if objects else np.empty(0, int)
    k = len(source)
    found_boxes = boxes[source] + rng.normal(0, 0.12, (k, 7)) * (1, 1, 1, 1, 1, 1, 0.3)
    far = rng.random(k) < 0.2
    found_boxes[far, :2] += rng.uniform(-30, 30, (int(far.sum()), 2))
    found_boxes[:, 3:6] = np.abs(found_boxes[:, 3:6]) + 0.01
    found_image = image[source] + rng.normal(0, 4, (k, 4))
    found_image[:, 2:] = np.maximum(found_image[:, 2:], found_image[:, :2] + 1)
    found = KittiDetections(
        types=tuple(rng.choice([name, name, name, "Truck"], k).tolist()) if k else (),
        boxes=found_boxes,
        image_boxes=found_image,
        scores=rng.random(k),
    )
    return truth, found


@pytest.mark.parametrize("metric", ["image", "bev", "3d"])
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), kind=st.sampled_from(KITTI_TYPES), level=st.integers(0, 2))
def test_agrees_with_the_kit(metric, seed, kind, level):
    rng = np.random.default_rng(seed)
    frames = [scene(rng, kind.name, int(rng.integers(0, 9))) for _ in range(6)]
    least = float(rng.choice([kind.overlap, 0.5, 0.25]))
    curve = kitti_average_precision(frames, kind, DIFFICULTIES[level], metric, overlap=least)
    if curve.objects == 0:
        assert np.isnan(curve.ap)
        return
    expected, objects = kit_ap(frames, kind.name, level, metric, least)
    assert curve.objects == objects
    assert curve.ap == pytest.approx(expected, abs=1e-9)


def one_frame(types, boxes, found_boxes, *, found_types=None, truncation=0.0, occlusion=0, image_height=60.0):
    image = np.array([[100.0 * k, 100, 100 * k + 50, 100 + image_height] for k in range(len(boxes))]).reshape(-1, 4)
    k = len(found_boxes)
    return (
        KittiTruth(
            types=types,
            boxes=np.array(boxes, float).reshape(-1, 7),
            image_boxes=image,
            truncation=np.full(len(boxes), truncation),
            occlusion=np.full(len(boxes), occlusion),
        ),
        KittiDetections(
            types=found_types or ("Car",) * k,
            boxes=np.array(found_boxes, float).reshape(-1, 7),
            image_boxes=np.tile([0.0, 100, 50, 160], (k, 1)),
            scores=np.linspace(0.9, 0.5, k),
        ),
    )


def car(x, y=0.0):
    return [x, y, 0, 4, 1.8, 1.5, 0]


def test_a_perfect_answer_is_100_percent():
    cars = [car(10.0 * k) for k in range(60)]
    curve = kitti_average_precision([one_frame(("Car",) * 60, cars, cars)], CAR, EASY)
    assert curve.ap == 100.0
    assert curve.objects == 60


def test_one_object_fills_but_one_of_forty_recalls():
    """As in the kit: a single hit gives the recall 0 alone, which R40 leaves out."""
    assert kitti_average_precision([one_frame(("Car",), [car(10)], [car(10)])], CAR, EASY).ap == 0.0


def test_a_van_found_as_a_car_is_not_wrong_and_a_truck_is():
    cars = [car(10.0 * k) for k in range(60)]
    with_van = one_frame(("Car",) * 60 + ("Van",), [*cars, car(5, 9)], [car(5, 9), *cars])
    with_truck = one_frame(("Car",) * 60 + ("Truck",), [*cars, car(5, 9)], [car(5, 9), *cars])
    assert kitti_average_precision([with_van], CAR, EASY).ap == 100.0
    assert kitti_average_precision([with_truck], CAR, EASY).ap < 99.0


@pytest.mark.parametrize("hidden", [{"occlusion": 1}, {"truncation": 0.2}, {"image_height": 30.0}])
def test_what_is_too_hard_counts_at_the_next_difficulty_alone(hidden):
    frame = one_frame(("Car",), [car(10)], [car(10)], **hidden)
    assert kitti_average_precision([frame], CAR, EASY).objects == 0
    assert kitti_average_precision([frame], CAR, MODERATE).objects == 1


def test_no_objects_give_no_figure():
    assert np.isnan(kitti_average_precision([one_frame((), [], [car(3)])], CAR, EASY).ap)
    assert np.isnan(kitti_average_precision([], PEDESTRIAN, HARD, "image").ap)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="metric must be"):
        kitti_average_precision([], CYCLIST, EASY, "volume")
    with pytest.raises(ValueError, match=r"overlap must be in \[0, 1\)"):
        kitti_average_precision([], CAR, EASY, overlap=1.0)
