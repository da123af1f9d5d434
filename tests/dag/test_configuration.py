"""Configuration files: whatever is wrong is told with file, line, key and what was expected."""

import os
from pathlib import Path
from typing import Literal

import pytest
from pydantic import BaseModel, ConfigDict, Field, model_validator

from warploom.dag import ConfigFile, find_config, import_class, nearest, parse_overrides
from warploom.dag.configuration import override
from warploom.errors import ConfigError


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid")


class Tracker(Strict):
    max_age: int = Field(5, ge=0)
    gate: float = 2.0
    kind: Literal["kalman", "none"] = "kalman"

    @model_validator(mode="after")
    def _gate_fits(self):
        if self.gate < 0:
            raise ValueError("gate must be >= 0")
        return self


class Profile(Strict):
    name: str
    capacity: int = 1000
    tracker: Tracker = Tracker()
    stages: dict[str, Tracker] = {}
    sensors: list[Tracker] = []
    folder: str = Field("", alias="class")


GOOD = """\
name: test
capacity: 20
tracker:
  max_age: 3
  gate: 1.5
stages:
  kind: {max_age: 1}
  far:
    max_age: 2
sensors:
  - max_age: 7
  - kind: none
"""


def message(write, text, changes=None):
    with pytest.raises(ConfigError) as caught:
        ConfigFile(write(text), Profile, changes)
    return str(caught.value)


def test_a_good_file_becomes_its_model(write):
    file = ConfigFile(write(GOOD), Profile)
    assert file.content.name == "test"
    assert file.content.tracker.max_age == 3
    assert file.content.sensors[1].kind == "none"


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (["name"], 1),
        (["tracker"], 3),
        (["tracker", "gate"], 5),
        (["stages", "kind"], 7),
        (["stages", "kind", "max_age"], 7),
        (["stages", "far", "max_age"], 9),
        (["sensors", 0], 11),
        (["sensors", 1, "kind"], 12),
        (["tracker", "absent"], 3),
        (["sensors", 9], 10),
        (["absent"], 1),
        ([], 1),
    ],
)
def test_keys_have_lines_and_what_is_not_there_that_of_its_parent(write, keys, line):
    assert ConfigFile(write(GOOD), Profile).line(keys) == line


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("capacity", "capactiy", 2, "capactiy: unknown key; did you mean 'capacity'? known: capacity, class, name"),
        ("  gate", "  gaet", 5, "tracker.gaet: unknown key; did you mean 'gate'? known: gate, kind, max_age"),
        (
            "    max_age: 2",
            "    maxage: 2",
            9,
            "stages.far.maxage: unknown key; did you mean 'max_age'? known: gate, kind",
        ),
        (
            "{max_age: 1}",
            "{mx_age: 1}",
            7,
            "stages.kind.mx_age: unknown key; did you mean 'max_age'? known: gate, kind",
        ),
        (
            "- max_age: 7",
            "- max_gae: 7",
            11,
            "sensors.0.max_gae: unknown key; did you mean 'max_age'? known: gate, kind",
        ),
        ("name: test\n", "", 1, "name: this key is missing"),
        ("capacity: 20", "capacity: many", 2, "capacity: Input should be a valid integer"),
        ("capacity: 20", "capacity: many", 2, "found 'many'"),
        ("capacity: 20", "capacity: [1, 2]", 2, "found list"),
        ("max_age: 3", "max_age: -3", 4, "tracker.max_age: Input should be greater than or equal to 0, found -3"),
        ("kind: none", "kind: particle", 12, "sensors.1.kind: Input should be 'kalman' or 'none', found 'particle'"),
        ("kind: none", "kind: kalmann", 12, "found 'kalmann'; did you mean 'kalman'?"),
        ("gate: 1.5", "gate: -1.5", 3, "tracker: gate must be >= 0"),
        ("tracker:\n", "tracker: 5\nmore:\n", 3, "tracker: Input should be a valid dictionary"),
        ("capacity: 20", "capacity: 20\ncapacity: 30", 3, "key 'capacity' stands twice in one mapping"),
        ("  gate: 1.5", "  gate: 1.5\n  gate: 2.5", 6, "key 'gate' stands twice"),
        ("capacity: 20", "capacity: [1, 2", 3, "is not YAML: expected ',' or ']'"),
        ("capacity: 20", "\tcapacity: 20", 2, "is not YAML: found character '\\t'"),
        ("capacity: 20", "[1]: 20\n? [2]\n: 3", 2, "is not YAML"),
        ("capacity: 20", "capacity: !!python/object:os.system 1", 2, "is not YAML: could not determine a constructor"),
    ],
)
def test_a_mistake_is_told_with_file_line_key_and_way_out(write, old, new, line, said):
    assert GOOD.count(old) == 1
    told = message(write, GOOD.replace(old, new))
    assert f"module.yaml:{line}: " in told
    assert said in told


