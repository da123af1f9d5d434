"""Taichi's clusters against Warp's: the same labels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.cluster import cluster
from warploom.kernels.ground import segment_ground


def check(points, radius=0.5, min_size=1):
    ours, expected = cluster(points, radius, min_size, backend="taichi"), cluster(points, radius, min_size)
    assert ours.dtype == expected.dtype
    np.testing.assert_array_equal(ours, expected)


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.integers(0, 3000), st.sampled_from([0.05, 0.5, 1.3, 30.0]), st.sampled_from([1, 2, 9])
)
def test_random_clouds(normal, seed, n, radius, min_size):
    check(normal(seed, n), radius, min_size)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.sampled_from([0.1, 0.3, 0.5]))
def test_points_on_a_lattice(seed, n, step):
    """Many distances are the radius itself, but for the rounding of the positions."""
    from warploom.kernels.taichi.device import has_64_bits

    if not has_64_bits():
        pytest.skip("without 64-bit numbers such distances may be decided otherwise")
    cells = np.random.default_rng(seed).integers(-12, 12, (n, 3))
    check((cells * step).astype(np.float32), step)
    check((cells * np.float32(step)), step)


def check_growing(points, radius, radius_per_metre, min_size=1):
    from warploom.kernels.interop import borrow_points
    from warploom.kernels.taichi.cluster import cluster as in_taichi

    ours = in_taichi(borrow_points(points), radius, min_size, radius_per_metre)
    np.testing.assert_array_equal(ours, cluster(points, radius, min_size, radius_per_metre=radius_per_metre))


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 3000),
    st.sampled_from([0.05, 0.3, 1.3]),
    st.sampled_from([1e-5, 0.004, 0.02, 0.2, 1.0]),
    st.sampled_from([1, 3]),
)
def test_a_radius_that_grows_with_the_range(normal, seed, n, radius, radius_per_metre, min_size):
    check_growing(normal(seed, n), radius, radius_per_metre, min_size)


@pytest.mark.parametrize("radius_per_metre", [0.01, 0.5])
def test_awkward_clouds_under_a_growing_radius(awkward, radius_per_metre):
    check_growing(awkward, 0.2, radius_per_metre)


def test_of_two_radii_that_of_the_nearer_point_holds():
    """Points 20 m and 21 m away, whose nearer one just reaches the other, and just does not."""
    for reach, joined in ((1.0 + 1e-6, True), (1.0 - 1e-6, False)):
        near = np.float32([[20.0, 0.0, 0.0], [21.0, 0.0, 0.0]])
        growth = (reach - 0.3) / 20.0
        check_growing(near, 0.3, growth)
        assert cluster(near, 0.3, radius_per_metre=growth).tolist() == [0, 0 if joined else 1]


def test_a_simulated_sweep_under_a_growing_radius(street):
    points = street[~segment_ground(street).mask]
    check_growing(points, 0.3, 0.02)
    check_growing(points, 0.1, 0.01, 5)


@pytest.mark.parametrize("radius", [0.01, 0.5, 100.0])
def test_awkward_clouds(awkward, radius):
    check(awkward, radius, 1)
    check(awkward, radius, 3)


@pytest.mark.parametrize("radius", [1e-8, 1e-3, 1e6, 1e25])
def test_extreme_radii(normal, radius):
    check(normal(0, 500) * np.float32(min(max(radius, 1e-3), 1e3)), radius)


def test_a_simulated_sweep(street):
    check(street[~segment_ground(street).mask])
    check(street, 0.3, 5)


@pytest.mark.real
def test_real_sweeps(scans):
    for scan in scans:
        points = scan[~segment_ground(scan).mask]
        check(points)
        check_growing(points, 0.3, 0.02)


def test_labels_are_the_same_each_time(street):
    first = cluster(street, 0.4, backend="taichi")
    for _ in range(5):
        np.testing.assert_array_equal(cluster(street, 0.4, backend="taichi"), first)


def test_without_64_bit_numbers(street, monkeypatch):
    """What a device without them would find, as long as no distance is within 1e-6 of the radius."""
    from warploom.kernels.taichi import cluster as in_taichi

    monkeypatch.setattr(in_taichi, "has_64_bits", lambda: False)
    plan = in_taichi.EuclideanCluster(radius=0.4567, capacity=len(street))
    plan.launch(street, len(street))
    np.testing.assert_array_equal(plan.labels.to_numpy(), cluster(street, 0.4567))
    plan = in_taichi.EuclideanCluster(radius=0.4567, radius_per_metre=0.0123, capacity=len(street))
    plan.launch(street, len(street))
    np.testing.assert_array_equal(plan.labels.to_numpy(), cluster(street, 0.4567, radius_per_metre=0.0123))


def test_points_that_take_no_part(normal):
    from warploom.kernels.taichi.cluster import EuclideanCluster

    plan = EuclideanCluster(radius=1.0, min_size=2, capacity=4000)
    for seed in range(3):
        points = normal(seed, 3000)
        include = (np.random.default_rng(seed).random(2000) < 0.7).astype(np.int32)
        plan.launch(points, 2000, include)
        labels = plan.labels.to_numpy()[:2000]
        np.testing.assert_array_equal(labels[include != 0], cluster(points[:2000][include != 0], 1.0, 2))
        assert (labels[include == 0] == -1).all()
        assert plan.totals.to_numpy()[2] == labels.max() + 1
    with pytest.raises(ValueError, match="include must have at least 2000 rows"):
        plan.launch(points, 2000, include[:10])


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"radius": 0.0}, "radius must be a positive number"),
        ({"radius": float("inf")}, "radius must be a positive number"),
        ({"radius_per_metre": 2.0}, "radius_per_metre must be 0, or from 1e-05 to 1"),
        ({"radius_per_metre": float("nan")}, "radius_per_metre must be 0, or from 1e-05 to 1"),
        ({"min_size": 0}, "min_size must be at least 1"),
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"device": "taichi:abacus"}, "device must be 'taichi'"),
    ],
)
def test_wrong_numbers(changed, message):
    from warploom.kernels.taichi.cluster import EuclideanCluster

    with pytest.raises(ValueError, match=message):
        EuclideanCluster(**{"radius": 1.0, "capacity": 10} | changed)
