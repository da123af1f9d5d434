"""What a second stage learns from, and that it learns."""

import numpy as np
import pytest
import torch
import warp as wp

from warploom.kernels.box_points import BoxPoints
from warploom.models.card import EIGHT_BITS_CARD, load_card
from warploom.models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.detections import Detections
from warploom.models.head import DetectionHead
from warploom.models.training.frames import TrainingFrame, labelled_boxes, save_frame, simulate_frame
from warploom.models.training.second import SecondConfig, candidates_in, main, train_second
from warploom.models.training.second_samples import SecondAugmentation, draw, join, overlap, samples_of

HEIGHT = 1.7


def detections(boxes, classes, scores):
    n = len(boxes)
    return Detections(
        boxes=np.float32(boxes),
        scores=np.float32(scores),
        classes=np.int32(classes),
        velocities=np.zeros((n, 2), np.float32),
        background=np.zeros(n, bool),
    )


def scene(rng, points_each=60):
    """Three objects, points in and around them, and a candidate near each and one in the open."""
    boxes = np.array(
        [[12, 3, -0.9, 4.2, 1.8, 1.5, 0.4], [8, -5, -0.8, 0.6, 0.5, 1.7, 1.0], [-9, 4, -0.8, 1.7, 0.6, 1.7, -2.0]]
    )
    classes = np.array([VEHICLE, PEDESTRIAN, CYCLIST], np.int32)
    spread = np.maximum(boxes[:, 3:6], 0.8)
    xyz = np.concatenate(
        [b[:3] + rng.uniform(-0.6, 0.6, (points_each, 3)) * s for b, s in zip(boxes, spread, strict=True)]
    )
    frame = TrainingFrame(
        xyz=np.float32(xyz),
        ring=np.zeros(len(xyz), np.uint8),
        boxes=np.float32(boxes),
        classes=classes,
        points_in=np.array([50, 50, 3], np.int32),
        sensor_height=HEIGHT,
        bowed=True,
    )
    wide = labelled_boxes(boxes, classes)
    off = wide + rng.normal(0, 0.03, wide.shape)
    found = np.concatenate([off, [[20, 20, -1, 4, 1.8, 1.5, 0.0]]])
    return frame, detections(found, [*classes, VEHICLE], [0.9, 0.7, 0.6, 0.3])


def test_candidates_have_their_points_and_the_object_that_they_may_mean():
    rng = np.random.default_rng(0)
    frame, found = scene(rng)
    samples = samples_of(found, frame, rng)
    assert samples.truth_kinds.tolist() == [0, 1, 2, -1]
    assert samples.truth_seen.tolist() == [True, True, False, False]
    assert samples.stored[3] == samples.found[3] == 0
    wide = labelled_boxes(frame.boxes, frame.classes)
    for k in range(3):
        c, s = np.cos(found.boxes[k, 6]), np.sin(found.boxes[k, 6])
        x, y = samples.truth[k, :2]
        there = found.boxes[k, :2] + [x * c - y * s, x * s + y * c]
        np.testing.assert_allclose(there, wide[k, :2], atol=1e-4)
        np.testing.assert_allclose(samples.truth[k, 3:6], wide[k, 3:6], atol=1e-6)
        assert samples.truth[k, 6] == pytest.approx(wide[k, 6] - found.boxes[k, 6], abs=1e-5)


def test_what_is_drawn_is_what_the_kernel_gathers():
    """The same rows in another order; half floats at 5 m are exact to 4 mm."""
    rng = np.random.default_rng(1)
    frame, found = scene(rng)
    samples = samples_of(found, frame, rng)
    drawn = draw(samples, np.arange(4), torch.Generator().manual_seed(0), None)
    plan = BoxPoints(capacity=1000, boxes=4, points_of_box=128, classes=5)

    def array(values, dtype):
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device="cpu")

    plan.launch(
        array(frame.xyz, wp.vec3), array([len(frame.xyz)], wp.int32), array(found.boxes, wp.float32),
        array(found.scores, wp.float32), array(found.classes, wp.int32), array(np.arange(4, dtype=np.int32), wp.int32),
        array([4], wp.int32), HEIGHT,
    )  # fmt: skip
    np.testing.assert_allclose(drawn.described.numpy(), plan.described.numpy(), atol=1e-4)
    for mine, theirs in zip(drawn.points.numpy(), plan.points.numpy(), strict=True):
        assert mine[:, 10].sum() == theirs[:, 10].sum()
        np.testing.assert_allclose(np.sort(mine, axis=0), np.sort(theirs, axis=0), atol=8e-3)


