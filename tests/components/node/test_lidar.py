"""The driver commits sweeps at the sensor's rate by the clock of the mesh, to and fro, and says when it cannot."""

import dataclasses
import threading
import time

import numpy as np
import pytest

from warploom.components.execution import ExecutionContext
from warploom.components.messages import CameraObjects, CameraSet, RadarObjects, RadarSet, SensorFrame, Truth
from warploom.components.node.lidar import LidarDriver, LidarDriverConfig
from warploom.components.profile import MountingSpec, SensorSpec
from warploom.datamesh import DataMesh
from warploom.datamesh.clock import ManualClock
from warploom.datamesh.messages import encode
from warploom.errors import SourceError

PERIOD = 100_000_000
START = 1_000_000_000_000


def frames(count, truth=True):
    for k in range(count):
        boxes, ints = np.zeros((1, 7), np.float32), np.zeros(1, np.int32)
        known = Truth(
            boxes=boxes,
            classes=ints,
            ids=np.ones(1, np.int64),
            velocities=np.full((1, 2), 3.0, np.float32),
            points=ints,
        )
        yield SensorFrame(
            version=k * PERIOD, index=k, points=np.full((4, 4), k, np.float32), truth=known if truth else None
        )


def until(condition):
    end = time.monotonic() + 10
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.001)


class Driven:
    """A driver on a clock that is moved by hand, and what it committed."""

    def __init__(self, clock, config, context=None):
        self.clock = clock
        self.mesh = DataMesh(clock=clock)
        self.driver = LidarDriver("driver", context or ExecutionContext())
        self.driver.bind(self.mesh, {"cloud": "raw", "cameras": "cameras", "radars": "radars"})
        self.driver.init(LidarDriverConfig.model_validate({"sensor": "roof", **config}))
        self.came, self.cameras, self.radars = [], [], []
        for topic, came in (("raw", self.came), ("cameras", self.cameras), ("radars", self.radars)):
            self.mesh.window(topic).subscribe(came.append, lambda *_: None)
        self.driver.start()

    def waits(self):
        """Whether it waits for the time of its next sweep."""
        return any(timer.is_due for _, _, timer in self.clock._due)

    def periods(self, count):
        """Lets so many periods pass, in each of which a sweep comes."""
        for _ in range(count):
            until(self.waits)
            before = len(self.came)
            self.clock.advance(PERIOD)
            until(lambda before=before: len(self.came) > before)


@pytest.fixture
def drive(monkeypatch):
    running = []

    def make(source, clock=None, /, **config):
        monkeypatch.setattr("warploom.components.sources.open_source", lambda uri, device=None: source)
        running.append(Driven(clock or ManualClock(START), config))
        return running[-1]

    yield make
    for one in running:
        one.driver.stop()


def test_sweeps_come_at_the_sensors_rate_with_the_time_of_reception_as_version(drive):
    driven = drive(frames(3), ahead_s=0.3)
    driven.periods(3)
    came = driven.came
    assert [entry.version for entry in came] == [START + k * PERIOD for k in range(4)]
    assert [entry.value.version for entry in came] == [entry.version for entry in came]
    assert [entry.value.index for entry in came] == [0, 1, 2, 3]
    assert {entry.value.frame_id for entry in came} == {"roof"}
    assert driven.driver.state()["sweeps"] == 4
    assert driven.driver.idle_because is None


def test_the_drive_goes_to_and_fro_and_backwards_everything_moves_backwards(drive):
    driven = drive(frames(9), ahead_s=0.3)
    driven.periods(8)
    assert [int(entry.value.points[0, 0]) for entry in driven.came] == [0, 1, 2, 1, 0, 1, 2, 1, 0]
    speeds = [float(entry.value.truth.velocities[0, 0]) for entry in driven.came]
    assert speeds == [3, 3, 3, -3, -3, 3, 3, -3, -3]


def with_others(count):
    """As `frames`, after a camera 50 ms before each and a radar 30 ms before, whose only target goes away at 5 m/s."""
    for frame in frames(count):
        k = np.array([[frame.index]], np.float32)
        camera = CameraObjects(
            version=frame.version - 50_000_000, sensor="camera", boxes=np.tile(k, 4), scores=k[0],
            projection=np.eye(4)[:3], classes=np.zeros(1, np.int32), size=(10, 10),
        )  # fmt: skip
        radar = RadarObjects(
            version=frame.version - 30_000_000, sensor="radar", positions=np.tile(k, 3), scores=k[0],
            mounting=np.eye(4), radial_velocities=np.full(1, 5, np.float32), velocity=np.array([8.0, 0, 0]),
        )  # fmt: skip
        yield dataclasses.replace(
            frame, cameras=CameraSet(version=camera.version, cameras=(camera,)),
            radars=RadarSet(version=radar.version, radars=(radar,)),
        )  # fmt: skip


