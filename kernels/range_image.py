"""Range images: a cloud as its sensor saw it, one row per laser and one column per step of the turn.

The picture of RangeNet++ (Milioto et al., IROS 2019): the top row is the highest laser, the middle column looks
straight ahead, columns run clockwise seen from above. Float32 tells the pixel of almost every point; the few near the
edge of one are told by float64 products, so that the pixels are those of exact angles, alike on every device.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow, borrow_points, count_on, give
from .plan import capacity_for, plan_for

__all__ = ["RangeImage", "RangeProjection", "range_image"]

# Which pixel a point falls into must not hang on whether a compiler fuses a multiplication with an addition.
wp.set_module_options({"fuse_fp": False})

_RANGE, _X, _Y, _Z, _INTENSITY = (wp.constant(i) for i in range(5))
_EMPTY = wp.constant(wp.int64(2**63 - 1))
_INDEX_BITS = wp.constant(wp.int64(32))
_INDEX_MASK = wp.constant(wp.int64(0x7FFFFFFF))
_OUTSIDE = wp.constant(-1)  # the row above the image; bins that hold less have an edge in them,
_SEARCH_FROM = wp.constant(-3)  # and the row above it is this less what they hold
_SINE_SLACK = 1e-6  # more than float32 errs in the sine of an elevation
_TURN_SLACK = 2e-6  # and in the share of a turn
_BINS_PER_ROW = 32
_MOST_COLUMNS = 1 << 16


@wp.struct
class _View:
    rows: int
    columns: int
    top_sine: float
    bins_per_sine: float
    place_slack: float


@wp.func
def _share_of_turn(ratio: float) -> float:
    """The arc tangent of 0 … 1 over 2π, within 6e-7."""
    square = ratio * ratio
    fourth = square * square
    low = 0.15915423 - 0.052996794 * square
    middle = 0.031129001 - 0.019275236 * square
    high = 0.0091244903 - 0.0021362182 * square
    return ratio * (low + fourth * (middle + fourth * high))


@wp.func
def _column_of(x: float, y: float, edges: wp.array(dtype=wp.vec2d), view: _View) -> int:
    """The column of a direction, counted clockwise from straight behind."""
    wide = wp.max(wp.abs(x), wp.abs(y))
    turn = _share_of_turn(wp.where(wide > 0.0, wp.min(wp.abs(x), wp.abs(y)) / wide, 0.0))
    turn = wp.where(wp.abs(y) > wp.abs(x), 0.25 - turn, turn)
    turn = wp.where(x < 0.0, 0.5 - turn, turn)
    place = wp.where(y < 0.0, 0.5 + turn, 0.5 - turn) * float(view.columns)
    column = int(place)
    edge = int(place + 0.5)
    if wp.abs(place - float(edge)) < view.place_slack:
        ray = edges[edge]
        column = edge
        if ray[0] * wp.float64(y) > ray[1] * wp.float64(x):  # counter-clockwise of the edge
            column = edge - 1
        column = (column + view.columns) % view.columns
    return column


@wp.func
def _row_of(
    p: wp.vec3,
    distance: float,
    sines: wp.array(dtype=wp.float64),
    row_of_bin: wp.array(dtype=wp.int32),
    view: _View,
) -> int:
    """The row whose upper edge is at or above a point and whose lower edge is below it; -1 and `rows` are outside."""
    bin = int((view.top_sine - p[2] / distance) * view.bins_per_sine)
    row = row_of_bin[wp.clamp(bin, 0, row_of_bin.shape[0] - 1)]
    if row < _OUTSIDE:
        row = _SEARCH_FROM - row
        x = wp.float64(p[0])
        y = wp.float64(p[1])
        z = wp.float64(p[2])
        exact = wp.sqrt(x * x + y * y + z * z)
        while row < view.rows and z <= sines[row + 1] * exact:
            row += 1
    return row


@wp.kernel
def _find_rows(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    ring_in: wp.array(dtype=wp.uint16),
    count_in: wp.array(dtype=wp.int32),
    sines_in: wp.array(dtype=wp.float64),
    row_of_bin_in: wp.array(dtype=wp.int32),
    view: _View,
    # out
    row_out: wp.array(dtype=wp.int32),
    distance_out: wp.array(dtype=wp.float32),
):
    """The row of each point, -1 outside the image, and its range. Apart from columns: a CPU is faster so."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    p = xyz_in[i]
    distance = wp.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
    row = int(_OUTSIDE)
    # Written so that NaN is nowhere.
    if distance > 0.0 and distance < float(wp.inf):
        if ring_in:
            row = view.rows - 1 - int(ring_in[i])
        else:
            row = _row_of(p, distance, sines_in, row_of_bin_in, view)
    row_out[i] = wp.where(row < view.rows, row, _OUTSIDE)
    distance_out[i] = distance


