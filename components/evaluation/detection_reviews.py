"""Detections that a person has looked at: real vehicles that the labels of a data set lack are not counted as false."""

from __future__ import annotations

import pathlib
from dataclasses import dataclass

import numpy as np
import yaml

from ...errors import ConfigError

__all__ = ["Review"]

_NEAR = 1.5  # metres from the place that was noted


@dataclass(frozen=True, eq=False, kw_only=True)
class Review:
    """Places of real but unlabelled vehicles, by the name of the frame."""

    places: dict[str, np.ndarray]
    """x y in the sensor's frame [m], shape (n, 2)."""

    @classmethod
    def read(cls, path: pathlib.Path) -> Review:
        """Reads a YAML file: a list of entries `{frame: kitti_object/000001, at: [12.3, -4.5]}`, with any note.

        Raises:
            ConfigError: It cannot be read, or an entry is none.
        """
        try:
            content = yaml.safe_load(path.read_text("utf-8")) or []
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise ConfigError(f"{path}: cannot read the review: {error}") from error
        places: dict[str, list[list[float]]] = {}
        if not isinstance(content, list):
            raise ConfigError(f"{path}: expected a list of entries with frame and at, not {type(content).__name__}")
        for number, entry in enumerate(content, 1):
            try:
                x, y = (float(value) for value in entry["at"])
                places.setdefault(str(entry["frame"]), []).append([x, y])
            except (KeyError, TypeError, ValueError) as error:
                raise ConfigError(
                    f"{path}, entry {number}: expected frame: NAME and at: [x, y], got {entry!r}"
                ) from error
        return cls(places={name: np.array(some) for name, some in places.items()})

    def is_real(self, frame: str, box: np.ndarray) -> bool:
        """Whether a detection is within 1.5 m of a place noted for its frame."""
        there = self.places.get(frame)
        return there is not None and bool((np.hypot(*(there - np.asarray(box[:2], float)).T) < _NEAR).any())
