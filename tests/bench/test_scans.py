"""The clouds that are timed."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from warploom.bench.scans import CITY, REAL, SIZES, Scans


@pytest.fixture(scope="module")
def made():
    return Scans(None)


def test_the_street_comes_in_sizes(made):
    small, whole = made.cloud("street 10k"), made.cloud("street 120k")
    assert len(small) == pytest.approx(10_000, rel=0.05)
    assert len(whole) == pytest.approx(120_000, rel=0.05)
    np.testing.assert_array_equal(small, whole[::12])
    assert whole.dtype == np.float32
    assert whole.flags.c_contiguous


@pytest.mark.slow
def test_several_sweeps_are_seen_from_the_first(made):
    whole, many = made.cloud("street 120k"), made.cloud("street 2M")
    assert many.shape == (2_000_000, 4)
    np.testing.assert_allclose(many[: len(whole)], whole, atol=1e-4)
    assert np.isfinite(many).all()
    # What stands on the ground is where it was in the first sweep, though the sensor has gone on by some 10 m.
    last = many[-100_000:, :3]
    last = last[(np.abs(last[:, 2]) < 0.5) & (np.abs(last[:, :2]).max(axis=1) < 20)]
    apart, _ = cKDTree(whole[:, :3]).query(last[::10])
    assert np.median(apart) < 0.2


@pytest.mark.parametrize("name", [REAL, CITY])
def test_real_scans_are_said_to_be_absent(made, name):
    with pytest.raises(FileNotFoundError, match="semantic_kitti/full"):
        made.cloud(name)
    with pytest.raises(FileNotFoundError):
        _ = made.labelled


def test_another_name_is_refused(made):
    with pytest.raises(ValueError, match=f"name must be one of {', '.join(SIZES)}"):
        made.cloud("street 7")


@pytest.mark.real
def test_labelled_scans_by_sensor(shared_data):
    sets = Scans(shared_data).labelled
    assert [len(scans) for scans in sets.values()] == [4, 15, 6, 6]
    for name, scans in sets.items():
        for scan in scans:
            assert scan.points.shape == (len(scan.ground), 4), name
            assert 0.1 < scan.ground[scan.scored].mean() < 0.95, (name, scan.name)


@pytest.mark.real
def test_the_true_ground_lies_under_the_lowest_points(shared_data):
    """In the other order of rows and columns they would be off by more than 0.15 m."""
    for points, truth in Scans(shared_data).elevations():
        near = points[np.abs(points[:, :2]).max(axis=1) < 15]
        index = tuple(np.floor(near[:, :2] + 50).astype(int).T)
        lowest = np.full(truth.shape, np.inf)
        np.minimum.at(lowest, index, near[:, 2])
        seen = np.isfinite(lowest)
        assert np.median(np.abs(lowest - truth)[seen]) < 0.1
