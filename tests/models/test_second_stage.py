"""The second stage of a head: its card, its network at work, and what is refused."""

import numpy as np
import pytest
import torch
import yaml

from warploom.errors import ModelError
from warploom.kernels.nms import rotated_nms
from warploom.models.card import EIGHT_BITS_CARD, load_card, save_card
from warploom.models.head import DetectionHead
from warploom.models.training.frames import height_over_ground
from warploom.models.training.second import export_second
from warploom.models.training.second_network import SecondNet

LEAST = 0.3


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """The shipped first stage alone, not refined."""
    folder = tmp_path_factory.mktemp("first")
    card, model = load_card(EIGHT_BITS_CARD)
    (folder / model.name).write_bytes(model.read_bytes())
    decode = card.decode.model_copy(update={"refine": (), "score_threshold": LEAST})
    save_card(folder / "first.yaml", card.model_copy(update={"second": None, "decode": decode}))
    return folder / "first.yaml"


@pytest.fixture(scope="module")
def network():
    """Of random weights, whose last layer says no more than little, so that boxes stay near their places."""
    torch.manual_seed(3)
    net = SecondNet(5)
    with torch.no_grad():
        net.boxes[-1].weight.mul_(4.0)
        net.boxes[-1].weight[7:].mul_(0.1)
    return net.eval()


SPEC = {"candidate_score": 0.2, "max_boxes": 48, "moved": ("vehicle", "cyclist"), "weights": (0.5, 0.3, 0.2)}


@pytest.fixture(scope="module")
def both(first, network, tmp_path_factory):
    return export_second(network, first, tmp_path_factory.mktemp("both"), spec=SPEC, training={"seed": 3})


@pytest.fixture(scope="module")
def clouds():
    from warploom.models.simulator import sample_scene

    frames = [sample_scene(seed, lidar=lidar) for seed, lidar in ((301, "hdl64"), (302, "hdl32"), (303, "hdl64"))]
    return [(f.points, height_over_ground(f.points, f.ground)) for f in frames]


def edit(path, target, **changes):
    content = yaml.safe_load(path.read_text())
    content["second"].update(changes)
    (target / path.name).write_text(yaml.safe_dump(content))
    for model in path.parent.glob("*.onnx"):
        (target / model.name).write_bytes(model.read_bytes())
    return target / path.name


def test_the_card_reads_back_as_written(both, tmp_path):
    card, model = load_card(both)
    assert card.second.file == "pillar_center_second.onnx"
    assert card.second.moved == ("vehicle", "cyclist")
    assert card.training["second"] == {"seed": 3}
    save_card(both.with_name("again.yaml"), card)
    assert load_card(both.with_name("again.yaml")) == (card, model)


def test_boxes_are_what_the_network_says_of_the_candidates(both, first, network, clouds):
    """Gathered by our kernel, said by torch and combined in NumPy: to 1e-3 m and 1e-3 of the score."""
    head = DetectionHead(both, score_threshold=LEAST)
    plain = DetectionHead(first, score_threshold=SPEC["candidate_score"])
    for points, height in clouds:
        found = head.detect_points(points, height)
        candidates = plain.detect_points(points, height)
        look = head._second.look(0)
        with torch.no_grad():
            said = network(*(torch.from_numpy(array.numpy()) for array in look.arrays[:2])).numpy()
        count = int(look.rescore.count.numpy()[0])
        assert 0 < count <= SPEC["max_boxes"]
        decode = head._slots[0].decode
        keep = look.rescore.chosen.numpy()[:count]
        able = candidates.boxes[candidates.scores**0.5 >= LEAST + 1e-6]  # the others cannot reach the least score
        assert set(map(bytes, able[: count - 2])) <= set(map(bytes, decode.boxes.numpy()[keep]))
        p = torch.softmax(torch.from_numpy(said[:count, :6]), 1).numpy()[:, 1:]
        overlap = 1 / (1 + np.exp(-said[:count, 6]))
        scores = decode.scores.numpy()[keep] ** 0.5 * p.max(1) ** 0.3 * overlap**0.2
        boxes = look.rescore.boxes_out.numpy()[:count]
        good = np.flatnonzero(scores >= LEAST)
        stay = good[rotated_nms(boxes[good], np.float32(scores[good]), 0.2)]
        stay = [k for k in stay if np.hypot(*boxes[k, :2]) > 4]
        far = [k for k in range(len(found)) if np.hypot(*found.boxes[k, :2]) > 4]
        np.testing.assert_allclose(found.scores[far], scores[stay], atol=1e-3)
        np.testing.assert_allclose(found.boxes[far], boxes[stay], atol=1e-3)
        np.testing.assert_array_equal(found.classes[far], p.argmax(1)[stay])


