"""The pipeline recorded, played and replayed: every commit again to the bit, on any number of workers."""

import dataclasses
import errno
import json
import re

import numpy as np
import pytest

import warploom as wl
from warploom.components.messages import Obstacles, PointLabels, SensorFrame
from warploom.components.pipeline import CAMERAS_TOPIC, LIDAR_TOPIC, OBSTACLES_TOPIC, POINTS_TOPIC, RADARS_TOPIC
from warploom.components.recording import play_recording, record_source, replay_lines, replay_recording
from warploom.datamesh import recording as recording_module
from warploom.datamesh.messages import encode
from warploom.datamesh.recording_reader import Recording
from warploom.errors import ConfigError, SourceError

SOURCE = "sim:street?seed=7&duration=1.0"
WORKERS = (1, 2, 8)
SOURCES = (CAMERAS_TOPIC, LIDAR_TOPIC, RADARS_TOPIC)


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """The main job on one second of the simulator, recorded."""
    path = tmp_path_factory.mktemp("recording") / "street.mcap"
    summary = record_source(SOURCE, path, settings=["perception.cluster.min_size=9"])
    assert (summary.frames, summary.commits, summary.dropped, summary.failure) == (10, 60, {}, None)
    assert summary.losses == {}
    return path


def test_every_message_of_the_pipeline_comes_back_to_the_bit(street):
    recording = Recording(street)
    frames = list(wl.read(SOURCE))
    values = {(event.topic, event.version): event.value for event in recording}
    for frame in frames:
        sensor = values[LIDAR_TOPIC, frame.version]
        assert isinstance(sensor, SensorFrame)
        assert encode(sensor) == encode(frame)
        assert sensor.points.tobytes() == frame.points.tobytes()
        assert isinstance(values[OBSTACLES_TOPIC, frame.version], Obstacles)
        labels = values[POINTS_TOPIC, frame.version]
        assert isinstance(labels, PointLabels)
        assert labels.height.dtype == np.float32


def test_the_recording_says_what_ran(street, repository):
    recording = Recording(street)
    assert recording.metadata["source"] == SOURCE
    assert recording.metadata["profile"] == "cpu"
    assert json.loads(recording.metadata["settings"]) == ["perception.cluster.min_size=9"]
    assert "warp-lang" in json.loads(recording.metadata["versions"])
    module = (repository / "conf" / "modules" / "perception.yaml").read_bytes()
    assert recording.attachments["perception.yaml"] == module


def test_the_main_job_replays_with_equal_hashes_at_1_2_and_8_workers(street):
    results = list(replay_recording(street, workers=WORKERS))
    assert [workers for workers, _, _ in results] == list(WORKERS)
    for _, result, changed in results:
        assert result.good, result.differences
        assert result.fed == dict.fromkeys(SOURCES, 10)
        assert result.equal == {"perception/detected": 10, POINTS_TOPIC: 10, OBSTACLES_TOPIC: 10}
        assert changed == []


def test_under_loop_and_seek_too(street, tmp_path):
    settings = ["perception.cluster.min_size=9"]
    summary = play_recording(
        street, profile="cpu", settings=settings, rate=None, seek=0.5, loops=2, record=tmp_path / "looped.mcap"
    )
    assert summary.published[LIDAR_TOPIC] == 10  # a camera is the first, 0.05 s before the sweep: 0.45 s on it
    assert summary.recorded.dropped == summary.recorded.losses == {}
    assert (summary.recorded.frames, summary.recorded.failure) == (10, None)
    epochs = [(event.epoch, event.topic) for event in Recording(tmp_path / "looped.mcap")]
    assert [epochs.count((epoch, OBSTACLES_TOPIC)) for epoch in (0, 1)] == [5, 5]
    for workers, result, _ in replay_recording(tmp_path / "looped.mcap", workers=WORKERS):
        assert result.good, (workers, result.differences)
        assert result.equal[OBSTACLES_TOPIC] == 10


def test_another_setting_is_found_out_and_told(street):
    ((_, result, _),) = replay_recording(street, settings=["perception.cluster.radius=0.7"])
    assert not result.good
    text = "\n".join(replay_lines(None, result, ["perception.yaml"]))
    assert "NOT bit-exact" in text
    assert "perception/points at " in text
    assert "perception.yaml is not what it was when the recording was made" in text


def test_a_run_at_its_own_pace_replays_too_whatever_it_dropped(tmp_path):
    settings = ["perception.backlog.policy=latest"]
    source = "sim:street?seed=3&duration=1.0&rate=40"
    summary = record_source(source, tmp_path / "a.mcap", realtime=True, settings=settings)
    assert not summary.dropped
    for workers, result, _ in replay_recording(tmp_path / "a.mcap", workers=(1, 8)):
        assert result.good, (workers, result.differences, result.hung)
        dropped = summary.losses.get("perception", {}).get("backlog", 0)
        assert result.equal[OBSTACLES_TOPIC] == result.fed[LIDAR_TOPIC] - dropped


