"""The wheel holds what the tree holds: code, configuration and models in, tests out."""

import pathlib
import re
import shutil
import subprocess
import sys
import zipfile

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
NOT_PACKAGED = {"tests", "examples", "docs", "build", "dist"}


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> pathlib.Path:
    """The wheel of the checkout, built from a copy, so that the checkout stays as it is."""
    copy = tmp_path_factory.mktemp("tree") / "warploom"
    tracked = subprocess.run(["git", "ls-files", "-co", "--exclude-standard"], cwd=ROOT, capture_output=True, text=True)
    if tracked.returncode:
        pytest.skip("this is not a git checkout, so the tree cannot be told from what was built in it")
    for name in tracked.stdout.splitlines():
        if (ROOT / name).is_file():
            (copy / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, copy / name)
    out = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(copy)]
    built = subprocess.run(command, capture_output=True, text=True)
    assert built.returncode == 0, built.stdout + built.stderr
    return next(out.glob("*.whl"))


def expected_files() -> set[str]:
    """What the tree says should be in the wheel, as paths below `warploom/`."""
    files = {"py.typed"}
    for path in ROOT.rglob("*"):
        parts = path.relative_to(ROOT).parts
        if parts[0].startswith(".") or parts[0] in NOT_PACKAGED or "__pycache__" in parts or "egg-info" in parts[0]:
            continue
        is_data = (parts[0] == "conf" and path.suffix in (".yaml", ".xml")) or parts[:2] == ("models", "weights")
        if path.is_file() and (path.suffix == ".py" or is_data):
            files.add("/".join(parts))
    return files


def test_the_wheel_holds_the_tree_and_nothing_else(wheel):
    packaged = {
        name.removeprefix("warploom/") for name in zipfile.ZipFile(wheel).namelist() if name.startswith("warploom/")
    }
    assert packaged == expected_files()


def test_the_wheel_has_configuration_and_models_and_no_tests(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    assert any(name.startswith("warploom/conf/profiles/") for name in names)
    assert any(re.fullmatch(r"warploom/models/weights/.+\.onnx", name) for name in names)
    assert not [name for name in names if "/tests/" in name or pathlib.PurePath(name).name.startswith("test_")]
    assert all(name.startswith(("warploom/", "warploom-")) for name in names)


@pytest.mark.slow
def test_an_installed_wheel_runs_the_demo_outside_the_checkout(wheel, tmp_path):
    """With the dependencies but not the checkout: the wheel lies where pip would put it."""
    site = tmp_path / "site"
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    # The editable install of the checkout is taken off the import path: only the unpacked wheel can be found.
    code = f"""
import pathlib, sys
sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in str(finder).lower()]
sys.path.insert(0, {str(site)!r})
import warploom
assert pathlib.Path(warploom.__file__).is_relative_to({str(site)!r}), warploom.__file__
from warploom.cli import main
sys.argv = ["warploom", "demo", "--seconds", "0.3", "--out", "out"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len((tmp_path / "out" / "objects.jsonl").read_text().splitlines()) == 3