def test_the_file_says_what_the_network_says(both, network):
    import onnxruntime

    session = onnxruntime.InferenceSession(both.with_name("pillar_center_second.onnx").read_bytes())
    rng = np.random.default_rng(0)
    points = rng.normal(0, 1, (9, 128, 11)).astype(np.float32)
    points[..., 10] = rng.random((9, 128)) < 0.5
    points *= points[..., 10:]
    points[0] = 0
    boxes = rng.normal(0, 1, (9, 14)).astype(np.float32)
    said = session.run(None, {"points": points, "boxes": boxes})[0]
    given = torch.from_numpy(points), torch.from_numpy(boxes)
    with torch.no_grad():
        np.testing.assert_allclose(said, network(*given).numpy(), atol=1e-4)
        np.testing.assert_allclose(said, network.train()(*given).numpy(), atol=1e-4)
    network.eval()


def test_the_same_scan_gives_the_same_bytes_and_a_batch_the_same_boxes(both, clouds):
    """Of a batch to 1e-3 m and 1e-4 of the score: the order of sums in a product may depend on its rows."""
    head = DetectionHead(both, score_threshold=LEAST)
    alone = [head.detect_points(*cloud) for cloud in clouds]
    again = DetectionHead(both, score_threshold=LEAST, threads=1).detect_points(*clouds[0])
    assert again.boxes.tobytes() == head.detect_points(*clouds[0]).boxes.tobytes() == alone[0].boxes.tobytes()
    together = DetectionHead(both, score_threshold=LEAST, batch=3).detect_batch(*zip(*clouds, strict=True))
    for a, b in zip(alone, together, strict=True):
        assert a.classes.tolist() == b.classes.tolist()
        np.testing.assert_allclose(a.boxes, b.boxes, atol=1e-3)
        np.testing.assert_allclose(a.scores, b.scores, atol=1e-4)


def test_no_points_and_no_candidates(both):
    head = DetectionHead(both, score_threshold=LEAST)
    for points in (np.zeros((0, 3)), np.zeros((1, 3)), np.full((9, 3), np.nan)):
        assert len(head.detect_points(points.astype(np.float32), 1.7)) == 0
    assert head.overflow == 0


def test_candidates_only_leave_the_second_stage_out(both, first, clouds):
    a = DetectionHead(both, score_threshold=LEAST, candidates_only=True).detect_points(*clouds[0])
    b = DetectionHead(first, score_threshold=LEAST).detect_points(*clouds[0])
    assert a.boxes.tobytes() == b.boxes.tobytes()
    assert a.scores.tobytes() == b.scores.tobytes()


def test_candidates_that_nobody_looks_at_are_counted(both, clouds, tmp_path):
    few = edit(both, tmp_path, max_boxes=3)
    head = DetectionHead(few, score_threshold=LEAST)
    assert len(head.detect_points(*clouds[0])) <= 3
    more = DetectionHead(both, score_threshold=LEAST, candidates_only=True).detect_points(*clouds[0])
    assert head.overflow >= len(more) - 4 > 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sha256": "0" * 64}, r"pillar_center_second.onnx: its sha256 is [0-9a-f]{64}, but the card"),
        ({"opset": 16}, "pillar_center_second.onnx: its opset is 17, but the card"),
        ({"file": "elsewhere.onnx"}, r"elsewhere.onnx is not there"),
        ({"file": "../pillar_center_second.onnx"}, "second.file: .*must be the name of a file beside the card"),
        ({"file": "pillar_center_int8.onnx"}, "second.file is the first stage's"),
        ({"moved": ["unicorn"]}, "second.moved names unicorn, but the classes are vehicle"),
        ({"size_shares": {"unicorn": 0.5}}, "second.size_shares names unicorn"),
        ({"size_shares": {"vehicle": 1.5}}, "second.size_shares: .*from 0 to 1"),
        ({"powers": {"unicorn": 0.5}}, "second.powers names unicorn"),
        ({"powers": {"vehicle": 0.0}}, "second.powers: .*above 0"),
        ({"powers": {"vehicle": float("inf")}}, "second.powers.vehicle: Input should be a finite number"),
        ({"weights": [float("nan")] * 3}, "second.weights.0: Input should be a finite number"),
        ({"over_bottom": float("nan")}, "second.over_bottom: Input should be a finite number"),
        ({"weights": [0.5, 0.6, 0.1]}, "second.weights: .*add up to 1"),
        ({"candidate_score": 1.5}, "second.candidate_score"),
        ({"points_of_box": 64}, r"its input is .*points.*, but the card says .*64, 11"),
        ({"surprise": 1}, "second.surprise"),
    ],
)
def test_what_does_not_fit_is_refused_by_name(both, tmp_path, changes, message):
    with pytest.raises(ModelError, match=message):
        DetectionHead(edit(both, tmp_path, **changes))


def test_a_network_of_other_classes_or_sizes_is_refused(first, tmp_path):
    with pytest.raises(ModelError, match=r"its output is .*but the card says"):
        DetectionHead(export_second(Wider(), first, tmp_path / "wider", training={}))


class Wider(SecondNet):
    """Says one thing more than is read."""

    def forward(self, points, boxes):
        said = super().forward(points, boxes)
        return torch.cat([said, said[:, :1]], 1)
