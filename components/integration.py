"""Integration: puts everything that a node needs into one folder, from where one script runs it without the checkout.

    python -m warploom.components.integration OUT

    OUT/bin/      start_all, launcher, warploom
    OUT/include/  the typed interfaces: topics, components with their handles, messages
    OUT/lib/      the package and all that it needs
    OUT/dag/      module files
    OUT/launch/   launch files
    OUT/conf/     profiles and the rest; `conf/modules` and `conf/launch` are the folders above

Files of the interpreter's packages are hard links where OUT is on the same disk, else copies.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shlex
import shutil
import sys
import tomllib
from collections.abc import Iterable, Iterator
from pathlib import Path

from ..errors import ConfigError, WarploomError

__all__ = ["Integration", "integrate", "main"]

PACKAGE = Path(__file__).resolve().parent.parent
"""The folder of the package."""

_MANIFEST = "integration.json"
_FOLDERS = ("bin", "include", "lib", "dag", "launch", "conf")

_RUN = """\
#!/bin/sh
# The command warploom of this folder; $WARPLOOM_PYTHON takes another interpreter of the same version.
here=$(CDPATH= cd -- "$(dirname -- "$(readlink -f -- "$0")")/.." && pwd)
PYTHONPATH="$here/lib" PYTHONNOUSERSITE=1 exec "${{WARPLOOM_PYTHON:-{python}}}" -P \\
  -c 'import sys; sys.argv[0] = "warploom"; from warploom.cli import main; main()' "$@"
