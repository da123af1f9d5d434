"""Points in polygons against shapely."""

import numpy as np
import pytest
import shapely
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from warploom.kernels.roi import PolygonMask, in_polygons

RANGE = (-40.0, -30.0, 40.0, 30.0)


def star(rng, spread=25.0, size=12.0):
    """A polygon around a place, of vertices at rising angles, so that it does not cross itself."""
    k = rng.integers(3, 14)
    angle = np.sort(rng.uniform(0, 2 * np.pi, k))
    return rng.uniform(-spread, spread, 2) + np.column_stack([np.cos(angle), np.sin(angle)]) * rng.uniform(
        0.2 * size, size, (k, 1)
    )


def with_hole(rng):
    """A polygon of an outer ring and a smaller copy of it as its hole."""
    outer = star(rng)
    return [outer, outer.mean(axis=0) + 0.4 * (outer - outer.mean(axis=0))]


def exact(points, polygons):
    """Shapely's answer, for each polygon by symmetric difference of its rings."""
    inside = np.zeros(len(points), bool)
    xy = points[:, :2].astype(np.float64)
    finite = np.isfinite(xy).all(axis=1)
    for polygon in polygons:
        odd = np.zeros(len(points), bool)
        for ring in polygon if isinstance(polygon, list) else [polygon]:
            odd[finite] ^= shapely.contains_xy(shapely.Polygon(ring), xy[finite])
        inside |= odd
    low, high = np.array(RANGE[:2]), np.array(RANGE[2:])
    return inside & ((xy >= low) & (xy < high)).all(axis=1)


def border_distance(points, polygons):
    rings = [ring for polygon in polygons for ring in (polygon if isinstance(polygon, list) else [polygon])]
    lines = shapely.MultiLineString([shapely.LinearRing(ring) for ring in rings])
    return shapely.distance(lines, shapely.points(points[:, :2].astype(np.float64)))


def cloud(n, seed):
    return np.random.default_rng(seed).uniform([-45, -35, -2], [45, 35, 2], (n, 3)).astype(np.float32)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 70), st.sampled_from([0.2, 1.0, 7.3]))
def test_exact_equals_shapely(seed, count, cell):
    """Any number of polygons, with holes or not, overlapping or not, in the range or not."""
    rng = np.random.default_rng(seed)
    polygons = [with_hole(rng) if rng.random() < 0.3 else star(rng) for _ in range(count)]
    points = cloud(2000, seed)
    assert np.array_equal(in_polygons(points, polygons, RANGE, cell, exact=True), exact(points, polygons))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from([0.1, 0.2, 1.0]))
def test_the_bitmap_errs_only_within_half_a_diagonal_of_a_border(seed, count, cell):
    rng = np.random.default_rng(seed)
    polygons = [with_hole(rng) if rng.random() < 0.3 else star(rng) for _ in range(count)]
    points = cloud(2000, seed)
    inside = in_polygons(points, polygons, RANGE, cell)
    differs = inside != exact(points, polygons)
    assert (border_distance(points[differs], polygons) <= cell * np.sqrt(0.5) + 1e-4).all()


def test_the_bitmap_is_what_shapely_says_of_the_centres():
    polygons = [with_hole(np.random.default_rng(1)), star(np.random.default_rng(2))]
    plan = PolygonMask(capacity=16, point_range=RANGE, cell=0.5)
    plan.set_polygons(polygons)
    x, y = np.meshgrid(np.arange(-39.75, 40, 0.5), np.arange(-29.75, 30, 0.5), indexing="ij")
    centres = np.column_stack([x.ravel(), y.ravel()])
    assert np.array_equal(plan.bitmap.numpy().ravel() == 1, exact(centres, polygons))


def test_a_polygon_that_covers_all():
    box = np.array([[-100, -100], [100, -100], [100, 100], [-100, 100.0]])
    for choice in (False, True):
        assert np.array_equal(in_polygons(cloud(1000, 1), [box], RANGE, exact=choice), exact(cloud(1000, 1), [box]))


def test_edges_along_the_cells():
    """A rectangle on cell borders holds its low sides and not its high ones, as point_range does."""
    box = [(0, 0), (2, 0), (2, 1), (0, 1)]
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(-1, 4, 0.5), np.arange(-1, 3, 0.5)))
    points = np.column_stack([x, y, 0 * x]).astype(np.float32)
    expected = (x >= 0) & (x < 2) & (y >= 0) & (y < 1)
    for choice in (False, True):
        assert np.array_equal(in_polygons(points, [box], (-1, -1, 4, 3), 0.5, exact=choice), expected)


