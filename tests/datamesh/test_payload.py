"""Freezing: what was committed cannot be written any more."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import pytest

from warploom.datamesh import Freezable, freeze


@dataclass
class Cloud:
    xyz: np.ndarray
    parts: dict = field(default_factory=dict)


class Pair(NamedTuple):
    first: np.ndarray
    second: object


class Own:
    frozen = False

    def freeze(self):
        self.frozen = True


def test_arrays_at_any_depth_refuse_writes():
    arrays = [np.zeros(2) for _ in range(6)]
    freeze(Cloud(arrays[0], {"a": [arrays[1], (arrays[2],)], "b": Cloud(arrays[3]), "c": Pair(arrays[4], arrays[5])}))
    for array in arrays:
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_an_object_may_freeze_itself():
    own = Own()
    assert isinstance(own, Freezable)
    freeze([own])
    assert own.frozen


@pytest.mark.parametrize("value", [None, 1, "text", b"bytes", object(), Cloud, {1, 2}, [], np.float32(1.0)])
def test_what_has_no_arrays_passes(value):
    freeze(value)


def test_freezing_twice_is_harmless_and_copies_stay_writable():
    array = np.arange(3.0)
    freeze(array)
    freeze(array)
    copy = array.copy()
    copy[0] = 7.0
    assert array[0] == 0.0