def test_cameras_and_radars_are_played_with_the_sweeps_and_backwards_too(drive):
    driven = drive(with_others(9), ahead_s=0.3)
    driven.periods(4)
    sweeps = [entry.version for entry in driven.came]
    assert [int(entry.value.points[0, 0]) for entry in driven.came] == [0, 1, 2, 1, 0]
    assert all(entry.value.cameras is None for entry in driven.came)
    cameras, radars = ([entry.value for entry in came] for came in (driven.cameras, driven.radars))
    # Between the sweeps 2 and 1 lies what was found before sweep 2, at its place in time.
    assert [int(one.cameras[0].boxes[0, 0]) for one in cameras] == [0, 1, 2, 2, 1]
    assert [sweep - one.version for sweep, one in zip(sweeps, cameras, strict=True)] == [50_000_000] * 5
    assert [sweep - one.version for sweep, one in zip(sweeps, radars, strict=True)] == [30_000_000] * 3 + [
        70_000_000
    ] * 2
    assert [one.radars[0].version for one in radars] == [one.version for one in radars]
    assert [float(one.radars[0].radial_velocities[0]) for one in radars] == [5, 5, 5, -5, -5]
    assert [float(one.radars[0].velocity[0]) for one in radars] == [8, 8, 8, -8, -8]


def test_a_single_frame_stands_still(drive):
    driven = drive(frames(1, truth=False), ahead_s=0.1)
    driven.periods(3)
    assert [int(entry.value.points[0, 0]) for entry in driven.came] == [0, 0, 0, 0]


def test_the_next_life_of_its_process_plays_what_was_made_ahead_and_opens_nothing(monkeypatch, tmp_path):
    opened = []

    def source(uri, device=None):
        opened.append(uri)
        return with_others(3)

    monkeypatch.setattr("warploom.components.sources.open_source", source)
    context = ExecutionContext(handover=tmp_path / "process")
    came = []
    for config in ({}, {}, {"seed": 8}):
        driven = Driven(ManualClock(START), {"ahead_s": 0.3, **config}, context)
        driven.periods(4)
        driven.driver.stop()
        came.append([encode(entry.value) for kind in (driven.came, driven.cameras, driven.radars) for entry in kind])
        assert driven.driver.starting_because is None
    assert came[0] == came[1]
    assert [uri.partition("&")[0] for uri in opened] == ["sim:street?seed=7", "sim:street?seed=8"]


def test_nothing_comes_between_two_sweeps(drive):
    driven = drive(frames(2), ahead_s=0.2)
    until(driven.waits)
    driven.clock.advance(PERIOD - 1)
    time.sleep(0.05)
    assert len(driven.came) == 1
    driven.clock.advance(1)
    until(lambda: len(driven.came) == 2)


def test_a_source_that_is_played_once_ends_and_says_so(drive):
    driven = drive(frames(3), play="once", source="kitti:somewhere")
    driven.periods(2)
    until(lambda: driven.driver.idle_because is not None)
    assert driven.driver.idle_because == "kitti:somewhere is at its end"
    assert len(driven.came) == 3


def test_a_late_sweep_is_counted_and_keeps_its_own_time(drive):
    clock = ManualClock(START)

    def slow():
        first, second = frames(2)
        yield first
        clock.advance(3 * PERIOD)  # so long the source takes for its second frame
        yield second

    driven = drive(slow(), clock, play="once")
    until(lambda: driven.driver.idle_because is not None)
    assert [entry.version for entry in driven.came] == [START, START + 3 * PERIOD]
    assert driven.driver.state()["late"] == 1
    assert driven.mesh.losses["driver", "late"] == 1


def test_a_source_that_fails_makes_the_driver_idle_and_says_why(drive):
    def broken():
        raise SourceError("the cable is off")
        yield

    driven = drive(broken(), play="once", source="pcap:cable")
    until(lambda: driven.driver.idle_because is not None)
    assert driven.driver.idle_because == "pcap:cable: the cable is off"
    assert driven.driver.state()["phase"] == "failed"


def test_it_can_be_stopped_while_it_waits_and_leaves_no_thread(drive):
    driver = drive(frames(2), ahead_s=0.2).driver
    driver.stop()
    assert not [thread for thread in threading.enumerate() if thread.name == "driver"]
    assert driver.state()["phase"] == "stopped"


