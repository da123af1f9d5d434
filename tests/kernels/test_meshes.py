"""Sets of meshes: what they keep, how instances are described, what they refuse."""

import numpy as np
import pytest

from warploom.kernels.meshes import MeshSet

CORNERS = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [0, 0, 1]], np.float32)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_meshes_are_numbered_in_turn():
    meshes = MeshSet("cpu", max_faces=10)
    assert [meshes.add(CORNERS, FACES, np.array([k, k])) for k in range(3)] == [0, 1, 2]
    assert len(meshes) == 3
    assert meshes.labels.numpy()[:6].tolist() == [0, 0, 1, 1, 2, 2]


def test_bounds_of_an_instance_hold_its_corners():
    random = np.random.default_rng(0)
    meshes = MeshSet("cpu", max_faces=10)
    meshes.add(CORNERS, FACES, np.zeros(2, int))
    transforms = np.tile(np.eye(4), (20, 1, 1))
    transforms[:, :3] += random.normal(0, 1, (20, 3, 4))
    host = meshes.instances(np.zeros(20, int), transforms)
    world = np.einsum("kij,vj->kvi", transforms[:, :3, :3], CORNERS) + transforms[:, None, :3, 3]
    assert (host["lower"][:, None] <= world).all()
    assert (host["upper"][:, None] >= world).all()
    back = np.einsum("kij,kvj->kvi", host["rows"][:, :, :3], world) + host["rows"][:, None, :, 3]
    assert np.allclose(back, CORNERS, atol=1e-3)


def test_a_reserved_place_takes_no_more_than_its_room():
    meshes = MeshSet("cpu", max_faces=10)
    number = meshes.reserve(2)
    assert meshes.add(CORNERS, FACES, np.ones(2, int)) == number + 1
    meshes.replace(number, CORNERS, FACES, np.array([7, 8]))
    assert meshes.labels.numpy()[:4].tolist() == [7, 8, 1, 1]
    with pytest.raises(ValueError, match="at most 2"):
        meshes.replace(number, CORNERS, np.tile(FACES, (2, 1)), np.zeros(4, int))


def test_a_full_set_says_how_much_room_it_needs():
    meshes = MeshSet("cpu", max_faces=3)
    meshes.add(CORNERS, FACES, np.zeros(2, int))
    with pytest.raises(ValueError, match="max_faces must be at least 4"):
        meshes.add(CORNERS, FACES, np.zeros(2, int))
