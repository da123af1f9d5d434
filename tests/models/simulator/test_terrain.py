"""The ground: its heights, its triangles and its coordinates agree."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.raycast import raycast
from warploom.models.simulator.labels import PointClass
from warploom.models.simulator.terrain import street_ground


def ground(seed=0, curvature=0.0):
    return street_ground(
        np.random.default_rng(seed), extent=(-60, 60), half_width=4.0, sidewalk=2.0, crossings=[(15.0, 3.0)],
        curvature=curvature,
    )  # fmt: skip


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.006, 0.006), st.floats(-100, 100), st.floats(-70, 70))
def test_street_coordinates_come_back(curvature, s, d):
    field = ground(curvature=curvature)
    x, y, _ = field.to_world(np.array([s]), np.array([d]))
    back = field.to_street(x, y)
    assert np.allclose([back[0][0], back[1][0]], [s, d], atol=1e-6)


@pytest.mark.parametrize("curvature", [0.0, 0.004, -0.004])
def test_heights_are_those_of_the_triangles(curvature):
    # On a bent street the triangles are chords of the grid: a centimetre or two on curbs and verges.
    field = ground(1, curvature)
    random = np.random.default_rng(2)
    s, d = random.uniform(-50, 50, 2000), random.uniform(-40, 40, 2000)
    x, y, _ = field.to_world(s, d)
    vertices, faces, _ = field.mesh()
    above = np.stack([x, y, np.full_like(x, 50.0)], 1).astype(np.float32)
    down = np.tile(np.array([[0, 0, -1]], np.float32), (len(above), 1))
    hits = raycast(vertices.astype(np.float32), faces, above, down)
    error = np.abs(50.0 - hits.distance - field.height(s, d))
    assert np.isfinite(error).all()
    assert np.percentile(error, 98) < (1e-4 if curvature == 0 else 0.02)


def test_the_curb_is_a_step_between_road_and_sidewalk():
    field = ground(3)
    s = np.linspace(-40, -20, 50)
    step = field.height(s, np.full(50, 4.05)) - field.height(s, np.full(50, 3.95))
    assert 0.04 < step.mean() < 0.2
    # No curb where the side street comes in.
    step = field.height(np.full(5, 15.0), np.full(5, 4.05)) - field.height(np.full(5, 15.0), np.full(5, 3.95))
    assert np.abs(step).max() < 0.03


def test_cells_have_the_classes_of_a_street():
    field = ground(4)
    sc, dc = 0.5 * (field.s[1:] + field.s[:-1]), 0.5 * (field.d[1:] + field.d[:-1])
    classes = field.labels // 256
    away = np.abs(sc - 15) > 8
    assert (classes[np.ix_(away, np.abs(dc) < 3.9)] == PointClass.ROAD).all()
    assert (classes[np.ix_(away, (np.abs(dc) > 4.1) & (np.abs(dc) < 5.9))] == PointClass.SIDEWALK).all()
    assert (classes[np.ix_(np.abs(sc - 15) < 2.5, np.abs(dc) > 10)] == PointClass.ROAD).all()
    assert (classes == PointClass.TERRAIN).any()


def test_slopes_are_those_of_the_heights():
    field = ground(5)
    along, across = field.slope(np.array([0.0]), np.array([0.0]))
    assert abs(along[0]) < 0.12
    assert abs(across[0]) < 0.12


def test_banks_leave_the_street_and_its_side_streets_as_they_are():
    arguments = {"extent": (-60, 60), "half_width": 4.0, "sidewalk": 2.0, "crossings": [(15.0, 3.0)]}
    rough = 0
    for seed in range(6):
        flat, banked = (street_ground(np.random.default_rng(seed), banks=banks, **arguments) for banks in (False, True))
        s, d = np.meshgrid(flat.s, flat.d, indexing="ij")
        paved = (np.abs(d) <= 6.0) | (np.abs(s - 15.0) <= 5.0)
        np.testing.assert_array_equal(banked.z[paved], flat.z[paved])
        rough += np.abs(banked.z - flat.z).max() > 0.5
    assert rough >= 3