@wp.kernel
def _find_nearest(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    count_in: wp.array(dtype=wp.int32),
    row_in: wp.array(dtype=wp.int32),
    distance_in: wp.array(dtype=wp.float32),
    edges_in: wp.array(dtype=wp.vec2d),
    view: _View,
    # in out: `_EMPTY` where there is none
    nearest: wp.array(dtype=wp.int64),
):
    """Per pixel the nearest point, the first of equals."""
    i = wp.tid()
    if i >= count_in[0]:
        return
    row = row_in[i]
    if row <= _OUTSIDE:
        return
    p = xyz_in[i]
    pixel = row * view.columns + _column_of(p[0], p[1], edges_in, view)
    # The bits of a positive float are in the order of its value.
    wp.atomic_min(nearest, pixel, (wp.int64(wp.cast(distance_in[i], wp.int32)) << _INDEX_BITS) | wp.int64(i))


@wp.kernel
def _draw_pixels(
    # in
    xyz_in: wp.array(dtype=wp.vec3),
    intensity_in: wp.array(dtype=wp.float32),
    # in out: left empty
    nearest: wp.array(dtype=wp.int64),
    # out
    channels_out: wp.array2d(dtype=wp.float32),
    index_out: wp.array(dtype=wp.int32),
):
    """Each pixel takes its point, and clears the workspace."""
    pixel = wp.tid()
    key = nearest[pixel]
    index = int(-1)
    distance = float(0.0)
    p = wp.vec3(0.0)
    intensity = float(0.0)
    if key != _EMPTY:
        nearest[pixel] = _EMPTY
        index = int(key & _INDEX_MASK)
        distance = wp.cast(int(key >> _INDEX_BITS), wp.float32)
        p = xyz_in[index]
        if intensity_in:
            intensity = intensity_in[index]
    channels_out[_RANGE, pixel] = distance
    channels_out[_X, pixel] = p[0]
    channels_out[_Y, pixel] = p[1]
    channels_out[_Z, pixel] = p[2]
    channels_out[_INTENSITY, pixel] = intensity
    index_out[pixel] = index


