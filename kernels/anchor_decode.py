"""From an anchor head's maps to boxes, as PointPillars and SECOND give them: what is said relative to the box assumed.

At each cell of the maps there are a few anchors, boxes of the classes' usual sizes; the network says how sure it is of
each class, how the box differs (Yan, Mao, Li, SECOND, Sensors 2018, equation 2), and which way round it is. Rows of the
maps are counted first and written after, so that boxes come in one order (anchor, row, column, class) whatever order
the threads run in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from .device import resolve_device

__all__ = ["AnchorDecode"]

_RESIDUALS = wp.constant(7)
_DIRECTIONS = wp.constant(2)


@wp.struct
class AnchorGrid:
    """Where anchors stand, and how what is said of them is to be read."""

    low_x: float
    low_y: float
    step_x: float
    step_y: float
    direction_offset: float
    direction_limit: float
    height: float
    gap: float


@wp.func
def _best_class(
    scores: wp.array3d(dtype=wp.float32), classes: int, anchor: int, row: int, column: int, least: float
) -> int:
    """The surest class of an anchor, the first of equals, or −1 where none is sure enough."""
    best = int(-1)
    value = float(0.0)
    for kind in range(classes):
        score = scores[anchor * classes + kind, row, column]
        if score >= least and (best < 0 or score > value):
            best = kind
            value = score
    return best


@wp.kernel
def _count_found(
    # in
    scores_in: wp.array3d(dtype=wp.float32),
    classes: int,
    each_class: bool,
    least: float,
    # out
    found_out: wp.array(dtype=wp.int32),
):
    """Counts what is sure enough in each row of each anchor."""
    anchor, row = wp.tid()  # pyright: ignore[reportAssignmentType]
    found = int(0)
    for column in range(scores_in.shape[2]):
        if each_class:
            for kind in range(classes):
                if scores_in[anchor * classes + kind, row, column] >= least:
                    found += 1
        elif _best_class(scores_in, classes, anchor, row, column, least) >= 0:
            found += 1
    found_out[anchor * scores_in.shape[1] + row] = found


@wp.kernel
def _write_found(
    # in
    scores_in: wp.array3d(dtype=wp.float32),
    residuals_in: wp.array3d(dtype=wp.float32),
    directions_in: wp.array3d(dtype=wp.float32),
    classes: int,
    each_class: bool,
    least: float,
    anchors_in: wp.array2d(dtype=wp.float32),
    grid: AnchorGrid,
    sensor_height_in: wp.array(dtype=wp.float32),
    ends_in: wp.array(dtype=wp.int32),
    found_in: wp.array(dtype=wp.int32),
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
    apart_out: wp.array2d(dtype=wp.float32),
    scores_out: wp.array(dtype=wp.float32),
    classes_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Writes the boxes of each row of each anchor, from where the rows before it end."""
    anchor, row = wp.tid()  # pyright: ignore[reportAssignmentType]
    line = anchor * scores_in.shape[1] + row
    capacity = scores_out.shape[0]
    if line == ends_in.shape[0] - 1:
        count_out[0] = wp.min(ends_in[line], capacity)
        dropped_out[0] = wp.max(ends_in[line] - capacity, 0)
    if found_in[line] == 0:
        return
    slot = ends_in[line] - found_in[line]
    length = anchors_in[anchor, 0]
    width = anchors_in[anchor, 1]
    tall = anchors_in[anchor, 2]
    diagonal = wp.sqrt(length * length + width * width)
    base = anchor * _RESIDUALS
    for column in range(scores_in.shape[2]):
        best = _best_class(scores_in, classes, anchor, row, column, least)
        if best >= 0:
            for kind in range(classes):
                logit = scores_in[anchor * classes + kind, row, column]
                if (each_class and logit >= least) or (not each_class and kind == best):
                    if slot < capacity:
                        x = residuals_in[base, row, column] * diagonal + grid.low_x + float(column) * grid.step_x
                        y = residuals_in[base + 1, row, column] * diagonal + grid.low_y + float(row) * grid.step_y
                        z = residuals_in[base + 2, row, column] * tall + anchors_in[anchor, 3]
                        yaw = residuals_in[base + 6, row, column] + anchors_in[anchor, 4]
                        turn = float(0.0)
                        if (
                            directions_in[anchor * _DIRECTIONS + 1, row, column]
                            > directions_in[anchor * _DIRECTIONS, row, column]
                        ):
                            turn = wp.PI
                        beyond = yaw - grid.direction_offset
                        beyond = beyond - wp.floor(beyond / wp.PI + grid.direction_limit) * wp.PI
                        yaw = beyond + grid.direction_offset + turn
                        boxes_out[slot, 0] = x
                        boxes_out[slot, 1] = y
                        # The network knows heights about a sensor at its own height alone.
                        boxes_out[slot, 2] = z - (sensor_height_in[0] - grid.height)
                        boxes_out[slot, 3] = wp.exp(residuals_in[base + 3, row, column]) * length
                        boxes_out[slot, 4] = wp.exp(residuals_in[base + 4, row, column]) * width
                        boxes_out[slot, 5] = wp.exp(residuals_in[base + 5, row, column]) * tall
                        boxes_out[slot, 6] = yaw - wp.floor(yaw / (2.0 * wp.PI) + 0.5) * 2.0 * wp.PI
                        for k in range(7):
                            apart_out[slot, k] = boxes_out[slot, k]
                        apart_out[slot, 0] = x + float(kind) * grid.gap
                        scores_out[slot] = 1.0 / (1.0 + wp.exp(-logit))
                        classes_out[slot] = kind
                    slot += 1


