"""From a centre head's maps to boxes: each peak of a class's heat map is an object, the maps beneath it are its box.

Rows of the maps are counted first and written after, so that the objects come in one order (class, row, column)
whatever order the threads run in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import warp as wp

from .device import resolve_device

__all__ = ["OVERLAP_MAP", "REGRESSION_MAPS", "CenterDecode"]

REGRESSION_MAPS = 10
"""After the heat maps (logits): dx dy [cells from the centre], z [m above ground], log l w h, cos and sin of 2 yaw,
cos and sin of yaw."""

OVERLAP_MAP = 1
"""One more map may follow: how far the box is thought to overlap the object, as twice the intersection over union
less one."""


@wp.func
def _at(maps: wp.array3d(dtype=wp.float32), fold: int, kind: int, row: int, column: int) -> float:
    """A map's value at a cell, where blocks of 2^fold x 2^fold cells are folded into channels."""
    mask = (1 << fold) - 1
    channel = (((kind << fold) + (row & mask)) << fold) + (column & mask)
    return maps[channel, row >> fold, column >> fold]


@wp.func
def _is_peak(maps: wp.array3d(dtype=wp.float32), fold: int, kind: int, row: int, column: int, least: float) -> bool:
    """Whether a cell is at least as high as its eight neighbours, and higher than those before it."""
    value = _at(maps, fold, kind, row, column)
    if not (value >= least):
        return False
    peak = bool(True)
    for dr in range(-1, 2):
        for dc in range(-1, 2):
            r = row + dr
            c = column + dc
            if r >= 0 and r < maps.shape[1] << fold and c >= 0 and c < maps.shape[2] << fold:
                other = _at(maps, fold, kind, r, c)
                before = dr < 0 or (dr == 0 and dc < 0)
                if other > value or (before and other == value):
                    peak = False
    return peak


@wp.func
def _score(
    maps: wp.array3d(dtype=wp.float32), fold: int, kinds: int, kind: int, row: int, column: int, weight: float
) -> float:
    """The probability of a peak, and where `weight` is not zero, its weighted geometric mean with the overlap."""
    score = 1.0 / (1.0 + wp.exp(-_at(maps, fold, kind, row, column)))
    if weight > 0.0:
        overlap = wp.clamp(0.5 * (_at(maps, fold, kinds + 10, row, column) + 1.0), 0.0, 1.0)
        score = wp.pow(score, 1.0 - weight) * wp.pow(overlap, weight)
    return score


@wp.func
def _is_object(
    maps: wp.array3d(dtype=wp.float32),
    fold: int,
    kinds: int,
    kind: int,
    row: int,
    column: int,
    least: float,
    weight: float,
    least_score: float,
) -> bool:
    """Whether a cell is a peak and, where the overlap counts, its score is high enough with it."""
    if not _is_peak(maps, fold, kind, row, column, least):
        return False
    return weight <= 0.0 or _score(maps, fold, kinds, kind, row, column, weight) >= least_score


@wp.kernel
def _count_peaks(
    # in
    maps_in: wp.array3d(dtype=wp.float32),
    fold: int,
    least: float,
    kinds: int,
    weight: float,
    least_score: float,
    # out
    peaks_out: wp.array(dtype=wp.int32),
):
    """Counts the peaks of each row of each class."""
    kind, row = wp.tid()  # pyright: ignore[reportAssignmentType]
    found = int(0)
    for column in range(maps_in.shape[2] << fold):
        if _is_object(maps_in, fold, kinds, kind, row, column, least, weight, least_score):
            found += 1
    peaks_out[kind * (maps_in.shape[1] << fold) + row] = found


@wp.kernel
def _write_boxes(
    # in
    maps_in: wp.array3d(dtype=wp.float32),
    fold: int,
    least: float,
    ends_in: wp.array(dtype=wp.int32),
    peaks_in: wp.array(dtype=wp.int32),
    sensor_height_in: wp.array(dtype=wp.float32),
    low_x: float,
    low_y: float,
    cell: float,
    kinds: int,
    weight: float,
    least_score: float,
    # out
    boxes_out: wp.array2d(dtype=wp.float32),
    scores_out: wp.array(dtype=wp.float32),
    classes_out: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    dropped_out: wp.array(dtype=wp.int32),
):
    """Writes the boxes of each row of each class, from where the rows before it end."""
    kind, row = wp.tid()  # pyright: ignore[reportAssignmentType]
    line = kind * (maps_in.shape[1] << fold) + row
    capacity = scores_out.shape[0]
    if line == ends_in.shape[0] - 1:
        count_out[0] = wp.min(ends_in[line], capacity)
        dropped_out[0] = wp.max(ends_in[line] - capacity, 0)
    if peaks_in[line] == 0:
        return
    slot = ends_in[line] - peaks_in[line]
    for column in range(maps_in.shape[2] << fold):
        if _is_object(maps_in, fold, kinds, kind, row, column, least, weight, least_score):
            if slot < capacity:
                axis = 0.5 * wp.atan2(
                    _at(maps_in, fold, kinds + 7, row, column), _at(maps_in, fold, kinds + 6, row, column)
                )
                along = wp.cos(axis) * _at(maps_in, fold, kinds + 8, row, column) + wp.sin(axis) * _at(
                    maps_in, fold, kinds + 9, row, column
                )
                if along < 0.0:
                    axis = wp.where(axis > 0.0, axis - wp.PI, axis + wp.PI)
                boxes_out[slot, 0] = low_x + (float(column) + 0.5 + _at(maps_in, fold, kinds, row, column)) * cell
                boxes_out[slot, 1] = low_y + (float(row) + 0.5 + _at(maps_in, fold, kinds + 1, row, column)) * cell
                boxes_out[slot, 2] = _at(maps_in, fold, kinds + 2, row, column) - sensor_height_in[0]
                for size in range(3):
                    boxes_out[slot, 3 + size] = wp.exp(
                        wp.clamp(_at(maps_in, fold, kinds + 3 + size, row, column), -4.0, 4.0)
                    )
                boxes_out[slot, 6] = axis
                scores_out[slot] = _score(maps_in, fold, kinds, kind, row, column, weight)
                classes_out[slot] = kind
            slot += 1


