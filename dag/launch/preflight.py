"""Checks before anything starts: is what the launch file and the profile ask for there?

Checks are registered by name. Each looks at the plan and says what it found; what is missing comes with the way out.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from .plan import LaunchPlan

__all__ = ["Check", "Finding", "register_check", "registered_checks", "run_checks"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Finding:
    """What one check found."""

    check: str
    """Name of the check."""
    ok: bool
    message: str
    """What is there, or what is missing."""
    way_out: str = ""
    """What to do where it is missing."""

    def __str__(self) -> str:
        text = f"{'ok     ' if self.ok else 'MISSING'}  {self.check}: {self.message}"
        return text if self.ok or not self.way_out else f"{text}\n         → {self.way_out}"


Check = Callable[[LaunchPlan], Iterable[Finding]]

_checks: dict[str, Check] = {}


def register_check(name: str, check: Check) -> None:
    """Adds a check, in the place of one of the same name."""
    _checks[name] = check


def registered_checks() -> dict[str, Check]:
    """The checks by name, in the order in which they were registered."""
    return dict(_checks)


def run_checks(plan: LaunchPlan) -> list[Finding]:
    """What all checks find; a check that raises counts as a thing that is missing."""
    findings: list[Finding] = []
    for name, check in _checks.items():
        try:
            findings.extend(check(plan))
        except Exception as error:
            _log.exception("the preflight check %s failed", name)
            findings.append(Finding(name, False, f"the check itself failed: {type(error).__name__}: {error}"))
    return findings
