"""Control groups, version 2: a process is put into one below the supervisor's own, with limits of memory and CPU."""

from __future__ import annotations

import contextlib
import errno
import os
from pathlib import Path

from .schema import LimitsSpec

__all__ = ["ControlGroups"]

_OWN_LEAF = "supervisor"
_PERIOD_US = 100_000
_WAY_OUT = "Way out: a systemd unit with Delegate=yes, or a group that root has given to this user (chown)"


class ControlGroups:
    """Makes groups, puts processes into them, and removes those that it made."""

    def __init__(self, mount: Path | None = None, own: str | None = None, ledger: Path | None = None) -> None:
        """Looks where groups can be made.

        Args:
            mount: Where cgroup v2 is mounted; by default as the system says.
            own: The group of this process below it, such as /user.slice; by default as the system says.
            ledger: Where to note the groups that are made, for who comes after this process was killed.
        """
        self._mount = _mounted() if mount is None else mount
        self._own = (_own_group() if own is None else own).strip("/")
        self._ledger = ledger
        self._made: list[Path] = []
        self._moved = False

    def refusal(self) -> str | None:
        """Why no group can be made here, with the way out; None where one can. Changes nothing."""
        if self._mount is None:
            return "this system has no cgroup v2"
        # To put a process into a group below, its own file and that of the group must both be writable.
        folder = self._mount / self._own
        for path in (folder, folder / "cgroup.procs"):
            if path.exists() and not os.access(path, os.W_OK):
                read_only = os.statvfs(path).f_flag & os.ST_RDONLY
                why = "is mounted read-only" if read_only else "is not writable for this user"
                return f"{path}: {why}. {_WAY_OUT}"
        if not folder.is_dir():
            return f"{folder}: there is no such group. {_WAY_OUT}"
        return None

    def missing(self, limits: LimitsSpec) -> str | None:
        """Which of these limits nobody can set here, and why; None where the system has all that they need."""
        if self._mount is None or not (values := limits.files(_PERIOD_US)):
            return None
        top = self._mount / self._own
        try:
            there = set((top / "cgroup.controllers").read_text().split())
        except OSError:
            return None
        wanted = {name: name.partition(".")[0] for name in values}
        lacking = sorted(set(wanted.values()) - there)
        if not lacking:
            return None
        names = ", ".join(name for name, controller in wanted.items() if controller in lacking)
        return (
            f"{names}: {top} has no controller {' and no '.join(lacking)} (cgroup.controllers). Way out: let the group "
            "above pass it on (Delegate=yes), or give it to cgroup v2 (systemd.unified_cgroup_hierarchy=1 at boot)"
        )

    def join(self, group: str, pid: int, limits: LimitsSpec | None = None) -> list[str]:
        """Puts a process into a group, which is made where there is none, and limits it.

        Args:
            group: Its path below the supervisor's own group, such as app/compute3d_sched.
            pid: The process.
            limits: Of the group.

        Returns:
            What could not be done, with the way out: a process runs without its group and without its limits, too.
        """
        if self._mount is None:
            return [f"cgroup {group}: this system has no cgroup v2; the process runs without"]
        folder = self._mount / self._own / group
        try:
            self._make(folder)
        except OSError as error:
            return [f"cgroup {group}: {_told(error, folder)}; the process runs without. {_WAY_OUT}"]
        warnings = [] if limits is None else self._limit(group, folder, limits)
        try:
            (folder / "cgroup.procs").write_text(f"{pid}\n")
        except ProcessLookupError:  # it has ended already, which is told elsewhere
            pass
        except OSError as error:
            told = _told(error, folder / "cgroup.procs")
            warnings.append(f"cgroup {group}: {told}; the process runs without. {_WAY_OUT}")
        return warnings

    def _make(self, folder: Path) -> None:
        if folder.is_dir():
            return
        self._make(folder.parent)
        folder.mkdir()
        self._made.append(folder)
        self._note()

    def _note(self) -> None:
        """Writes down which groups are to be removed."""
        if self._ledger is None:
            return
        with contextlib.suppress(OSError):  # without it they stay after a kill, and nothing else is amiss
            if self._made:
                self._ledger.write_text("".join(f"{folder}\n" for folder in self._made), encoding="utf-8")
            else:
                self._ledger.unlink(missing_ok=True)

    def reap(self) -> list[str]:
        """Removes the groups that a life before has noted and left, and names them.

        One in which a process still is becomes this one's own, which `close` removes.
        """
        if self._ledger is None or self._mount is None:
            return []
        try:
            noted = [Path(line) for line in self._ledger.read_text(encoding="utf-8").splitlines()]
        except (OSError, UnicodeDecodeError):
            return []
        removed, left = [], []
        for folder in reversed(noted):
            if self._mount not in folder.parents or ".." in folder.parts or not folder.is_dir():
                continue
            if folder.name == _OWN_LEAF:
                with contextlib.suppress(OSError):
                    (folder.parent / "cgroup.subtree_control").write_text("-cpu -memory")
            try:
                folder.rmdir()
                removed.append(str(folder))
            except OSError:
                left.append(folder)
        self._made = [*reversed(left), *self._made]
        self._note()
        return removed

    def _limit(self, group: str, folder: Path, limits: LimitsSpec) -> list[str]:
        """Writes the limits of a group; what cannot be limited is told."""
        values = limits.files(_PERIOD_US)
        if not values:
            return []
        if lacking := self.missing(limits):
            return [f"cgroup {group}: the process runs without limits: {lacking}"]
        try:
            self._enable(folder.parent, {name.partition(".")[0] for name in values})
        except OSError as error:
            names = ", ".join(values)
            return [f"cgroup {group}: {names}: {_told(error, folder)}; the process runs without limits. {_WAY_OUT}"]
        warnings = []
        for name, value in values.items():
            try:
                (folder / name).write_text(f"{value}\n")
            except OSError as error:
                told = _told(error, folder / name)
                warnings.append(f"cgroup {group}: {told}; the process runs without this limit")
        return warnings

    def _enable(self, folder: Path, controllers: set[str]) -> None:
        """Lets the groups in a folder, and in those between it and the supervisor's own, be limited."""
        assert self._mount is not None, "join has looked"
        top = self._mount / self._own
        if folder != top:
            self._enable(folder.parent, controllers)
        file = folder / "cgroup.subtree_control"
        text = " ".join(f"+{name}" for name in sorted(controllers))
        try:
            file.write_text(text)
        except OSError as error:
            # A group that processes are in passes no controllers on: the supervisor goes into one of its own.
            if error.errno != errno.EBUSY or folder != top or self._moved:
                raise
            self._make(top / _OWN_LEAF)
            (top / _OWN_LEAF / "cgroup.procs").write_text(f"{os.getpid()}\n")
            self._moved = True
            file.write_text(text)

    def close(self) -> None:
        """Removes the groups that it made, as far as nobody is in them; this process is back in its own."""
        if self._moved and self._mount is not None:
            top = self._mount / self._own
            with contextlib.suppress(OSError):
                (top / "cgroup.subtree_control").write_text("-cpu -memory")
                (top / "cgroup.procs").write_text(f"{os.getpid()}\n")
            self._moved = False
        left = []
        for folder in reversed(self._made):
            try:
                folder.rmdir()
            except OSError:
                if folder.is_dir():  # somebody is still in it: for the next start
                    left.append(folder)
        self._made = list(reversed(left))
        self._note()
        self._made.clear()


def _told(error: OSError, folder: Path) -> str:
    return f"{error.filename or folder}: {error.strerror}"


def _mounted() -> Path | None:
    try:
        for line in Path("/proc/self/mountinfo").read_text().splitlines():
            before, _, after = line.partition(" - ")
            if after.split()[0] == "cgroup2":
                return Path(before.split()[4].replace("\\040", " "))
    except OSError:
        pass
    return None


def _own_group() -> str:
    try:
        for line in Path("/proc/self/cgroup").read_text().splitlines():
            if line.startswith("0::"):
                return line[3:]
    except OSError:
        pass
    return "/"