def test_a_source_that_takes_for_ever_to_open_does_not_hold_up_the_stop(monkeypatch, caplog):
    opening, opened = threading.Event(), threading.Event()

    def slow(uri, device=None):
        opening.set()
        opened.wait(30)
        return iter(())

    monkeypatch.setattr("warploom.components.sources.open_source", slow)
    monkeypatch.setattr(LidarDriver, "stop_timeout_s", 0.01)
    mesh = DataMesh()
    driver = LidarDriver("driver", ExecutionContext())
    driver.bind(mesh, {"cloud": "raw", "cameras": "cameras", "radars": "radars"})
    driver.init(LidarDriverConfig(sensor="roof"))
    driver.start()
    assert opening.wait(10)
    assert driver.starting_because == f"makes frames of {driver.source} ahead"
    driver.stop()
    assert mesh.losses["driver", "hung"] == 1
    assert "left to itself" in caplog.text
    opened.set()
    until(lambda: not [thread for thread in threading.enumerate() if thread.name == "driver"])
    assert driver.state()["phase"] == "stopped", "what ends later does not say so"


def test_what_plays_the_sensor_comes_from_the_profile_and_nothing_is_opened(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("nothing may be opened before the start")

    monkeypatch.setattr("warploom.components.sources.open_source", refuse)

    def source_of(sensor, **config):
        driver = LidarDriver("driver", ExecutionContext(sensors={} if sensor is None else {"roof": sensor}))
        driver.init(LidarDriverConfig.model_validate({"sensor": "roof", **config}))
        return driver.source

    assert source_of(None) == "sim:street?seed=7&lidar=pandar90&rate=10&duration=2"
    mounted = SensorSpec(name="roof", model="vlp16", rate_hz=20, mounting=MountingSpec(xyz=(1.0, 0.0, 1.9)))
    assert source_of(mounted, ahead_s=3) == ("sim:street?seed=7&lidar=vlp16&rate=20&duration=3&mounting_height=1.9")
    assert source_of(SensorSpec(name="roof", source="mcap:drive.mcap"), source="kitti:x") == "mcap:drive.mcap"
    assert source_of(SensorSpec(name="roof"), source="kitti:x") == "kitti:x"


def test_the_simulator_plays_a_sensor():
    """In earnest, with few lasers: a cloud of the named sensor comes out."""
    mesh = DataMesh()
    driver = LidarDriver("driver", ExecutionContext())
    driver.bind(mesh, {"cloud": "raw", "cameras": "cameras", "radars": "radars"})
    driver.init(LidarDriverConfig(sensor="roof", model="vlp16", ahead_s=0.1))
    came = threading.Event()
    mesh.window("raw").subscribe(lambda entry: came.set(), lambda *_: None)
    driver.start()
    try:
        assert came.wait(120)
    finally:
        driver.stop()
    frame = mesh.window("raw").snapshot().last()
    assert len(frame.points) > 5_000
    assert frame.ring is not None
    assert int(frame.ring.max()) < 16


def equipped(**config):
    """The names of the cameras and radars that the simulated vehicle gets, of two and one in the profile."""

    class Source:
        suite = None

    at = MountingSpec(xyz=(1.0, 0.0, 1.5))
    sensors = {name: SensorSpec(name=name, mounting=at) for name in ("roof", "front", "rear", "radar")}
    sensors["loose"] = SensorSpec(name="loose")
    kinds = {"lidar": ("roof",), "camera": ("front", "rear", "loose"), "radar": ("radar",)}
    context = ExecutionContext(sensors=sensors, sensor_kinds=kinds)
    driver, source = LidarDriver("driver", context), Source()
    driver.init(LidarDriverConfig.model_validate({"sensor": "roof", **config}))
    driver._equip(source, context)
    return source.suite and (list(source.suite.cameras), list(source.suite.radars))


def test_the_simulated_vehicle_has_the_cameras_and_radars_of_the_profile_or_those_asked_for():
    assert equipped() == (["front", "rear"], ["radar"])
    assert equipped(cameras=["rear"]) == (["rear"], ["radar"])
    assert equipped(cameras=["front"], radars=[]) == (["front"], [])
    assert equipped(cameras=[], radars=[]) is None
    for name in ("top", "loose"):
        with pytest.raises(ValueError, match=f"no camera '{name}' with a mounting, but \\['front', 'rear'\\]"):
            equipped(cameras=[name])
