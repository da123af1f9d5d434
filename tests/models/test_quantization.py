"""A head in eight bits: its card fits its file, it is smaller, and says nearly the same."""

import numpy as np
import pytest
import torch

from warploom.errors import ModelError
from warploom.models.card import load_card
from warploom.models.head import DetectionHead
from warploom.models.quantization import quantize_head
from warploom.models.training.export import export_head
from warploom.models.training.network import PillarCenterNet

RANGE = (-8.0, -8.0, -2.0, 8.0, 8.0, 6.0)


@pytest.fixture(scope="module")
def clouds():
    rng = np.random.default_rng(0)
    return [np.column_stack([rng.uniform(-8, 8, (4000, 2)), rng.uniform(-1.7, 1, 4000)]).astype(np.float32)
            for _ in range(4)]  # fmt: skip


@pytest.fixture(scope="module")
def cards(tmp_path_factory, clouds):
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("heads")
    network = PillarCenterNet((16, 16, 16))
    card = export_head(network, folder, point_range=RANGE, training={"seed": 0})
    return card, quantize_head(card, folder, [(cloud, 1.7) for cloud in clouds[:3]], measured={"nothing": 0})


def test_the_card_fits_its_file(cards):
    old, new = load_card(cards[0])[0], load_card(cards[1])[0]
    assert new.name == f"{old.name}_int8"
    assert new.training["quantised_from"] == old.sha256
    assert new.measured == {"nothing": 0}
    assert (new.input, new.output, new.decode, new.classes) == (old.input, old.output, old.decode, old.classes)
    assert load_card(cards[1])[1].stat().st_size < load_card(cards[0])[1].stat().st_size


def test_it_says_nearly_the_same(cards, clouds):
    """On a cloud that it was not calibrated with: the maps differ by a few hundredths of their spread."""
    maps = []
    for card in cards:
        head = DetectionHead(card, threads=1)
        head.detect_points(clouds[3], 1.7)
        maps.append(head._maps.numpy().copy())
    assert np.abs(maps[1] - maps[0]).mean() < 0.05 * maps[0].std()
    assert not np.array_equal(maps[0], maps[1])


def test_eight_bits_are_not_quantised_again(cards, clouds, tmp_path):
    with pytest.raises(ModelError, match="it is in eight bits already; take the card that it was made of"):
        quantize_head(cards[1], tmp_path, [(clouds[0], 1.7)])


def test_a_second_stage_goes_with_it(cards, clouds, tmp_path):
    from warploom.models.training.second import export_second
    from warploom.models.training.second_network import SecondNet

    both = export_second(SecondNet(5), cards[0], tmp_path / "both", training={})
    new, model = load_card(quantize_head(both, tmp_path / "small", [(clouds[0], 1.7)]))
    assert new.second == load_card(both)[0].second
    assert (model.parent / new.second.file).read_bytes() == (both.parent / new.second.file).read_bytes()
    assert not (cards[0].parent / new.second.file).exists()
