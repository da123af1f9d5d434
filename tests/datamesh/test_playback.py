"""Playing a recording into a mesh: everything in order, at any pace, from any place, again and again."""

import threading
import time

import pytest

from warploom.datamesh import CommitPolicy, DataMesh, Output
from warploom.datamesh.playback import Player
from warploom.datamesh.recording import Recorder
from warploom.datamesh.recording_reader import Recording

STEP = 10_000_000  # [ns] between versions


def output_of(mesh, topic) -> Output:
    output = Output()
    output.bind(topic, mesh.window(topic))
    return output


def commit(mesh, topic, version, value):
    output = output_of(mesh, topic)
    with output.allocate_change() as change:
        change.set_version(version)
        change.value = value
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Ten versions of `a`, every other one of `b`, in between a settled one; then a second epoch of three."""
    path = tmp_path_factory.mktemp("recording") / "a.mcap"
    mesh = DataMesh()
    with Recorder(path, digest_only=["hashes"]) as recorder:
        recorder.watch(mesh, ["a", "b", "hashes"])
        for number in range(10):
            version = 1_000_000_000 + number * STEP
            commit(mesh, "a", version, number)
            commit(mesh, "hashes", version, number)
            if number % 2:
                output_of(mesh, "b").settle(version)
            else:
                commit(mesh, "b", version, str(number))
        for topic in mesh.topics():
            mesh.window(topic).new_epoch()
        for number in range(3):
            commit(mesh, "a", 5 + number * STEP, 100 + number)
    return Recording(path)


def watch(mesh, *topics):
    """What subscribers of the topics are told: (topic, value or None where settled)."""
    told = []
    for topic in topics:
        mesh.window(topic).subscribe(
            lambda entry, topic=topic: told.append((topic, entry.value)),
            lambda version, epoch, topic=topic: told.append((topic, None)),
        )
    return told


FIRST = [event for number in range(10) for event in (("a", number), ("b", None if number % 2 else str(number)))]
SECOND = [("a", 100), ("a", 101), ("a", 102)]


def test_everything_is_published_in_its_order(recording):
    mesh = DataMesh()
    told = watch(mesh, "a", "b")
    player = Player(recording, mesh, ["a", "b"], rate=None)
    player.play()
    assert told == FIRST + SECOND
    assert player.published == {"a": 13, "b": 5}
    assert mesh.window("a").snapshot().epoch == 1
    assert mesh.losses.as_dict() == {}


def test_a_loop_is_a_new_epoch_before_which_the_owner_is_asked(recording):
    mesh = DataMesh()
    told = watch(mesh, "a")
    epochs = []
    Player(recording, mesh, ["a"], rate=None, loops=3, before_epoch=lambda: epochs.append(len(told))).play()
    once = [event for event in FIRST + SECOND if event[0] == "a"]
    assert told == once * 3
    assert epochs == [10, 13, 23, 26, 36]
    assert mesh.window("a").snapshot().epoch == 5


def test_seeking_leaves_out_what_is_before(recording):
    mesh = DataMesh()
    told = watch(mesh, "a", "b")
    Player(recording, mesh, ["a", "b"], rate=None, seek=0.035).play()
    assert told == FIRST[8:] + SECOND


@pytest.fixture(scope="module")
def two_sensors(tmp_path_factory):
    """Ten sweeps at 1 s, 1.1 s …, each with an image 50 ms before it that is committed after it."""
    path = tmp_path_factory.mktemp("recording") / "two.mcap"
    mesh = DataMesh()
    with Recorder(path) as recorder:
        recorder.watch(mesh, ["sweep", "image"])
        for number in range(10):
            commit(mesh, "sweep", 1_000_000_000 + number * 100_000_000, number)
            commit(mesh, "image", 950_000_000 + number * 100_000_000, number)
    return Recording(path)


@pytest.mark.parametrize("loops", [1, 2])
@pytest.mark.parametrize(
    ("seek", "sweeps", "images"),
    [
        (0.0, range(10), range(10)),
        (0.05, range(10), range(1, 10)),
        (0.1, range(1, 10), range(1, 10)),
        (0.5, range(5, 10), range(5, 10)),
        (0.93, range(9, 10), ()),
        (0.96, (), ()),
    ],
)
def test_seeking_counts_from_the_lowest_version_of_all_topics_in_every_loop(two_sensors, loops, seek, sweeps, images):
    mesh = DataMesh()
    told = watch(mesh, "sweep", "image")
    Player(two_sensors, mesh, ["sweep", "image"], rate=None, seek=seek, loops=loops).play()
    assert [value for topic, value in told if topic == "sweep"] == [*sweeps] * loops
    assert [value for topic, value in told if topic == "image"] == [*images] * loops


def test_seeking_may_count_from_a_version_that_is_given(two_sensors):
    """So that the same time is meant whichever topics are played."""
    mesh = DataMesh()
    told = watch(mesh, "sweep")
    Player(two_sensors, mesh, ["sweep"], rate=None, seek=0.11, beginning=950_000_000).play()
    assert told == [("sweep", number) for number in range(1, 10)]
    again = watch(other := DataMesh(), "sweep")
    Player(two_sensors, other, ["sweep"], rate=None, seek=0.11).play()
    assert again == [("sweep", number) for number in range(2, 10)]


@pytest.mark.parametrize("rate", [2.0, 8.0])
def test_after_seeking_the_rate_counts_from_what_comes_first(two_sensors, rate):
    """What was left out takes no time; what comes then is never earlier than the rate says."""
    mesh = DataMesh()
    stamps = []
    mesh.window("sweep").subscribe(lambda entry: stamps.append((entry.version, time.perf_counter())), lambda *_: None)
    Player(two_sensors, mesh, ["sweep"], rate=rate, seek=0.7).play()
    (first, start), *rest = stamps
    assert first == 1_700_000_000
    for version, stamp in rest:
        assert stamp - start >= (version - first) / 1e9 / rate - 0.005


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_versions_are_as_far_apart_as_the_rate_says(recording, rate):
    """Never earlier than the rate says; how much later is the machine's business."""
    mesh = DataMesh()
    stamps = []
    mesh.window("a").subscribe(lambda entry: stamps.append((entry.version, time.perf_counter())), lambda *_: None)
    Player(recording, mesh, ["a"], rate=rate).play()
    for part in (stamps[:10], stamps[10:]):
        (first, start), *rest = part
        for version, stamp in rest:
            assert stamp - start >= (version - first) / 1e9 / rate - 0.005


