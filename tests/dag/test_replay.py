"""Replay: the same components give the same bytes on any number of workers, and others are found out."""

import dataclasses

import numpy as np
import pytest

from warploom.dag import In, Out, Process, Processor, ProcessorConfig, Status, load_module
from warploom.dag.replay import Difference, Drain, Replay, produced_topics
from warploom.datamesh import CommitPolicy, Output
from warploom.datamesh.messages import message
from warploom.datamesh.playback import Player
from warploom.datamesh.recording import Recorder
from warploom.datamesh.recording_reader import Recording
from warploom.errors import ConfigError

pytestmark = pytest.mark.usefixtures("no_thread_left")


class SumConfig(ProcessorConfig):
    gain: float = 1.0
    fails_at: int = -1


class RunningSum(Processor):
    """Keeps state from frame to frame, which begins anew in a new epoch."""

    Config = SumConfig
    value: In[np.ndarray]
    total: Out[np.ndarray]

    def init(self, config):
        self.config, self.sum, self.epoch = config, np.zeros(3), None

    def process(self, trigger):
        if trigger.version % 7 == 5 or trigger.version == self.config.fails_at:
            raise RuntimeError("made to fail")
        if trigger.epoch != self.epoch:
            self.sum, self.epoch = np.zeros(3), trigger.epoch
        self.sum = self.sum * self.config.gain + self.value.value
        self.total.value = self.sum.copy()
        return Status.OK


class Spread(Processor):
    value: In[np.ndarray]
    spread: Out[float]

    def process(self, trigger):
        self.spread.value = float(np.ptp(self.value.value))
        return Status.OK


MODULE = f"""\
module: sums
components:
  - name: first
    kind: dag
    trigger: value
    inputs: {{value: sensor/value}}
    outputs: {{total: made/total, spread: made/spread}}
    workers: 2
    in_flight: 2
    graph:
      sum: {{processor: {__name__}.RunningSum, config: {{gain: 0.5}}}}
      spread: {{processor: {__name__}.Spread}}
      commit_total: {{processor: warploom.dag.CommitDagProcessor, in: {{value: total}}, config: {{output: total}}}}
      commit_spread: {{processor: warploom.dag.CommitDagProcessor, in: {{value: spread}}, config: {{output: spread}}}}
  - name: second
    kind: monotonic_dag
    trigger: value
    inputs: {{value: made/total}}
    outputs: {{total: made/twice}}
    graph:
      sum: {{processor: {__name__}.RunningSum}}
      commit_total: {{processor: warploom.dag.CommitDagProcessor, in: {{value: total}}, config: {{output: total}}}}
"""


def process_of(write, text=MODULE, **changes):
    placed = {tuple(key.split("__")): value for key, value in changes.items()}
    return Process([load_module(write(text), placed)], external={"sensor/value": np.ndarray}, offline=True)


def feed(mesh, versions, topic="sensor/value"):
    output = Output()
    output.bind(topic, mesh.window(topic))
    for version in versions:
        with output.allocate_change() as change:
            change.set_version(version)
            change.value = np.random.default_rng(version).normal(size=3)
            output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def record(path, process, versions=range(40), **options):
    with Recorder(path, **options) as recorder:
        recorder.watch(process.mesh, {"sensor/value", *produced_topics(process)})
        process.start()
        feed(process.mesh, versions)
        process.stop()
    assert not recorder.dropped
    return Recording(path)


@pytest.mark.parametrize("workers", [1, 2, 8])
def test_the_same_components_give_the_same_bytes_on_any_number_of_workers(write, tmp_path, workers, caplog):
    recording = record(tmp_path / "a.mcap", process_of(write))
    process = process_of(write, first__workers=workers, first__in_flight=workers)
    result = Replay(recording, process).run()
    assert result.good, result.differences
    # Versions 5, 12, … fail in the sum, and nothing comes of them.
    failed = len([v for v in range(40) if v % 7 == 5])
    assert result.equal == {"made/total": 40 - failed, "made/spread": 40, "made/twice": 40 - failed}
    assert result.fed == {"sensor/value": 40}
    assert (result.different, result.broken) == (0, None)


def test_one_bit_is_found(write, tmp_path, caplog):
    recording = record(tmp_path / "a.mcap", process_of(write))
    result = Replay(recording, process_of(write, first__sum__gain=np.nextafter(0.5, 1).item())).run()
    assert not result.good
    # The very first total is the first value itself, whatever the gain is; soon after that they part for good.
    assert 1 <= result.equal["made/total"] < 6
    assert result.equal["made/spread"] == 40
    assert {difference.what for difference in result.differences} == {"differs"}
    assert {difference.topic for difference in result.differences} == {"made/total", "made/twice"}


