"""Labelled scans as files to learn from: only what has labels, on a KITTI folder made here; and the command."""

import numpy as np
import pytest
from typer.testing import CliRunner

from warploom.cli import app
from warploom.components.labelled_scans import write_labelled_scans
from warploom.errors import ConfigError, SourceError
from warploom.models.card import DEFAULT_CARD, load_card
from warploom.models.training.frames import load_frame

P = "721.5 0 609.6 44.9 0 721.5 172.9 0.2 0 0 1 0.003"
CALIBRATION = (
    "".join(f"P{k}: {P}\n" for k in range(4))
    + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n"
)
LABELS = """Car 0.00 0 0.00 600 150 700 250 1.50 1.60 4.00 0.00 1.65 12.00 -1.57
Misc 0.00 0 0.00 300 150 350 250 1.50 1.60 4.00 -6.00 1.65 15.00 -1.57
Pedestrian 0.00 0 0.00 700 150 720 250 1.73 0.60 0.80 3.00 1.65 15.00 0.00
DontCare -1 -1 -10 800.00 150.00 900.00 200.00 -1 -1 -1 -1000 -1000 -1000 -10
"""


def seen_at(u, v, depth):
    """The place in the LiDAR's frame that the camera sees at a pixel, by the calibration above."""
    x, y = (u * depth - 609.6 * depth - 44.9) / 721.5, (v * depth - 172.9 * depth - 0.2) / 721.5
    return [depth + 0.27, -x, -y - 0.08]


@pytest.fixture
def kitti(tmp_path):
    root = tmp_path / "drives"
    for name in ("velodyne", "label_2", "calib"):
        (root / name).mkdir(parents=True)
    car = [[12.27 + 0.1 * k, 0.0, -1.0] for k in range(10)]
    misc = [[15.27, 6.0, -1.0]] * 5
    walker = [[15.27, -3.0, -1.0 + 0.02 * k] for k in range(6)]
    behind, beside = [[-12.0, 0.0, -1.0]] * 4, [[5.0, 30.0, -1.0]] * 3
    unlabelled, free = [seen_at(850, 175, 20)] * 7, [seen_at(1000, 175, 20)] * 2
    points = np.array([*car, *misc, *walker, *behind, *beside, *unlabelled, *free], np.float32)
    np.c_[points, np.zeros(len(points), np.float32)].tofile(root / "velodyne" / "000007.bin")
    (root / "label_2" / "000007.txt").write_text(LABELS)
    (root / "calib" / "000007.txt").write_text(CALIBRATION)
    return root


def test_only_what_has_labels_is_kept(kitti, tmp_path):
    """Ten points of the car, six of the walker, two of nothing: not those behind, beside, of Misc or in DontCare."""
    assert write_labelled_scans(f"kitti:{kitti}", tmp_path / "scans") == 1
    frame = load_frame(tmp_path / "scans" / "drives-000007.npz")
    assert len(frame.xyz) == 10 + 6 + 2
    assert frame.classes.tolist() == [0, 1]
    assert frame.points_in.tolist() == [10, 6]
    assert not frame.tight
    np.testing.assert_allclose(frame.boxes[:, :2], [[12.27, 0.0], [15.27, -3.0]], atol=1e-3)
    np.testing.assert_allclose(frame.boxes[:, 3:6], [[4.0, 1.6, 1.5], [0.8, 0.6, 1.73]], atol=1e-3)


def test_what_cannot_be_learnt_from_is_named(kitti, tmp_path):
    with pytest.raises(ConfigError, match="expected one of kitti"):
        write_labelled_scans("drives", tmp_path / "scans")
    with pytest.raises(ConfigError, match="nowhere is not there"):
        write_labelled_scans(f"kitti:{tmp_path / 'nowhere'}", tmp_path / "scans")
    (kitti / "label_2" / "000007.txt").write_text("Car 0.00 0\n")
    with pytest.raises(SourceError, match=r"000007\.txt, line 1"):
        write_labelled_scans(f"kitti:{kitti}", tmp_path / "scans")


def test_the_command_goes_on_with_the_head_that_ships(kitti, tmp_path):
    """Its network, what is read of it and its second stage stay; its weights do not."""
    out = tmp_path / "head"
    options = ["--frozen", "--frames", "0", "--labelled-share", "1", "--iterations", "2", "--learning-rate", "1e-3"]
    result = CliRunner().invoke(
        app,
        ["head", "train", "--data", f"kitti:{kitti}", "--start-from", str(DEFAULT_CARD), "--out", str(out), *options],
    )
    assert result.exit_code == 0, result.output
    assert "1 labelled scans" in result.output
    card, _ = load_card(out / "pillar_center.yaml")
    shipped, _ = load_card(DEFAULT_CARD)
    assert card.sha256 != shipped.sha256
    assert (card.decode, card.second, card.input.channels) == (shipped.decode, shipped.second, shipped.input.channels)
    assert card.training["data"] == "1 labelled scans of one's own"
    assert card.training["iterations"] == 2
