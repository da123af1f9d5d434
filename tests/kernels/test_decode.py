"""Decoding of centre maps against NumPy, and by hand."""

import numpy as np
import pytest
import warp as wp

from warploom.kernels.decode import REGRESSION_MAPS, CenterDecode

SHAPE = (3 + REGRESSION_MAPS, 24, 32)


def plan(device="cpu", capacity=512):
    return CenterDecode(shape=SHAPE, classes=3, origin=(-8.0, -6.0), cell=0.5, capacity=capacity, device=device)


def run(decode, maps, threshold, height=1.5):
    decode.launch(wp.array(maps[None], dtype=wp.float32, device=decode.device), threshold, height)
    n = int(decode.count.numpy()[0])
    return decode.boxes.numpy()[:n], decode.scores.numpy()[:n], decode.classes_found.numpy()[:n]


def reference(maps, threshold, height):
    """Peaks by the definition, boxes in double precision."""
    maps = maps.astype(np.float64)
    rows = []
    for kind in range(3):
        heat = np.pad(maps[kind], 1, constant_values=-np.inf)
        for r in range(SHAPE[1]):
            for c in range(SHAPE[2]):
                around = heat[r : r + 3, c : c + 3]
                score = 1 / (1 + np.exp(-heat[r + 1, c + 1]))
                if score < threshold or around.max() > heat[r + 1, c + 1]:
                    continue
                dx, dy, z, ll, lw, lh, c2, s2, cy, sy = maps[3:, r, c]
                axis = 0.5 * np.arctan2(s2, c2)
                if np.cos(axis) * cy + np.sin(axis) * sy < 0:
                    axis += np.pi
                size = np.exp(np.clip([ll, lw, lh], -4, 4))
                rows.append(
                    [kind, score, -8 + (c + 0.5 + dx) * 0.5, -6 + (r + 0.5 + dy) * 0.5, z - height, *size, axis, r, c]
                )
    return np.array(rows)


def test_boxes_agree_with_the_reference(device):
    """Within 1e-5 relative: float32 against double precision; yaw modulo a turn."""
    maps = np.random.default_rng(5).normal(0, 1.2, SHAPE).astype(np.float32)
    boxes, scores, kinds = run(plan(device), maps, 0.6)
    expected = reference(maps, 0.6, 1.5)
    assert len(expected) > 50
    np.testing.assert_array_equal(kinds, expected[:, 0])
    np.testing.assert_allclose(scores, expected[:, 1], atol=1e-6)
    np.testing.assert_allclose(boxes[:, :6], expected[:, 2:8], rtol=1e-5, atol=1e-5)
    turn = (boxes[:, 6] - expected[:, 8] + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(turn, 0, atol=1e-5)


def test_one_object_by_hand():
    maps = np.full(SHAPE, -9.0, np.float32)
    maps[3:] = 0
    maps[1, 4, 20] = 2.0
    yaw = -2.5
    log = np.log([4.2, 1.8, 1.5])
    maps[3:, 4, 20] = [0.2, -0.4, 0.75, *log, np.cos(2 * yaw), np.sin(2 * yaw), 0.3 * np.cos(yaw), 0.3 * np.sin(yaw)]
    boxes, scores, kinds = run(plan(), maps, 0.5)
    assert kinds.tolist() == [1]
    assert scores[0] == pytest.approx(1 / (1 + np.exp(-2.0)))
    np.testing.assert_allclose(boxes[0], [-8 + 20.7 * 0.5, -6 + 4.1 * 0.5, -0.75, 4.2, 1.8, 1.5, yaw], atol=1e-5)


def test_a_plateau_gives_one_object():
    maps = np.full(SHAPE, -9.0, np.float32)
    maps[0, 5:8, 5:8] = 1.0
    assert len(run(plan(), maps, 0.5)[0]) == 1


def test_objects_beyond_capacity_are_counted():
    maps = np.random.default_rng(5).normal(0, 1.2, SHAPE).astype(np.float32)
    everything = len(run(plan(), maps, 0.6)[0])
    few = plan(capacity=10)
    boxes, _, _ = run(few, maps, 0.6)
    assert len(boxes) == 10
    assert few.dropped.numpy()[0] == everything - 10


def test_nan_maps_give_nothing():
    assert len(run(plan(), np.full(SHAPE, np.nan, np.float32), 0.1)[0]) == 0


def test_a_shape_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="must begin with"):
        CenterDecode(shape=(12, 4, 4), classes=3, origin=(0, 0), cell=0.5, capacity=4)