def test_what_is_missing_and_what_is_extra_is_told(write, tmp_path, caplog):
    recording = record(tmp_path / "a.mcap", process_of(write))
    result = Replay(recording, process_of(write, second__sum__fails_at=38)).run()
    assert sorted(result.differences) == [
        Difference("made/twice", 0, 38, "missing"),
        Difference("made/twice", 0, 39, "differs"),
    ]
    recording = record(tmp_path / "b.mcap", process_of(write, second__sum__fails_at=39))
    assert Replay(recording, process_of(write)).run().differences == [Difference("made/twice", 0, 39, "extra")]


def test_a_topic_that_is_not_in_the_recording_is_named(write, tmp_path):
    recording = record(tmp_path / "a.mcap", process_of(write), range(3))
    process = Process(
        [load_module(write(MODULE.replace("sensor/value", "sensor/values")))], external={"sensor/values": np.ndarray}
    )
    with pytest.raises(
        ConfigError, match=r"read topic 'sensor/values', which is not in it; did you mean 'sensor/value'"
    ):
        Replay(recording, process)
    hashes = record(tmp_path / "b.mcap", process_of(write), range(3), digest_only=["sensor/value"])
    with pytest.raises(ConfigError, match="'sensor/value', which was recorded as hashes alone"):
        Replay(hashes, process_of(write))


def test_outputs_kept_as_hashes_are_enough(write, tmp_path, caplog):
    recording = record(tmp_path / "a.mcap", process_of(write), digest_only=["made/total", "made/twice", "made/spread"])
    assert Replay(recording, process_of(write)).run().good


def test_an_empty_recording_proves_nothing(write, tmp_path):
    recording = record(tmp_path / "a.mcap", process_of(write), [])
    with pytest.raises(ConfigError, match="'sensor/value', which is not in it"):
        Replay(recording, process_of(write))


def test_a_truncated_recording_is_replayed_up_to_its_break(write, tmp_path, caplog):
    recording = record(tmp_path / "a.mcap", process_of(write), range(3000), compression="none")
    data = recording.path.read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
    result = Replay(Recording(tmp_path / "cut.mcap"), process_of(write)).run()
    assert result.broken is not None
    assert 1000 < result.equal["made/spread"] < 3000
    assert result.good, "what is beyond the break is no difference"
    other = Replay(Recording(tmp_path / "cut.mcap"), process_of(write, second__sum__fails_at=38)).run()
    assert not other.good
    assert other.differences[0].version >= 38


def play(path, recording, process, *, loops=1, seek=0.0):
    """Records what the components make of a recording that is played, as `warploom play --record` does."""
    drain = Drain(process, ["sensor/value"])
    with Recorder(path) as recorder:
        recorder.watch(process.mesh, {"sensor/value", *produced_topics(process)})
        player = Player(
            recording, process.mesh, ["sensor/value"], rate=None, loops=loops, seek=seek, before_epoch=drain.wait
        )
        process.start()
        player.play()
        process.stop()
    assert not recorder.dropped
    return Recording(path)


@pytest.mark.parametrize("workers", [1, 2, 8])
@pytest.mark.parametrize(("loops", "seek"), [(3, 0.0), (1, 15e-9), (2, 22e-9)])
def test_loop_and_seek_are_new_epochs_and_replay_to_the_bit(write, tmp_path, workers, loops, seek, caplog):
    once = record(tmp_path / "once.mcap", process_of(write))
    played = play(tmp_path / "played.mcap", once, process_of(write), loops=loops, seek=seek)
    kept = [version for version in range(40) if version >= round(seek * 1e9)]
    events = [event for event in played if event.topic == "sensor/value"]
    assert [(event.epoch, event.version) for event in events] == [(e, v) for e in range(loops) for v in kept]
    result = Replay(played, process_of(write, first__workers=workers, first__in_flight=workers)).run()
    assert result.good, result.differences
    sums = loops * len([version for version in kept if version % 7 != 5])
    assert result.equal == {"made/total": sums, "made/spread": loops * len(kept), "made/twice": sums}


