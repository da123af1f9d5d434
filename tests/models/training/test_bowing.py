"""Scans of vehicles with straight flanks made such as bowed and polished vehicles would give."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.models.classes import PEDESTRIAN, VEHICLE
from warploom.models.training.bowing import Bowing, bowed
from warploom.models.training.frames import Augmentation, TrainingFrame, augment, load_frame, save_frame

LENGTH, WIDTH, HEIGHT = 4.4, 1.8, 1.5


def parked(*, at=(12.0, 3.0), yaw=0.0, length=LENGTH, kind=VEHICLE, n=40_000, seed=0):
    """A box before the sensor whose near flank and lid are covered evenly with points, and some ground around it."""
    rng = np.random.default_rng(seed)
    box = np.array([*at, HEIGHT / 2 - 1.73, length, WIDTH, HEIGHT, yaw])
    c, s = np.cos(yaw), np.sin(yaw)
    side = np.sign(box[0] * s - box[1] * c)
    u = rng.uniform(-0.5, 0.5, n) * length
    flank = np.stack([u, np.full(n, side * WIDTH / 2), rng.uniform(-0.3, 0.3, n) * HEIGHT], 1)
    lid = np.stack([u[: n // 4], rng.uniform(-0.25, 0.25, n // 4) * WIDTH, np.full(n // 4, 0.15 * HEIGHT)], 1)
    local = np.concatenate([flank, lid])
    xyz = box[:3] + np.stack([local[:, 0] * c - local[:, 1] * s, local[:, 0] * s + local[:, 1] * c, local[:, 2]], 1)
    ground = np.column_stack([rng.uniform(0, 30, (2000, 1)), rng.uniform(-9, 9, (2000, 1)), np.full(2000, -1.73)])
    cloud = np.concatenate([xyz, ground]).astype(np.float32)
    return TrainingFrame(
        xyz=cloud, ring=np.arange(len(cloud)).astype(np.uint8), boxes=box[None].astype(np.float32),
        classes=np.array([kind], np.int32), points_in=np.array([len(xyz)], np.int32), sensor_height=1.73,
        velocities=np.zeros((1, 2), np.float32),
    )  # fmt: skip


def along(frame):
    """Places of the points above the ground along the box, across it towards the sensor, and above its centre."""
    box = frame.boxes[0].astype(np.float64)
    c, s = np.cos(box[6]), np.sin(box[6])
    apart = frame.xyz[frame.xyz[:, 2] > -1.7].astype(np.float64) - box[:3]
    side = np.sign(box[0] * s - box[1] * c)
    return apart[:, 0] * c + apart[:, 1] * s, side * (apart[:, 1] * c - apart[:, 0] * s), apart[:, 2]


def test_the_far_end_of_a_parked_car_is_lost_and_its_middle_is_not():
    """At 12 m ahead and 3 m beside: of the last half metre some comes back, of the middle most."""
    last, middle, lids = [], [], []
    for seed in range(40):
        frame = parked(n=2000, seed=seed)
        u, across, _ = along(bowed(frame, np.random.default_rng(seed)))
        before, across_before, _ = along(frame)
        flank, flank_before = across > 0.6, across_before > 0.6
        last.append((flank & (u > LENGTH / 2 - 0.5)).sum() / (flank_before & (before > LENGTH / 2 - 0.5)).sum())
        middle.append((flank & (np.abs(u) < 0.5)).sum() / (flank_before & (np.abs(before) < 0.5)).sum())
        lids.append((~flank & (u > 1.2)).sum() / (~flank_before & (before > 1.2)).sum())
    assert 0.1 < np.mean(last) < 0.5
    assert np.std(last) > 0.1  # each car is another
    assert np.mean(middle) > 0.75
    assert np.mean(lids) < 0.3


def test_without_bow_and_polish_flanks_stay():
    frame = parked()
    same = bowed(frame, np.random.default_rng(1), Bowing(bow=0.0, mirror=(0.0, 0.0)))
    # But for lids, which fall away from the sensor beyond the horizon.
    u, across, _ = along(same)
    v, across_before, _ = along(frame)
    on_flank, before = across > 0.8, across_before > 0.8
    assert np.allclose(np.sort(u[on_flank]), np.sort(v[before]), atol=1e-5)


def test_flanks_become_as_narrow_as_the_draw_says():
    """Each end loses at most a fifth of the width, nothing amidships, and the loss grows towards the ends."""
    wide = bowed(parked(n=200_000), np.random.default_rng(5), Bowing(mirror=(0.0, 0.0)))
    u, across, up = along(wide)
    flank = np.abs(up) < 0.29 * HEIGHT
    half = [np.percentile(across[flank & (np.abs(u - at) < 0.05)], 99) for at in (-2.0, -1.0, 0.0, 1.0)]
    assert half[2] == pytest.approx(WIDTH / 2, abs=2e-3)
    assert half[0] < half[1] < half[2]
    assert half[3] <= half[2]
    assert half[0] > 0.8 * WIDTH / 2 - 1e-3


def test_the_share_that_is_left_is_that_of_a_surface_so_turned():
    """Against the density of beams on a bowed curve: cosines of incidence, by differences of the curve itself."""
    options = Bowing(bow=0.2, mirror=(0.0, 0.0))
    frame = parked(n=400_000)
    draws = np.random.default_rng(9).random(4)
    ends, power = 0.2 * draws[:2], 2.2 + 1.8 * draws[2]
    thinned = bowed(frame, np.random.default_rng(9), options)
    u0, a0, _ = along(frame)
    u1, a1, _ = along(thinned)
    box = frame.boxes[0].astype(np.float64)
    sensor = np.array([-box[0], abs(box[1])])

    def curve(x):
        share = np.where(x > 0, ends[0], ends[1])
        return 0.5 * WIDTH * (1 - share * np.abs(2 * x / LENGTH) ** power)

    for x in (-1.9, -1.2, 0.6, 1.2, 1.5):
        step = 1e-4
        tangent = np.array([2 * step, curve(x + step) - curve(x - step)])
        normal = np.array([-tangent[1], tangent[0]]) / np.linalg.norm(tangent)
        ray = sensor - [x, curve(x)]
        ray /= np.linalg.norm(ray)
        wanted = np.clip(normal @ ray / ray[1], 0.0, 1.0)
        near0 = (np.abs(u0 - x) < 0.04) & (a0 > 0.5 * WIDTH - 1e-3)
        near1 = (np.abs(u1 - x) < 0.04) & (a1 > 0.6)
        # Some 7,000 points in the window: five standard deviations are 0.03; the window is 0.08 m wide.
        assert near1.sum() / near0.sum() == pytest.approx(wanted, abs=0.05)


@given(st.floats(-np.pi, np.pi), st.floats(-20, 20), st.floats(-20, 20), st.integers(0, 1000))
@settings(max_examples=40, deadline=None)
def test_it_takes_points_of_vehicles_alone(yaw, x, y, seed):
    frame = parked(at=(x, y), yaw=yaw, n=300)
    thinned = bowed(frame, np.random.default_rng(seed))
    again = bowed(frame, np.random.default_rng(seed))
    assert thinned.xyz.tobytes() == again.xyz.tobytes()
    assert np.array_equal(thinned.boxes, frame.boxes)
    assert len(thinned.xyz) == len(thinned.ring) <= len(frame.xyz)
    assert frame.points_in[0] - thinned.points_in[0] == len(frame.xyz) - len(thinned.xyz)
    # The road is as before, and what is left has moved inward, by no more than a fifth of half the width.
    ground = frame.xyz[:, 2] <= -1.7
    assert np.array_equal(thinned.xyz[thinned.xyz[:, 2] <= -1.7], frame.xyz[ground])
    _, across, _ = along(thinned)
    assert np.abs(across).max(initial=0.0) <= WIDTH / 2 + 1e-4


def test_people_and_what_is_bowed_already_stay():
    person = parked(kind=PEDESTRIAN)
    assert bowed(person, np.random.default_rng(0)).xyz.tobytes() == person.xyz.tobytes()
    done = replace(parked(), bowed=True)
    assert bowed(done, np.random.default_rng(0)) is done
    once = bowed(parked(), np.random.default_rng(0))
    assert once.bowed
    assert bowed(once, np.random.default_rng(1)) is once


def test_trucks_have_flat_flanks():
    def narrowest(length):
        u, across, _ = along(bowed(parked(length=length, at=(14.0, 3.0)), np.random.default_rng(5)))
        return np.percentile(across[(u < -0.4 * length) & (across > 0.6)], 50)

    assert narrowest(9.0) > WIDTH / 2 - 0.04
    assert narrowest(4.4) < WIDTH / 2 - 0.04


def test_a_file_and_its_variations_remember_that_it_is_bowed(tmp_path):
    frame = parked(n=50)
    for bow in (False, True):
        save_frame(tmp_path / "1.npz", replace(frame, bowed=bow))
        loaded = load_frame(tmp_path / "1.npz")
        assert loaded.bowed is bow
        assert augment(loaded, np.random.default_rng(0), Augmentation()).bowed is bow
