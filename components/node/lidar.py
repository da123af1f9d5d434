"""The LiDAR's driver as the node sees it: sweeps at the sensor's rate, played by the simulator or a recording.

A simulator or a decoder may be slower than the sensor, so frames are made ahead: the first seconds of a drive, which
are then played to and fro. Each frame follows the one before it by one period of motion, forwards or backwards, so
that what perceives it sees one continuous drive however long it lasts. A sensor goes on while its driver is dead, but
a simulated street takes seconds to build: so the frames are left to the next life of the process, which plays them at
once. Where the simulator plays, it plays the cameras and radars of the profile too, at the level of objects.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from ...dag import Component, ProcessorConfig
from ...datamesh import CommitPolicy, Output
from ...datamesh.clock import Timer
from ...errors import WarploomError
from ..execution import ExecutionContext
from ..messages import CameraSet, RadarSet, SensorFrame
from .handover import Handover
from .transforms import mounting_matrix

__all__ = ["LidarDriver", "LidarDriverConfig"]

_log = logging.getLogger(__name__)


class LidarDriverConfig(ProcessorConfig):
    """Which sensor, and who plays it."""

    sensor: str
    """Name of the sensor in the profile."""
    model: str = "pandar90"
    """Its type, where the profile does not say."""
    rate_hz: float = Field(10.0, gt=0.0, le=100.0)
    """Sweeps a second, where the profile does not say."""
    source: str | None = None
    """Who plays it, as a URI of `--source`, where the profile does not say; null: the simulator, with this sensor."""
    seed: int = Field(7, ge=0)
    """Of the simulated street."""
    ahead_s: float = Field(2.0, gt=0.0, le=60.0)
    """How much of the drive is made before it is played [s]."""
    cameras: tuple[str, ...] | None = None
    """Cameras of the profile that the simulated vehicle has; null: all that have a mounting."""
    radars: tuple[str, ...] | None = None
    """Its radars, likewise."""
    play: Literal["to_and_fro", "once"] = "to_and_fro"
    """to_and_fro: what was made ahead, without end; once: the whole source, at its rate or as fast as it can."""


class LidarDriver(Component):
    """Commits the sweeps of one LiDAR, each at its time by the clock of the mesh.

    The version of a sweep is its time of reception. A sweep that was not ready in time is committed when it is, and
    counted as `late`.
    """

    Config = LidarDriverConfig
    context: ExecutionContext | None
    stop_timeout_s: ClassVar[float] = 3.0
    """How long a stop waits for a frame that is being made."""

    cloud: Output[SensorFrame]
    cameras: Output[CameraSet] = Output(optional=True)
    radars: Output[RadarSet] = Output(optional=True)

    def __init__(self, name: str, context: Any = None) -> None:
        super().__init__(name, context)
        self._config = LidarDriverConfig(sensor=name)
        self._uri = ""
        self._period_ns = 100_000_000
        self._stopping = threading.Event()
        self._tick = threading.Event()
        self._thread: threading.Thread | None = None
        self._phase = "not started"
        self._committed = self._late = 0
        self._failure: str | None = None

    def init(self, config: LidarDriverConfig) -> None:
        """Finds out what plays the sensor; nothing is opened before the start.

        Raises:
            ValueError: The profile has no such camera or radar, or does not say where it is.
        """
        self._config = config
        for kind, asked in (("camera", config.cameras), ("radar", config.radars)):
            known = self._mounted(kind)
            for name in asked or ():
                if name not in known:
                    raise ValueError(f"{kind}s: the profile has no {kind} {name!r} with a mounting, but {list(known)}")
        sensor = (self.context or ExecutionContext()).sensors.get(config.sensor)
        rate = getattr(sensor, "rate_hz", None) or config.rate_hz
        self._period_ns = round(1e9 / rate)
        source = getattr(sensor, "source", None) or config.source
        if source is None:
            model = getattr(sensor, "model", None) or config.model
            source = f"sim:street?seed={config.seed}&lidar={model}&rate={rate:g}&duration={config.ahead_s:g}"
            mounting = getattr(sensor, "mounting", None)
            if mounting is not None and mounting.xyz[2] > 0:
                source += f"&mounting_height={mounting.xyz[2]:g}"
        self._uri = source

    @property
    def source(self) -> str:
        """The URI of what plays the sensor."""
        return self._uri

    def start(self) -> None:
        """Starts the thread that makes and commits the sweeps."""
        self._stopping.clear()
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Ends it. A source that is just being opened cannot be interrupted: it is left to itself, and counted."""
        self._stopping.set()
        self._tick.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(self.stop_timeout_s)
            if thread.is_alive():
                _log.warning("%s: %s is still being opened since the stop, and is left to itself", self.name, self._uri)
                self.losses.count(self.name, "hung")
        self._phase = "stopped"

    @property
    def idle_because(self) -> str | None:
        """Why no sweeps come: its source failed, or has come to its end."""
        if self._failure is not None:
            return f"{self._uri}: {self._failure}"
        return f"{self._uri} is at its end" if self._phase == "ended" else None

    @property
    def starting_because(self) -> str | None:
        """What is done before the first sweep can come."""
        return f"makes frames of {self._uri} ahead" if self._phase == "making frames" else None

    def state(self) -> Mapping[str, str | float | int]:
        """What plays it, and how many sweeps it gave."""
        return {
            "source": self._uri,
            "phase": self._phase,
            "rate_hz": round(1e9 / self._period_ns, 3),
            "sweeps": self._committed,
            "late": self._late,
        }

    def _run(self) -> None:
        try:
            self._phase = "making frames"
            frames = self._frames()
            frame = next(frames, None)
            if self._stopping.is_set():
                return
            self._phase = "playing"
            due = self.clock.monotonic_ns()
            index = 0
            while frame is not None and not self._stopping.is_set():
                self._commit(_stamped(frame, self.clock.now_ns(), index, self._config.sensor))
                index += 1
                frame = next(frames, None)
                if frame is not None:
                    due = self._wait(due + self._period_ns)
            self._phase = "ended"
        except WarploomError as error:
            self._failure = str(error)
        except Exception as error:
            self._failure = f"{type(error).__name__}: {error}"
        if self._failure is not None:
            self._phase = "failed"
            _log.error("%s gives no more sweeps: %s: %s", self.name, self._uri, self._failure)

    def _frames(self) -> Iterator[SensorFrame]:
        """The sweeps in the order in which they are played."""
        if self._config.play == "once":
            yield from self._open()
            return
        handover = Handover((self.context or ExecutionContext()).handover, self.name, self._origin())
        made: list[SensorFrame] = handover.take()
        if not made:
            for frame in self._open():
                if self._stopping.is_set():
                    return
                made.append(frame)
                if len(made) * self._period_ns >= self._config.ahead_s * 1e9:
                    break
            handover.leave(made)
        last = len(made) - 1
        position, step = 0, 1
        while made:
            frame = made[position]
            yield frame if step > 0 else _backwards(frame, made[min(position + 1, last)], self._period_ns)
            if not 0 <= position + step <= last:
                step = -step
            position = min(max(position + step, 0), last)

    def _open(self) -> Iterable[SensorFrame]:
        """What plays the sensor, opened."""
        from ..sources import open_source

        context = self.context or ExecutionContext()
        source = open_source(self._uri, device=context.device)
        if hasattr(source, "suite"):
            self._equip(source, context)
        return source

    def _origin(self) -> str:
        """All that the frames made ahead are made of."""
        context = self.context or ExecutionContext()
        lidar = getattr(context.sensors.get(self._config.sensor), "mounting", None)
        mounted = {
            kind: {name: at.tolist() for name, at in self._mounted(kind).items()} for kind in ("camera", "radar")
        }
        return repr((self._uri, self._period_ns, self._config.model_dump(), lidar, mounted))

    def _mounted(self, kind: str) -> dict[str, np.ndarray]:
        """Vehicle from sensor, of those of a kind in the profile that say where they are."""
        context = self.context or ExecutionContext()
        specs = {name: context.sensors[name].mounting for name in context.sensor_kinds.get(kind, ())}
        return {name: mounting_matrix(at.xyz, at.rpy_deg) for name, at in specs.items() if at is not None}

    def _equip(self, source: Any, context: ExecutionContext) -> None:
        """Gives a simulated vehicle the cameras and radars that it is to have."""
        from ..sources.simulated_sensors import mounted_suite

        def asked(kind: str, names: tuple[str, ...] | None) -> dict[str, np.ndarray]:
            return {name: at for name, at in self._mounted(kind).items() if names is None or name in names}

        cameras, radars = asked("camera", self._config.cameras), asked("radar", self._config.radars)
        lidar = getattr(context.sensors.get(self._config.sensor), "mounting", None)
        if lidar is not None and (cameras or radars):
            source.suite = mounted_suite(mounting_matrix(lidar.xyz, lidar.rpy_deg), cameras, radars)

    def _wait(self, due: int) -> int:
        """Waits until a sweep is due, by the clock of the mesh; gives when it was, or is now where that is past."""
        now = self.clock.monotonic_ns()
        if now >= due:
            if now > due + self._period_ns // 2:
                self._late += 1
                self.losses.count(self.name, "late", self.clock.now_ns())
                return now
            return due
        self._tick.clear()
        timer: Timer = self.clock.call_at(due, self._tick.set)
        if not self._stopping.is_set():
            self._tick.wait()
        timer.cancel()
        return due

    def _commit(self, frame: SensorFrame) -> None:
        for output, others in ((self.cameras, frame.cameras), (self.radars, frame.radars)):
            if others is not None and output.is_bound:
                _commit_to(output, others)
        _commit_to(self.cloud, replace(frame, cameras=None, radars=None))
        self._committed += 1


