"""Windows: what they keep of grids and targets, turned as frames turn, side by side in a batch."""

import itertools

import numpy as np
import pytest
import torch

from warploom.kernels.pillar import pillar_channels
from warploom.models.training.network import LEAN_CHANNELS
from warploom.models.training.targets import draw_targets
from warploom.models.training.windows import Windows, batched, turned, window_of

EDGE = 32
ALL = pillar_channels()


def frame(seed):
    """Pillars of a few cells, and objects; every value exact in bfloat16."""
    rng = np.random.default_rng(seed)
    names = pillar_channels()
    grid = np.zeros((len(names), 2 * EDGE, 2 * EDGE), np.float32)
    for row, column in rng.integers(0, 2 * EDGE, (40, 2)):
        grid[rng.integers(1, 8), row, column] = 1.0
        grid[-5:, row, column] = rng.integers(-4, 5, 5) / 8.0 + 0.0625
    k = 6
    boxes = np.c_[rng.uniform(-7.5, 7.5, (k, 2)), np.full(k, 0.8), rng.uniform(0.5, 4, (k, 3)), rng.uniform(-3, 3, k)]
    return grid, boxes, rng.integers(0, 5, k), rng.integers(0, 40, k), rng.normal(0, 5, (k, 2))


def window(grid, boxes, classes, points, velocities, names=ALL):
    targets = draw_targets(
        boxes.astype(np.float32), classes, points, (-8.0, -8.0), 0.5, (EDGE, EDGE), velocities=velocities
    )
    return window_of(grid, names, targets), targets


def test_a_batch_has_the_pillars_and_what_is_calm():
    frames = [frame(seed) for seed in range(3)]
    drawn = [window(*each) for each in frames]
    batch = batched([each for each, _ in drawn])
    assert batch.pillars.is_contiguous(memory_format=torch.channels_last)
    np.testing.assert_array_equal(batch.pillars.float().numpy(), np.stack([each[0] for each in frames]))
    heat = np.stack([targets.heat for _, targets in drawn])
    mask = np.stack([targets.mask for _, targets in drawn])
    calm = torch.nn.functional.pixel_shuffle(batch.calm.permute(0, 3, 1, 2), 2).numpy()
    # A thousandth: kept in float16.
    np.testing.assert_allclose(calm, (1.0 - heat) ** 4 * mask, atol=1e-3)
    peaks = torch.zeros_like(batch.calm)
    peaks.view(-1)[batch.peaks] = 1.0
    np.testing.assert_array_equal(
        torch.nn.functional.pixel_shuffle(peaks.permute(0, 3, 1, 2), 2).numpy() == 1.0, heat >= 1.0
    )
    n, row, column, inner = batch.where.numpy()
    values = np.stack([targets.values for _, targets in drawn])
    np.testing.assert_array_equal(values[n, :, 2 * row + inner // 2, 2 * column + inner % 2], batch.values.numpy())
    assert len(n) == (np.stack([targets.weight for _, targets in drawn]) > 0).sum()


@pytest.mark.parametrize("way", list(itertools.product((False, True), repeat=3)))
@pytest.mark.parametrize("names", [pillar_channels(), LEAN_CHANNELS])
def test_a_turned_window_is_the_window_of_a_turned_frame(way, names):
    """Targets within 1e-5: angles are turned in float32."""
    flip_x, flip_y, swap = way
    grid, boxes, classes, points, velocities = frame(7)
    kept = [pillar_channels().index(name) for name in names]
    before, _ = window(grid[kept], boxes, classes, points, velocities, names)
    A = np.diag([-1.0 if flip_x else 1.0, -1.0 if flip_y else 1.0])
    A = A[::-1] if swap else A
    moved = boxes.copy()
    moved[:, :2] = boxes[:, :2] @ A.T
    heading = np.stack([np.cos(boxes[:, 6]), np.sin(boxes[:, 6])], 1) @ A.T
    moved[:, 6] = np.arctan2(heading[:, 1], heading[:, 0])
    drawn = grid.copy()
    drawn[-5] *= A[0, 0] + A[1, 0] if not swap else 1.0
    drawn[-4] *= A[1, 1] if not swap else 1.0
    if swap:
        drawn[-5], drawn[-4] = grid[-4] * A[0, 1], grid[-5] * A[1, 0]
    if flip_x:
        drawn = drawn[:, :, ::-1]
    if flip_y:
        drawn = drawn[:, ::-1]
    if swap:
        drawn = drawn.transpose(0, 2, 1)
    after, _ = window(np.ascontiguousarray(drawn)[kept], moved, classes, points, velocities @ A.T, names)
    got, expected = batched([turned(before, *way)]), batched([after])
    torch.testing.assert_close(got.pillars, expected.pillars, rtol=0, atol=0)
    torch.testing.assert_close(got.calm, expected.calm)
    assert sorted(got.peaks.tolist()) == sorted(expected.peaks.tolist())
    order, other = (np.lexsort(each.where.numpy()) for each in (got, expected))
    np.testing.assert_array_equal(got.where.numpy()[:, order], expected.where.numpy()[:, other])
    np.testing.assert_allclose(got.values[order], expected.values[other], atol=1e-5)
    np.testing.assert_allclose(got.velocity[order], expected.velocity[other], atol=1e-5)
    np.testing.assert_array_equal(got.weight[order], expected.weight[other])


def test_new_windows_come_first_and_the_oldest_go():
    drawn = [window(*frame(seed))[0] for seed in range(5)]
    windows = Windows(3)
    for k, each in enumerate(drawn):
        batch = windows.batch([each], 2, np.random.default_rng(k))
        assert batch.pillars.shape[0] == 2
        torch.testing.assert_close(batch.pillars[:1], batched([each]).pillars)
    assert len(windows) == 3
    assert {id(each) for each in windows._kept.values()} == {id(each) for each in drawn[2:]}