def test_each_loop_gives_what_the_first_gave(write, tmp_path, caplog):
    once = record(tmp_path / "once.mcap", process_of(write))
    played = play(tmp_path / "played.mcap", once, process_of(write), loops=3)
    hashes = [
        [(e.topic, e.version, e.sha256) for e in played if e.epoch == epoch and e.topic == "made/twice" and e.payload]
        for epoch in range(3)
    ]
    assert hashes[0] == hashes[1] == hashes[2]
    assert len(hashes[0]) > 30


ANY = f"""\
module: pairs
components:
  - name: either
    kind: dag
    trigger: {{any: [left, right]}}
    inputs: {{left: sensor/value, right: sensor/other}}
    outputs: {{spread: made/either}}
    graph:
      spread: {{processor: {__name__}.SpreadOfEither}}
      commit: {{processor: warploom.dag.CommitDagProcessor, in: {{value: spread}}, config: {{output: spread}}}}
  - name: both
    kind: dag
    trigger: {{all: [left, right]}}
    inputs: {{left: sensor/value, right: sensor/other}}
    outputs: {{spread: made/both}}
    graph:
      spread: {{processor: {__name__}.SpreadOfEither}}
      commit: {{processor: warploom.dag.CommitDagProcessor, in: {{value: spread}}, config: {{output: spread}}}}
"""


class SpreadOfEither(Processor):
    left: In[np.ndarray] = In(optional=True)
    right: In[np.ndarray] = In(optional=True)
    spread: Out[float]

    def process(self, trigger):
        values = [port.value for port in (self.left, self.right) if port.present]
        self.spread.value = float(np.ptp(np.concatenate(values)))
        return Status.OK


def test_triggers_of_several_inputs_replay_and_drain(write, tmp_path):
    def build():
        return Process([load_module(write(ANY))], external={"sensor/value": np.ndarray, "sensor/other": np.ndarray},
                       offline=True)  # fmt: skip

    topics = ["sensor/value", "sensor/other"]
    process = build()
    with Recorder(tmp_path / "a.mcap") as recorder:
        recorder.watch(process.mesh, {*topics, *produced_topics(process)})
        process.start()
        for version in range(30):
            feed(process.mesh, [version])
            if version % 3 == 0:
                feed(process.mesh, [version], "sensor/other")
            else:
                process.mesh.window("sensor/other").settle(version)
        process.stop()
    result = Replay(Recording(tmp_path / "a.mcap"), build()).run()
    assert result.good, result.differences
    assert result.equal == {"made/either": 30, "made/both": 10}
    # And drained between two epochs.
    process = build()
    drain = Drain(process, topics)
    drained = []
    player = Player(
        Recording(tmp_path / "a.mcap"), process.mesh, topics, rate=None, loops=2,
        before_epoch=lambda: (drain.wait(), drained.append(True)),
    )  # fmt: skip
    process.start()
    player.play()
    process.stop()
    assert drained == [True]
    assert not process.mesh.losses["made/either", "out_of_order"]


def reading(*fields):
    """A message as one version of a program defines it."""
    made = dataclasses.make_dataclass("Reading", [("total", float), *fields], frozen=True)
    return message("warploom_tests.Reading")(made)


class Reads(Processor):
    message = reading()
    value: In[np.ndarray]
    reading: Out[object]

    def process(self, trigger):
        self.reading.value = self.message(float(self.value.value.sum()))
        return Status.OK


READS = f"""\
module: reads
components:
  - name: reads
    kind: dag
    trigger: value
    inputs: {{value: sensor/value}}
    outputs: {{reading: made/reading}}
    graph:
      read: {{processor: {__name__}.Reads}}
      commit: {{processor: warploom.dag.CommitDagProcessor, in: {{value: reading}}, config: {{output: reading}}}}
"""


def test_a_message_that_has_got_a_field_since_is_told_and_compared_with_that_field(write, tmp_path, monkeypatch):
    recording = record(tmp_path / "a.mcap", process_of(write, READS))
    result = Replay(recording, process_of(write, READS)).run()
    assert (result.good, result.other_fields) == (True, ())
    monkeypatch.setattr(Reads, "message", reading(("unit", str, dataclasses.field(default="m"))))
    result = Replay(recording, process_of(write, READS)).run()
    assert result.other_fields == ("made/reading",)
    assert result.good, result.differences
    assert result.equal == {"made/reading": 40}
    # Another value of the new field is a difference, as another default would be.
    today = Reads.message
    monkeypatch.setattr(Reads, "message", lambda _, total: today(total, "ft"))
    assert Replay(recording, process_of(write, READS)).run().different == 40