@dataclass(frozen=True, kw_only=True)
class RangeProjection:
    """A plan: workspace for clouds of up to `capacity` points; `launch` allocates nothing and reads nothing back."""

    capacity: int
    """Points that one launch can take."""
    shape: tuple[int, int]
    """Rows, one per laser, and columns, one per step of the turn."""
    vertical_fov: tuple[float, float] = (-25.0, 3.0)
    """Elevation of the lower and the upper edge of the image [deg]; rows are of even height between them."""
    elevations: tuple[float, ...] | None = None
    """Elevation of each laser, lowest first [deg], rows of them; each row then reaches half way to its neighbours,
    and `vertical_fov` does not matter. None for even rows."""
    device: str = DEFAULT_DEVICE
    """A Warp device, such as `cpu` or `cuda:0`."""

    channels: wp.array = field(init=False, repr=False, compare=False)
    """Out: range, x, y, z [m] and intensity, shape (5, rows, columns), float32; zero where there is no point."""
    index: wp.array = field(init=False, repr=False, compare=False)
    """Out: which point a pixel shows, shape (rows, columns), int32; -1 where there is none."""

    def __post_init__(self):
        if not 1 <= self.capacity < 2**31:
            raise ValueError(f"capacity must be 1 to 2³¹ − 1 points, not {self.capacity}")
        if len(self.shape) != 2 or min(self.shape) < 1 or self.shape[1] > _MOST_COLUMNS:
            raise ValueError(
                f"shape must be rows and columns, at least 1 and at most {_MOST_COLUMNS}, not {self.shape}"
            )
        rows, columns = self.shape
        if rows * columns > 2**31 - 1:
            raise ValueError(f"shape {self.shape} has more pixels than 2³¹ − 1")
        device = resolve_device(self.device)
        sines = np.sin(np.deg2rad(self._row_edges()))
        view = _View()
        view.rows, view.columns = rows, columns
        view.top_sine, view.bins_per_sine, row_of_bin = _bins_of_sines(sines)
        view.place_slack = columns * _TURN_SLACK

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_view", view)
        keep("_edges", wp.array(_column_edges(columns), dtype=wp.vec2d, device=device))
        keep("_sines", wp.array(sines, dtype=wp.float64, device=device))
        keep("_row_of_bin", wp.array(row_of_bin, dtype=wp.int32, device=device))
        keep("_row", wp.zeros(self.capacity, dtype=wp.int32, device=device))
        keep("_distance", wp.zeros(self.capacity, dtype=wp.float32, device=device))
        keep("_nearest", wp.full(rows * columns, 2**63 - 1, dtype=wp.int64, device=device))
        keep("channels", wp.zeros((5, rows, columns), dtype=wp.float32, device=device))
        keep("index", wp.full((rows, columns), -1, dtype=wp.int32, device=device))
        keep("_flat", (self.channels.reshape((5, rows * columns)), self.index.reshape(rows * columns)))

    def _row_edges(self) -> np.ndarray:
        """Elevations of the edges of the rows, from the top [deg], shape (rows + 1,)."""
        rows = self.shape[0]
        if self.elevations is None:
            if len(self.vertical_fov) != 2 or not -90.0 <= self.vertical_fov[0] < self.vertical_fov[1] <= 90.0:
                raise ValueError(
                    "vertical_fov must be a lower and an upper elevation [deg] within −90 … 90, "
                    f"not {self.vertical_fov}"
                )
            return np.linspace(self.vertical_fov[1], self.vertical_fov[0], rows + 1)
        lasers = np.asarray(self.elevations, np.float64)
        if lasers.shape != (rows,) or rows < 2 or not (np.diff(lasers) > 0).all() or abs(lasers).max() > 90.0:
            raise ValueError(
                f"elevations must be {rows} rising angles [deg] within −90 … 90, two or more, one for each row of "
                f"shape {self.shape}, not {self.elevations}"
            )
        between = (lasers[1:] + lasers[:-1]) / 2
        below, above = 2 * lasers[0] - between[0], 2 * lasers[-1] - between[-1]
        return np.concatenate([[below], between, [above]])[::-1].clip(-90.0, 90.0)

    def launch(self, xyz: wp.array, intensity: wp.array | None, count: wp.array, ring: wp.array | None = None) -> None:
        """Fills `channels` and `index` from the first `count[0]` points.

        Args:
            xyz: Positions in the sensor's frame [m], shape (n,), vec3, n ≤ capacity.
            intensity: Shape (n,), float32; None where there are none, which gives zeros.
            count: Shape (1,), int32.
            ring: Laser of each point, counted from below, shape (n,), uint16: then this, not the elevation, tells
                the row.
        """
        self._draw_into(*self._flat, xyz, intensity, count, ring)

    def _draw_into(
        self,
        channels: wp.array,
        index: wp.array,
        xyz: wp.array,
        intensity: wp.array | None,
        count: wp.array,
        ring: wp.array | None,
    ) -> None:
        """Draws on flat images, shapes (5, pixels) and (pixels,)."""
        n = xyz.shape[0]
        if n > self.capacity:
            raise ValueError(f"xyz has {n} rows, more than the plan's capacity of {self.capacity}")
        if ring is not None and (ring.shape[0] < n or ring.dtype != wp.uint16):
            raise ValueError(f"ring must be uint16 with at least {n} rows, as there are points")
        wp.launch(
            _find_rows,
            n,
            inputs=[xyz, ring, count, self._sines, self._row_of_bin, self._view],
            outputs=[self._row, self._distance],
            device=self.device,
        )
        wp.launch(
            _find_nearest,
            n,
            inputs=[xyz, count, self._row, self._distance, self._edges, self._view],
            outputs=[self._nearest],
            device=self.device,
        )
        wp.launch(
            _draw_pixels,
            index.shape[0],
            inputs=[xyz, intensity, self._nearest],
            outputs=[channels, index],
            device=self.device,
        )