def test_a_step_that_says_no_ends_it(recording):
    mesh = DataMesh()
    told = watch(mesh, "a")
    seen = []
    Player(
        recording, mesh, ["a"], rate=None, loops=None, on_event=lambda e: len(seen) < 4 and not seen.append(e)
    ).play()
    assert [event.value for event in seen] == [0, 1, 2, 3]
    assert told == [("a", number) for number in range(4)]


def test_it_can_be_stopped_from_another_thread(recording):
    mesh = DataMesh()
    player = Player(recording, mesh, ["a"], rate=1e-6, loops=None)
    thread = threading.Thread(target=player.play)
    thread.start()
    player.stop()
    thread.join(20)
    assert not thread.is_alive()


def test_what_is_kept_as_hashes_is_skipped_and_counted(recording, caplog):
    mesh = DataMesh()
    player = Player(recording, mesh, ["a", "hashes"], rate=None)
    player.play()
    assert player.skipped == {"hashes": 10}
    assert player.published == {"a": 13}
    assert caplog.text.count("is skipped") == 1


def test_a_topic_without_events_ends_at_once(recording):
    Player(recording, DataMesh(), ["absent"], rate=None, loops=None).play()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"rate": 0}, "rate must be above 0"),
        ({"rate": float("nan")}, "rate must be above 0"),
        ({"seek": -1}, "seek must be at least 0 s, not -1"),
        ({"loops": 0}, "loops must be at least 1, not 0"),
    ],
)
def test_numbers_that_make_no_sense_are_refused(recording, options, said):
    with pytest.raises(ValueError, match=said):
        Player(recording, DataMesh(), ["a"], **options)