def test_what_should_be_said_without_variation():
    rng = np.random.default_rng(2)
    frame, found = scene(rng)
    drawn = draw(samples_of(found, frame, rng), np.arange(4), torch.Generator().manual_seed(0), None)
    assert drawn.kinds.tolist() == [1, 2, -1, 0]  # the third is there, but has too few points to be asked for
    assert drawn.boxed.tolist() == [True, True, True, False]
    wide = labelled_boxes(frame.boxes, frame.classes)
    sizes = np.exp(drawn.residuals[:3, 3:6].numpy()) * found.boxes[:3, 3:6]
    np.testing.assert_allclose(sizes, wide[:, 3:6], atol=1e-4)


def test_variation_keeps_points_in_their_boxes_and_truth_with_them():
    """Faces add up to the sizes, whatever is turned, moved, mirrored or stretched; 1e-5 m in float32."""
    rng = np.random.default_rng(3)
    frame, found = scene(rng)
    samples = join([samples_of(found, frame, rng)] * 100)
    drawn = draw(samples, np.arange(400), torch.Generator().manual_seed(1), SecondAugmentation())
    there = drawn.points[..., 10] > 0
    for axis in range(3):
        both = drawn.points[..., 3 + 2 * axis] + drawn.points[..., 4 + 2 * axis]
        wanted = drawn.sizes[:, axis : axis + 1].expand_as(both)
        torch.testing.assert_close(both[there], wanted[there], atol=1e-5, rtol=0)
    assert (drawn.points[~there] == 0).all()
    torch.testing.assert_close(drawn.described[:, :3], drawn.sizes.log(), atol=1e-5, rtol=0)
    torch.testing.assert_close(
        drawn.described[:, 6] ** 2 + drawn.described[:, 7] ** 2, torch.ones(400), atol=1e-4, rtol=0
    )
    assert 0.05 < (drawn.described[1::4, 11] == 1).float().mean() < 0.3  # people in riders' boxes


def test_overlap_is_that_of_boxes_that_head_alike():
    a = torch.tensor([[0.0, 0, 0, 4, 2, 1]])
    b = torch.tensor([[1.0, 0, 0, 4, 2, 1]])
    assert overlap(a, a).item() == pytest.approx(1.0)
    assert overlap(a, b).item() == pytest.approx(6 / 10)
    assert overlap(a, b + torch.tensor([[9.0, 0, 0, 0, 0, 0]])).item() == 0.0


def test_a_training_follows_from_its_seed_and_learns():
    rng = np.random.default_rng(4)
    samples = join(samples_of(found, frame, rng) for frame, found in (scene(rng) for _ in range(20)))
    config = SecondConfig(seed=5, iterations=150, batch=24)
    networks = [train_second(samples, config) for _ in range(2)]
    for a, b in zip(networks[0].state_dict().values(), networks[1].state_dict().values(), strict=True):
        assert torch.equal(a, b)
    drawn = draw(samples, np.arange(len(samples)), torch.Generator().manual_seed(0), None)
    with torch.no_grad():
        said = networks[0](drawn.points, drawn.described)
    asked = drawn.kinds >= 0
    assert (said[asked, :6].argmax(1) == drawn.kinds[asked]).float().mean() > 0.9


def test_the_command_writes_a_head_that_opens(tmp_path):
    main(EIGHT_BITS_CARD, tmp_path, seed=1, iterations=3, frames=1, frames_folder=None, learning_rate=1e-3, threads=1)
    card, _ = load_card(tmp_path / EIGHT_BITS_CARD.name)
    assert card.training["second"]["seed"] == 1
    assert card.training["second"]["candidates"] > 0
    DetectionHead(tmp_path / EIGHT_BITS_CARD.name).warm_up()


def test_candidates_are_of_the_first_stage_alone(tmp_path):
    frame = simulate_frame(77)
    save_frame(tmp_path / "77.npz", frame)
    head = DetectionHead(candidates_only=True, score_threshold=0.2)
    samples = candidates_in(head, [tmp_path / "77.npz"])
    assert len(samples) > 5
    assert (samples.scores >= 0.2).all()
    assert (samples.stored <= 512).all()
