"""Cards of any kind: the right head for each, and what is none is refused by name."""

import pytest
import yaml

from warploom.errors import ModelError
from warploom.models.card import DEFAULT_CARD, HeadCard
from warploom.models.head import DetectionHead
from warploom.models.heads import KINDS, card_kind, check_head, open_head, read_card


def test_the_shipped_head_opens_by_default():
    head = open_head(threads=1, score_threshold=0.9)
    assert isinstance(head, DetectionHead)
    assert head.score_threshold == 0.9
    card, model = read_card(DEFAULT_CARD)
    assert isinstance(card, HeadCard)
    assert model.name == card.file


def test_a_card_without_a_kind_is_of_a_pillar_centre_head():
    assert card_kind(DEFAULT_CARD) == "pillar_center"


@pytest.mark.parametrize(
    ("text", "message"),
    [("kind: [masks]", r"a card of the kind \['masks'\]; there are"),
     ("kind: oracle", "a card of the kind 'oracle'; there are: pillar_center"), ("- 1", "a card of the kind None"),
     ("kind: [", "the card is not YAML")],
)  # fmt: skip
def test_what_is_no_card_is_refused(text, message, tmp_path):
    path = tmp_path / "card.yaml"
    path.write_text(text)
    with pytest.raises(ModelError, match=message):
        open_head(path)
    with pytest.raises(ModelError, match="cannot read the head's card"):
        open_head(tmp_path / "none.yaml")


@pytest.mark.parametrize("kind", KINDS)
def test_a_card_must_be_whole_whatever_its_kind(kind, tmp_path):
    path = tmp_path / "card.yaml"
    path.write_text(yaml.safe_dump({"kind": kind, "name": "x"}))
    with pytest.raises(ModelError, match=r"the card is not valid: .*sha256: Field required"):
        open_head(path)


@pytest.mark.real
def test_a_cameras_head_is_no_head_for_points(shared_data, tmp_path):
    from warploom.models.importers.image_detectors import import_yolox

    card = import_yolox(shared_data / "weights" / "yolox_nano" / "yolox_nano.onnx", tmp_path)
    check_head(card)
    with pytest.raises(ModelError, match="kind yolox is for images"):
        open_head(card, capacity=10)


def test_what_card_and_model_say_of_the_classes_is_checked_without_detecting(tmp_path):
    content = yaml.safe_load(DEFAULT_CARD.read_text())
    content["classes"][:2] = content["classes"][1::-1]
    for file in DEFAULT_CARD.parent.glob("*.onnx"):
        (tmp_path / file.name).symlink_to(file)
    path = tmp_path / "card.yaml"
    path.write_text(yaml.safe_dump(content))
    with pytest.raises(ModelError, match="its classes are vehicle,pedestrian"):
        check_head(path)
    assert check_head(DEFAULT_CARD)[0].name == "pillar_center"
