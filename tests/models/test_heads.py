"""Cards of any kind: the right head for each, and what is none is refused by name."""

import pytest
import yaml

from warploom.errors import ModelError
from warploom.models.card import DEFAULT_CARD, HeadCard
from warploom.models.head import DetectionHead
from warploom.models.heads import KINDS, card_kind, open_head, read_card


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
    [("kind: oracle", "a card of the kind 'oracle'; there are: pillar_center"), ("- 1", "a card of the kind None"),
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
