"""Plans, the preallocated face of each kernel family, kept between calls of its function face."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any, TypeVar

from .threads import thread_count

__all__ = ["capacity_for", "plan_for"]

Plan = TypeVar("Plan")

_KEPT_PER_THREAD = 24
_plans = threading.local()


def capacity_for(count: int) -> int:
    """The next power of two at or above `count`, at least 1024, so that clouds of like size share a plan."""
    return max(1024, 1 << (max(count, 1) - 1).bit_length())


def plan_for(plan_class: type[Plan], **configuration: Any) -> Plan:
    """A plan of this class and configuration: this thread's own from an earlier call, or a new one.

    A plan's workspace serves one thread, so each thread keeps its own; the least recently used are let go. A plan takes
    the number of threads that its kernels may use when it is made: another number, another plan.

    Args:
        plan_class: The plan's class, a dataclass whose fields are hashable.
        **configuration: Its fields, such as `capacity` and `device`.
    """
    if not hasattr(_plans, "kept"):
        _plans.kept = OrderedDict()
    kept: OrderedDict[tuple, Any] = _plans.kept
    key = (plan_class, thread_count(), *sorted(configuration.items()))
    plan = kept.pop(key, None)
    if plan is None:
        plan = plan_class(**configuration)
    kept[key] = plan
    while len(kept) > _KEPT_PER_THREAD:
        kept.popitem(last=False)
    return plan
