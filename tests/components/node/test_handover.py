"""What a component leaves for its next life: it comes back to the bit, or not at all."""

import numpy as np
import pytest

from warploom.components.messages import SensorFrame
from warploom.components.node.handover import Handover
from warploom.datamesh.messages import encode

FRAMES = [SensorFrame(version=k, index=k, points=np.full((3, 4), k, np.float32)) for k in range(3)]


def test_the_next_life_takes_what_was_left_to_the_bit(tmp_path):
    Handover(tmp_path / "process", "front/lidar", "a street").leave(FRAMES)
    taken = Handover(tmp_path / "process", "front/lidar", "a street").take()
    assert [encode(frame) for frame in taken] == [encode(frame) for frame in FRAMES]
    assert len(list((tmp_path / "process").iterdir())) == 1, "whatever the name, one file in the folder"
    Handover(tmp_path / "process", "front/lidar", "a street").leave(FRAMES[:1])
    assert len(Handover(tmp_path / "process", "front/lidar", "a street").take()) == 1


def test_what_is_of_another_origin_or_name_is_not_taken(tmp_path):
    Handover(tmp_path, "lidar", "a street").leave(FRAMES)
    assert Handover(tmp_path, "lidar", "another street").take() == []
    assert Handover(tmp_path, "radar", "a street").take() == []


@pytest.mark.parametrize("damage", [lambda data: data[:-5], lambda data: b"", lambda data: b"\xff" + data[1:]])
def test_what_is_damaged_is_not_taken(tmp_path, damage):
    Handover(tmp_path, "lidar", "a street").leave(FRAMES)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    assert Handover(tmp_path, "lidar", "a street").take() == []


def test_without_a_folder_nothing_is_left(tmp_path):
    Handover(None, "lidar", "a street").leave(FRAMES)
    assert Handover(None, "lidar", "a street").take() == []


def test_what_cannot_be_left_is_told_and_nothing_of_it_stays(tmp_path, caplog):
    Handover(tmp_path, "lidar", "a street").leave([FRAMES[0], object()])
    assert "nothing is left for a next life: builtins.object is not a message" in caplog.text
    (tmp_path / "file").write_text("")
    Handover(tmp_path / "file", "lidar", "a street").leave(FRAMES)
    assert "File exists" in caplog.text
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