def test_overlapping_polygons_unite_and_rings_of_one_polygon_take_turns():
    box = np.array([[0, 0], [4, 0], [4, 4], [0, 4.0]])
    inner = box / 2 + 1
    points = np.float32([[2, 2, 0], [0.5, 0.5, 0], [5, 5, 0]])
    assert in_polygons(points, [box, inner], RANGE).tolist() == [True, True, False]
    assert in_polygons(points, [[box, inner]], RANGE).tolist() == [False, True, False]


def test_a_closed_ring_is_the_same_as_an_open_one():
    ring = star(np.random.default_rng(5))
    closed = np.vstack([ring, ring[:1]])
    points = cloud(1000, 5)
    assert np.array_equal(in_polygons(points, [ring], RANGE), in_polygons(points, [closed], RANGE))


def test_degenerate_input():
    """No polygon, no point, polygons without area, points that are not finite or far away."""
    ring = star(np.random.default_rng(6))
    points = cloud(100, 6)
    points[:4, 0] = np.nan, np.inf, -np.inf, 1e5
    points[4], points[5] = 1e30, 1e-45
    for choice in (False, True):
        assert not in_polygons(points, [], RANGE, exact=choice).any()
        assert in_polygons(np.zeros((0, 3), np.float32), [ring], RANGE, exact=choice).shape == (0,)
        assert not in_polygons(points, [[(0, 0), (5, 5), (10, 10)], [(1, 1)] * 3], RANGE, exact=choice).any()
        far = [ring * 1e9, ring + 1e7, ring * 1e-40]
        answer = in_polygons(points, far, RANGE, exact=choice)
        assert np.array_equal(answer[6:], exact(points, far)[6:])
        assert not answer[:5].any()


def test_any_layout_of_the_input():
    polygons, points = [star(np.random.default_rng(7))], cloud(500, 7)
    expected = in_polygons(points, polygons, RANGE)
    frozen = points.copy()
    frozen.setflags(write=False)
    for given_points in (frozen, np.asfortranarray(points), points.astype(np.float64), np.repeat(points, 2, 0)[::2]):
        assert np.array_equal(in_polygons(given_points, polygons, RANGE), expected)
    as_lists = [ring.tolist() for ring in polygons]
    assert np.array_equal(in_polygons(points, as_lists, RANGE), expected)


def test_arrays_of_other_families():
    import torch

    polygons, points = [star(np.random.default_rng(8))], cloud(500, 8)
    expected = in_polygons(points, polygons, RANGE)
    inside = in_polygons(torch.from_numpy(points), polygons, RANGE)
    assert inside.dtype == torch.bool
    assert np.array_equal(inside.numpy(), expected)
    inside = in_polygons(wp.array(points, dtype=wp.float32, device="cpu"), polygons, RANGE)
    assert np.array_equal(inside.numpy(), expected)


def test_the_plan_reads_its_count_and_forgets_earlier_polygons(device):
    rng = np.random.default_rng(9)
    points = cloud(1000, 9)
    plan = PolygonMask(capacity=1024, point_range=RANGE, exact=True, device=device)
    xyz = wp.array(points, dtype=wp.vec3, device=device)
    for polygons, n in (([star(rng) for _ in range(40)], 1000), ([with_hole(rng)], 300), ([], 300)):
        plan.set_polygons(polygons)
        for _ in range(2):
            plan.launch(xyz, wp.array([n], dtype=wp.int32, device=device))
            inside = plan.inside.numpy()[:1000]
            assert np.array_equal(inside[:n], exact(points[:n], polygons))
            assert not inside[n:].any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"polygons": [np.zeros((2, 2))]}, "polygons must be of rings"),
        ({"polygons": [np.zeros((4, 3))]}, "polygons must be of rings"),
        ({"polygons": [np.full((4, 2), np.nan)]}, "polygons must be finite"),
        ({"point_range": (0, 0, 1)}, "point_range must be"),
        ({"point_range": (0, 0, 1, 0)}, "point_range must be"),
        ({"point_range": (0, 0, 1, np.inf)}, "point_range must be"),
        ({"cell": 0}, "cell must be"),
        ({"cell": np.nan}, "cell must be"),
        ({"cell": 1e-5}, "more than 2³⁰ cells"),
    ],
)
def test_wrong_arguments_are_refused(change, message):
    arguments = {"polygons": [np.eye(3)[:, :2]], "point_range": (0.0, 0.0, 4.0, 4.0), **change}
    with pytest.raises(ValueError, match=message):
        in_polygons(np.zeros((5, 3), np.float32), **arguments)


def test_more_vertices_than_the_plan_takes_are_refused():
    with pytest.raises(ValueError, match="max_vertices"):
        PolygonMask(capacity=1, point_range=RANGE, max_vertices=2).set_polygons([np.eye(3)[:, :2]])
