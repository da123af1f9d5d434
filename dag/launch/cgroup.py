"""Control groups, version 2: a process is put into one below the supervisor's own."""

from __future__ import annotations

import contextlib
from pathlib import Path

__all__ = ["ControlGroups"]


class ControlGroups:
    """Makes groups, puts processes into them, and removes those that it made."""

    def __init__(self, mount: Path | None = None, own: str | None = None) -> None:
        """Looks where groups can be made.

        Args:
            mount: Where cgroup v2 is mounted; by default as the system says.
            own: The group of this process below it, such as /user.slice; by default as the system says.
        """
        self._mount = _mounted() if mount is None else mount
        self._own = (_own_group() if own is None else own).strip("/")
        self._made: list[Path] = []

    def join(self, group: str, pid: int) -> str | None:
        """Puts a process into a group, which is made where there is none.

        Args:
            group: Its path below the supervisor's own group, such as app/compute3d_sched.
            pid: The process.

        Returns:
            None, or why it is not in it, with the way out: a process runs without its group, too.
        """
        if self._mount is None:
            return f"cgroup {group}: this system has no cgroup v2; the process runs without"
        folder = self._mount / self._own / group
        try:
            self._make(folder)
            (folder / "cgroup.procs").write_text(f"{pid}\n")
        except OSError as error:
            where = error.filename or folder
            return (
                f"cgroup {group}: {where}: {error.strerror}; the process runs without. Way out: a systemd unit with "
                "Delegate=yes, or a group that root has given to this user (chown)"
            )
        return None

    def _make(self, folder: Path) -> None:
        if folder.is_dir():
            return
        self._make(folder.parent)
        folder.mkdir()
        self._made.append(folder)

    def close(self) -> None:
        """Removes the groups that it made, as far as nobody is in them."""
        for folder in reversed(self._made):
            with contextlib.suppress(OSError):
                folder.rmdir()
        self._made.clear()


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
