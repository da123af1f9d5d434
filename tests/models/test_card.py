"""Cards: read back as written, and a model that does not fit is refused by name."""

from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from warploom.errors import ModelError
from warploom.models.card import DEFAULT_CARD, EIGHT_BITS_CARD, default_card, load_card, named_card, save_card
from warploom.models.head import DetectionHead
from warploom.models.training.export import export_head
from warploom.models.training.network import PillarCenterNet

RANGE = (-8.0, -4.0, -2.0, 8.0, 4.0, 6.0)


@pytest.fixture
def card_path(tmp_path):
    torch.manual_seed(0)
    return export_head(PillarCenterNet((8, 8, 8)), tmp_path, point_range=RANGE, training={"seed": 0})


def edit(path, **changes):
    """Changes keys, dotted, of a card file."""
    content = yaml.safe_load(path.read_text())
    for key, value in changes.items():
        *parents, last = key.split("__")
        place = content
        for parent in parents:
            place = place[parent]
        place[last] = value
    path.write_text(yaml.safe_dump(content))


def test_a_card_reads_back_as_written(card_path, tmp_path):
    card, model = load_card(card_path)
    assert model.name == "pillar_center.onnx"
    assert card.input.shape == (1, 20, 32, 64)
    assert card.output.shape == (1, 60, 8, 16)
    assert card.output.unfolded == (15, 16, 32)
    save_card(tmp_path / "again.yaml", card)
    assert load_card(tmp_path / "again.yaml")[0] == card


def test_a_changed_model_is_refused_by_its_sha256(card_path):
    model = card_path.with_suffix(".onnx")
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 1
    model.write_bytes(data)
    with pytest.raises(ModelError, match=r"pillar_center.onnx: its sha256 is [0-9a-f]{64}, but the card"):
        load_card(card_path)


def test_a_missing_model_and_a_missing_card_are_named(card_path):
    with pytest.raises(ModelError, match="cannot read the head's card"):
        load_card(card_path.with_name("other.yaml"))
    card_path.with_suffix(".onnx").unlink()
    with pytest.raises(ModelError, match=r"pillar_center.onnx is not there"):
        load_card(card_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"input__shape": [1, 20, 64, 64]}, r"input.shape \(1, 20, 64, 64\) does not follow"),
        ({"output__shape": [1, 14, 16, 32]}, r"output.shape \(1, 14, 16, 32\) does not follow"),
        ({"classes": ["vehicle", "unicorn"]}, "no class 'unicorn'"),
        ({"opset": 16}, "its opset is 17, but the card"),
        ({"opset": 18}, "opset"),
        ({"decode__nms_iou": 2.0}, "decode.nms_iou"),
        (
            {"input__point_range": [-8, -4, -2, 8, 4, float("inf")]},
            "input.point_range.5: Input should be a finite number",
        ),
        ({"input__point_range": [-8, -4, 6, 8, 4, -2]}, "input.point_range must be .* with min < max"),
        ({"decode__max_candidates": 10**9}, "decode.max_candidates: Input should be less than or equal to 32768"),
        ({"decode__overlap_weight": 0.5}, "overlap_weight is 0.5, but output.regression has no iou"),
        ({"decode__overlap_weight": 1.0}, "decode.overlap_weight"),
        ({"decode__refine": ["unicorn"]}, "decode.refine names unicorn, but the classes are vehicle"),
        ({"output__regression": ["dx", "dy"]}, "this version decodes dx, dy"),
        ({"surprise": 1}, "surprise"),
        ({"kind": "unicorn"}, "a card of the kind 'unicorn'; one of the kind .*pillar_center.* is wanted here"),
        ({"sha256": "abc"}, "sha256"),
        ({"file": "../pillar_center.onnx"}, "file: .*must be the name of a file beside the card"),
        ({"file": "/etc/passwd"}, "file: .*must be the name of a file beside the card"),
    ],
)
def test_a_card_that_does_not_fit_is_refused(card_path, changes, message):
    edit(card_path, **changes)
    with pytest.raises(ModelError, match=message):
        load_card(card_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"input__name": "points"}, "its input is .*'pillars'.* but the card says .*'points'"),
        ({"output__name": "boxes"}, "its output is .*'maps'"),
        (
            {
                "input__shape": [1, 20, 32, 32],
                "input__point_range": [-4, -4, -2, 4, 4, 6],
                "output__shape": [1, 60, 8, 8],
            },
            "its input is",
        ),
        ({"input__channels": [f"c{k}" for k in range(20)]}, "channels must be some of those"),
    ],
)
def test_a_model_that_does_not_fit_its_card_is_refused_before_it_runs(card_path, changes, message):
    edit(card_path, **changes)
    with pytest.raises(ModelError, match=message):
        DetectionHead(card_path, threads=1)


