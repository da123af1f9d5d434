"""Windows to learn from: the occupied pillars and the targets of a varied frame, kept small so that many are kept.

To vary a frame, draw its pillars and its targets takes as long as a step of the network on it. A window is therefore
learnt from more than once, each time turned by a quarter or mirrored, while new ones come in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from .network import HEAD_CLASSES, REGRESSION, STRIDE, UNFOLD
from .targets import Targets

__all__ = ["Batch", "Window", "Windows", "batched", "turned", "window_of"]

_DX, _DY = (REGRESSION.index(name) for name in ("dx", "dy"))
_COS2, _SIN2, _COS, _SIN = (REGRESSION.index(name) for name in ("cos_2yaw", "sin_2yaw", "cos_yaw", "sin_yaw"))


@dataclass(frozen=True, kw_only=True)
class Window:
    """A square of pillars and what is to be said of it; cells are numbered row by row."""

    edge: int
    """Rows, and columns, of output cells; of pillars there are `STRIDE` times as many."""
    cells: np.ndarray
    """Numbers of the occupied pillars, shape (k,), int32."""
    pillars: np.ndarray
    """Their channels as bfloat16, shape (k, C), uint16."""
    offsets: tuple[int, int]
    """Which of the channels are the mean dx and dy, −1 where they are not among them."""
    calm_class: np.ndarray
    """Of the cells near peaks, or not to be judged, in the map of a class: the class, shape (m,), uint8."""
    calm_cell: np.ndarray
    """The cell's number, shape (m,), int32."""
    calm: np.ndarray
    """By what a false peak there counts less than elsewhere, shape (m,), float16."""
    peak_class: np.ndarray
    """Of centres of objects: the class, shape (p,), uint8."""
    peak_cell: np.ndarray
    """The cell's number, shape (p,), int32."""
    box_cell: np.ndarray
    """Numbers of the cells that say a box, shape (b,), int32."""
    values: np.ndarray
    """What they should say, shape (b, regression), float32."""
    weight: np.ndarray
    """How much it counts, shape (b,), float32."""
    velocity: np.ndarray
    """Along the grid's axes [10 m/s], shape (b, 2), float32; NaN where unknown."""


@dataclass(frozen=True, kw_only=True)
class Batch:
    """Several windows as the network takes them and the loss reads its maps, which are folded (`UNFOLD`)."""

    pillars: torch.Tensor
    """Shape (n, C, H, W), bfloat16, its channels last in memory."""
    calm: torch.Tensor
    """By what a false peak counts less, shape (n, H / 4, W / 4, classes · UNFOLD²), float32."""
    peaks: torch.Tensor
    """Which of its numbers are centres of objects, shape (p,)."""
    where: torch.Tensor
    """Of each cell that says a box: window, row, column and place in the unfolded square, shape (4, b)."""
    values: torch.Tensor
    """Shape (b, regression)."""
    weight: torch.Tensor
    """Shape (b,)."""
    velocity: torch.Tensor
    """Shape (b, 2)."""


def window_of(grid: np.ndarray, channels: Sequence[str], targets: Targets) -> Window:
    """What there is in a drawn grid of pillars and its targets.

    Args:
        grid: Shape (C, H, W), float32.
        channels: Their names.
        targets: On a grid of H / `STRIDE` rows and columns.
    """
    pillars = grid.reshape(len(grid), -1)
    cells = np.flatnonzero((pillars != 0).any(0)).astype(np.int32)
    classes, edge, _ = targets.heat.shape
    heat, mask = targets.heat.reshape(classes, -1), targets.mask.reshape(classes, -1)
    calm_class, calm_cell = np.nonzero((heat > 0) | (mask == 0))
    near = heat[calm_class, calm_cell]
    peaks = near >= 1.0
    boxes = np.flatnonzero(targets.weight > 0)
    names = list(channels)
    return Window(
        edge=edge,
        cells=cells,
        pillars=torch.from_numpy(pillars[:, cells].T.copy()).bfloat16().view(torch.uint16).numpy(),
        offsets=tuple(names.index(name) if name in names else -1 for name in ("mean_dx", "mean_dy")),
        calm_class=calm_class.astype(np.uint8),
        calm_cell=calm_cell.astype(np.int32),
        calm=((1.0 - near) ** 4 * mask[calm_class, calm_cell]).astype(np.float16),
        peak_class=calm_class[peaks].astype(np.uint8),
        peak_cell=calm_cell[peaks].astype(np.int32),
        box_cell=boxes.astype(np.int32),
        values=targets.values.reshape(len(REGRESSION), -1)[:, boxes].T.copy(),
        weight=targets.weight.reshape(-1)[boxes],
        velocity=targets.velocity.reshape(2, -1)[:, boxes].T.copy(),
    )


def _moved(cells: np.ndarray, edge: int, flip_x: bool, flip_y: bool, swap: bool) -> np.ndarray:
    row, column = np.divmod(cells, edge)
    column = edge - 1 - column if flip_x else column
    row = edge - 1 - row if flip_y else row
    return (column * edge + row if swap else row * edge + column).astype(cells.dtype)