def _commit_to(output: Output, value: SensorFrame | CameraSet | RadarSet) -> None:
    with output.allocate_change() as change:
        change.set_version(value.version)
        change.value = value
        output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)


def _stamped(frame: SensorFrame, version: int, index: int, frame_id: str) -> SensorFrame:
    """A frame as of another time, and with it what cameras and radars found before."""
    shift = version - frame.version
    return replace(
        frame,
        version=version,
        index=index,
        frame_id=frame_id,
        cameras=_shifted_cameras(frame.cameras, shift),
        radars=_shifted_radars(frame.radars, shift),
    )


def _shifted_cameras(given: CameraSet | None, shift: int) -> CameraSet | None:
    if given is None:
        return None
    cameras = tuple(replace(one, version=one.version + shift) for one in given.cameras)
    return CameraSet(version=given.version + shift, cameras=cameras)


def _shifted_radars(given: RadarSet | None, shift: int) -> RadarSet | None:
    if given is None:
        return None
    radars = tuple(replace(one, version=one.version + shift) for one in given.radars)
    return RadarSet(version=given.version + shift, radars=radars)


def _backwards(frame: SensorFrame, before: SensorFrame, period_ns: int) -> SensorFrame:
    """A frame as it is seen while the drive goes backwards: what moves goes the other way.

    What cameras and radars found in between is what they found before `before`, the sweep that is played before it.
    """
    truth, cameras, radars = frame.truth, before.cameras, before.radars
    if truth is not None:
        truth = replace(truth, velocities=-truth.velocities)
    if cameras is not None:
        age = period_ns - (before.version - cameras.version)
        cameras = _shifted_cameras(cameras, frame.version - age - cameras.version)
    if radars is not None:
        age = period_ns - (before.version - radars.version)
        radars = _shifted_radars(radars, frame.version - age - radars.version)
        assert radars is not None
        turned = tuple(
            replace(
                one,
                radial_velocities=-one.radial_velocities,
                velocity=None if one.velocity is None else -one.velocity,
            )
            for one in radars.radars
        )
        radars = replace(radars, radars=turned)
    return replace(frame, truth=truth, cameras=cameras, radars=radars)
