"""An idle component says what it waits for, and refuses sensors that it is not for."""

import pytest

from warploom.components.execution import ExecutionContext
from warploom.components.node.idle import IdleComponent, IdleConfig
from warploom.components.profile import SensorSpec
from warploom.datamesh import CommitPolicy, DataMesh, Output


def idle(mesh=None, context=None, **config):
    component = IdleComponent("place", context)
    component.bind(mesh or DataMesh(), {})
    settings = IdleConfig.model_validate({"purpose": "does it", "missing": "a driver", **config})
    component.check(settings)
    component.init(settings)
    return component


def context_with(**names):
    sensors = {name: SensorSpec(name=name, model=model) for group in names.values() for name, model in group.items()}
    return ExecutionContext(sensors=sensors, sensor_kinds={kind: tuple(group) for kind, group in names.items()})


def test_it_says_what_is_missing_and_what_it_waits_for():
    component = idle(sensors={"gnss": 0}, topics=["sensor/gnss/raw"])
    because = "a driver is not there; the profile names no gnss; waits for sensor/gnss/raw"
    assert component.idle_because == because
    assert component.state() == {"purpose": "does it", "gnss": 0, "topics with data": "0 of 1"}


def test_it_sees_that_its_topic_has_data_and_makes_no_topic_of_its_own():
    mesh = DataMesh()
    component = idle(mesh, topics=["a", "b"])
    assert "waits for a, b" in component.idle_because
    assert mesh.topics() == []
    output = Output()
    output.bind("a", mesh.window("a"))
    assert "waits for a, b" in component.idle_because, "a topic without data is not there yet"
    with output.allocate_change() as change:
        change.set_version(1)
        change.value = 1
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)
    assert component.idle_because == "a driver is not there; waits for b; a has data already"
    assert component.state()["topics with data"] == "1 of 2"


def test_it_counts_the_sensors_of_the_profile():
    context = context_with(camera={"front": None, "rear": None})
    component = idle(context=context, sensors={"camera": 2})
    assert component.idle_because == "a driver is not there"
    assert component.state()["camera"] == "2 of 2"


def test_another_number_of_sensors_is_refused():
    context = context_with(camera={"front": None, "rear": None})
    with pytest.raises(ValueError, match=r"for 13 of kind camera, but the profile names 2: front, rear; name as many"):
        idle(context=context, sensors={"camera": 13})


def test_another_type_of_sensor_is_refused():
    context = context_with(radar={"front": "ars548"})
    with pytest.raises(ValueError, match="for conti430, but the profile says front is a ars548"):
        idle(context=context, sensors={"radar": 0}, model="conti430")


def test_a_sensor_without_a_type_is_taken():
    context = context_with(radar={"front": None})
    assert idle(context=context, sensors={"radar": 0}, model="conti430").state()["radar"] == 1


@pytest.mark.parametrize("config", [{"purpose": ""}, {"missing": ""}, {"sensors": {"sonar": 1}}, {"topic": "a"}])
def test_a_bad_configuration_is_refused(config):
    with pytest.raises(ValueError, match=next(iter(config))):
        IdleConfig.model_validate({"purpose": "p", "missing": "m", **config})
