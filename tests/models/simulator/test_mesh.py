"""The primitives: closed where they should be, and of the volume and area that geometry says."""

import numpy as np
import pytest

from warploom.models.simulator.mesh import box, ellipsoid, join, leaves, loft, relief, tube


def open_edges(shape):
    """Edges that belong to an odd number of triangles, corners that coincide taken as one."""
    _, corner = np.unique(np.round(shape.vertices, 9), axis=0, return_inverse=True)
    faces = corner.ravel()[shape.faces]
    faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return int((np.unique(edges, axis=0, return_counts=True)[1] % 2).sum())


def area(shape):
    a, b, c = shape.vertices[shape.faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()


def test_a_box_is_closed_and_has_its_area():
    shape = box((0, 0, 0), (1, 2, 3), 5)
    assert open_edges(shape) == 0
    assert area(shape) == pytest.approx(2 * (2 + 3 + 6))
    assert set(shape.labels) == {5}


@pytest.mark.parametrize("path", [[[0, 0, 0], [0, 0, 2]], [[0, 0, 0], [1, 1, 0], [2, 0, 1]], [[0, 0, 0], [3, 0, 0]]])
def test_a_tube_is_closed_and_keeps_its_radius(path):
    path = np.array(path, float)
    shape = tube(path, 0.1, 1, sides=24)
    assert open_edges(shape) == 0
    rings = shape.vertices[: 24 * len(path)].reshape(len(path), 24, 3)
    assert np.allclose(np.linalg.norm(rings - path[:, None], axis=2), 0.1)
    assert np.allclose(rings.mean(1), path)


def test_an_ellipsoid_has_its_extent():
    low, high = ellipsoid((1, 2, 3), (0.5, 1.0, 2.0), 1, rings=20).bounds()
    assert np.allclose([low, high], [[0.5, 1, 1], [1.5, 3, 5]], atol=0.02)


def test_a_relief_has_reveals_between_its_depths():
    u, v = np.array([0.0, 1.0, 2.0, 3.0]), np.array([0.0, 1.0, 2.0, 3.0])
    depth = np.zeros((3, 3))
    depth[1, 1] = 0.5
    shape = relief(u, v, depth, np.ones((3, 3), int), 2)
    assert area(shape) == pytest.approx(9 + 4 * 0.5)
    assert (shape.labels == 2).sum() == 8
    # Only the outer rim of the wall is open.
    assert open_edges(shape) == 12


def test_shapes_move_turn_and_join():
    one = box((0, 0, 0), (2, 1, 1), 1)
    low, high = one.turned(np.pi / 2).bounds()
    assert np.allclose([low, high], [[-1, 0, 0], [0, 2, 1]])
    both = join(one, one.moved(x=5).unboxed())
    assert np.allclose(both.bounds()[1], [2, 1, 1])
    assert len(both.faces) == 24
    assert np.allclose(sum(one.moved(x=9, z=4).centred().bounds()), [0, 0, 1])


def test_leaves_stay_near_their_centres():
    centres = np.random.default_rng(0).normal(0, 5, (50, 3))
    shape = leaves(centres, 0.2, 1, np.random.default_rng(1))
    assert np.linalg.norm(shape.vertices.reshape(50, 3, 3) - centres[:, None], axis=2).max() <= 0.2 + 1e-9


def test_caps_close_a_loft():
    ring = np.array([[0, 0, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1]], float)
    sections = ring + np.array([[[0, 0, 0]], [[1, 0, 0]], [[2, 0, 0]]])
    assert open_edges(loft(sections, 1, closed=True)) > 0
    assert open_edges(loft(sections, 1, closed=True, caps=1)) == 0
