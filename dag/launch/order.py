"""The order of processes: those that consume start before those that produce, and stop after them."""

from __future__ import annotations

from collections.abc import Mapping, Set

__all__ = ["consumers_first"]


def consumers_first(exports: Mapping[str, Set[str]], imports: Mapping[str, Set[str]]) -> list[str]:
    """The names of processes in the order of their start.

    Args:
        exports: By process, the topics that it commits and others read.
        imports: By process, the topics that it reads and others commit.

    Returns:
        All names. Where processes feed each other in a cycle, the one that feeds the fewest others comes first.
    """
    left = list(exports)
    order: list[str] = []
    while left:

        def fed(name: str) -> int:
            return sum(bool(exports[name] & imports.get(other, set())) for other in left if other != name)

        first = min(left, key=fed)
        left.remove(first)
        order.append(first)
    return order
