"""Configuration files by name: which counts, how they are told apart, copies that come first."""

import pytest

from warploom.components.configurations import copy_file, find_file, named_files
from warploom.components.profile import CONF, load_profile
from warploom.errors import ConfigError


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("WARPLOOM_CONF", raising=False)
    return tmp_path


def test_every_shipped_file_is_listed_once_and_says_what_it_is():
    files = named_files()
    assert {file.path for file in files} == {p for p in CONF.rglob("*") if p.suffix in (".yaml", ".xml")}
    assert not [file.path for file in files if not file.description()]


def test_a_name_finds_the_file_with_or_without_kind_and_ending():
    assert (
        find_file("cpu").path
        == find_file("profiles/cpu").path
        == find_file("cpu.yaml").path
        == CONF / "profiles/cpu.yaml"
    )


def test_a_copy_comes_before_the_packages_file(elsewhere):
    target = copy_file("cpu", elsewhere / "conf")
    assert target == elsewhere / "conf/profiles/cpu.yaml"
    target.write_text(target.read_text().replace("profile: cpu", "profile: mine"))
    assert load_profile("cpu").content.profile == "mine"
    assert find_file("cpu").path.resolve() == target


def test_a_copy_never_replaces_a_file(elsewhere):
    copy_file("cpu", elsewhere / "conf")
    with pytest.raises(ConfigError, match="is there already"):
        copy_file("profiles/cpu", elsewhere / "conf")


def test_one_name_in_two_kinds_has_to_be_told_apart(elsewhere):
    own = elsewhere / "conf/trackers/cpu.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("description: of its own\n")
    with pytest.raises(ConfigError, match="profiles/cpu, trackers/cpu"):
        find_file("cpu")
    assert find_file("trackers/cpu").description() == "of its own"


def test_an_unknown_name_tells_the_nearest():
    with pytest.raises(ConfigError, match="perception"):
        find_file("percepton")


def test_a_broken_file_is_listed_as_such(elsewhere):
    broken = elsewhere / "conf/profiles/broken.yaml"
    broken.parent.mkdir(parents=True)
    broken.write_bytes(b"a: [\xff")
    assert find_file("broken").description().startswith("cannot be read")
