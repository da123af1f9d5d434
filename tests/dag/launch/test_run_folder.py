"""The folder of a node at run time, and the logs in it."""

import shutil
import stat

import pytest

from warploom.dag.launch.run_folder import RotatedLog, RunFolder, run_base, running_nodes
from warploom.errors import ConfigError


def test_the_folder_is_where_the_environment_says(monkeypatch, tmp_path):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert run_base() == tmp_path / "own"
    monkeypatch.delenv("WARPLOOM_RUN")
    assert run_base() == tmp_path / "warploom"
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert run_base().parent.name == "tmp"


def test_it_is_its_owners_alone_and_locked_for_one_supervisor(run_base):
    one, other = RunFolder("n"), RunFolder("n")
    one.open()
    for folder in (one.path, one.path / "log", one.path / "plan"):
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert running_nodes() == ["n"]
    with pytest.raises(ConfigError, match=r"node 'n' runs already \(process \d+\)"):
        other.open()
    one.plan("p").write_text("{}")
    one.handover("p").mkdir(parents=True)
    one.close()
    assert running_nodes() == []
    assert not one.plan("p").exists()
    assert not one.handover("p").exists()
    one.handover("p").mkdir(parents=True)
    other.open()
    assert not one.handover("p").exists(), "one that was killed has left it"
    other.close()


def test_a_path_that_no_socket_can_have_is_told(monkeypatch, tmp_path):
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / ("x" * 100)))
    with pytest.raises(ConfigError, match="the path of a socket has at most 100 bytes: set WARPLOOM_RUN"):
        RunFolder("n").open()


def test_a_folder_that_cannot_be_made_is_told(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WARPLOOM_RUN", str(tmp_path / "file"))
    with pytest.raises(ConfigError, match="set WARPLOOM_RUN"):
        RunFolder("n").open()


def test_a_log_is_rotated_and_the_oldest_go(tmp_path):
    log = RotatedLog(tmp_path / "p.log", limit=10, kept=2)
    for number in range(5):
        log.write(b"%d23456\n" % number)
    log.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["p.log", "p.log.1", "p.log.2"]
    assert [(tmp_path / name).read_text()[0] for name in ("p.log", "p.log.1", "p.log.2")] == ["4", "3", "2"]


def test_a_log_goes_on_at_its_end(tmp_path):
    for text in (b"one\n", b"two\n"):
        log = RotatedLog(tmp_path / "p.log")
        log.write(text)
        log.close()
    assert (tmp_path / "p.log").read_text() == "one\ntwo\n"


def test_what_cannot_be_written_is_counted(tmp_path):
    log = RotatedLog(tmp_path / "none" / "p.log")
    log.write(b"12345")
    log.write(b"678")
    assert log.lost == 8


def test_a_plan_that_was_tidied_away_is_written_again(run_base):
    folder = RunFolder("n")
    folder.open()
    shutil.rmtree(folder.path / "plan")
    folder.write_plan("p", "{}")
    assert folder.plan("p").read_text() == "{}"
    folder.plan("q").mkdir()
    with pytest.raises(
        ConfigError, match=r"n: cannot be written: Is a directory; make room there, or set WARPLOOM_RUN"
    ):
        folder.write_plan("q", "{}")
    folder.plan("q").rmdir()
    folder.close()