"""
_START_ALL = """\
#!/bin/sh
# Starts every process of a node, and the monitors beside them; of {node} where no other is named.
here=$(CDPATH= cd -- "$(dirname -- "$(readlink -f -- "$0")")/.." && pwd)
WARPLOOM_LAUNCH={node} exec "$here/bin/warploom" start-all "$@"
"""
_LAUNCHER = """\
#!/bin/sh
# One process, as the reference starts it: launcher -c a.yaml -c b.yaml -p compute3d_sched
here=$(CDPATH= cd -- "$(dirname -- "$(readlink -f -- "$0")")/.." && pwd)
exec "$here/bin/warploom" launch "$@"
"""


class Integration:
    """Assembles one folder."""

    def __init__(self, out: Path, *, extras: Iterable[str] = ("net",)) -> None:
        """Names the folder.

        Args:
            out: It is made, or replaced where an integration made it before.
            extras: Extras of the package whose requirements go with it, as far as they are installed.
        """
        self.out = out
        self._extras = tuple(extras)
        self.packages: dict[str, str] = {}
        """What lies in lib beside the package itself: name → version."""

    def run(self, node: str | None = None) -> None:
        """Does it.

        Args:
            node: What `start_all` starts when nobody says: the name of a launch file; None: the only one that ships.

        Raises:
            ConfigError: The folder holds something else, there is no such launch file, or a requirement is not
                installed.
            WarploomError: It cannot be written.
        """
        launch = {path.name.split(".")[0] for path in (PACKAGE / "conf" / "launch").glob("*.launch.*")}
        if node is None and len(launch) == 1:
            node = next(iter(launch))
        if node not in launch:
            raise ConfigError(f"no launch file {node!r}; there are: {', '.join(sorted(launch))}")
        try:
            self._clear()
            self._configuration()
            self._library()
            self._interfaces()
            self._scripts(node)
            self._manifest(node)
        except OSError as error:
            raise WarploomError(f"{self.out}: {error.strerror or error}: {error.filename}") from error

    def _clear(self) -> None:
        """An empty folder, or one that an integration made."""
        if self.out.exists() and not self.out.is_dir():
            raise ConfigError(f"{self.out}: is a file, not a folder")
        if self.out.is_dir() and any(self.out.iterdir()) and not (self.out / _MANIFEST).is_file():
            raise ConfigError(f"{self.out}: holds files that no integration put there; take an empty folder")
        for name in _FOLDERS:
            shutil.rmtree(self.out / name, ignore_errors=True)
        for name in _FOLDERS:
            (self.out / name).mkdir(parents=True)
        # From here on a run that breaks off can be repeated.
        (self.out / _MANIFEST).write_text("{}\n", encoding="utf-8")

    def _configuration(self) -> None:
        conf = PACKAGE / "conf"
        for source, target in (("modules", "dag"), ("launch", "launch")):
            shutil.copytree(conf / source, self.out / target, dirs_exist_ok=True)
            (self.out / "conf" / source).symlink_to(Path("..") / target, target_is_directory=True)
        for folder in sorted(conf.iterdir()):
            if folder.is_dir() and folder.name not in ("modules", "launch"):
                shutil.copytree(folder, self.out / "conf" / folder.name)

    def _library(self) -> None:
        lib = self.out / "lib"
        own = lib / "warploom"
        for file in _package_files():
            target = own / file.relative_to(PACKAGE)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(file, target)
        (own / "conf").symlink_to(Path("..") / ".." / "conf", target_is_directory=True)
        # Written out, not looked up: the metadata of an editable installation names the checkout.
        described = lib / f"warploom-{_version()}.dist-info"
        described.mkdir()
        metadata = f"Metadata-Version: 2.1\nName: warploom\nVersion: {_version()}\n"
        (described / "METADATA").write_text(metadata, encoding="utf-8")
        for distribution in self._requirements():
            self.packages[distribution.metadata["Name"]] = distribution.version
            for file in distribution.files or ():
                if ".." in file.parts or "__pycache__" in file.parts:  # scripts lie outside; bytecode is made anew
                    continue
                source = Path(str(distribution.locate_file(file)))
                if source.is_file():
                    _link(source, lib / Path(*file.parts))

    def _requirements(self) -> Iterator[importlib.metadata.Distribution]:
        """The distributions that the package needs, and those that they need."""
        from packaging.requirements import Requirement

        wanted = [(Requirement(text), True) for text in _declared(())]
        wanted += [(Requirement(text), False) for text in _declared(self._extras)]
        seen: set[tuple[str, frozenset[str]]] = set()
        given: set[str] = set()
        while wanted:
            requirement, needed = wanted.pop()
            name = requirement.name.lower().replace("_", "-")
            if (name, frozenset(requirement.extras)) in seen or name == "warploom":
                continue
            seen.add((name, frozenset(requirement.extras)))
            try:
                distribution = importlib.metadata.distribution(name)
            except importlib.metadata.PackageNotFoundError:
                if needed:
                    raise ConfigError(f"{requirement} is not installed: pip install warploom") from None
                continue
            if name not in given:
                given.add(name)
                yield distribution
            for text in distribution.requires or ():
                inner = Requirement(text)
                chosen = requirement.extras or {""}
                if inner.marker is None or any(inner.marker.evaluate({"extra": extra}) for extra in chosen):
                    wanted.append((inner, needed))

    def _interfaces(self) -> None:
        from .interfaces import write_interfaces

        write_interfaces(self.out / "include")

    def _scripts(self, node: str) -> None:
        # The interpreter below a virtual environment, which may lie in the checkout.
        python = getattr(sys, "_base_executable", None) or sys.executable
        for name, text in (
            ("warploom", _RUN.format(python=shlex.quote(str(Path(python).resolve())))),
            ("start_all", _START_ALL.format(node=shlex.quote(node))),
            ("launcher", _LAUNCHER),
        ):
            script = self.out / "bin" / name
            script.write_text(text, encoding="utf-8")
            script.chmod(0o755)

    def _manifest(self, node: str) -> None:
        said = {
            "warploom": _version(),
            "node": node,
            "python": platform.python_version(),
            "system": f"{platform.system()} {platform.machine()}",
            "packages": dict(sorted(self.packages.items())),
        }
        (self.out / _MANIFEST).write_text(json.dumps(said, indent=2) + "\n", encoding="utf-8")


def _version() -> str:
    from .. import __version__

    return __version__


def _package_files() -> Iterator[Path]:
    """The files of the package that a wheel would hold, less its configuration."""
    project = _project()
    if project is None:  # it is an installed wheel: all that lies there belongs to it
        for file in sorted(PACKAGE.rglob("*")):
            inside = file.relative_to(PACKAGE).parts
            if file.is_file() and inside[0] != "conf" and "__pycache__" not in inside:
                yield file
        return
    settings = project["tool"]["setuptools"]
    for name in settings["packages"]:
        yield from sorted((PACKAGE / Path(*name.split(".")[1:])).glob("*.py"))
    for pattern in settings["package-data"]["warploom"]:
        if not pattern.startswith("conf/"):
            yield from sorted(PACKAGE.glob(pattern))


def _declared(extras: Iterable[str]) -> list[str]:
    """The requirements of the package, or those of some of its extras."""
    extras = tuple(extras)
    project = _project()
    if project is not None:
        own = project["project"]
        return [text for extra in extras for text in own["optional-dependencies"][extra]] or (
            [] if extras else list(own["dependencies"])
        )
    texts = importlib.metadata.requires("warploom") or []
    if not extras:
        return [text for text in texts if "extra ==" not in text]
    marks = [f'extra == "{extra}"' for extra in extras]
    return [text.split(";")[0] for text in texts if any(mark in text.replace("'", '"') for mark in marks)]


def _project() -> dict | None:
    """What pyproject.toml says, in a checkout."""
    try:
        project = tomllib.loads((PACKAGE / "pyproject.toml").read_text(encoding="utf-8"))
    except OSError:
        return None
    return project if project.get("project", {}).get("name") == "warploom" else None


def _link(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists():
        return
    try:
        os.link(source, target)
    except OSError:  # another disk, or one without links
        shutil.copy2(source, target)


def integrate(out: str | Path, *, node: str | None = None, extras: Iterable[str] = ("net",)) -> Path:
    """Assembles a folder from which `bin/start_all` runs the node.

    Args:
        out: The folder: empty, or made by this before.
        node: What `start_all` starts when nobody says: the name of a launch file; None: the only one that ships.
        extras: Extras of the package whose requirements go with it, as far as they are installed.

    Returns:
        The folder.

    Raises:
        ConfigError: The folder holds something else, there is no such launch file, or a requirement is not installed.
        WarploomError: It cannot be written.
    """
    place = Path(out).absolute()
    Integration(place, extras=extras).run(node)
    return place


def main() -> int:
    """The command `python -m warploom.components.integration OUT`."""
    parser = argparse.ArgumentParser(description="Assemble a folder from which a node runs without the checkout.")
    parser.add_argument("out", help="The folder: empty, or made by this before.")
    parser.add_argument("--node", help="The launch file that start_all starts when nobody says.")
    options = parser.parse_args()
    try:
        place = integrate(options.out, node=options.node)
    except WarploomError as error:
        sys.stderr.write(f"warploom: {error}\n")
        return 2 if isinstance(error, ConfigError) else 1
    sys.stdout.write(f"{place}: {', '.join(_FOLDERS)}; {place / 'bin' / 'start_all'} runs the node\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
