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

from .arguments import reals, wholes
from .device import DEFAULT_DEVICE, resolve_device
from .interop import adopt, borrow, borrow_points, count_on, give
from .plan import capacity_for, plan_for
from .range_pixels import (
    EMPTY,
    SEARCH_FROM,
    View,
    draw_pixels,
    draw_pixels_in_parts,
    find_nearest,
    find_nearest_in_parts,
    find_rows,
)
from .threads import launch_parts, thread_count

__all__ = ["RangeImage", "RangeProjection", "range_image"]

_SINE_SLACK = 1e-6  # more than float32 errs in the sine of an elevation
_TURN_SLACK = 2e-6  # and in the share of a turn
_BINS_PER_ROW = 32
_MOST_COLUMNS = 1 << 16
_LEAST_OF_PART = 8192  # points or pixels for which a thread of their own is worth its while


def _in_parts(device: str) -> bool:
    """Whether few threads do much each, as suits a CPU, or many little."""
    return device == DEFAULT_DEVICE


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
        view = View()
        view.rows, view.columns = rows, columns
        view.top_sine, view.bins_per_sine, row_of_bin = _bins_of_sines(sines)
        view.place_slack = columns * _TURN_SLACK

        def keep(name: str, value: Any) -> None:
            object.__setattr__(self, name, value)

        keep("_view", view)
        keep("_edges", wp.array(_column_edges(columns), dtype=wp.vec2d, device=device))
        keep("_sines", wp.array(sines, dtype=wp.float64, device=device))
        keep("_row_of_bin", wp.array(row_of_bin, dtype=wp.int32, device=device))
        keep("_parts", thread_count() if _in_parts(device) else 0)
        keep("_row", wp.zeros(self.capacity, dtype=wp.int32, device=device))
        keep("_distance", wp.zeros(0 if self._parts else self.capacity, dtype=wp.float32, device=device))
        images = (self._parts, rows * columns) if self._parts else rows * columns
        keep("_nearest", wp.full(images, EMPTY, dtype=wp.int64, device=device))
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
        if self._parts:
            images = max(1, min(self._parts, n // _LEAST_OF_PART))
            inputs = [xyz, ring, count, self._sines, self._row_of_bin, self._edges, self._view]
            launch_parts(find_nearest_in_parts, images, inputs, [self._row, self._nearest])
            parts = max(1, min(self._parts, index.shape[0] // _LEAST_OF_PART))
            inputs = [xyz, intensity, images, self._nearest]
            launch_parts(draw_pixels_in_parts, parts, inputs, [channels, index])
            return
        wp.launch(
            find_rows,
            n,
            inputs=[xyz, ring, count, self._sines, self._row_of_bin, self._view],
            outputs=[self._row, self._distance],
            device=self.device,
        )
        wp.launch(
            find_nearest,
            n,
            inputs=[xyz, count, self._row, self._distance, self._edges, self._view],
            outputs=[self._nearest],
            device=self.device,
        )
        wp.launch(
            draw_pixels,
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
    return tops[0], 1.0 / width, np.where(above == below, above, SEARCH_FROM - above)


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
        shape=wholes(shape, "shape"),
        vertical_fov=reals(vertical_fov, "vertical_fov"),
        elevations=None if elevations is None else reals(elevations, "elevations"),
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
