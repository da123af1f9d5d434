"""The fragmentation monitor on recorded texts of /proc/buddyinfo."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from warploom.components.monitors.buddyinfo import (
    FragmentationMonitor,
    FragmentationMonitorConfig,
    parse_buddyinfo,
    unusable_share,
)
from warploom.dag import Trigger
from warploom.datamesh import DataMesh, Status

HEALTHY = """\
Node 0, zone      DMA      0      0      0      0      0      0      0      0      1      1      3 
Node 0, zone    DMA32      1      1      4      2      5      4      3      3      4      2    752 
Node 0, zone   Normal   6886  10008   7449   6193   3203   1656    812    309    162    590   3258 
"""  # noqa: W291 – as the kernel writes it
FRAGMENTED = """\
Node 0, zone   Normal  90000  60000  20000   4000    100      0      0      0      0      0      0
Node 1, zone   Normal      0      0      0      0      0      0      0      0      0      0   1000
"""


def test_a_recorded_text_is_read():
    dma, dma32, normal = parse_buddyinfo(HEALTHY, 9, 4096)
    assert (dma.node, dma.zone, dma32.zone, normal.zone) == (0, "DMA", "DMA32", "Normal")
    assert normal.free_blocks == (6886, 10008, 7449, 6193, 3203, 1656, 812, 309, 162, 590, 3258)
    pages = [6886, 20016, 29796, 49544, 51248, 52992, 51968, 39552, 41472, 302080, 3336192]
    assert normal.free_mib == pytest.approx(sum(pages) * 4096 / 2**20)
    assert normal.unusable == pytest.approx(sum(pages[:9]) / sum(pages))
    assert normal.largest_mib == 4.0
    assert dma.unusable == pytest.approx(256 / (256 + 512 + 3 * 1024))


def test_a_fragmented_node_is_told_from_a_sound_one():
    first, second = parse_buddyinfo(FRAGMENTED, 9, 4096)
    assert (first.node, second.node) == (0, 1)
    assert first.unusable == 1.0
    assert first.largest_mib == 16 * 4096 / 2**20
    assert second.unusable == 0.0


def test_larger_pages_make_larger_blocks():
    (only,) = parse_buddyinfo("Node 0, zone DMA 1 0 2", 2, 65536)
    assert only.free_mib == 9 * 65536 / 2**20


@pytest.mark.parametrize(
    "text", ["Node 0 zone DMA 1", "Node 0, zone DMA", "Node x, zone DMA 1", "Node 0, zone DMA 1 -2"]
)
def test_another_text_is_refused_with_its_line(text):
    with pytest.raises(ValueError, match="line 2 is not of the form"):
        parse_buddyinfo(f"Node 0, zone DMA 1\n{text}\n", 9)


@given(st.lists(st.integers(0, 1000), min_size=1, max_size=11), st.integers(0, 10))
def test_the_share_is_between_none_and_all_and_grows_with_the_order(blocks, order):
    share = unusable_share(blocks, order)
    assert 0.0 <= share <= 1.0
    assert share <= unusable_share(blocks, order + 1)
    if any(blocks):
        assert unusable_share(blocks, 0) == 0.0


def monitor(path, **config):
    mesh = DataMesh()
    one = FragmentationMonitor("memory")
    one.bind(mesh, {"fragmentation": "f"})
    one.init(FragmentationMonitorConfig(path=path, **config))
    return one, mesh


def test_it_warns_once_when_a_zone_becomes_fragmented(tmp_path, caplog):
    path = tmp_path / "buddyinfo"
    path.write_text(HEALTHY)
    one, mesh = monitor(path)
    for version, text in enumerate((HEALTHY, FRAGMENTED, FRAGMENTED, HEALTHY, FRAGMENTED)):
        path.write_text(text)
        assert one.process(Trigger(version + 1)) is Status.OK
    assert caplog.text.count("memory of node 0, zone Normal is fragmented") == 2
    assert "node 1" not in caplog.text
    assert len(mesh.window("f").snapshot()) == 5
    assert one.state()["worst"] == "node 0 Normal"
    assert one.state()["unusable"] == 1.0
    assert one.idle_because is None


def test_a_small_zone_is_not_watched(tmp_path, caplog):
    path = tmp_path / "buddyinfo"
    path.write_text("Node 0, zone DMA 100 0 0 0 0 0 0 0 0 0 0\n")
    one, _ = monitor(path)
    one.process(Trigger(1))
    assert not caplog.records
    assert one.state() == {}


@pytest.mark.parametrize("text", [None, "", "nonsense\n"])
def test_a_kernel_that_does_not_tell_makes_it_idle(tmp_path, text):
    path = tmp_path / "buddyinfo"
    if text is not None:
        path.write_text(text)
    one, mesh = monitor(path)
    assert one.process(Trigger(1)) is Status.MISS
    assert str(path) in one.idle_because
    assert len(mesh.window("f").snapshot()) == 0