def test_the_python_of_the_docs_runs_as_it_stands(repository, tmp_path, monkeypatch, capsys):
    text = (repository / "docs" / "recording.md").read_text(encoding="utf-8")
    code = re.findall(r"```python\n(.*?)```", text, re.DOTALL)[-1]
    (tmp_path / "scans").mkdir()
    for frame in wl.read("sim:street?seed=1&duration=0.2"):
        frame.points.tofile(tmp_path / "scans" / f"{frame.index:06d}.bin")
    monkeypatch.chdir(tmp_path)
    exec(compile(code, "recording.md", "exec"), {"wl": wl})
    assert len(capsys.readouterr().out.splitlines()) == 2


def test_a_recording_is_a_source_of_frames(street):
    source = wl.read(f"mcap:{street}")
    frames = list(source)
    assert len(source) == len(frames) == 10
    assert [encode(frame) for frame in frames] == [encode(frame) for frame in wl.read(SOURCE)]
    assert next(source).version == frames[0].version


def test_a_full_disk_ends_the_recording_and_the_run_goes_on_and_says_so(tmp_path, monkeypatch, caplog):
    written = 0
    write = recording_module._File.write

    def until_full(self, data):
        nonlocal written
        written += len(data)
        if written > 6_000_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(self, data)

    monkeypatch.setattr(recording_module._File, "write", until_full)
    summary = record_source("sim:street?seed=3&duration=0.6", tmp_path / "a.mcap", compression="none")
    assert summary.frames == 6
    assert summary.failure == "No space left on device"
    topics = {name.removeprefix("recorder ") for name in summary.losses if name.startswith("recorder ")}
    assert {"lidar/points", "camera/objects", "radar/objects", OBSTACLES_TOPIC} <= topics
    assert summary.commits + sum(summary.dropped.values()) == 6 * len(topics)
    assert summary.losses["recorder lidar/points"]["disk"] >= 3
    text = "\n".join(summary.lines())
    assert "the recording broke off: No space left on device; the run went on without it" in text
    assert f"{summary.dropped['disk']} commits were not recorded: disk" in text
    (_, result, _) = next(iter(replay_recording(tmp_path / "a.mcap")))
    assert result.broken is not None
    assert result.different == 0


def test_a_recording_without_the_sensor_cannot_be_replayed(tmp_path):
    record_source("sim:street?seed=3&duration=0.2", tmp_path / "a.mcap", topics=[OBSTACLES_TOPIC])
    with pytest.raises(ConfigError, match=f"the components read topic '{LIDAR_TOPIC}', which is not in it"):
        list(replay_recording(tmp_path / "a.mcap"))


def test_topics_and_files_that_make_no_sense_are_refused(street, tmp_path):
    with pytest.raises(
        ConfigError, match=r"--topic 'lidar/pionts': no component reads or writes it; there are: .*lidar/points"
    ):
        record_source(SOURCE, tmp_path / "a.mcap", topics=["lidar/pionts"])
    with pytest.raises(ConfigError, match="--source"):
        record_source("nowhere.bin", tmp_path / "a.mcap")
    with pytest.raises(ConfigError, match="'perception/obstacles' cannot be played: a module produces it"):
        play_recording(street, profile="cpu", topics=[OBSTACLES_TOPIC])
    with pytest.raises(ConfigError, match=r"cannot be played: it holds .*lidar/points, "):
        play_recording(street, topics=["camera/front"])
    with pytest.raises(ConfigError, match="cannot be recorded into itself"):
        play_recording(street, record=street)
    with pytest.raises(SourceError, match="No such file"):
        list(replay_recording(tmp_path / "absent.mcap"))


@pytest.mark.parametrize(("seek", "sweeps"), [(0.0, 10), (0.04, 10), (0.06, 9), (0.5, 5), (0.9, 1)])
def test_a_seek_is_the_same_time_whichever_topics_are_played(street, seek, sweeps):
    """The recording begins with a camera, 0.05 s before the first sweep, and ends 0.95 s later."""
    everything = play_recording(street, rate=None, seek=seek)
    alone = play_recording(street, rate=None, seek=seek, topics=[LIDAR_TOPIC])
    assert everything.published[LIDAR_TOPIC] == alone.published[LIDAR_TOPIC] == sweeps


def test_a_seek_beyond_the_end_is_told(street):
    with pytest.raises(ConfigError, match=r"--seek 7 is beyond its end, 0\.95 s after its beginning"):
        play_recording(street, rate=None, seek=7.0)


def test_a_replay_tells_which_messages_have_other_fields(street):
    ((_, result, _),) = replay_recording(street)
    lines = replay_lines(None, dataclasses.replace(result, other_fields=("perception/points",)), [])
    assert any("perception/points: its message has other fields" in line for line in lines)


@pytest.mark.parametrize(("options", "said"), [({"settings": ["a=3"]}, "--set"), ({"device": "cpu"}, "--device")])
def test_what_changes_nothing_is_refused(tmp_path, options, said):
    with pytest.raises(ConfigError, match=f"{said} changes nothing without --profile"):
        play_recording(tmp_path / "a.mcap", **options)
