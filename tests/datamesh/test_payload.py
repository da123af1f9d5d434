"""Freezing: what was committed cannot be written any more."""

from dataclasses import dataclass, field
from enum import Enum
from typing import NamedTuple

import numpy as np
import pytest

from warploom.datamesh import Freezable, checksum, freeze
from warploom.datamesh.payload import holds_device_array


@dataclass
class Cloud:
    xyz: np.ndarray
    parts: dict = field(default_factory=dict)


class Pair(NamedTuple):
    first: np.ndarray
    second: object


class Color(Enum):
    RED = 1


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


class Plain:
    """No dataclass, and without a method that freezes it."""

    def __init__(self, inner=None):
        self.xyz, self.parts, self.inner = np.zeros(3), {"a": [np.zeros(2)]}, inner


def test_the_arrays_of_an_object_of_any_class_refuse_writes():
    plain = Plain()
    freeze([plain])
    for array in (plain.xyz, plain.parts["a"][0]):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1.0


def test_an_object_within_an_object_is_left_alone_as_it_may_be_somebody_elses():
    workspace, cyclic = Plain(), Plain()
    cyclic.inner = cyclic
    freeze(Plain(workspace))
    freeze(cyclic)
    workspace.xyz[0] = 1.0


def test_a_checksum_sees_what_is_in_an_object_of_any_class():
    plain = Plain()
    before = checksum(plain)
    plain.parts["a"][0][1] = 1.0
    assert checksum(plain) != before


def test_an_object_may_freeze_itself():
    own = Own()
    assert isinstance(own, Freezable)
    freeze([own])
    assert own.frozen


@pytest.mark.parametrize("value", [None, 1, "text", b"bytes", object(), Cloud, {1, 2}, [], np.float32(1.0), Color.RED])
def test_what_has_no_arrays_passes(value):
    freeze(value)


def test_freezing_twice_is_harmless_and_copies_stay_writable():
    array = np.arange(3.0)
    freeze(array)
    freeze(array)
    copy = array.copy()
    copy[0] = 7.0
    assert array[0] == 0.0


class DeviceArray:
    """Stands in for an array on a device, which NumPy cannot protect."""

    def __init__(self, values):
        self.values = np.asarray(values)

    def numpy(self):
        return self.values


def test_a_checksum_sees_every_byte_at_any_depth():
    def payload(x=0.0, key="a", text="t", on_device=1):
        return Cloud(np.array([1.0, x]), {key: [np.zeros((2, 3))[:, 1], DeviceArray([on_device])], "b": (text, 3)})

    sums = {checksum(payload(**change)) for change in ({}, {"x": -0.0}, {"key": "c"}, {"text": "u"}, {"on_device": 2})}
    assert len(sums) == 5
    assert checksum(payload()) == checksum(payload())


@pytest.mark.parametrize("value", [object(), np.array([object()]), np.zeros(0), np.float32(2.0), np.array(5), {}, None])
def test_a_checksum_is_taken_of_anything(value):
    assert checksum(value) == checksum(value)


def test_torch_and_warp_arrays_have_checksums():
    torch = pytest.importorskip("torch")
    wp = pytest.importorskip("warp")
    tensor, array = torch.zeros(4), wp.zeros(4, dtype=wp.float32, device="cpu")
    before = [checksum(tensor), checksum({"a": array})]
    freeze([tensor, array])
    tensor[2] = 1.0
    array.fill_(1.0)
    assert checksum(tensor) != before[0]
    assert checksum({"a": array}) != before[1]


def test_an_array_of_a_device_is_found_at_any_depth():
    torch = pytest.importorskip("torch")
    wp = pytest.importorskip("warp")

    for array in (wp.zeros(1), torch.zeros(1)):
        assert holds_device_array(array)
        assert holds_device_array({"a": [(1, array)]})
    assert not holds_device_array({"a": [(1, np.zeros(1), "text")]})
