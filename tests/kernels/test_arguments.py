"""Numbers that callers give: taken where they are such, refused by name where they are not."""

import numpy as np
import pytest

from warploom.kernels.arguments import real, reals, several, table, whole, wholes


@pytest.mark.parametrize("value", [2, 2.0, np.float32(2), np.int64(2), np.uint8(2), np.array(2.0), True + 1])
def test_numbers_of_any_type_are_taken(value):
    assert real(value, "it") == 2.0
    assert type(real(value, "it")) is float
    assert whole(value, "it") == 2
    assert type(whole(value, "it")) is int


@pytest.mark.parametrize("value", [None, "2", b"2", [1, 2], {}, np.zeros(3), 1j])
def test_what_is_no_number_is_refused(value):
    for take in (real, whole):
        with pytest.raises(TypeError, match="radius must be a number, not"):
            take(value, "radius")


@pytest.mark.parametrize("value", [1.5, float("nan"), float("inf"), -float("inf"), 2**31, -(2**31), 1e300, 10**400])
def test_what_is_not_whole_or_too_large_is_refused(value):
    with pytest.raises(ValueError, match="min_size must be a whole number"):
        whole(value, "min_size")


def test_the_largest_whole_numbers():
    assert whole(2**31 - 1, "it") == 2**31 - 1
    assert whole(-(2**31) + 1, "it") == -(2**31) + 1
    assert whole(2**63 - 1, "it", bits=64) == 2**63 - 1
    with pytest.raises(ValueError, match="of 64 bits"):
        whole(2**63, "it", bits=64)
    with pytest.raises(ValueError, match="that a float can hold"):
        real(10**400, "it")


def test_several_numbers():
    assert reals(np.arange(3, dtype=np.float32), "it") == (0.0, 1.0, 2.0)
    assert wholes([1, 2.0, np.int8(3)], "it") == (1, 2, 3)
    assert several((k for k in "ab"), "it") == ["a", "b"]
    for take in (reals, wholes, several):
        for value in (None, 3.0, "ab"):
            with pytest.raises(TypeError, match="point_range must be a sequence"):
                take(value, "point_range")
    with pytest.raises(TypeError, match="point_range must be a number, not None"):
        reals([1, None], "point_range")


def test_a_table():
    assert table([[1, 2], [3, 4]], "it").dtype == np.float64
    given = np.eye(3)
    assert table(given, "it") is given
    for value in ("x", [[1, 2], [3]], [None, {}]):
        with pytest.raises(TypeError, match="initial must be numbers"):
            table(value, "initial")
