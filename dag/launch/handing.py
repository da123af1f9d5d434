"""Which components the thread that receives a topic runs itself."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence

from ..configuration import ConfigFile
from ..schema import ModuleSpec

__all__ = ["hand_over"]


def hand_over(files: Sequence[ConfigFile[ModuleSpec]], imports: Collection[str]) -> None:
    """Hands a component over to the thread that receives what triggers it, unless its module file says who runs it.

    To wake another thread would cost as much as all else from the commit to its start. It is done for a data process
    that one topic from elsewhere triggers, which nobody else of the process reads: so the thread keeps nobody waiting.

    Args:
        files: The module files of a process.
        imports: The topics that it receives.
    """
    components = [component for file in files for component in file.content.components]
    readers = Counter(topic for component in components for topic in component.inputs.values())
    for component in components:
        names = component.trigger.any
        if (
            component.kind == "data"
            and "hand_off" not in component.model_fields_set
            and component.backlog.policy != "block"
            and len(names) == 1
            and (topic := component.inputs.get(names[0])) in imports
            and readers[topic] == 1
        ):
            component.hand_off = "inline"
