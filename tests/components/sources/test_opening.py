import pathlib

import numpy as np
import pytest

from warploom.components.sources import KittiSource, ScanFileSource, open_source, read
from warploom.errors import ConfigError, SourceError


@pytest.fixture
def scans(tmp_path):
    folder = tmp_path / "my scans"
    folder.mkdir()
    for number in range(2):
        np.zeros((3, 4), np.float32).tofile(folder / f"{number}.bin")
    return folder


def test_a_path_a_string_and_a_file_uri_are_the_same(scans):
    for uri in (scans, str(scans), f"file:{scans}", scans.as_uri()):
        source = open_source(uri)
        assert isinstance(source, ScanFileSource)
        assert len(source) == 2


def test_a_path_that_exists_is_a_path_whatever_is_in_its_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    odd = pathlib.Path("day:1?x")
    odd.mkdir()
    np.zeros((3, 4), np.float32).tofile(odd / "a.bin")
    assert len(read("day:1?x")) == 1


def test_kitti_takes_a_folder(scans):
    assert isinstance(open_source(f"kitti:{scans}"), KittiSource)


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("", "empty"),
        ("kiti:x", r"unknown scheme 'kiti' \(did you mean 'kitti'\?\); known: sim, kitti, mcap, file"),
        ("pcap:x.pcap", "unknown scheme 'pcap'.*known: sim, kitti, mcap, file"),
        ("pcap:x.pcap?model=pandar64", "unknown scheme 'pcap'"),
        ("kitti:", "no folder after kitti:"),
        ("kitti:x?seqence=1", r"unknown key 'seqence' \(did you mean 'sequence'\?\)"),
        ("sim:street?seed=seven", "seed is 'seven'; expected a whole number"),
        ("sim:street?duration=nan", "duration is 'nan'; expected a number"),
        ("sim:street?seed=1&seed=2", "'seed' is there twice"),
        ("sim:street?sed=1", "did you mean 'seed'"),
        ("file:x?loop=1", "unknown key 'loop'; keys of this source: none"),
    ],
)
def test_a_uri_that_makes_no_sense_says_what_is_expected(uri, message):
    with pytest.raises(ConfigError, match=message):
        open_source(uri)


def test_a_wrong_type_is_told():
    with pytest.raises(TypeError, match="uri is int"):
        open_source(3)


def test_a_missing_path_is_told(tmp_path):
    with pytest.raises(SourceError, match="no such file or folder"):
        open_source(str(tmp_path / "none"))
