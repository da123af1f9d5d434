"""Units: what is told when a number comes with one, or a key with another one."""

import pytest
from pydantic import BaseModel, ConfigDict, Field

from warploom.dag import ConfigFile
from warploom.dag.units import field_unit, hint_for_key, hint_for_value
from warploom.errors import ConfigError


class Stage(BaseModel):
    model_config = ConfigDict(extra="forbid")

    radius: float = Field(0.5, gt=0.0, le=10.0)
    """Points no farther apart belong together [m]."""
    count: int = 3
    """How many."""
    timeout_ms: float = 5.0
    slope: float = 0.1
    """Of the ground [rad]."""
    speed: float = 0.0
    """Over ground [m/s]."""


class Derived(Stage):
    """Has no source of its own for `radius`."""


class Whole(BaseModel):
    model_config = ConfigDict(extra="forbid")

    stage: Stage = Stage()
    stages: dict[str, Derived | None] = {}


def test_a_field_has_the_unit_of_its_name_or_of_its_text():
    fields = ("radius", "count", "timeout_ms", "slope", "speed", "absent")
    assert [field_unit(Derived, name) for name in fields] == ["m", None, "ms", "rad", "m/s", None]
    assert field_unit(Derived | None, "radius") == "m"
    assert field_unit(int, "radius") is None


@pytest.mark.parametrize(
    ("value", "unit", "hint"),
    [
        ("50 cm", "m", "this is in m, so write 0.5"),
        ("50cm", "m", "this is in m, so write 0.5"),
        ("1.5e3mm", "m", "this is in m, so write 1.5"),
        ("0.1 s", "ms", "this is in ms, so write 100"),
        ("100 ms", "s", "this is in s, so write 0.1"),
        ("36 km/h", "m/s", "this is in m/s, so write 10"),
        ("180 deg", "rad", "this is in rad, so write 3.141592654"),
        ("180°", "rad", "this is in rad, so write 3.141592654"),
        ("50 ms", "m", "this is in m (length), and '50 ms' is not (time)"),
        ("50 cm", None, "write the number alone, in the unit that this key has"),
        ("50", "m", None),
        ("wide", "m", None),
        ("50 parsec", "m", None),
        (50, "m", None),
        (None, "m", None),
    ],
)
def test_a_number_with_a_unit_is_told_as_what_to_write(value, unit, hint):
    assert hint_for_value(value, unit) == hint


@pytest.mark.parametrize(
    ("key", "value", "hint"),
    [
        ("timeout_s", 0.25, "'timeout_ms' is in ms: write timeout_ms: 250"),
        ("timeout_ns", 5_000_000, "'timeout_ms' is in ms: write timeout_ms: 5"),
        ("radius_cm", 50, "'radius' is in m: write radius: 0.5"),
        ("radius_cm", "50", "'radius' is in m"),
        ("radius_ms", 50, None),
        ("timeout", 5, None),
        ("_ms", 5, None),
        ("count_m", 5, None),
    ],
)
def test_a_key_with_another_unit_is_told_as_the_right_one(key, value, hint):
    assert hint_for_key(key, value, Stage.model_fields, Stage) == hint


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("stage:\n  radius: 50 cm\n", 2, "stage.radius: Input should be a valid number, unable to parse string as a "
         "number, found '50 cm'; this is in m, so write 0.5"),
        ("stage: {radius: 50}\n", 1, "stage.radius: Input should be less than or equal to 10 [m], found 50"),
        ("stages:\n  far:\n    timeout_s: 0.1\n", 3, "stages.far.timeout_s: unknown key; 'timeout_ms' is in ms: write "
         "timeout_ms: 100; did you mean 'timeout_ms'? known: count"),
        ("stages:\n  far:\n    slope: 3 m\n", 3, "this is in rad (angle), and '3 m' is not (length)"),
    ],
)  # fmt: skip
def test_a_file_with_a_wrong_unit_is_told_with_its_line_and_what_to_write(write, text, line, said):
    with pytest.raises(ConfigError) as caught:
        ConfigFile(write(text), Whole)
    assert f"module.yaml:{line}: " in str(caught.value)
    assert said in str(caught.value)