def test_all_mistakes_are_told_at_once(write):
    told = message(write, "nam: x\ncapacity: y\n").splitlines()
    assert [line.split(": ")[1] for line in told] == ["name", "capacity", "nam"]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "expected a mapping of keys to values, found NoneType"),
        ("# nothing\n", "found NoneType"),
        ("- a\n- b\n", "found list"),
        ("just text", "found str"),
    ],
)
def test_a_file_that_is_no_mapping_is_refused(write, text, said):
    assert said in message(write, text)


def test_a_file_that_cannot_be_read_is_named(tmp_path, write):
    with pytest.raises(ConfigError, match=r"absent\.yaml: cannot be read: No such file"):
        ConfigFile(tmp_path / "absent.yaml", Profile)
    with pytest.raises(ConfigError, match="cannot be read: Is a directory"):
        ConfigFile(tmp_path, Profile)
    path = write("")
    for deep in (101 * "[" + 101 * "]", 200_000 * "[", 200_000 * "- "):
        with pytest.raises(ConfigError, match=r"module\.yaml:2: is not YAML: more than 100 levels in each other"):
            ConfigFile(write("name:\n " + deep), Profile)
    path.write_bytes(b"name: \xff\xfe")
    with pytest.raises(ConfigError, match=r"module\.yaml: is not UTF-8 text"):
        ConfigFile(path, Profile)


def test_anchors_and_merges_are_understood(write):
    text = "name: a\ntracker: &base {max_age: 9}\nsensors: [*base, *base]\nstages:\n  far: {<<: *base, gate: 1.0}\n"
    content = ConfigFile(write(text), Profile).content
    assert content.stages["far"].max_age == content.sensors[1].max_age == 9


def test_anchors_within_anchors_do_not_blow_up(write):
    doubling = "".join(f"x{i}: &x{i} [*x{i - 1}, *x{i - 1}]\n" for i in range(1, 40))
    assert "x39: unknown key" in message(write, f"name: a\nx0: &x0 [1]\n{doubling}")
    assert "x: unknown key" in message(write, "name: a\nx: &x [*x]\n")


def test_a_part_can_be_validated_by_a_model_of_its_own(write):
    file = ConfigFile(write(GOOD), Profile)
    assert file.validate(["tracker"], Tracker, {"max_age": 1}).max_age == 1
    with pytest.raises(ConfigError, match=r"module\.yaml:5: tracker\.gate: Input should be a valid number"):
        file.validate(["tracker"], Tracker, {"gate": "wide"})


def test_changes_replace_values_and_their_mistakes_do_not_blame_the_file(write):
    file = ConfigFile(write(GOOD), Profile, {("tracker", "max_age"): 8, ("sensors", "1", "gate"): 4})
    assert file.content.tracker.max_age == 8
    assert file.content.sensors[1].gate == 4
    told = message(write, GOOD, {("tracker", "max_age"): "old"})
    assert "tracker.max_age (as set from outside the file): Input should be a valid integer" in told
    assert "outside" not in message(write, GOOD.replace("1.5", "x"), {("tracker", "max_age"): 1})


def test_an_override_makes_the_mappings_on_its_way():
    data = {"a": 1, "items": [{"b": 2}, 5]}
    override(data, ["new", "deep", "key"], 3)
    override(data, ["a", "inside"], 4)
    override(data, ["items", 0, "b"], 6)
    override(data, ["items", "1"], 7)
    assert data == {"a": {"inside": 4}, "items": [{"b": 6}, 7], "new": {"deep": {"key": 3}}}


@pytest.mark.parametrize("key", ["first", "2", "-1"])
def test_an_override_of_an_item_that_is_not_there_is_refused(key):
    with pytest.raises(ConfigError, match=rf"setting items\.{key}: '{key}' is not the number of an item, 0 to 1"):
        override({"items": [1, 2]}, ["items", key, "b"], 1)


def test_overrides_come_from_the_environment_and_the_command_line_wins():
    environment = {"WARPLOOM__a__b": "1", "WARPLOOM__c": "[1, 2]", "HOME": "/root", "WARPLOOM_CONF": "x"}
    assert parse_overrides(["a.b=2", "d=", "e=x=y", "f = off"], environment) == {
        "a.b": 2,
        "c": [1, 2],
        "d": None,
        "e": "x=y",
        "f": False,
    }


def test_overrides_are_read_from_the_environment_of_the_process(monkeypatch):
    monkeypatch.setenv("WARPLOOM__perception__cluster__radius", "0.75")
    assert parse_overrides()["perception.cluster.radius"] == 0.75


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("radius", "--set 'radius': expected key=value"),
        ("=5", "expected key=value"),
        ("a=[1", "setting a=[1: the value is not YAML"),
    ],
)
def test_a_setting_that_makes_no_sense_is_refused(text, said):
    with pytest.raises(ConfigError) as caught:
        parse_overrides([text], {})
    assert said in str(caught.value)