def turned(window: Window, flip_x: bool, flip_y: bool, swap: bool) -> Window:
    """The window mirrored along x, along y, and at the diagonal: the eight ways that a square fits onto itself."""
    if not (flip_x or flip_y or swap):
        return window
    pillars, (dx, dy) = window.pillars.copy(), window.offsets
    values, velocity = window.values.copy(), window.velocity.copy()
    sign = np.uint16(0x8000)
    if flip_x:
        if dx >= 0:
            pillars[:, dx] ^= sign
        values[:, [_DX, _SIN2, _COS]] *= -1.0
        velocity[:, 0] *= -1.0
    if flip_y:
        if dy >= 0:
            pillars[:, dy] ^= sign
        values[:, [_DY, _SIN2, _SIN]] *= -1.0
        velocity[:, 1] *= -1.0
    if swap:
        if dx >= 0 and dy >= 0:
            pillars[:, [dx, dy]] = pillars[:, [dy, dx]]
        values[:, [_DX, _DY, _COS, _SIN]] = values[:, [_DY, _DX, _SIN, _COS]]
        values[:, _COS2] *= -1.0
        velocity = velocity[:, ::-1].copy()
    way = (flip_x, flip_y, swap)
    return replace(
        window,
        cells=_moved(window.cells, STRIDE * window.edge, *way),
        pillars=pillars,
        calm_cell=_moved(window.calm_cell, window.edge, *way),
        peak_cell=_moved(window.peak_cell, window.edge, *way),
        box_cell=_moved(window.box_cell, window.edge, *way),
        values=values,
        velocity=velocity,
    )


def batched(windows: Sequence[Window]) -> Batch:
    """Several windows of one size side by side."""
    n, edge, channels = len(windows), windows[0].edge, windows[0].pillars.shape[1]
    pillars = torch.zeros(n, (STRIDE * edge) ** 2, channels, dtype=torch.bfloat16)
    folded, classes = edge // UNFOLD, len(HEAD_CLASSES)
    calm = torch.ones(n, folded, folded, classes * UNFOLD**2)
    where, quiet, centres = [], [], []

    def places(k: int, cells: np.ndarray) -> np.ndarray:
        row, column = np.divmod(cells.astype(np.int64), edge)
        inner = (row % UNFOLD) * UNFOLD + column % UNFOLD
        return np.stack([np.full(len(cells), k), row // UNFOLD, column // UNFOLD, inner])

    def numbers(k: int, kinds: np.ndarray, cells: np.ndarray) -> np.ndarray:
        _, row, column, inner = places(k, cells)
        return ((k * folded + row) * folded + column) * (classes * UNFOLD**2) + kinds.astype(np.int64) * 4 + inner

    for k, window in enumerate(windows):
        pillars[k, torch.from_numpy(window.cells.astype(np.int64))] = torch.from_numpy(window.pillars).view(
            torch.bfloat16
        )
        quiet.append(numbers(k, window.calm_class, window.calm_cell))
        centres.append(numbers(k, window.peak_class, window.peak_cell))
        where.append(places(k, window.box_cell))
    calm.view(-1)[torch.from_numpy(np.concatenate(quiet))] = torch.from_numpy(
        np.concatenate([window.calm for window in windows])
    ).float()
    return Batch(
        pillars=pillars.view(n, STRIDE * edge, STRIDE * edge, channels).permute(0, 3, 1, 2),
        calm=calm,
        peaks=torch.from_numpy(np.concatenate(centres)),
        where=torch.from_numpy(np.concatenate(where, 1)),
        values=torch.from_numpy(np.concatenate([window.values for window in windows])),
        weight=torch.from_numpy(np.concatenate([window.weight for window in windows])),
        velocity=torch.from_numpy(np.concatenate([window.velocity for window in windows])),
    )


class Windows:
    """Windows that have been drawn, the latest so many of them.

    Args:
        capacity: How many are kept.
        before: How many had been drawn before the first that it is given, of a training that goes on.
    """

    def __init__(self, capacity: int, before: int = 0):
        self._capacity = capacity
        self._kept: dict[int, Window] = {}
        self._drawn = before

    def __len__(self) -> int:
        return len(self._kept)

    def keep(self, new: Sequence[Window]) -> None:
        """Takes them in, each in the place of one that is `capacity` older."""
        for window in new:
            self._kept[self._drawn % self._capacity] = window
            self._drawn += 1

    def batch(self, new: Sequence[Window], size: int, random: np.random.Generator) -> Batch:
        """The new windows as they are, and of those before them as many as it takes, each turned at random."""
        chosen = list(new[:size])
        for _ in range(size - len(chosen)):
            known = self._kept or chosen
            flips = random.random(3) < 0.5
            chosen.append(turned(known[int(random.integers(len(known)))], *(bool(flip) for flip in flips)))
        self.keep(new)
        return batched(chosen)