def _bins_of_sines(sines: np.ndarray) -> tuple[float, float, np.ndarray]:
    """A table that tells a row by the sine of an elevation: where it begins, how fine it is, and the row of each bin.

    A bin with an edge in it, or almost, holds -3 less the row above the edge, to search from.
    """
    rows = len(sines) - 1
    inner = _BINS_PER_ROW * rows
    width = (sines[0] - sines[-1]) / inner
    tops = sines[0] + 2 * width - np.arange(inner + 4) * width  # two bins on each side are outside
    slack = _SINE_SLACK + 1e-6 * width * inner
    above = np.searchsorted(-sines, -tops - slack, side="left") - 1
    below = np.searchsorted(-sines, -(tops - width) + slack, side="right") - 1
    return tops[0], 1.0 / width, np.where(above == below, above, _SEARCH_FROM - above)


def _column_edges(columns: int) -> np.ndarray:
    """The rays between columns, clockwise from straight behind to there, shape (columns + 1, 2).

    On axes and diagonals they are exact.
    """
    steps = np.arange(columns + 1)
    angle = np.pi - 2.0 * np.pi * steps / columns
    rays = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    on_eighth = 8 * steps % columns == 0
    rays[on_eighth] = np.sign(np.round(rays[on_eighth], 9))  # of diagonals, only the direction matters
    return rays


@dataclass(frozen=True, eq=False)
class RangeImage:
    """What `range_image` drew."""

    channels: Any
    """Range, x, y, z [m] and intensity, shape (5, rows, columns), float32; zero where there is no point."""
    index: Any
    """Which point a pixel shows, shape (rows, columns), int32; -1 where there is none."""


def range_image(
    points: Any,
    shape: Sequence[int] = (64, 1024),
    *,
    vertical_fov: Sequence[float] = (-25.0, 3.0),
    elevations: Sequence[float] | None = None,
    ring: Any = None,
) -> RangeImage:
    """Draws a cloud as its sensor saw it, of several points on a pixel the nearest.

    Row 0 is the highest; the middle column looks along x, and columns run clockwise seen from above, so that the left
    of the image is left of the sensor. Points at the sensor itself, beyond the view, or not finite are left out.

    Args:
        points: x y z [m] in the sensor's frame and intensity in the fourth column, shape (n, 3 or more), floating.
        shape: Rows and columns.
        vertical_fov: Elevation of the lower and the upper edge of the image [deg].
        elevations: Elevation of each laser, lowest first [deg], one per row: each point goes to the nearest laser's
            row. By default rows are of even height within `vertical_fov`.
        ring: Laser of each point, counted from below, shape (n,), integers, on the device of `points`: then this
            tells the row.

    Returns:
        The image and which point each of its pixels shows, of the family and on the device of `points`.

    Raises:
        TypeError: `points` is not a floating array, or `ring` not one of integers.
        ValueError: A shape or a number does not fit; the message says which.
    """
    borrowed = borrow_points(points)
    n = len(borrowed)
    rings, owner = (None, None) if ring is None else borrow(ring, wp.uint16, (n,), "ring")
    if rings is not None and str(rings.device) != borrowed.device:
        raise ValueError(f"points are on {borrowed.device} and ring on {rings.device}; both must be on one device")
    plan = plan_for(
        RangeProjection,
        capacity=capacity_for(n),
        shape=tuple(int(length) for length in shape),
        vertical_fov=tuple(float(angle) for angle in vertical_fov),
        elevations=None if elevations is None else tuple(float(angle) for angle in elevations),
        device=borrowed.device,
    )
    count = count_on(n, borrowed.device)
    given = (borrowed.xyz, borrowed.intensity, count, rings)
    if borrowed.device != DEFAULT_DEVICE:
        plan.launch(*given)
        image = RangeImage(give(plan.channels, borrowed.family), give(plan.index, borrowed.family))
    else:
        # Straight onto arrays of its own, without a copy.
        channels, index = np.empty((5, *plan.shape), np.float32), np.empty(plan.shape, np.int32)
        flat = [
            wp.array(host, copy=False, device=DEFAULT_DEVICE) for host in (channels.reshape(5, -1), index.reshape(-1))
        ]
        plan._draw_into(*flat, *given)
        image = RangeImage(adopt(channels, borrowed.family), adopt(index, borrowed.family))
    del owner
    return image
