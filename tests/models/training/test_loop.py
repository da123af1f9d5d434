"""The training loop on a handful of tiny scenes: it learns, resumes, repeats, and its export is a head that works."""

import logging
import pickle
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from warploom.errors import ConfigError, ModelError
from warploom.models.card import load_card
from warploom.models.classes import CYCLIST, PEDESTRIAN, VEHICLE
from warploom.models.head import DetectionHead
from warploom.models.training.export import export_head, exported_shape, exported_weights
from warploom.models.training.frames import (
    Augmentation,
    TrainingFrame,
    augment,
    labelled_boxes,
    labelled_frame,
    load_frame,
    save_frame,
    simulate_frame,
)
from warploom.models.training.loop import TrainingConfig, described, make_frames, make_views, read_checkpoint, train
from warploom.models.training.network import EXTRAS, HEAD_CLASSES, LEAN_CHANNELS, REGRESSION, PillarCenterNet
from warploom.models.training.targets import draw_targets, loss, overlap
from warploom.models.training.windows import batched, window_of

FIRST = 1_000_000


def scene(seed, reach=9.0):
    """A flat ground with boxes on it whose sides are sprinkled with points."""
    rng = np.random.default_rng(seed)
    k = 5
    boxes = np.c_[
        rng.uniform(-reach, reach, (k, 2)),
        np.full(k, 0.75 - 1.7),
        np.tile([4.2, 1.8, 1.5], (k, 1)),
        rng.uniform(-np.pi, np.pi, k),
    ].astype(np.float32)
    points = [np.c_[rng.uniform(-12, 12, (1500, 2)), rng.normal(-1.7, 0.02, 1500)]]
    for b in boxes:
        u = rng.uniform(-0.5, 0.5, (80, 3))
        u[np.arange(80), rng.integers(0, 2, 80)] = rng.choice([-0.5, 0.5], 80)
        local = u * b[3:6]
        c, s = np.cos(b[6]), np.sin(b[6])
        points.append(b[:3] + np.c_[c * local[:, 0] - s * local[:, 1], s * local[:, 0] + c * local[:, 1], local[:, 2]])
    xyz = np.concatenate(points).astype(np.float32)
    return TrainingFrame(
        xyz=xyz,
        ring=rng.integers(0, 64, len(xyz)).astype(np.uint8),
        boxes=boxes,
        classes=np.zeros(k, np.int32),
        points_in=np.full(k, 80, np.int32),
        sensor_height=1.7,
        velocities=rng.normal(0, 5, (k, 2)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def frames_folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frames")
    make_frames(folder, range(FIRST, FIRST + 4), scene)
    return folder


def config(out, frames_folder, iterations, **options):
    return TrainingConfig(
        out=out,
        iterations=iterations,
        frames=4,
        frames_folder=frames_folder,
        workers=0,
        batch=2,
        window=8.0,
        width=(8, 8, 8),
        average=0.5,
        learning_rate=1e-2,
        augmentation=Augmentation(shift=1.0),
        **options,
    )


def test_it_learns_and_its_export_is_a_head(tmp_path, frames_folder):
    settings = config(tmp_path, frames_folder, 60)
    result = train(settings)
    assert result.iterations == 60
    assert result.losses["heat"] < 8.0  # begins above 20
    path = export_head(
        result.network,
        tmp_path / "head",
        point_range=(-12.0, -8.0, -2.0, 12.0, 8.0, 6.0),
        training=described(settings, result),
    )
    card, _ = load_card(path)
    assert card.input.shape == (1, 20, 64, 96)
    assert card.training["iterations"] == 60
    head = DetectionHead(path, threads=1, score_threshold=0.05)
    frame = scene(77, reach=6.0)
    first = head.detect_points(frame.xyz, frame.sensor_height)
    assert first.boxes.tobytes() == head.detect_points(frame.xyz, frame.sensor_height).boxes.tobytes()


def test_the_export_computes_what_the_network_does(tmp_path):
    """Within 1e-4: batch norms folded into the convolutions, another order of sums."""
    import onnxruntime

    torch.manual_seed(3)
    network = PillarCenterNet((8, 8, 16), (1, 1))
    network.train()(torch.rand(4, 20, 32, 32))  # batch norms that are not the identity
    path = export_head(network, tmp_path, point_range=(-4.0, -4.0, -2.0, 4.0, 4.0, 6.0), training={})
    card, model = load_card(path)
    pillars = torch.rand(1, 20, 32, 32)
    session = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"])
    got = session.run(None, {card.input.name: pillars.numpy()})[0]
    with torch.no_grad():
        said = torch.nn.functional.pixel_unshuffle(network.eval()(pillars), card.output.unfold)
    np.testing.assert_allclose(got, said.numpy(), atol=1e-4)


def test_a_seed_repeats_and_a_checkpoint_resumes(tmp_path, frames_folder, caplog):
    results = [train(config(tmp_path / name, frames_folder, 3)) for name in ("a", "b")]
    for one, other in zip(*(r.network.state_dict().values() for r in results), strict=True):
        assert torch.equal(one, other)
    with caplog.at_level(logging.INFO, logger="warploom.models.training.loop"):
        resumed = train(config(tmp_path / "a", frames_folder, 5))
    assert resumed.iterations == 5
    assert "resuming from iteration 3" in caplog.text


@pytest.mark.parametrize(
    "options", [{}, {"fresh": 1, "kept": 3}, {"frozen": True}], ids=["", "known windows", "frozen"]
)
def test_a_training_that_was_killed_ends_as_if_it_had_not_been(tmp_path, frames_folder, options):
    """Killed by SIGKILL in its sixth step, after the checkpoint of its fifth."""
    whole = train(config(tmp_path / "whole", frames_folder, 8, **options))
    settings = config(tmp_path / "killed", frames_folder, 8, save_every=0.0, **options)
    script = (
        "import os, pickle, signal, torch\n"
        "from warploom.models.training.loop import train\n"
        "average, steps = torch.optim.swa_utils.AveragedModel.update_parameters, iter(range(9))\n"
        "def update(self, network):\n"
        "    average(self, network)\n"
        "    if next(steps) == 5:\n"
        "        os.kill(os.getpid(), signal.SIGKILL)\n"
        "torch.optim.swa_utils.AveragedModel.update_parameters = update\n"
        f"train(pickle.loads(bytes.fromhex('{pickle.dumps(settings).hex()}')))\n"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -signal.SIGKILL
    assert read_checkpoint(settings.out / "checkpoint.pt")["iteration"] == 5
    resumed = train(settings)
    assert resumed.iterations == whole.iterations == 8
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name


def test_checkpoints_that_do_not_fit_are_named(tmp_path, frames_folder):
    settings = config(tmp_path / "a", frames_folder, 1)
    train(settings)
    checkpoint = settings.out / "checkpoint.pt"
    with pytest.raises(ModelError, match=r"checkpoint\.pt: of a training of another network; go on with the options"):
        train(replace(settings, width=(8, 8, 16)))
    other = config(tmp_path / "b", frames_folder, 1, start_from=tmp_path / "x.pt")
    with pytest.raises(ModelError, match=r"x\.pt: cannot read the checkpoint: No such file"):
        train(other)
    torch.save({"model": torch.zeros(3)}, tmp_path / "x.pt")
    with pytest.raises(ModelError, match=r"x\.pt: not a checkpoint of a training"):
        train(other)
    checkpoint.write_bytes(checkpoint.read_bytes()[:-1000])
    with pytest.raises(ModelError, match=r"checkpoint\.pt: the checkpoint is damaged"):
        train(settings)


def test_fewer_channels_and_a_further_branch_learn_too(tmp_path, frames_folder):
    settings = config(tmp_path, frames_folder, 60, channels=LEAN_CHANNELS, extras=EXTRAS)
    assert len(LEAN_CHANNELS) == 16
    result = train(settings)
    assert result.losses["heat"] < 8.0
    assert 0.0 < result.losses["iou"] < 1.0
    recipe = described(settings, result)["recipe"]
    assert recipe["extras"] == list(EXTRAS)
    assert len(recipe["channels"]) == 16
    # Velocities are not exported, the overlap is: the file says what the network does.
    path = export_head(
        result.network, tmp_path / "head", point_range=(-8, -8, -2, 8, 8, 6), training={}, overlap_weight=0.5
    )
    card, model = load_card(path)
    assert b"vehicle,pedestrian,cyclist,cone,barrier" in model.read_bytes()
    assert card.input.channels == LEAN_CHANNELS
    assert card.input.shape == (1, 16, 64, 64)
    assert card.output.regression == (*REGRESSION, "iou")
    import onnxruntime

    pillars = torch.rand(1, 16, 64, 64)
    got = onnxruntime.InferenceSession(str(model), providers=["CPUExecutionProvider"]).run(
        None, {"pillars": pillars.numpy()}
    )[0]
    with torch.no_grad():
        maps, said = result.network.eval().forward_all(pillars)
    expected = torch.nn.functional.pixel_unshuffle(torch.cat([maps, said[:, :1]], 1), card.output.unfold)
    np.testing.assert_allclose(got, expected.numpy(), atol=1e-4)
    frame = scene(3, reach=6.0)
    found = DetectionHead(path, threads=1, score_threshold=0.05).detect_points(frame.xyz, frame.sensor_height)
    assert len(found) > 0


def test_a_wider_network_begins_where_a_narrower_one_was():
    """What is new adds nothing at first; the four channels that it is not given are empty here."""
    torch.manual_seed(0)
    old = PillarCenterNet((8, 8, 8))
    old.train()(torch.rand(4, 20, 32, 32))
    new = PillarCenterNet((12, 8, 8), channels=LEAN_CHANNELS, extras=("iou",))
    new.begin_with(old.state_dict())
    pillars = torch.rand(1, 20, 32, 32)
    pillars[:, 11:15] = 0.0
    kept = torch.cat([pillars[:, :11], pillars[:, 15:]], 1)
    with torch.no_grad():
        torch.testing.assert_close(new.eval()(kept), old.eval()(pillars), atol=1e-5, rtol=1e-5)


def test_a_deeper_network_begins_as_the_shallower_one():
    torch.manual_seed(4)
    shallow = PillarCenterNet((8, 8, 8), (1, 1)).eval()
    deep = PillarCenterNet((8, 8, 8), (1, 3)).eval()
    deep.begin_with(shallow.state_dict())
    pillars = torch.rand(1, 20, 32, 32)
    torch.testing.assert_close(deep(pillars), shallow(pillars))
    deep.train()(pillars).sum().backward()
    assert deep.down2[-1].second[1].weight.grad.abs().sum() > 0  # from there on it learns


def test_names_that_there_are_not_are_refused():
    for options, message in (
        ({"channels": ("z9",)}, "channels must be of"),
        ({"extras": ("mass",)}, "extras must be of"),
    ):
        with pytest.raises(ValueError, match=message):
            PillarCenterNet((8, 8, 8), **options)


def test_a_process_beside_draws_the_same_windows(tmp_path, frames_folder):
    from warploom.models.training.loop import _fresh

    ways = [_fresh(config(tmp_path, frames_folder, 3, loaders=loaders, fresh=1), 0) for loaders in (0, 1)]
    for _ in range(3):
        (one,), (other,) = (next(way) for way in ways)
        assert one.pillars.tobytes() == other.pillars.tobytes()
        assert one.values.tobytes() == other.values.tobytes()
        assert one.cells.tobytes() == other.cells.tobytes()
    with pytest.raises(ValueError, match="loaders must be 0 or 1"):
        config(tmp_path, frames_folder, 3, loaders=2)
    with pytest.raises(ValueError, match="fresh must be from 1 to the batch, 2, not 3"):
        config(tmp_path, frames_folder, 3, fresh=3)


def test_known_windows_and_frozen_norms_repeat_and_learn_on(tmp_path, frames_folder):
    first = train(config(tmp_path / "first", frames_folder, 40))
    frozen = {"frozen": True, "fresh": 1, "start_from": tmp_path / "first" / "checkpoint.pt"}
    results = [train(config(tmp_path / name, frames_folder, 12, **frozen)) for name in ("a", "b")]
    for one, other in zip(*(r.network.state_dict().values() for r in results), strict=True):
        assert torch.equal(one, other)
    assert results[0].losses["heat"] < 8.0  # begins above 20 without what was learnt
    norms = [
        {name: value for name, value in result.network.state_dict().items() if "running" in name}
        for result in (first, results[0])
    ]
    assert norms[0]
    assert all(torch.equal(value, norms[1][name]) for name, value in norms[0].items())
    changed = (first.network.stem[0].weight - results[0].network.stem[0].weight).abs().max()
    assert changed > 0


def test_frozen_norms_compute_what_evaluation_does():
    """In float32, within 1e-4: the same sums in another order; gradients of every weight within 1 %."""
    torch.manual_seed(5)
    network = PillarCenterNet((8, 8, 16), (1, 2), extras=("iou",))
    network.train()(torch.rand(4, 20, 32, 32))
    network.eval()
    pillars = torch.rand(2, 20, 32, 32)
    folded = network.folded_maps(pillars, frozen=True)
    unfolded = torch.nn.functional.pixel_unshuffle(torch.cat(network.forward_all(pillars), 1), 2)
    torch.testing.assert_close(folded, unfolded, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(network.folded_maps(pillars), unfolded, atol=1e-4, rtol=1e-4)
    slopes = []
    for maps in (folded, unfolded):
        network.zero_grad()
        maps.square().mean().backward()
        slopes.append({name: value.grad.clone() for name, value in network.named_parameters()})
    for name, slope in slopes[0].items():
        torch.testing.assert_close(slope, slopes[1][name], rtol=0.01, atol=0.01 * float(slopes[1][name].abs().max()))


def test_people_have_room_in_their_labels_and_stand_where_they_did():
    boxes = np.array([[1, 2, 0.85, 0.3, 0.5, 1.7, 0.3], [4, 5, 0.9, 1.7, 0.6, 1.8, 1.0], [9, 9, 1, 4, 2, 1.5, 0.2]])
    labelled = labelled_boxes(boxes, np.array([PEDESTRIAN, CYCLIST, VEHICLE]))
    np.testing.assert_allclose(labelled[0, 3:6], [0.7, 0.6, 1.75])
    np.testing.assert_allclose(labelled[1, 3:6], [1.7, 0.7, 1.85])
    np.testing.assert_array_equal(labelled[2], boxes[2])
    np.testing.assert_array_equal(labelled[:, [0, 1, 6]], boxes[:, [0, 1, 6]])
    np.testing.assert_allclose(labelled[:, 2] - labelled[:, 5] / 2, boxes[:, 2] - boxes[:, 5] / 2)


@pytest.mark.parametrize("seed", range(5))
def test_the_overlap_is_that_of_the_solids_where_headings_agree(seed):
    """Against the polygons' of `models.geometry`, within 1e-4: float32 logarithms and angles."""
    from warploom.models.geometry import box_overlap

    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-3, 3)
    true = np.array([[*rng.uniform(-0.4, 0.4, 2), 0.8, 4.2, 1.8, 1.5, yaw]])
    said = true + np.array([[*rng.normal(0, 0.4, 2), 0.2, 0.5, -0.2, 0.1, 0.0]])

    def maps(box):
        x, y, z, length, width, height, angle = box[0]
        turn = [np.cos(2 * angle), np.sin(2 * angle), np.cos(angle), np.sin(angle)]
        row = [x / 0.5, y / 0.5, z, *np.log([length, width, height]), *turn]
        return torch.tensor(row, dtype=torch.float32)[None, :, None, None]

    _, solid, _ = box_overlap(true, said)
    assert float(overlap(maps(said), maps(true))) == pytest.approx(float(solid[0]), abs=1e-4)
    turned = said + np.array([[0, 0, 0, 0, 0, 0, 0.4]])
    assert float(overlap(maps(turned), maps(true))) < float(overlap(maps(said), maps(true)))


def test_velocities_turn_with_the_frame_and_reach_the_targets():
    frame = scene(5)
    options = Augmentation(thin_rings=0.0, thin_points=0.0, tilt=0.0, scale=0.0, shift=0.0)
    varied = augment(frame, np.random.default_rng(8), options)
    c, s = np.cos(varied.boxes[:, 6]), np.sin(varied.boxes[:, 6])
    along = varied.velocities[:, 0] * c + varied.velocities[:, 1] * s
    before = frame.velocities[:, 0] * np.cos(frame.boxes[:, 6]) + frame.velocities[:, 1] * np.sin(frame.boxes[:, 6])
    np.testing.assert_allclose(along, before, atol=1e-4)
    arguments = (np.array([[1.3, -0.6, -0.9, 4.2, 1.8, 1.5, 2.0]], np.float32), np.array([0]), np.array([50]))
    known = draw_targets(*arguments, (-8.0, -8.0), 0.5, (32, 32), velocities=np.array([[5.0, -2.0]]))
    np.testing.assert_allclose(known.velocity[:, 14, 18], [0.5, -0.2], atol=1e-6)
    assert np.isnan(draw_targets(*arguments, (-8.0, -8.0), 0.5, (32, 32)).velocity).all()


def test_views_are_scans_of_one_street_in_files_of_their_own(tmp_path):
    settings = TrainingConfig(out=tmp_path, iterations=1, frames=3, views=2)
    make_views(settings.folder, range(FIRST, FIRST + 1), 2)
    paths = [settings.frame_path(number) for number in range(3)]
    assert [path.exists() for path in paths] == [True, True, False]
    assert len(set(paths)) == 3
    one, other = (load_frame(path) for path in paths[:2])
    assert one.xyz.tobytes() == load_frame(paths[0]).xyz.tobytes()
    assert len(one.boxes) > 0
    assert one.velocities.shape == (len(one.boxes), 2)
    first = simulate_frame(FIRST)  # the first view is the scene of the seed
    np.testing.assert_allclose(one.xyz, first.xyz, atol=1.1e-3)
    assert one.xyz.shape != other.xyz.shape
    with pytest.raises(ValueError, match="views"):
        TrainingConfig(out=tmp_path, iterations=1, views=0)


def test_no_frames_is_said(tmp_path):
    with pytest.raises(RuntimeError, match="ended with 0 of 4 frames"):
        train(config(tmp_path, tmp_path / "nothing", 3))


def test_a_frame_file_keeps_millimetres(tmp_path):
    frame = scene(1)
    save_frame(tmp_path / "f.npz", frame)
    back = load_frame(tmp_path / "f.npz")
    np.testing.assert_allclose(back.xyz, frame.xyz, atol=1.1e-3)
    np.testing.assert_array_equal(back.boxes, frame.boxes)
    assert back.sensor_height == pytest.approx(1.7)


@pytest.mark.parametrize("seed", range(6))
def test_augmentation_keeps_points_in_their_boxes(seed):
    from warploom.models.geometry import points_in_boxes

    frame = scene(seed)
    options = Augmentation(thin_rings=0.0, thin_points=0.0, tilt=0.0)
    varied = augment(frame, np.random.default_rng(seed), options)

    def inside(xyz, boxes):
        grown = boxes.astype(np.float64).copy()
        grown[:, 3:6] += 0.02
        return points_in_boxes(xyz, grown).any(axis=0)

    on_boxes = np.arange(len(frame.xyz)) >= 1500
    assert inside(frame.xyz, frame.boxes)[on_boxes].all()
    assert inside(varied.xyz, varied.boxes)[on_boxes].all()


def test_targets_say_the_box_at_its_centre():
    yaw = 2.0
    boxes = np.array([[1.3, -0.6, -0.9, 4.2, 1.8, 1.5, yaw], [-3.0, 3.0, -0.9, 0.6, 0.6, 1.7, 0.0]], np.float32)
    targets = draw_targets(boxes, np.array([0, 1]), np.array([50, 2]), (-8.0, -8.0), 0.5, (32, 32), ground=-1.7)
    row, column = int(7.4 / 0.5), int(9.3 / 0.5)
    assert targets.heat[0, row, column] == 1.0
    assert (targets.heat >= 1.0).sum() == 1  # the other has too few points
    assert targets.mask[1, 22, 10] == 0.0
    expected = [18.6 - 18.5, 14.8 - 14.5, 0.8, *np.log([4.2, 1.8, 1.5]), np.cos(4), np.sin(4), np.cos(2), np.sin(2)]
    np.testing.assert_allclose(targets.values[:, row, column], expected, atol=1e-5)


def asked(targets):
    """The targets of one frame as a batch that the loss reads."""
    edge = 2 * targets.heat.shape[1]
    return batched([window_of(np.zeros((1, edge, edge), np.float32), ("below",), targets)])


def folded(maps):
    return torch.nn.functional.pixel_unshuffle(maps, 2)


def test_saying_the_targets_costs_next_to_nothing():
    boxes = np.array([[1.3, -0.6, -0.9, 4.2, 1.8, 1.5, 2.0]], np.float32)
    t = draw_targets(boxes, np.array([0]), np.array([50]), (-8.0, -8.0), 0.5, (32, 32))
    heat, values = torch.from_numpy(t.heat)[None], torch.from_numpy(t.values)[None]
    right = torch.cat([torch.where(heat >= 1.0, 12.0, -12.0), values], dim=1)
    wrong = torch.zeros_like(right)
    assert right.shape[1] == len(HEAD_CLASSES) + len(REGRESSION)
    assert float(loss(folded(right), asked(t))[0]) < 1e-3
    assert float(loss(folded(wrong), asked(t))[0]) > 10.0


def test_the_loss_is_that_of_whole_maps():
    """Against the sums over all cells, differentiated automatically, within 0.2 %: what is calm is kept in float16."""
    rng = np.random.default_rng(0)
    drawn, samples = [], []
    for _ in range(2):
        k = 12
        box = np.c_[rng.uniform(-7, 7, (k, 2)), np.full(k, -0.9), rng.uniform(0.5, 5, (k, 3)), rng.uniform(-3, 3, k)]
        t = draw_targets(
            box.astype(np.float32), rng.integers(0, 5, k), rng.integers(0, 60, k), (-8.0, -8.0), 0.5, (32, 32),
            velocities=rng.normal(0, 5, (k, 2)),
        )  # fmt: skip
        drawn.append(t)
        samples.append(window_of(np.zeros((1, 64, 64), np.float32), ("below",), t))
    heat, mask, values, weight = (
        torch.from_numpy(np.stack([getattr(t, name) for t in drawn])) for name in ("heat", "mask", "values", "weight")
    )
    maps = torch.from_numpy(rng.normal(-2, 2, (2, 16, 32, 32)).astype(np.float32)).requires_grad_()
    total, parts = loss(folded(maps), batched(samples), ("iou",))
    total.backward()
    slope = maps.grad.clone()
    maps.grad = None

    p = torch.sigmoid(maps[:, :5])
    peaks = heat >= 1.0
    focal = torch.where(peaks, -((1 - p) ** 2) * p.log(), -(p**2) * (1 - heat) ** 4 * mask * (1 - p).log())
    class_weights = torch.tensor([1.0, 1.5, 1.5, 1.0, 1.0])[None, :, None, None]
    expected = (focal * class_weights).sum() / peaks.sum()
    own = torch.tensor([1.0] * 6 + [2.0] * 2 + [0.3] * 2)[None, :, None, None]
    box = ((maps[:, 5:15] - values).abs() * own * weight[:, None]).sum() / weight.sum()
    common = overlap(maps[:, 5:15], values)
    apart = ((1.0 - common) * weight).sum() / weight.sum()
    iou = ((maps[:, 15] - (2 * common.detach() - 1)).abs() * weight).sum() / weight.sum()
    (expected + 0.5 * box + apart + 0.2 * iou).backward()
    for name, value in {"heat": expected, "box": box, "apart": apart, "iou": iou}.items():
        assert parts[name] == pytest.approx(float(value.detach()), rel=2e-3)
    torch.testing.assert_close(slope, maps.grad, rtol=2e-3, atol=2e-3 * float(maps.grad.abs().max()))


def test_what_a_place_is_off_by_costs_a_person_more_than_a_bus():
    """0.3 m along an object's axis of either size: L1 is the same, the overlap is not; gradients stay finite."""
    costs, pulls = [], []
    for size in ([0.7, 0.6, 1.75], [11.0, 2.5, 3.0]):
        box = np.array([[1.25, -0.75, 0.5 * size[2], *size, 0.0]], np.float32)
        t = draw_targets(box, np.array([0]), np.array([50]), (-8.0, -8.0), 0.5, (32, 32))
        heat, values = torch.from_numpy(t.heat)[None], torch.from_numpy(t.values)[None]
        said = torch.cat([torch.where(heat >= 1.0, 12.0, -12.0), values], dim=1)
        said[:, len(HEAD_CLASSES)] += 0.6  # [cells]
        said.requires_grad_()
        total, parts = loss(folded(said), asked(t))
        total.backward()
        assert torch.isfinite(said.grad).all()
        costs.append(parts)
        pulls.append(float(said.grad[0, len(HEAD_CLASSES)].abs().sum()))
    assert costs[0]["box"] == pytest.approx(costs[1]["box"], abs=1e-5)
    assert costs[0]["apart"] == pytest.approx(1 - 0.4 / 1.0, abs=1e-4)
    assert costs[1]["apart"] == pytest.approx(1 - 10.7 / 11.3, abs=1e-4)
    assert pulls[0] > 1.5 * pulls[1]


def test_contradicting_lengths_are_refused(tmp_path):
    with pytest.raises(ValueError, match="either minutes or iterations"):
        TrainingConfig(out=tmp_path)
    with pytest.raises(ValueError, match="multiple of 8"):
        TrainingConfig(out=tmp_path, iterations=1, window=8.1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": -1}, "seed must be at least 0, not -1"),
        ({"threads": 0}, "threads must be at least 1, not 0"),
        ({"workers": -1}, "workers must be at least 0, not -1"),
        ({"iterations": 0}, "iterations must be at least 1, not 0"),
        ({"iterations": None, "minutes": float("nan")}, "minutes must be a number above 0, not nan"),
        ({"learning_rate": float("inf")}, "learning_rate must be a number above 0, not inf"),
        ({"final_share": -1.0}, "final_share must be a number above 0"),
        ({"extras": ("mass",)}, "extras must be of iou"),
        ({"width": (0, 48, 128)}, "width must be 1 or more each"),
        ({"depth": (1, -1)}, "depth 0 or more"),
    ],
)
def test_what_no_training_can_be_made_of_is_refused(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        TrainingConfig(out=tmp_path, **{"iterations": 1} | options)


def test_a_training_begins_with_an_exported_head(tmp_path):
    """Batch norms were folded into the convolutions: the network says the same within 1e-5 of what it said."""
    torch.manual_seed(5)
    network = PillarCenterNet((8, 12, 16), (2, 1), LEAN_CHANNELS, ("iou",))
    network.train()(torch.rand(4, 16, 32, 32))
    path = export_head(network, tmp_path, point_range=(-4.0, -4.0, -2.0, 4.0, 4.0, 6.0), training={})
    shape = exported_shape(path)
    assert shape == {"width": (8, 12, 16), "depth": (2, 1), "channels": LEAN_CHANNELS, "extras": ("iou",)}
    again = PillarCenterNet(**shape)
    again.load_state_dict(exported_weights(path, again))
    pillars = torch.rand(2, 16, 32, 32)
    with torch.no_grad():
        said, wanted = again.eval().forward_all(pillars), network.eval().forward_all(pillars)
    for mine, other in zip(said, wanted, strict=True):
        np.testing.assert_allclose(mine.numpy(), other.numpy(), atol=1e-5)
    with pytest.raises(ModelError, match="another shape"):
        exported_weights(path, PillarCenterNet((8, 12, 16), (1, 1), LEAN_CHANNELS, ("iou",)))


def test_labelled_scans_are_learnt_from_as_they_are(tmp_path, frames_folder):
    """A share of 1 draws no simulated scan; boxes that people drew are not given more room."""
    folder = tmp_path / "labelled"
    folder.mkdir()
    walker = np.array([[3.0, 1.0, -0.9, 0.8, 0.6, 1.7, 0.0]], np.float32)
    points = np.random.default_rng(0).uniform((2.7, 0.8, -1.6), (3.3, 1.2, -0.2), (50, 3))
    save_frame(folder / "one.npz", labelled_frame(points, walker, np.array([1]), 1.7))
    assert load_frame(folder / "one.npz").points_in.tolist() == [50]
    # With no simulated scan there, to draw one would fail.
    settings = replace(config(tmp_path, tmp_path / "nothing", 40), frames=0, labelled=folder, labelled_share=1.0)
    result = train(settings)
    assert result.losses["heat"] < 8.0  # begins above 20
    assert described(settings, result)["data"] == "1 labelled scans of one's own"
    mixed = replace(config(tmp_path / "mixed", frames_folder, 4), labelled=folder)
    assert described(mixed, train(mixed))["data"].endswith("and scenes of warploom's simulator")


def test_labelled_scans_that_are_not_there_are_named(tmp_path, frames_folder):
    with pytest.raises(ConfigError, match="no scans"):
        train(replace(config(tmp_path, frames_folder, 2), labelled=tmp_path))
    with pytest.raises(ValueError, match="labelled_share"):
        replace(config(tmp_path, frames_folder, 2), labelled_share=1.5)
    with pytest.raises(ValueError, match="frames must be at least 1"):
        replace(config(tmp_path, frames_folder, 2), frames=0)
