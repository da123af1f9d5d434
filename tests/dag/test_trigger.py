"""What a module file may say about triggers."""

import pytest
from pydantic import ValidationError

from warploom.dag import TriggerConfig


@pytest.mark.parametrize(
    ("given", "inputs", "period"),
    [
        ("lidar", ("lidar",), None),
        ("", (), None),
        ({"any": ["a", "b"]}, ("a", "b"), None),
        ({"all": ["a", "b"], "tolerance_ms": 20}, ("a", "b"), None),
        ({"period_ms": 50, "overrun": "coalesce"}, (), 50),
    ],
)
def test_a_trigger_is_an_input_or_some_or_a_time(given, inputs, period):
    config = TriggerConfig.model_validate(given)
    assert (config.inputs, config.period_ms) == (inputs, period)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"any": ["a"], "all": ["b"]}, "one of any, all and period_ms, not any and all"),
        ({"any": ["a"], "tolerance_ms": 3}, "tolerance_ms belongs to a trigger of kind `all`"),
        ({"all": ["a"], "overrun": "coalesce"}, "overrun belongs to a trigger with period_ms"),
        ({"period_ms": 0}, "greater than or equal to 0.1"),
        ({"all": ["a"], "tolerance_ms": -1}, "greater than or equal to 0"),
        (["a", "b"], "the name of an input, {any: [a, b]}, {all: [a, b]} or {period_ms: 100}, not ['a', 'b']"),
        (100, "or {period_ms: 100}, not 100"),
        ({"every": 3}, "Extra inputs are not permitted"),
        ({"period_ms": 5, "overrun": "burst"}, "'skip' or 'coalesce'"),
    ],
)
def test_a_trigger_that_makes_no_sense_is_refused(given, said):
    with pytest.raises(ValidationError) as caught:
        TriggerConfig.model_validate(given)
    assert said in str(caught.value)
