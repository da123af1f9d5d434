"""Packets of rays against Warp's own query, ray by ray: the same bytes, however the rays are split into parts."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.ray_packets import hit_packets
from warploom.kernels.raycast import _first_hit


def triangles(seed, faces=400):
    """Triangles here and there, of a few metres, about the origin."""
    random = np.random.default_rng(seed)
    vertices = random.normal(0, 15, (faces, 1, 3)) + random.normal(0, 2, (faces, 3, 3))
    return vertices.reshape(-1, 3).astype(np.float32), np.arange(3 * faces, dtype=np.int32)


def fan(n, spread):
    """Directions, each near the one before, as those of a sensor."""
    azimuth = 1.0 + np.linspace(0, spread * n, n)
    return np.stack([np.cos(azimuth), np.sin(azimuth), 0.4 * np.sin(3 * azimuth)], axis=1).astype(np.float32)


def outputs(n):
    return [wp.empty(n, dtype=dtype) for dtype in (wp.float32, wp.int32, wp.vec3)]


def assert_hits_are_warps(mesh, origins, directions, max_distance, parts):
    n = len(directions)
    rays = [wp.array(array, dtype=wp.vec3) for array in (origins, directions)]
    alone, together = outputs(n), outputs(n)
    wp.launch(_first_hit, n, inputs=[mesh.id, *rays, max_distance], outputs=alone)
    for part in range(parts):
        wp.launch(hit_packets, 1, inputs=[part, parts, mesh.id, *rays, max_distance], outputs=together)
    for expected, got in zip(alone, together, strict=True):
        assert np.array_equal(expected.numpy(), got.numpy())
    return np.isfinite(together[0].numpy())


def mesh_of(vertices, indices, **options):
    return wp.Mesh(points=wp.array(vertices, dtype=wp.vec3), indices=wp.array(indices, dtype=wp.int32), **options)


@pytest.mark.parametrize("n", [1, 7, 8, 9, 255, 256, 257, 3000])
@pytest.mark.parametrize("spread", [1e-5, 0.002, 0.1])
def test_near_rays_hit_what_each_alone_would(n, spread):
    mesh = mesh_of(*triangles(1))
    for parts in (1, 2, 3, 7):
        assert_hits_are_warps(mesh, np.zeros((n, 3), np.float32), fan(n, spread), 1e6, parts)


@pytest.mark.parametrize(
    "options", [{}, {"bvh_constructor": "median"}, {"bvh_constructor": "cubql", "bvh_leaf_size": 4}]
)
def test_any_tree_will_do(options):
    mesh = mesh_of(*triangles(2), **options)
    hit = assert_hits_are_warps(mesh, np.zeros((2000, 3), np.float32), fan(2000, 0.003), 1e6, 1)
    assert 0.2 < hit.mean() < 1.0


def test_rays_that_have_nothing_in_common_go_alone():
    random = np.random.default_rng(3)
    mesh = mesh_of(*triangles(3))
    assert_hits_are_warps(
        mesh, random.normal(0, 9, (999, 3)).astype(np.float32), random.normal(0, 1, (999, 3)).astype(np.float32), 1e6, 2
    )


def test_nothing_is_hit_beyond_the_maximum_distance():
    mesh = mesh_of(*triangles(4))
    far = assert_hits_are_warps(mesh, np.zeros((3000, 3), np.float32), fan(3000, 0.002), 1e6, 1)
    near = assert_hits_are_warps(mesh, np.zeros((3000, 3), np.float32), fan(3000, 0.002), 12.0, 1)
    assert 0 < near.sum() < far.sum()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_an_axis(axis):
    """Directions with zeros; of a wall of squares before each."""
    steps = np.arange(-5.0, 6.0)
    u, v = (grid.ravel() for grid in np.meshgrid(steps, steps))
    corners = np.insert(np.stack([u, v], 1), axis, 4.0, axis=1).astype(np.float32)
    low = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    indices = np.stack([low, low + 1, low + 12, low, low + 12, low + 11], 1).ravel().astype(np.int32)
    directions = np.zeros((64, 3), np.float32)
    directions[:, axis] = 1.0
    origins = np.tile(np.insert(np.array([0.3, 0.4]), axis, 0.0), (64, 1)).astype(np.float32)
    assert assert_hits_are_warps(mesh_of(corners, indices), origins, directions, 1e6, 1).all()


@pytest.mark.parametrize("faces", [1, 2])
def test_a_tree_that_is_one_leaf(faces):
    vertices = np.array([[5, -1, -1], [5, 1, -1], [5, 0, 1], [6, -1, -1], [6, 1, -1], [6, 0, 1]], np.float32)
    directions = np.tile(np.array([[1.0, 0, 0]], np.float32), (20, 1))
    directions[10:, 0] = -1.0
    mesh = mesh_of(vertices, np.arange(3 * faces, dtype=np.int32))
    hit = assert_hits_are_warps(mesh, np.zeros((20, 3), np.float32), directions, 1e6, 1)
    assert hit.tolist() == [True] * 10 + [False] * 10
