"""Regions of interest: which points lie within polygons, such as the roads of a map, by a bitmap seen from above.

Polygons are drawn once, by the even-odd rule along each row of cells; a point is then one look-up. Where it must be
exact, only the points of cells that a border passes through are held against the polygons themselves.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .arguments import real, reals, several, table
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["PolygonMask", "in_polygons"]

# On which side of a border a point lies must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_OUTSIDE, _INSIDE, _BORDER = (wp.constant(wp.uint8(i)) for i in range(3))
_BITS = wp.constant(32)  # polygons that are drawn at once, each as one bit
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_PAD = wp.constant(wp.float64(1e-6))  # of a cell: more than rounding moves a point or a border


@wp.struct
class _Area:
    x: wp.float64
    y: wp.float64
    cells_per_metre: wp.float64
    rows: int
    columns: int
    height: wp.float64  # in cells
    width: wp.float64


@wp.func
def _in_cells(edge: wp.vec4d, area: _Area) -> wp.vec4d:
    """An edge from metres to cells."""
    return wp.vec4d(
        (edge[0] - area.x) * area.cells_per_metre,
        (edge[1] - area.y) * area.cells_per_metre,
        (edge[2] - area.x) * area.cells_per_metre,
        (edge[3] - area.y) * area.cells_per_metre,
    )


@wp.func
def _cell_along(place: wp.float64, cells: int) -> int:
    """The cell at a place, of those before the first and after the last the outermost."""
    return int(wp.floor(wp.clamp(place, wp.float64(0.0), wp.float64(cells - 1))))


@wp.func
def _is_crossed(a: wp.vec4d, x: wp.float64, y: wp.float64) -> bool:
    """Whether an edge crosses the ray from a place towards lower y."""
    if (a[0] <= x) == (a[2] <= x):
        return False
    return a[1] + (x - a[0]) / (a[2] - a[0]) * (a[3] - a[1]) <= y


@wp.kernel
def _toggle_rows(
    # in
    edges_in: wp.array(dtype=wp.vec4d),
    polygon_in: wp.array(dtype=wp.int32),
    edge_count_in: wp.array(dtype=wp.int32),
    area: _Area,
    first_polygon: int,
    # in out: zero
    toggles: wp.array2d(dtype=wp.uint32),
):
    """An edge toggles its polygon from the first cell on whose centre is behind it, in each row whose centre it meets.

    Which edge comes first does not matter: toggling commutes.
    """
    e = wp.tid()
    if e >= edge_count_in[0]:
        return
    bit = polygon_in[e] - first_polygon
    if bit < 0 or bit >= _BITS:
        return
    a = _in_cells(edges_in[e], area)
    if wp.max(a[0], a[2]) < wp.float64(0.0) or wp.min(a[0], a[2]) > area.height:
        return
    last = _cell_along(wp.max(a[0], a[2]), area.rows)
    for row in range(_cell_along(wp.min(a[0], a[2]), area.rows), last + 1):
        x = wp.float64(row) + _HALF
        if (a[0] <= x) != (a[2] <= x):
            y = a[1] + (x - a[0]) / (a[2] - a[0]) * (a[3] - a[1])
            if y <= area.width:
                column = int(wp.ceil(wp.max(y - _HALF, wp.float64(0.0))))
                if column < area.columns:
                    wp.atomic_xor(toggles, row, column, wp.uint32(1) << wp.uint32(bit))


@wp.kernel
def _fill_rows(
    first_polygon: int,
    # in out: toggles are left zero
    toggles: wp.array2d(dtype=wp.uint32),
    bitmap: wp.array2d(dtype=wp.uint8),
):
    """One row a thread: a cell is inside where any polygon has been toggled an odd number of times."""
    row = wp.tid()
    inside = wp.uint32(0)
    for column in range(bitmap.shape[1]):
        toggle = toggles[row, column]
        if toggle != wp.uint32(0):
            inside = inside ^ toggle
            toggles[row, column] = wp.uint32(0)
        if inside != wp.uint32(0):
            bitmap[row, column] = _INSIDE
        elif first_polygon == 0:
            bitmap[row, column] = _OUTSIDE


@wp.kernel
def _mark_borders(
    # in
    edges_in: wp.array(dtype=wp.vec4d),
    edge_count_in: wp.array(dtype=wp.int32),
    area: _Area,
    # in out
    bitmap: wp.array2d(dtype=wp.uint8),
):
    """Marks every cell that an edge passes through or touches."""
    e = wp.tid()
    if e >= edge_count_in[0]:
        return
    a = _in_cells(edges_in[e], area)
    low = wp.min(a[0], a[2])
    high = wp.max(a[0], a[2])
    if high < -_PAD or low > area.height + _PAD:
        return
    for row in range(_cell_along(low - _PAD, area.rows), _cell_along(high + _PAD, area.rows) + 1):
        begin = wp.max(wp.float64(row) - _PAD, low)
        end = wp.min(wp.float64(row) + _ONE + _PAD, high)
        y0 = a[1]
        y1 = a[3]
        if a[0] != a[2]:
            slope = (a[3] - a[1]) / (a[2] - a[0])
            y0 = a[1] + (begin - a[0]) * slope
            y1 = a[1] + (end - a[0]) * slope
        left = wp.max(wp.min(y0, y1), wp.min(a[1], a[3])) - _PAD
        right = wp.min(wp.max(y0, y1), wp.max(a[1], a[3])) + _PAD
        if right >= wp.float64(0.0) and left <= area.width:
            for column in range(_cell_along(left, area.columns), _cell_along(right, area.columns) + 1):
                bitmap[row, column] = _BORDER


@wp.func
def _is_in_any(
    x: wp.float64, y: wp.float64, edges: wp.array(dtype=wp.vec4d), polygon: wp.array(dtype=wp.int32), count: int
) -> bool:
    """Whether a place is within a polygon by the even-odd rule; edges are in the order of their polygons."""
    current = int(-1)
    odd = bool(False)
    for e in range(count):
        if polygon[e] != current:
            if odd:
                return True
            current = polygon[e]
            odd = False
        if _is_crossed(edges[e], x, y):
            odd = not odd
    return odd


@wp.kernel
def _look_up(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    bitmap_in: wp.array2d(dtype=wp.uint8),
    edges_in: wp.array(dtype=wp.vec4d),
    polygon_in: wp.array(dtype=wp.int32),
    edge_count_in: wp.array(dtype=wp.int32),
    area: _Area,
    # out
    inside_out: wp.array(dtype=wp.bool),
):
    i = wp.tid()
    inside = bool(False)
    if i < count_in[0]:
        p = xyz_in[i]
        x = (wp.float64(p[0]) - area.x) * area.cells_per_metre
        y = (wp.float64(p[1]) - area.y) * area.cells_per_metre
        # Written so that NaN is outside.
        if x >= wp.float64(0.0) and y >= wp.float64(0.0) and x < area.height and y < area.width:
            cell = bitmap_in[wp.min(int(x), area.rows - 1), wp.min(int(y), area.columns - 1)]
            inside = cell == _INSIDE
            if cell == _BORDER:
                inside = _is_in_any(wp.float64(p[0]), wp.float64(p[1]), edges_in, polygon_in, edge_count_in[0])
    inside_out[i] = inside


@dataclass(frozen=True, kw_only=True)
class PolygonMask:
    """A plan: a bitmap of polygons, and room for clouds of up to `capacity` points.

    `set_polygons` draws, `launch` looks up; `launch` allocates nothing and reads nothing back.
    """

    capacity: int
    """Points that one launch can take."""
    point_range: tuple[float, ...]
    """xmin ymin xmax ymax [m] of the bitmap; what lies beyond is outside; upper bounds open."""
    cell: float = 0.2
    """Side of a cell [m]."""
    exact: bool = False
    """Whether points near a border are held against the polygons; else a point is what its cell's centre is."""
    max_vertices: int = 1024
    """Vertices of all polygons that `set_polygons` can take."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    bitmap: wp.array = field(init=False, repr=False, compare=False)
    """Of the polygons: 0 outside, 1 inside and, where `exact`, 2 on a border, shape (rows, columns), uint8; rows
    rise with x, columns with y."""
    inside: wp.array = field(init=False, repr=False, compare=False)
    """Out: whether a point is within a polygon, shape (capacity,), bool; as many set as points were given."""

    def __post_init__(self):
        for name in ("capacity", "max_vertices"):
            if not 1 <= getattr(self, name) < 2**31:
                raise ValueError(f"{name} must be at least 1 and below 2³¹, not {getattr(self, name)}")
        if not (self.cell > 0 and math.isfinite(self.cell)):
            raise ValueError(f"cell must be a positive number of metres, not {self.cell}")
        limits = self.point_range
        if len(limits) != 4 or not all(
            a < b and math.isfinite(b - a) for a, b in zip(limits[:2], limits[2:], strict=True)
        ):
            raise ValueError(f"point_range must be xmin ymin xmax ymax, finite, with min < max, not {limits}")
        area = _Area()
        area.x, area.y, area.cells_per_metre = limits[0], limits[1], 1.0 / self.cell
        area.height, area.width = ((limits[i + 2] - limits[i]) / self.cell for i in (0, 1))
        if area.height * area.width > 2**30:
            raise ValueError(f"cell {self.cell} m cuts point_range {limits} into more than 2³⁰ cells")
        area.rows, area.columns = max(math.ceil(area.height - 1e-9), 1), max(math.ceil(area.width - 1e-9), 1)
        device = resolve_device(self.device)

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_area", area)
        keep("_edges", wp.zeros(self.max_vertices, dtype=wp.vec4d, device=device))
        keep("_polygon", wp.zeros(self.max_vertices, dtype=wp.int32, device=device))
        keep("_edge_count", wp.zeros(1, dtype=wp.int32, device=device))
        keep("_toggles", wp.zeros((area.rows, area.columns), dtype=wp.uint32, device=device))
        keep("_drawn", np.zeros((0, 5)))
        keep("bitmap", wp.zeros((area.rows, area.columns), dtype=wp.uint8, device=device))
        keep("inside", wp.zeros(self.capacity, dtype=wp.bool, device=device))

    def set_polygons(self, polygons: Sequence[Any]) -> None:
        """Draws the polygons that later launches test for; a copy to the device, not for a captured graph.

        Args:
            polygons: As `in_polygons` takes them. The same ones again cost nothing but to compare them.

        Raises:
            ValueError: A shape or a number does not fit; the message says which.
        """
        self._draw(_edges_of(polygons))

    def _draw(self, edges: np.ndarray) -> None:
        """Draws edges and the numbers of their polygons, shape (e, 5)."""
        n = len(edges)
        if n > self.max_vertices:
            raise ValueError(f"polygons have {n} vertices, more than the plan's max_vertices of {self.max_vertices}")
        if np.array_equal(edges, self._drawn):
            return
        object.__setattr__(self, "_drawn", edges)
        if n:
            self._edges[:n].assign(edges[:, :4])
            self._polygon[:n].assign(edges[:, 4].astype(np.int32))
        self._edge_count.assign(np.array([n], np.int32))
        self.bitmap.zero_()
        for first in range(0, int(edges[-1, 4]) + 1 if n else 0, _BITS):
            wp.launch(
                _toggle_rows,
                n,
                inputs=[self._edges, self._polygon, self._edge_count, self._area, first, self._toggles],
                device=self.device,
            )
            wp.launch(_fill_rows, self._area.rows, inputs=[first, self._toggles, self.bitmap], device=self.device)
        if self.exact:
            wp.launch(
                _mark_borders, n, inputs=[self._edges, self._edge_count, self._area, self.bitmap], device=self.device
            )

    def launch(self, xyz: wp.array, count: wp.array) -> None:
        """Fills `inside` for the first `count[0]` points; the others are outside.

        Args:
            xyz: Positions [m], shape (n,), vec3, n ≤ capacity.
            count: Shape (1,), int32.
        """
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        self._look_up_into(self.inside, xyz, count)

    def _look_up_into(self, inside: wp.array, xyz: wp.array, count: wp.array) -> None:
        edges = [self._edges, self._polygon, self._edge_count]
        wp.launch(
            _look_up,
            xyz.shape[0],
            inputs=[xyz, count, self.bitmap, *edges, self._area],
            outputs=[inside],
            device=self.device,
        )


def _rings(polygon: Any) -> Iterator[np.ndarray]:
    """The rings of a polygon: it is one itself, or a sequence of them."""
    if not isinstance(polygon, np.ndarray):
        polygon = several(polygon, "polygons")
    for ring in [polygon] if len(polygon) and np.ndim(polygon[0]) == 1 else polygon:
        ring = table(ring, "polygons")
        if ring.ndim != 2 or ring.shape[1] != 2 or len(ring) < 3:
            raise ValueError(f"polygons must be of rings of shape (k, 2), 3 vertices or more, not {ring.shape}")
        if not np.isfinite(ring).all():
            raise ValueError("polygons must be finite: a vertex is NaN or infinite")
        yield ring


def _edges_of(polygons: Sequence[Any]) -> np.ndarray:
    """From each vertex to the next of its ring, and the number of its polygon, shape (e, 5)."""
    edges = [
        np.column_stack([ring, np.roll(ring, -1, axis=0), np.full(len(ring), number)])
        for number, polygon in enumerate(several(polygons, "polygons"))
        for ring in _rings(polygon)
    ]
    return np.concatenate(edges) if edges else np.zeros((0, 5))


def in_polygons(
    points: Any, polygons: Sequence[Any], point_range: Sequence[float], cell: float = 0.2, *, exact: bool = False
) -> Any:
    """Tells which points lie within any of some polygons, seen from above.

    Args:
        points: Positions [m], shape (n, 3 or more), floating.
        polygons: Each a ring of vertices, shape (k, 2), x y [m], closed or not, or, as in GeoJSON, a sequence of
            rings, the outer one and its holes. Within a polygon the even-odd rule holds; polygons may overlap.
        point_range: xmin ymin xmax ymax [m]; points beyond are outside whatever the polygons say.
        cell: Side of a cell of the bitmap [m].
        exact: By default a point counts as inside where the centre of its cell is, which errs only within a cell's
            half diagonal of a border; exact, the points of cells with a border are held against the polygons.

    Returns:
        Shape (n,), bool, of the family and on the device of `points`. A point that is not finite is outside.

    Raises:
        TypeError: `points` is not a floating array.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    edges = _edges_of(polygons)
    plan = plan_for(
        PolygonMask,
        capacity=1 if borrowed.device == DEFAULT_DEVICE else capacity_for(n),
        point_range=reals(point_range, "point_range"),
        cell=real(cell, "cell"),
        exact=bool(exact),
        max_vertices=capacity_for(len(edges)),
        device=borrowed.device,
    )
    plan._draw(edges)
    count = count_on(n, borrowed.device)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(borrowed.xyz, count)
        return give(plan.inside[:n], borrowed.family)
    host = np.empty(n, bool)
    plan._look_up_into(wp.array(host, dtype=wp.bool, copy=False, device=DEFAULT_DEVICE), borrowed.xyz, count)
    return adopt(host, borrowed.family)
