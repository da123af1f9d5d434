"""Flag loaders: run before everything else; every component and processor sees what they found."""

import pytest

from warploom.dag import Process, YamlFlags, load_module
from warploom.errors import ConfigError

pytestmark = pytest.mark.usefixtures("no_thread_left")

MODULE = """\
module: flagged
flag_loaders:
  - class: warploom.dag.YamlFlags
    config: {path: FLAGS}
  - class: flag_parts.Loader
    config: {mode: night}
components:
  - name: reader
    kind: data
    class: flag_parts.Reader
    trigger: number
    inputs: {number: number}
  - name: graph
    kind: dag
    trigger: number
    inputs: {number: number}
    graph:
      look: {processor: flag_parts.Look, in: {value: number}}
"""
PARTS = """\
from warploom.dag import DataProcessComponent, In, Processor
from warploom.datamesh import Input, Status

seen = {}


class Loader:
    def __init__(self, mode):
        self.mode = mode

    def load(self):
        seen.clear()
        return {"mode": self.mode, "cameras": 13}


class Broken(Loader):
    def load(self):
        raise OSError("no such server")


class Odd(Loader):
    def load(self):
        return 5


class Reader(DataProcessComponent):
    number: Input[int]

    def init(self, config):
        seen["component"] = dict(self.flags)


class Look(Processor):
    value: In[int]

    def init(self, config):
        seen["processor"] = dict(self.flags)

    def process(self, trigger):
        return Status.OK
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """Writes the module and its parts, and builds the process."""
    (tmp_path / "flag_parts.py").write_text(PARTS)
    flags = tmp_path / "flags.yaml"
    flags.write_text("mode: day\nroute: harbour\n")
    monkeypatch.syspath_prepend(tmp_path)

    def build(change=lambda text: text):
        path = tmp_path / "module.yaml"
        path.write_text(change(MODULE).replace("FLAGS", str(flags)))
        return Process([load_module(path)], external={"number": int})

    return build


def test_flags_are_there_when_components_and_processors_are_initialised(module):
    process = module()
    import flag_parts

    expected = {"mode": "night", "route": "harbour", "cameras": 13}
    assert flag_parts.seen == {"component": expected, "processor": expected}
    assert process.flags == expected
    with pytest.raises(TypeError):
        process.flags["mode"] = "day"


@pytest.mark.parametrize(
    ("old", "new", "line", "said"),
    [
        ("flag_parts.Loader", "flag_parts.Loder", 5, "has no class 'Loder'; did you mean 'Loader'"),
        ("flag_parts.Loader", "flag_parts.Broken", 5, "flag_parts.Broken cannot load flags: OSError: no such server"),
        ("flag_parts.Loader", "flag_parts.Odd", 5, "flag_parts.Odd loaded int, not a mapping"),
        ("{mode: night}", "{mod: night}", 5, "unexpected keyword argument 'mod'"),
        ("{path: FLAGS}", "{path: nowhere.yaml}", 3, "nowhere.yaml: flags cannot be read"),
        ("class: flag_parts.Loader", "clas: flag_parts.Loader", 5, "unknown key; did you mean 'class'?"),
    ],
)
def test_a_loader_that_fails_is_told_with_its_place_and_nothing_starts(old, new, line, said, module):
    with pytest.raises(ConfigError) as caught:
        module(lambda text: text.replace(old, new))
    assert f"module.yaml:{line}: " in str(caught.value)
    assert said in str(caught.value)


@pytest.mark.parametrize("text", ["- a\n- b\n", "a: [\n"])
def test_a_flag_file_that_is_no_mapping_is_refused(text, tmp_path):
    path = tmp_path / "flags.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=r"flags\.yaml"):
        YamlFlags(str(path)).load()
