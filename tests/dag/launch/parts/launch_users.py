"""Commands run with the rights of an ordinary user, also where the tests run as root."""

import functools
import os
import shutil
import subprocess
import sys

import pytest

USER = 54321
"""A number that nobody has."""

# The interpreter and the tests may lie where that user may not look: reading is permitted, nothing else is.
_RIGHTS = "-all,+dac_read_search"
_AS_USER = [
    "setpriv",
    f"--reuid={USER}",
    f"--regid={USER}",
    "--clear-groups",
    f"--inh-caps={_RIGHTS}",
    f"--ambient-caps={_RIGHTS}",
    f"--bounding-set={_RIGHTS}",
]


def as_user():
    """What goes before a command, so that it runs without root's rights; skips the test where that cannot be had."""
    if os.geteuid() != 0:
        return []
    why = _refused()
    if why:
        pytest.skip(f"the tests run as root, and cannot run a command as somebody else: {why}")
    return _AS_USER


@functools.cache
def _refused():
    if shutil.which("setpriv") is None:
        return "there is no setpriv"
    done = subprocess.run([*_AS_USER, sys.executable, "-c", "import warploom"], capture_output=True, text=True)
    return (done.stderr.strip().splitlines() or ["it fails"])[-1] if done.returncode else ""


def give(*paths):
    """Makes files and folders that user's own."""
    if os.geteuid() == 0:
        for path in paths:
            os.chown(path, USER, USER)


def with_mount(options, folder):
    """What goes before a command, so that it sees a file system of its own in a folder; skips where that cannot be.

    Args:
        options: Of `mount`, the last one being what is mounted.
        folder: Where.
    """
    if os.geteuid() != 0:
        pytest.skip("only root mounts")
    script = 'mount "$@"'
    probe = subprocess.run(
        ["unshare", "--mount", "sh", "-c", script, "sh", *options, str(folder)], capture_output=True, text=True
    )
    if probe.returncode:
        pytest.skip(f"nothing can be mounted here: {probe.stderr.strip()}")
    quoted = " ".join(f"'{one}'" for one in (*options, folder))
    return ["unshare", "--mount", "sh", "-c", f'mount {quoted} && exec "$@"', "sh"]
