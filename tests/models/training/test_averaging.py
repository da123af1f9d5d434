"""The mean of several trainings' weights, and its head."""

import pytest
import torch

from warploom.models.card import load_card
from warploom.models.training.averaging import average_networks, main
from warploom.models.training.network import PillarCenterNet


def checkpoint(path, seed, width, depth=(1, 1)):
    torch.manual_seed(seed)
    network = PillarCenterNet(width, depth)
    network.train()(torch.rand(2, 20, 16, 16))
    averaged = torch.optim.swa_utils.AveragedModel(network, use_buffers=True)
    path.parent.mkdir()
    torch.save({"averaged": averaged.state_dict()}, path)
    return network.state_dict()


def test_every_weight_is_the_mean(tmp_path):
    paths = [tmp_path / name / "checkpoint.pt" for name in ("a", "b", "c")]
    states = [checkpoint(path, seed, (8, 8, 8)) for seed, path in enumerate(paths)]
    mean = average_networks(paths, PillarCenterNet((8, 8, 8)))
    assert not mean.training
    for name, value in mean.state_dict().items():
        expected = sum(state[name].double() for state in states) / 3
        torch.testing.assert_close(value.double(), expected.to(value.dtype).double(), atol=1e-6, rtol=1e-6)
    with pytest.raises(ValueError, match="one or more"):
        average_networks([], PillarCenterNet((8, 8, 8)))


def test_shares_weigh_the_checkpoints(tmp_path):
    paths = [tmp_path / name / "checkpoint.pt" for name in ("a", "b")]
    one, other = (checkpoint(path, seed, (8, 8, 8)) for seed, path in enumerate(paths))
    mean = average_networks(paths, PillarCenterNet((8, 8, 8)), [3.0, 1.0]).state_dict()
    for name, value in mean.items():
        if value.is_floating_point():
            expected = 0.75 * one[name].double() + 0.25 * other[name].double()
            torch.testing.assert_close(value.double(), expected, atol=1e-6, rtol=1e-6)
    for wrong in ([1.0], [1.0, 0.0], [1.0, float("nan")], [1.0, 1.0, 1.0]):
        with pytest.raises(ValueError, match="shares must be 2 positive numbers"):
            average_networks(paths, PillarCenterNet((8, 8, 8)), wrong)


def test_the_command_writes_a_head(tmp_path):
    checkpoint(tmp_path / "a" / "checkpoint.pt", 0, (16, 48, 128), (1, 2))
    main([tmp_path / "a" / "checkpoint.pt"], tmp_path / "head", stem=16, blocks=2, score=0.4)
    card, _ = load_card(tmp_path / "head" / "pillar_center.yaml")
    assert card.decode.score_threshold == 0.4
    assert card.training == {"mean_of": ["a"]}