@dataclass(frozen=True, kw_only=True)
class CenterDecode:
    """A plan: the objects in maps of one shape, before suppression.

    Attributes:
        boxes: Shape (capacity, 7), float32: x y z l w h yaw in the sensor's frame.
        scores: Shape (capacity,), float32.
        classes_found: Indices of the heat maps, shape (capacity,), int32.
        count: How many they are, shape (1,), int32, on the device.
        dropped: Peaks beyond `capacity`, shape (1,), int32, on the device.
    """

    shape: tuple[int, int, int]
    """Maps, rows (along y), columns (along x)."""
    classes: int
    """Heat maps, which come first; `REGRESSION_MAPS` follow, and perhaps the `OVERLAP_MAP`."""
    origin: tuple[float, float]
    """Lowest x and y of the maps [m]."""
    cell: float
    """Edge of a cell of the maps [m]."""
    capacity: int
    """Most objects."""
    unfold: int = 1
    """Blocks of so many by so many cells are folded into channels, a power of two: what a network computes at a coarser
    step and says at this one. Channel (m · unfold + row mod unfold) · unfold + column mod unfold is of map m."""
    overlap_weight: float = 0.0
    """Share a of the overlap map in a score: p^(1 − a) · overlap^a (CIA-SSD, Zheng et al., AAAI 2021); 0: none."""
    device: str = "cpu"
    """A Warp device, such as `cpu` or `cuda:0`."""

    def __post_init__(self):
        fewest = self.classes + REGRESSION_MAPS
        if self.shape[0] not in (fewest, fewest + OVERLAP_MAP):
            raise ValueError(
                f"shape must begin with {self.classes} + {REGRESSION_MAPS} maps, or one more, not {self.shape[0]}"
            )
        if not 0.0 <= self.overlap_weight < 1.0 or (self.overlap_weight and self.shape[0] == fewest):
            raise ValueError(f"overlap_weight must be in [0, 1), and 0 without its map, not {self.overlap_weight}")
        if self.unfold < 1 or self.unfold & (self.unfold - 1) or any(n % self.unfold for n in self.shape[1:]):
            raise ValueError(f"unfold must be a power of two that divides rows and columns, not {self.unfold}")
        object.__setattr__(self, "_fold", self.unfold.bit_length() - 1)
        device = resolve_device(self.device)

        def buffer(name: str, shape: int | tuple[int, int], dtype: type) -> None:
            object.__setattr__(self, name, wp.zeros(shape, dtype=dtype, device=device))

        lines = self.classes * self.shape[1]
        buffer("_peaks", lines, wp.int32)
        buffer("_ends", lines, wp.int32)
        buffer("_height", 1, wp.float32)
        buffer("boxes", (self.capacity, 7), wp.float32)
        buffer("scores", self.capacity, wp.float32)
        buffer("classes_found", self.capacity, wp.int32)
        buffer("count", 1, wp.int32)
        buffer("dropped", 1, wp.int32)

    def launch(self, maps: wp.array, score_threshold: float, sensor_height: float | wp.array) -> None:
        """Fills `boxes`, `scores`, `classes_found`, `count` and `dropped`.

        Args:
            maps: Shape (1, maps · unfold², rows / unfold, columns / unfold), float32.
            score_threshold: Least score of an object, in [0, 1].
            sensor_height: Height of the sensor above the ground [m]: a number or a device array of one float32.
        """
        height = sensor_height
        if not isinstance(height, wp.array):
            height = self._height
            height.fill_(float(sensor_height))
        p = min(max(score_threshold, 1e-6), 1.0 - 1e-6)
        # With a weight, what the peak itself must reach is what it takes where the overlap is perfect.
        p **= 1.0 / (1.0 - self.overlap_weight)
        least, weighting = math.log(p / (1.0 - p)), [self.classes, self.overlap_weight, float(score_threshold)]
        lines = (self.classes, self.shape[1])
        device = self.scores.device
        flat = maps[0]
        wp.launch(
            _count_peaks, lines, inputs=[flat, self._fold, least, *weighting], outputs=[self._peaks], device=device
        )
        wp.utils.array_scan(self._peaks, self._ends, inclusive=True)
        wp.launch(
            _write_boxes,
            lines,
            inputs=[flat, self._fold, least, self._ends, self._peaks, height, *self.origin, self.cell, *weighting],
            outputs=[self.boxes, self.scores, self.classes_found, self.count, self.dropped],
            device=device,
        )