@dataclass(frozen=True, kw_only=True)
class AnchorDecode:
    """A plan: the boxes in maps of one shape, before suppression.

    Attributes:
        boxes: Shape (capacity, 7), float32: x y z l w h yaw in the sensor's frame, yaw in [−π, π).
        apart: The same, where classes are to be suppressed by themselves: 1 km between them along x.
        scores: Shape (capacity,), float32.
        classes_found: Indices of the network's classes, shape (capacity,), int32.
        count: How many they are, shape (1,), int32, on the device.
        dropped: Boxes beyond `capacity`, shape (1,), int32, on the device.
    """

    anchors: tuple[tuple[float, float, float, float, float], ...]
    """At each cell, in the network's order: length width height, z of the centre [m], yaw [rad]."""
    classes: int
    """Of which the network says how sure it is, at each anchor."""
    shape: tuple[int, int]
    """Rows (along y) and columns (along x) of the maps."""
    first: tuple[float, float]
    """x and y of the anchors at row 0, column 0 [m]."""
    step: tuple[float, float]
    """Between the anchors of neighbouring columns and rows [m]."""
    capacity: int
    """Most boxes."""
    each_class: bool = False
    """Whether an anchor gives a box for every class that is sure enough, not for the surest alone."""
    direction_offset: float = 0.78539
    """Where the half turn begins that the network's direction chooses [rad]."""
    direction_limit: float = 0.0
    """Share of a half turn by which that is shifted."""
    trained_height: float = 0.0
    """Height of the sensor above the ground that the anchors' z is about [m]."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        if not self.anchors or any(len(anchor) != 5 or not min(anchor[:3]) > 0 for anchor in self.anchors):
            raise ValueError(f"anchors must be rows of l w h z yaw with sizes > 0, not {self.anchors}")
        for name, value in (("classes", self.classes), ("capacity", self.capacity), ("shape", min(self.shape))):
            if value < 1:
                raise ValueError(f"{name} must be at least 1, not {value}")
        device = resolve_device(self.device)

        def keep(name: str, value) -> None:
            object.__setattr__(self, name, value)

        grid = AnchorGrid()
        grid.low_x, grid.low_y = self.first
        grid.step_x, grid.step_y = self.step
        grid.direction_offset, grid.direction_limit = self.direction_offset, self.direction_limit
        grid.height, grid.gap = self.trained_height, 1000.0 if self.each_class else 0.0
        keep("_grid", grid)
        keep("_anchors", wp.array(np.array(self.anchors, np.float32), dtype=wp.float32, device=device))
        lines = len(self.anchors) * self.shape[0]
        for name, shape, dtype in (
            ("_found", lines, wp.int32),
            ("_ends", lines, wp.int32),
            ("_height", 1, wp.float32),
            ("boxes", (self.capacity, 7), wp.float32),
            ("apart", (self.capacity, 7), wp.float32),
            ("scores", self.capacity, wp.float32),
            ("classes_found", self.capacity, wp.int32),
            ("count", 1, wp.int32),
            ("dropped", 1, wp.int32),
        ):
            keep(name, wp.zeros(shape, dtype=dtype, device=device))

    def launch(
        self,
        scores: wp.array,
        residuals: wp.array,
        directions: wp.array,
        score_threshold: float,
        sensor_height: float | wp.array,
    ) -> None:
        """Fills the outputs.

        Args:
            scores: Logits, shape (1, anchors · classes, rows, columns), float32; the class is the inner index.
            residuals: Shape (1, anchors · 7, rows, columns).
            directions: Logits of the two directions, shape (1, anchors · 2, rows, columns).
            score_threshold: Least score of a box, in [0, 1].
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
        """
        count = len(self.anchors)
        for name, array, channels in (
            ("scores", scores, count * self.classes),
            ("residuals", residuals, count * 7),
            ("directions", directions, count * 2),
        ):
            if tuple(array.shape) != (1, channels, *self.shape):
                raise ValueError(f"{name} must have shape {(1, channels, *self.shape)}, not {tuple(array.shape)}")
        height = sensor_height
        if not isinstance(height, wp.array):
            height = self._height
            height.fill_(float(sensor_height))
        p = min(max(score_threshold, 1e-6), 1.0 - 1e-6)
        least = math.log(p / (1.0 - p))
        lines, device = (count, self.shape[0]), self.scores.device
        wp.launch(
            _count_found,
            lines,
            inputs=[scores[0], self.classes, self.each_class, least],
            outputs=[self._found],
            device=device,
        )
        wp.utils.array_scan(self._found, self._ends, inclusive=True)
        wp.launch(
            _write_found,
            lines,
            inputs=[
                *(scores[0], residuals[0], directions[0], self.classes, self.each_class, least),
                *(self._anchors, self._grid, height, self._ends, self._found),
            ],
            outputs=[self.boxes, self.apart, self.scores, self.classes_found, self.count, self.dropped],
            device=device,
        )
