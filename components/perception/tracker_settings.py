"""The tracker's configuration as files have it: whatever is left out is as the tracker has it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from ...dag import ConfigFile, ProcessorConfig, find_config, parse_overrides
from ...models.classes import CLASSES
from ...models.track_config import ClassConfig, TrackerConfig
from ..profile import CONF

__all__ = ["TrackerSettings", "load_tracker"]

_OF_ALL = {"size_weight", "longest_gap", "score_weight", "max_detections", "max_tracks"}
_TYPES: dict[str, Any] = {"int": int, "str": str, "float": float}

ClassSettings = create_model(
    "ClassSettings",
    __config__=ConfigDict(extra="forbid", frozen=True),
    **{each.name: (_TYPES[str(each.type)] | None, None) for each in dataclasses.fields(ClassConfig)},
)
"""What may be said of one class: the fields of `models.track_config.ClassConfig`."""


class TrackerSettings(ProcessorConfig):
    """How objects are tracked, class by class; the keys are those of `models.track_config`."""

    vehicle: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of vehicles."""
    pedestrian: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of pedestrians."""
    cyclist: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of cyclists."""
    cone: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of cones."""
    barrier: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of barriers."""
    unknown: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of detections without a known class."""
    background: ClassSettings = Field(default_factory=ClassSettings)  # pyright: ignore[reportInvalidTypeForm]
    """Of boxes from clusters."""
    size_weight: float | None = Field(None, ge=0.0)
    """How much a difference in size counts beside distance."""
    longest_gap: float | None = Field(None, gt=0.0)
    """No track outlives a longer gap between frames [s]."""
    score_weight: float | None = Field(None, gt=0.0, le=1.0)
    """Least weight of the newest score in a track's mean."""
    max_detections: int | None = Field(None, ge=1, le=1 << 16)
    """More in one frame are dropped, those of lowest score."""
    max_tracks: int | None = Field(None, ge=1, le=1 << 16)
    """No track is begun beyond."""

    @model_validator(mode="after")
    def _is_possible(self) -> TrackerSettings:
        self.tracker_config()
        return self

    def tracker_config(self) -> TrackerConfig:
        """The tracker's configuration with these settings in place."""

        def changed(kind: ClassConfig, settings: BaseModel) -> ClassConfig:
            return dataclasses.replace(kind, **settings.model_dump(exclude_none=True))

        usual = TrackerConfig()
        own = self.model_dump(exclude_none=True, include=_OF_ALL)
        return dataclasses.replace(
            usual,
            classes=tuple(changed(usual.of(k), getattr(self, name)) for k, name in enumerate(CLASSES)),
            background=changed(usual.background, self.background),
            **own,
        )


def load_tracker(name: str, settings: Iterable[str] = ()) -> TrackerConfig:
    """Reads a tracker's settings.

    Args:
        name: Of a file in `conf/trackers`, or the path of one.
        settings: Changes by dotted key, as texts `key=value`.

    Raises:
        ConfigError: There is none of that name, or it is bad.
    """
    changes = {tuple(key.split(".")): value for key, value in parse_overrides(settings).items()}
    return ConfigFile(find_config(name, "trackers", CONF), TrackerSettings, changes).content.tracker_config()
