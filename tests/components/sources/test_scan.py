import numpy as np
import pytest

from warploom.components.sources.scan import scan_from_columns
from warploom.errors import SourceError


def columns(**extra):
    return {name: np.arange(4, dtype=np.float32) for name in "xyz"} | extra


def scan(**extra):
    return scan_from_columns(columns(**extra), format="test", where="a.pcd")


def test_intensity_of_bytes_is_scaled_and_of_floats_is_not():
    assert scan(intensity=np.array([0, 51, 255, 0], np.uint8)).points[:, 3].tolist() == pytest.approx([0, 0.2, 1, 0])
    assert scan(Reflectivity=np.array([0, 13107, 65535, 0], np.uint16)).points[2, 3] == 1
    assert scan(intensity=np.array([0, 100, 255, 0.5], np.float32)).points[:, 3].tolist() == [0, 100, 255, 0.5]
    assert (scan().points[:, 3] == 0).all()


def test_rings_that_cannot_be_rings_are_left_out():
    assert scan(ring=np.array([0, 1, 2, 65535], np.int32)).ring.dtype == np.uint16
    assert scan(ring=np.array([0, 1, 2, -1], np.int32)).ring is None
    assert scan(ring=np.array([0, 1, np.nan, 3])).ring is None
    assert scan().ring is None


def test_times_become_seconds_after_the_first_stamp():
    np.testing.assert_allclose(scan(t=np.array([0, 10, 20, 99_000_000], np.uint32)).t, [0, 1e-8, 2e-8, 0.099])
    stamps = np.array([5, 0, 7, 8], np.uint64) + np.uint64(1_700_000_000_000_000_000)
    np.testing.assert_allclose(scan(timestamp=stamps).t, [5e-9, 0, 7e-9, 8e-9], rtol=1e-6)
    # float64 seconds since 1970 resolve 0.2 µs
    np.testing.assert_allclose(scan(time=np.array([0.1, 0, 0.2, 0.3]) + 1.7e9).t, [0.1, 0, 0.2, 0.3], atol=3e-7)
    assert scan(time=np.array([0.1, np.nan, 0.2, 0.3])).t is None


def test_missing_coordinates_are_named():
    with pytest.raises(SourceError, match=r"a\.pcd: no field y, z among its fields \(x, intensity\)"):
        scan_from_columns({"x": np.zeros(2), "intensity": np.zeros(2)}, format="test", where="a.pcd")
