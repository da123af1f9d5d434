"""Clouds: a structure of arrays with a capacity and a count on the device."""

import numpy as np
import pytest

from warploom.errors import DeviceError
from warploom.kernels.cloud import Cloud


def table(n=50, columns=4):
    return np.random.default_rng(0).uniform(0, 1, (n, columns)).astype(np.float32)


def test_a_cloud_holds_what_it_was_given(device):
    points, ring, t = table(), np.arange(50, dtype=np.uint16), np.linspace(0, 0.1, 50, dtype=np.float32)
    cloud = Cloud.from_numpy(points, ring=ring, t=t, capacity=64, device=device, frame_id="top")
    assert (len(cloud), cloud.capacity, cloud.dropped, cloud.frame_id) == (50, 64, 0, "top")
    assert cloud.device == device
    np.testing.assert_array_equal(cloud.numpy(), points)
    np.testing.assert_array_equal(cloud.ring.numpy()[:50], ring)
    np.testing.assert_array_equal(cloud.t.numpy()[:50], t)
    assert not cloud.xyz.numpy()[50:].any()


def test_points_beyond_the_capacity_are_counted():
    cloud = Cloud.from_numpy(table(), capacity=20)
    assert (len(cloud), cloud.capacity, cloud.dropped) == (20, 20, 30)
    np.testing.assert_array_equal(cloud.numpy(), table()[:20])


def test_a_cloud_does_not_share_the_callers_memory():
    points = table()
    cloud = Cloud.from_numpy(points)
    points[:] = 0
    np.testing.assert_array_equal(cloud.numpy(), table())


@pytest.mark.parametrize("points", [table(columns=3), table(columns=3).astype(np.float64), table(0), table()[::2]])
def test_other_tables(points):
    cloud = Cloud.from_numpy(points)
    assert len(cloud) == len(points)
    np.testing.assert_array_equal(cloud.numpy()[:, :3], points[:, :3].astype(np.float32))


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"points must have shape \(n, 3 or more\), not \(5, 2\)"):
        Cloud.from_numpy(np.zeros((5, 2), np.float32))
    with pytest.raises(ValueError, match=r"ring must have shape \(50,\)"):
        Cloud.from_numpy(table(), ring=np.zeros(49, np.uint16))
    with pytest.raises(DeviceError, match="no device 'cuda:99'"):
        Cloud.from_numpy(table(), device="cuda:99")