@pytest.fixture
def places(tmp_path, monkeypatch):
    """Fills the conf folders, which are searched in this order: ./conf, $WARPLOOM_CONF (here `own`), shipped."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WARPLOOM_CONF", str(tmp_path / "own"))

    def put(folder, name):
        path = tmp_path / folder / "profiles" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("")
        return path

    return put


def found(name):
    return Path(os.path.abspath(find_config(name, "profiles", Path("shipped"))))


def test_a_named_file_is_searched_nearest_first(places):
    shipped = places("shipped", "cpu.yaml")
    assert found("cpu") == shipped
    own = places("own", "cpu.yaml")
    assert found("cpu") == own
    local = places("conf", "cpu.yaml")
    assert found("cpu") == found("cpu.yaml") == local


def test_a_path_comes_before_a_name(places, tmp_path):
    places("conf", "cpu.yaml")
    direct = tmp_path / "cpu.yaml"
    direct.write_text("")
    assert found("cpu.yaml") == found(str(direct)) == direct
    assert found("cpu") == tmp_path / "conf" / "profiles" / "cpu.yaml"


def test_a_name_that_is_nowhere_is_told_with_those_that_are(places):
    places("shipped", "cpu.yaml")
    places("own", "cpu-min.yaml")
    with pytest.raises(ConfigError, match=r"no profile 'cpo': .*did you mean 'cpu'\? known: cpu, cpu-min"):
        find_config("cpo", "profiles", Path("shipped"))
    for long in (5000 * "a", 5000 * "a" + ".yaml", "a\0b", "a\0b.yaml"):
        with pytest.raises(ConfigError, match="neither a file nor a name"):
            find_config(long, "profiles", Path("shipped"))


def test_the_environment_need_not_name_a_folder(places, monkeypatch):
    monkeypatch.delenv("WARPLOOM_CONF")
    shipped = places("shipped", "cpu.yaml")
    assert found("cpu") == shipped


def test_nearest_names_what_is_known():
    assert nearest("radios", ["radius", "min_size"]) == "did you mean 'radius'? known: min_size, radius"
    assert nearest("zzz", ["a", "b"]) == "known: a, b"
    assert nearest("a", []) == "known: none"


def test_a_class_is_imported_from_warploom_or_from_a_package_of_the_users_own(tmp_path, monkeypatch):
    package = tmp_path / "own_package_for_import"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "parts.py").write_text("class Mine:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert import_class("own_package_for_import.parts.Mine").__name__ == "Mine"
    assert import_class("warploom.dag.ConfigFile") is ConfigFile


def test_a_private_module_is_not_proposed():
    with pytest.raises(ConfigError, match="cannot import 'weakrefset'") as error:
        import_class("weakrefset.WeakSet")
    assert "_weakrefset" not in str(error.value)


@pytest.mark.parametrize(
    ("source", "name", "said"),
    [
        ("", "Processor", "'Processor' is not a dotted name: write package.module.Class"),
        ("", "not_there_at_all.Processor", "cannot import 'not_there_at_all'"),
        ("", "not_there_at_all.Processor", "is its folder on PYTHONPATH?"),
        ("", ".Processor", "cannot import ''"),
        ("class Ground: pass", "MODULE.Grund", "has no class 'Grund'; did you mean 'Ground'? known: Ground"),
        ("number = 3", "MODULE.number", "has no class 'number'"),
        ("def f(:", "MODULE.Ground", "cannot import 'MODULE': SyntaxError"),
        ("1 / 0", "MODULE.Ground", "cannot import 'MODULE': ZeroDivisionError: division by zero"),
        ("import not_there_at_all", "MODULE.Ground", "No module named 'not_there_at_all'"),
        ("", "warploom.dag.proccessor.In", "cannot import 'warploom.dag.proccessor'"),
        ("", "warploom.dag.proccessor.In", "did you mean 'warploom.dag.processor'?"),
        ("", "MODULEs.Ground", "did you mean 'MODULE'?"),
        ("from pathlib import Path\nclass Ground: pass", "MODULE.Grund", "did you mean 'Ground'? known: Ground"),
    ],
)
def test_a_class_that_cannot_be_had_is_told_with_the_reason(source, name, said, tmp_path, monkeypatch, request):
    module = f"imported_{abs(hash(request.node.name))}"
    (tmp_path / f"{module}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError) as caught:
        import_class(name.replace("MODULE", module))
    assert said.replace("MODULE", module) in str(caught.value)


def test_a_module_that_is_there_and_cannot_be_imported_is_not_named_as_a_way_out(tmp_path, monkeypatch):
    (tmp_path / "imports_what_is_not_there.py").write_text("from os import not_there_at_all")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match="cannot import name 'not_there_at_all'") as caught:
        import_class("imports_what_is_not_there.Ground")
    assert "did you mean" not in str(caught.value)
