"""Taichi's ground against Warp's: no more than 1e-4 of the points judged otherwise, heights within 1 mm."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.ground import segment_ground


def check(points, **options):
    ours, expected = segment_ground(points, **options, backend="taichi"), segment_ground(points, **options)
    assert ours.mask.dtype == expected.mask.dtype
    assert ours.height.dtype == expected.height.dtype
    assert ours.mask.shape == expected.mask.shape == ours.height.shape
    assert (ours.mask != expected.mask).sum() <= 1e-4 * len(points)
    # At the far end of what a float32 can say a millimetre is nothing.
    np.testing.assert_allclose(ours.height, expected.height, rtol=1e-6, atol=1e-3)
    assert ours.sensor_height == pytest.approx(expected.sensor_height, abs=1e-4)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 5000), st.sampled_from([None, 0.0, 1.73]))
def test_random_clouds(normal, seed, n, sensor_height):
    check(normal(seed, n), sensor_height=sensor_height)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(0.5, 3))
def test_tilted_planes(seed, a, b, height):
    random = np.random.default_rng(seed)
    points = random.uniform(-50, 50, (4000, 3)).astype(np.float32)
    points[:, 2] = a * points[:, 0] + b * points[:, 1] - height + random.normal(0, 0.02, 4000)
    points[::10, 2] += random.uniform(0, 2, 400)
    check(points)


def test_awkward_clouds(awkward):
    check(awkward)


def test_a_simulated_sweep(street):
    check(street)
    check(street, sensor_height=2.0)


@pytest.mark.real
def test_real_sweeps(scans):
    for scan in scans:
        check(scan)
        check(scan, sensor_height=1.73)


def test_the_fit_without_64_bit_numbers(street, monkeypatch):
    """What a device without them would find."""
    from warploom.kernels.taichi import ground

    monkeypatch.setattr(ground, "has_64_bits", lambda: False)
    plan = ground.GroundSegment(capacity=len(street))
    plan.launch(street, len(street))
    expected = segment_ground(street)
    mask, height = plan.mask.to_numpy() != 0, plan.height.to_numpy()
    assert (mask != expected.mask).sum() <= 1e-4 * len(street)
    np.testing.assert_allclose(height, expected.height, rtol=1e-6, atol=1e-3)


def test_a_plan_leaves_nothing_behind(normal):
    from warploom.kernels.taichi.ground import GroundSegment

    plan = GroundSegment(capacity=4000)
    for seed in range(3):
        points = normal(seed, 3000)
        plan.launch(points, 2000)
        expected = segment_ground(points[:2000])
        assert (plan.mask.to_numpy()[:2000] != expected.mask).sum() <= 1
        np.testing.assert_allclose(plan.height.to_numpy()[:2000], expected.height, rtol=1e-6, atol=1e-3)
        assert plan.found.to_numpy()[3] == pytest.approx(expected.sensor_height, abs=1e-4)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"sensor_height": float("nan")}, "sensor_height must be finite"),
        ({"device": "cpu"}, "device must be 'taichi'"),
    ],
)
def test_wrong_numbers(changed, message):
    from warploom.kernels.taichi.ground import GroundSegment

    with pytest.raises(ValueError, match=message):
        GroundSegment(**{"capacity": 10} | changed)