def test_what_is_not_a_model_is_refused(card_path):
    import hashlib

    junk = bytes(np.random.default_rng(0).integers(0, 256, 5000, dtype=np.uint8))
    card_path.with_suffix(".onnx").write_bytes(junk)
    edit(card_path, sha256=hashlib.sha256(junk).hexdigest())
    with pytest.raises(ModelError, match=r"pillar_center.onnx"):
        DetectionHead(card_path, threads=1)


def test_weights_in_other_files_are_refused(card_path):
    import hashlib

    import onnx

    model = card_path.with_suffix(".onnx")
    changed = onnx.load(str(model))
    changed.graph.initializer[0].data_location = onnx.TensorProto.EXTERNAL
    model.write_bytes(changed.SerializeToString())
    edit(card_path, sha256=hashlib.sha256(model.read_bytes()).hexdigest())
    with pytest.raises(ModelError, match="its weights lie in other files"):
        load_card(card_path)


def test_a_model_cut_off_is_refused_though_its_card_means_it(card_path):
    import hashlib

    model = card_path.with_suffix(".onnx")
    model.write_bytes(model.read_bytes()[:-100])
    edit(card_path, sha256=hashlib.sha256(model.read_bytes()).hexdigest())
    with pytest.raises(ModelError, match=r"pillar_center.onnx: this is not an ONNX model"):
        load_card(card_path)


@pytest.mark.parametrize("text", ["", "[1, 2]", "just text"])
def test_what_is_no_mapping_is_refused(text, tmp_path):
    (tmp_path / "card.yaml").write_text(text)
    with pytest.raises(ModelError, match=r"card.yaml: the card is not valid: card: Input should be a valid dictionary"):
        load_card(tmp_path / "card.yaml")


def test_what_is_not_yaml_is_refused(tmp_path):
    (tmp_path / "card.yaml").write_text("name: [")
    with pytest.raises(ModelError, match="not YAML"):
        load_card(tmp_path / "card.yaml")


def test_the_shipped_head_fits_its_card_and_is_small():
    card, model = load_card(DEFAULT_CARD)
    assert model.stat().st_size <= 8e6
    assert card.training
    assert card.measured
    assert card.licence


def test_a_cpu_gets_the_head_in_eight_bits_and_a_gpu_in_floating_point():
    assert default_card("cpu") == EIGHT_BITS_CARD
    assert default_card("cuda:0") == DEFAULT_CARD
    whole, small = load_card(DEFAULT_CARD)[0], load_card(EIGHT_BITS_CARD)[0]
    assert small.training["quantised_from"] == whole.sha256
    assert (small.input, small.output, small.decode, small.classes) == (
        whole.input,
        whole.output,
        whole.decode,
        whole.classes,
    )
    assert DetectionHead(threads=1).card == small


def test_a_head_that_ships_is_found_by_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert named_card("pillar_center") == named_card("pillar_center.yaml") == DEFAULT_CARD
    assert load_card("pillar_center_int8")[0].name == "pillar_center_int8"
    assert named_card("my_head/pillar_center.yaml") == Path("my_head/pillar_center.yaml"), "a path is a path"
    (tmp_path / "pillar_center.yaml").write_text("name: mine")
    assert named_card("pillar_center.yaml") == Path("pillar_center.yaml"), "and a file goes first"
    with pytest.raises(ModelError, match=r"pillar: cannot read .*; by name there are pillar_center and pillar_center_"):
        load_card("pillar")
