"""The voxel map against dictionaries and SciPy's k-d tree; both methods give the same bytes."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from warploom.kernels.interop import borrow_points, count_on
from warploom.kernels.registration import ScanRegistration
from warploom.kernels.voxel_map import VoxelMap

METHODS = ("in_order", "shared")


def reference(clouds, size, max_points):
    """All points of the map, voxel by voxel in the order of their first points."""
    voxels = {}
    least = np.float32(size * size / max_points)
    for xyz, pose in clouds:
        p = xyz.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]
        p = p[np.isfinite(p).all(axis=1)]
        cells = np.floor(p * (1.0 / size)).astype(np.int64)
        offsets = (p - cells * size).astype(np.float32)
        for cell, offset in zip(map(tuple, cells), offsets, strict=True):
            kept = voxels.setdefault(cell, [])
            if len(kept) < max_points and all(((other - offset) ** 2).sum() >= least for other in kept):
                kept.append(offset)
    points = [np.array(cell) * size + np.array(offsets) for cell, offsets in voxels.items()]
    return np.concatenate(points) if points else np.empty((0, 3))


def pose_at(x=0.0, y=0.0, z=0.0, yaw=0.0):
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, z
    return pose


def add(voxel_map, xyz, pose):
    device = str(voxel_map.table.device)
    cloud = borrow_points(xyz if device == "cpu" else wp.array(xyz, dtype=wp.float32, device=device))
    voxel_map.launch(cloud.xyz, count_on(len(cloud), device), wp.array(pose[None], dtype=wp.mat44d, device=device))
    return cloud  # whoever launches keeps the points


def filled(clouds, method="auto", device="cpu", **kwargs):
    settings = {"voxel_size": 1.0, "capacity": 4096, "max_voxels": 4096, "method": method, "device": device, **kwargs}
    voxel_map = VoxelMap(**settings)
    for xyz, pose in clouds:
        add(voxel_map, xyz, pose)
    return voxel_map


def some_clouds(seed, n=1500, spread=6.0):
    rng = np.random.default_rng(seed)
    poses = (pose_at(), pose_at(2.0, -1.0, 0.3, 0.4), pose_at(-3.0, 2.0, 0.0, -1.0))
    return [(rng.uniform(-spread, spread, (n, 3)).astype(np.float32), pose) for pose in poses]


def everything(voxel_map):
    """All that a launch may change, as bytes; the table but for where in it an entry is."""
    table = voxel_map.table.numpy()
    table = table[table[:, 0] != -1]
    parts = [table[np.argsort(table[:, 0])], voxel_map._free.numpy()[: int(voxel_map.free_count.numpy()[0])]]
    parts += [voxel_map.to_numpy(), voxel_map.free_count.numpy(), voxel_map.dropped.numpy()]
    return [part.tobytes() for part in parts]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("max_points", [1, 5, 20])
def test_holds_what_a_dictionary_would(method, max_points):
    clouds = some_clouds(1)
    voxel_map = filled(clouds, method, max_points=max_points)
    assert np.array_equal(voxel_map.to_numpy(), reference(clouds, 1.0, max_points))
    assert voxel_map.dropped.numpy().tolist() == [0, 0]


def test_on_each_device_the_same_bytes(device):
    clouds = some_clouds(2)
    assert everything(filled(clouds, device=device)) == everything(filled(clouds, "in_order"))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0.1, 0.37, 1.0, 3.0]), st.integers(1, 20))
def test_the_methods_agree_to_the_byte_even_when_there_is_no_room(seed, size, max_points):
    clouds = some_clouds(seed, n=300)
    clouds[1][0][:5] = np.nan
    options = {"voxel_size": size, "max_points": max_points, "max_voxels": 200, "max_distance": 8.0}
    first, second = (filled(clouds, method, **options) for method in METHODS)
    assert everything(first) == everything(second)
    assert first.dropped.numpy()[0] == 5


@pytest.mark.parametrize("method", METHODS)
def test_what_finds_no_room_is_counted(method):
    xyz = np.float32([[0.5 + i, 0.5, 0.5] for i in range(10)] * 2)
    voxel_map = filled([(xyz, pose_at())], method, max_voxels=4)
    assert voxel_map.dropped.numpy().tolist() == [0, 12]
    assert np.array_equal(voxel_map.to_numpy(), xyz[:4])
    voxel_map.clear()
    assert voxel_map.dropped.numpy().tolist() == [0, 0]
    assert voxel_map.free_count.numpy()[0] == 4
    assert len(voxel_map.to_numpy()) == 0


@pytest.mark.parametrize("method", METHODS)
def test_voxels_whose_cells_differ_by_multiples_of_four_find_room(method):
    """Their places in their cubes of 64 slots are the same: the search must not stay on those."""
    grid = np.stack(np.meshgrid(*[np.arange(10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    xyz = np.float32(4.0 * grid + 0.5)
    voxel_map = VoxelMap(voxel_size=1.0, capacity=1024, max_voxels=1000, method=method)
    add(voxel_map, xyz, pose_at())
    assert voxel_map.dropped.numpy().tolist() == [0, 0]
    assert len(voxel_map.to_numpy()) == 1000


@pytest.mark.parametrize("method", METHODS)
def test_voxels_far_away_go_and_their_room_is_used_again(method):
    rng = np.random.default_rng(3)
    voxel_map = VoxelMap(voxel_size=1.0, capacity=1024, max_voxels=2600, max_distance=10.0, method=method, max_points=3)
    everywhere = np.float32(rng.uniform(-6, 6, (1000, 3)) * [1, 1, 0.3])
    for step in range(40):
        pose = pose_at(x=2.5 * step)
        add(voxel_map, everywhere, pose)
        points = voxel_map.to_numpy()
        # Pruned at least since the last metre, by the centres of voxels.
        assert np.linalg.norm(points - pose[:3, 3], axis=1).max() < 10.0 + 1.0 + 0.5 * np.sqrt(3)
    assert voxel_map.dropped.numpy().tolist() == [0, 0]
    inside = reference([(everywhere, pose)], 1.0, 3)
    distance, _ = cKDTree(points).query(inside)
    assert distance.max() < 1.0  # what came before stays, and takes the place of some of it


@pytest.mark.parametrize("method", METHODS)
def test_nothing_at_all_one_point_and_duplicates(method):
    assert len(filled([(np.empty((0, 3), np.float32), pose_at())], method).to_numpy()) == 0
    one = np.float32([[1.25, -2.5, 0.75]])
    assert np.array_equal(filled([(one, pose_at())], method).to_numpy(), one)
    assert np.array_equal(filled([(np.repeat(one, 4000, axis=0), pose_at())], method).to_numpy(), one)


@pytest.mark.parametrize("method", METHODS)
def test_a_million_metres_away_it_is_as_exact_as_near(method):
    near = np.random.default_rng(4).uniform(-5, 5, (800, 3)).astype(np.float32)
    far = pose_at(x=2.0**19, y=-(2.0**19), z=2.0**19)
    got = filled([(near, far)], method).to_numpy() - far[:3, 3]
    assert np.abs(got - filled([(near, pose_at())], method).to_numpy()).max() < 1e-6


@pytest.mark.parametrize("method", METHODS)
def test_points_out_of_all_numbers_are_counted(method):
    tiny = np.float32(1e-40)
    odd = np.float32([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [2e6, 0, 0], [tiny, -tiny, 0], [1e5, -1e5, 3]])
    voxel_map = filled([(odd, pose_at())], method)
    assert voxel_map.dropped.numpy().tolist() == [4, 0]
    assert len(voxel_map.to_numpy()) == 2


def test_the_nearest_are_scipys():
    """Registration with one step reports how many points had one in reach and their squared distances: by a k-d tree.

    Within voxel_size of a point the 27 voxels hold all there is. Tolerance: 1e-4 of the sum, for squares in float32.
    """
    rng = np.random.default_rng(5)
    voxel_map = filled(some_clouds(6))
    tree = cKDTree(voxel_map.to_numpy())
    query = rng.uniform(-9, 9, (2000, 3)).astype(np.float32)
    cloud = borrow_points(query)
    plan = ScanRegistration(capacity=2000, max_iterations=1)
    for reach in (0.1, 0.4, 1.0):
        limits = wp.array([reach, 1.0, 1.0], dtype=wp.float32, device="cpu")
        plan.launch(cloud.xyz, count_on(2000, "cpu"), voxel_map, wp.array(np.eye(4)[None], dtype=wp.mat44d), limits)
        distance, _ = tree.query(query.astype(np.float64))
        matched = distance < reach
        assert plan.fit.numpy()[0] == matched.sum()
        assert plan.fit.numpy()[1] == pytest.approx((distance[matched] ** 2).sum(), rel=1e-4)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"voxel_size": 0.0}, "voxel_size must be > 0 m"),
        ({"voxel_size": np.nan}, "voxel_size must be > 0 m"),
        ({"capacity": 0}, "capacity must be at least 1"),
        ({"max_voxels": 0}, "max_voxels must be at least 1"),
        ({"max_points": 256}, "max_points must be 1 to 255"),
        ({"max_voxels": 1 << 30}, "must stay below 2³¹"),
        ({"max_distance": 0.0}, "max_distance must be > 0 m or None"),
        ({"method": "magic"}, "method must be"),
    ],
)
def test_refuses_what_makes_no_sense(wrong, message):
    with pytest.raises(ValueError, match=message):
        VoxelMap(**{"voxel_size": 1.0, "capacity": 10, **wrong})


def test_refuses_more_points_than_its_capacity():
    with pytest.raises(ValueError, match="xyz has 11 rows, more than the plan's capacity of 10"):
        filled([(np.zeros((11, 3), np.float32), pose_at())], capacity=10)
