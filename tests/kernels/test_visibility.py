"""Visible shares against what the geometry says: walls that hide a known part of a plate."""

import numpy as np
import pytest

from warploom.kernels.meshes import MeshSet
from warploom.kernels.raycast import MATERIALS, LidarCast
from warploom.kernels.visibility import visible_shares

PLATE = np.array([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], np.float32)
PLAIN, GHOST = 1, 2


def at(x, y=0.0, scale=1.0):
    transform = np.diag([scale, scale, scale, 1.0])
    transform[:2, 3] = x, y
    return transform


def shares(transforms, labels, motion=None, **options):
    meshes = MeshSet("cpu", max_faces=100)
    for label in (PLAIN, GHOST):
        meshes.add(PLATE, np.array([[0, 1, 2], [0, 2, 3]]), np.full(2, label))
    cast = LidarCast(meshes=meshes, beams=np.eye(3), ring=np.zeros(3), time=np.zeros(3), max_range=60.0)
    table = np.zeros((MATERIALS, 6), np.float32)
    table[GHOST, 1] = 1.0
    cast.set_materials(table)
    cast.place(np.array(labels) - 1, np.array(transforms), motion)
    cast.aim(np.eye(4))
    targets = np.zeros((1, 400, 3))
    targets[0, :, 1:] = np.random.default_rng(0).uniform(-0.99, 0.99, (400, 2))
    return visible_shares(cast, np.zeros(3), np.array([len(labels) - 1]), targets, **options)[0]


def test_nothing_before_it_hides_nothing_and_a_wall_hides_all():
    assert shares([at(-5), at(20)], [PLAIN, PLAIN]) == 1.0
    assert shares([at(10, scale=2.0), at(20)], [PLAIN, PLAIN]) == 0.0
    assert shares([at(30), at(20)], [PLAIN, PLAIN]) == 1.0


def test_a_wall_over_a_part_hides_that_part():
    # A plate of ± 1 m at 10 m, 1.25 m to the left, shades y from 0.5 to 4.5 m at 20 m: a quarter of ± 1 m.
    # 400 points: ± 6 %.
    assert shares([at(10, 1.25), at(20)], [PLAIN, PLAIN]) == pytest.approx(0.75, abs=0.06)


def test_what_lets_beams_through_hides_nothing():
    assert shares([at(10, scale=2.0), at(20)], [GHOST, PLAIN]) == 1.0


def test_it_is_seen_where_it_is_at_that_time_and_within_range():
    motion = np.array([[0, 0, 0, 0], [0, 4.0, 0, 0.3]])
    # At the start straight behind the wall; after the sweep 4 m to the left, where the wall's shadow has ended.
    assert shares([at(10), at(20)], [PLAIN, PLAIN], motion, fraction=0.0) == 0.0
    assert shares([at(10), at(20)], [PLAIN, PLAIN], motion, fraction=1.0) == 1.0
    assert shares([at(-5), at(80)], [PLAIN, PLAIN]) == 0.0


def test_shapes_that_do_not_fit_are_refused():
    meshes = MeshSet("cpu", max_faces=10)
    meshes.add(PLATE, np.array([[0, 1, 2]]), np.full(1, PLAIN))
    cast = LidarCast(meshes=meshes, beams=np.eye(3), ring=np.zeros(3), time=np.zeros(3))
    cast.place(np.zeros(1, int), np.eye(4)[None])
    with pytest.raises(ValueError, match="targets must be"):
        visible_shares(cast, np.zeros(3), np.zeros(2, int), np.zeros((1, 5, 3)))
    assert len(visible_shares(cast, np.zeros(3), np.zeros(0, int), np.zeros((0, 5, 3)))) == 0