@pytest.mark.parametrize("unfold", [2, 4])
def test_folded_maps_give_the_same_bytes_as_unfolded_ones(unfold, device):
    """Folded as torch's PixelUnshuffle does, the inverse of the PixelShuffle that networks end with."""
    maps = np.random.default_rng(8).normal(0, 1.2, SHAPE).astype(np.float32)
    m, rows, columns = SHAPE
    blocks = maps.reshape(m, rows // unfold, unfold, columns // unfold, unfold).transpose(0, 2, 4, 1, 3)
    folded = np.ascontiguousarray(blocks.reshape(m * unfold**2, rows // unfold, columns // unfold))
    decode = CenterDecode(
        shape=SHAPE, classes=3, origin=(-8.0, -6.0), cell=0.5, capacity=512, unfold=unfold, device=device
    )
    for one, other in zip(run(plan(device), maps, 0.6), run(decode, folded, 0.6), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("unfold", [0, 3, 16])
def test_an_unfolding_that_does_not_divide_the_maps_is_refused(unfold):
    with pytest.raises(ValueError, match="power of two that divides"):
        CenterDecode(shape=SHAPE, classes=3, origin=(0, 0), cell=0.5, capacity=4, unfold=unfold)


@pytest.mark.parametrize("weight", [0.0, 0.3, 0.7])
@pytest.mark.parametrize("unfold", [1, 2])
def test_a_thought_overlap_weighs_in_the_score(weight, unfold, device):
    """p^(1 - a) overlap^a of every peak in double precision, those below the threshold left out; within 1e-5."""
    rng = np.random.default_rng(9)
    maps = np.concatenate([rng.normal(0, 1.2, SHAPE), rng.uniform(-1.3, 1.3, (1, *SHAPE[1:]))]).astype(np.float32)
    m, rows, columns = maps.shape
    folded = maps.reshape(m, rows // unfold, unfold, columns // unfold, unfold).transpose(0, 2, 4, 1, 3)
    folded = np.ascontiguousarray(folded.reshape(m * unfold**2, rows // unfold, columns // unfold))
    decode = CenterDecode(
        shape=maps.shape, classes=3, origin=(-8.0, -6.0), cell=0.5, capacity=512, unfold=unfold, overlap_weight=weight,
        device=device,
    )  # fmt: skip
    boxes, scores, kinds = run(decode, folded, 0.55)
    every = reference(maps[:-1], 0.0, 1.5)
    overlap = np.clip(
        0.5 * (maps[-1, every[:, 9].astype(int), every[:, 10].astype(int)].astype(np.float64) + 1.0), 0, 1
    )
    every[:, 1] = every[:, 1] ** (1.0 - weight) * overlap**weight
    expected = every[every[:, 1] >= 0.55]
    assert len(expected) > 20
    np.testing.assert_array_equal(kinds, expected[:, 0])
    np.testing.assert_allclose(scores, expected[:, 1], atol=1e-5)
    np.testing.assert_allclose(boxes[:, :6], expected[:, 2:8], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("maps", "weight"), [(13, 0.5), (14, 1.0), (14, -0.1)])
def test_a_weight_without_its_map_or_out_of_range_is_refused(maps, weight):
    with pytest.raises(ValueError, match="overlap_weight must be"):
        CenterDecode(shape=(maps, 4, 4), classes=3, origin=(0, 0), cell=0.5, capacity=4, overlap_weight=weight)
