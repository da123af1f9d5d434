"""The pipeline: LiDAR frames in, perceived frames out, by the modules of a profile."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from ..dag import ConfigFile, ModuleSpec, Process, VertexTiming, find_config, load_module, nearest, parse_overrides
from ..datamesh import CommitPolicy, DataMesh, Entry, Output
from ..errors import ConfigError, SourceError
from .messages import CameraSet, Obstacles, PointLabels, RadarSet, SensorFrame
from .motion import sweep_motion
from .profile import CONF, Profile, execution_context, load_profile, profile_device, use_threads

__all__ = [
    "CAMERAS_TOPIC",
    "LIDAR_TOPIC",
    "OBSTACLES_TOPIC",
    "POINTS_TOPIC",
    "RADARS_TOPIC",
    "Latency",
    "PerceptionFrame",
    "Pipeline",
    "StageLatency",
]

LIDAR_TOPIC = "lidar/points"
"""Where a pipeline commits its source's frames: the modules' input."""
CAMERAS_TOPIC, RADARS_TOPIC = "camera/objects", "radar/objects"
"""Where it commits, before a frame, what cameras and radars found since the one before, where the source knows it."""
OBSTACLES_TOPIC = "perception/obstacles"
"""Where the modules commit the objects of a frame."""
POINTS_TOPIC = "perception/points"
"""Where the modules commit what they say of each point."""

_REALTIME_FRAMES = 64
"""Frames that may wait for a caller who is slow to take them, before further ones are dropped at the source."""


@dataclass(frozen=True, slots=True)
class StageLatency:
    """Time that one stage took for one frame."""

    wait_ms: float
    """From when its inputs were there to its start [ms]."""
    run_ms: float
    """Its own work [ms]."""


@dataclass(frozen=True)
class Latency:
    """Time that one frame took."""

    total_ms: float
    """From the reception of the LiDAR frame to the commit of its obstacles, waits included [ms]."""
    stages: dict[str, StageLatency] = field(default_factory=dict)
    """By stage: the vertices of the graphs, as `component.vertex`."""


@dataclass(frozen=True, eq=False, kw_only=True)
class PerceptionFrame:
    """What was perceived in one LiDAR frame."""

    sensor: SensorFrame
    """The LiDAR frame itself, with the truth where its source knows it."""
    objects: Obstacles
    """The tracked objects; iterating gives them one by one. Empty where the frame was lost, see `failed`."""
    ground: np.ndarray
    """True where a point of `sensor.points` is on the ground, shape (n,), bool."""
    height: np.ndarray
    """Height of each point above the ground [m], NaN where unknown, shape (n,), float32."""
    clusters: np.ndarray
    """Label of each point's cluster, −1 for none, shape (n,), int32."""
    latency: Latency
    dropped: Mapping[str, int]
    """Points that were left out, by reason."""
    data: Mapping[str, Any] = field(default_factory=dict)
    """What was committed at this version to the further topics that `Pipeline.run` was asked for, by topic."""
    compensated: bool = False
    """True where perception undid the sensor's own motion during the sweep."""
    failed: bool = False
    """True where no obstacles came out: a processor raised, or the frame was dropped on the way."""

    @property
    def version(self) -> int:
        """Time of reception of the LiDAR frame [ns]."""
        return self.sensor.version

    @property
    def index(self) -> int:
        """Number of the frame in its source."""
        return self.sensor.index

    @cached_property
    def points(self) -> np.ndarray:
        """The points of the LiDAR frame as perception saw them, shape (n, 4).

        That is `sensor.points`, less the sensor's own motion during the sweep where that was undone.
        """
        motion = sweep_motion(self.sensor) if self.compensated else None
        from ..kernels.motion import compensate_motion

        return self.sensor.points if motion is None else compensate_motion(self.sensor.points, *motion, 0.0)


class Pipeline:
    """Runs the modules of a profile over the frames of a source.

    with wl.Pipeline.from_profile("cpu") as pipeline:
        for frame in pipeline.run(wl.read("scans/")):
            print(len(frame.objects), frame.latency.total_ms)
    """

    def __init__(self, profile: ConfigFile[Profile], modules: list[ConfigFile[ModuleSpec]], device: str) -> None:
        """Builds the process, so that whatever is wrong with the configuration is said here.

        Args:
            profile: The profile.
            modules: Its modules, with the settings in place.
            device: The Warp device, resolved.
        """
        self._profile = profile
        self._modules = modules
        self.device = device
        self._context = execution_context(profile, device)
        self._timings: dict[int, list[VertexTiming]] = {}
        self._timings_lock = threading.Lock()
        self._on_timing: list[Callable[[VertexTiming], None]] = []
        self._process: Process | None = None
        self._next: tuple[Process, bool] | None = (self._build(offline=True), True)
        self._mesh = DataMesh()

    @property
    def files(self) -> tuple[Path, ...]:
        """The configuration it was made from: the profile's file, then those of its modules."""
        return (self._profile.path, *(module.path for module in self._modules))

    def on_timing(self, callback: Callable[[VertexTiming], None]) -> None:
        """Calls back after every run of a vertex, in the worker's thread."""
        self._on_timing.append(callback)

    def take_process(self, *, offline: bool) -> Process:
        """A process of its modules, not started: for whoever feeds topics himself, where `run` feeds LiDAR frames.

        Args:
            offline: Its backlogs block whoever commits, so that nothing is lost.
        """
        ready, self._next = self._next, None
        return ready[0] if ready is not None and ready[1] is offline else self._build(offline=offline)

    @classmethod
    def from_profile(
        cls,
        name: str = "cpu",
        *,
        device: str | None = None,
        settings: Iterable[str] | Mapping[str, Any] = (),
        workers: int | None = None,
    ) -> Self:
        """Makes the pipeline of a hardware profile.

        Args:
            name: Of a shipped profile, or the path of a file.
            device: The Warp device, in place of the profile's.
            settings: Changes by dotted key, as a mapping or as texts `key=value`: `component.vertex.key` for a module,
                `profile.key` for the profile. Keys of the environment (`WARPLOOM__component__vertex__key`) come first.
            workers: Threads of every graph, and frames that may be in it at once, in place of what the modules say.

        Raises:
            ConfigError: Profile, module or setting is bad.
            DeviceError: There is no such device.
            ModelError: A model does not fit its card.
        """
        overrides = parse_overrides(() if isinstance(settings, Mapping) else settings)
        if isinstance(settings, Mapping):
            overrides.update(settings)
        changes = {tuple(key.split(".")): value for key, value in overrides.items()}
        of_profile = {keys[1:]: value for keys, value in changes.items() if keys[0] == "profile"}
        profile = load_profile(name, of_profile)
        of_modules = {keys: value for keys, value in changes.items() if keys[0] != "profile"}
        modules = profile_modules(profile, of_modules)
        components = [component for module in modules for component in module.content.components]
        if workers is not None:
            graphs = {(one.name, key): workers for one in components if one.graph for key in ("workers", "in_flight")}
            modules = profile_modules(profile, {**of_modules, **graphs})
        refuse_unknown(of_modules, modules)
        use_threads(profile.content)
        return cls(profile, modules, profile_device(profile.content, device))

    @property
    def profile(self) -> Profile:
        """The profile it was made from."""
        return self._profile.content

    @property
    def losses(self) -> dict[str, dict[str, int]]:
        """What the latest run lost: topic or component → reason → how many."""
        return self._mesh.losses.as_dict()

    def _build(self, *, offline: bool) -> Process:
        return Process(
            self._modules,
            context=self._context,
            external={LIDAR_TOPIC: SensorFrame, CAMERAS_TOPIC: CameraSet, RADARS_TOPIC: RadarSet},
            offline=offline,
            on_timing=self._record,
            switch_interval_s=self.profile.threads.switch_interval_s,
            check=self.profile.check,
        )

    def _record(self, timing: VertexTiming) -> None:
        if self._process is not None:  # else nobody will take them
            with self._timings_lock:
                self._timings.setdefault(timing.version, []).append(timing)
        for callback in self._on_timing:
            callback(timing)

    def run(
        self,
        source: Iterable[SensorFrame],
        *,
        topics: Iterable[str] = (),
        realtime: bool = False,
        watch: Callable[[Process], None] | None = None,
    ) -> Iterator[PerceptionFrame]:
        """Perceives the frames of a source, in their order.

        Args:
            source: Gives frames with rising versions.
            topics: Further topics of the modules, whose data each frame brings in `data`.
            realtime: Frames are fed at the pace of their versions, and what is too slow drops frames as its backlog
                says, counted in `losses`. Otherwise nothing is dropped: every frame of the source comes out.
            watch: Is given the process before it starts, to record its topics for example.

        Yields:
            One PerceptionFrame for each frame of the source, in its order.

        Raises:
            ConfigError: No component gives one of the topics.
            SourceError: The source failed; the frames before it have come out.
        """
        topics = tuple(topics)
        given = {t for file in self._modules for c in file.content.components for t in c.outputs.values()}
        for topic in topics:
            if topic not in given:
                raise ConfigError(f"no component gives topic {topic!r}; {nearest(topic, given)}")
        process = self.take_process(offline=not realtime)
        self._process, self._mesh = process, process.mesh
        with self._timings_lock:
            self._timings.clear()
        if watch is not None:
            watch(process)
        run = _Run(self, process, source, topics, realtime)
        try:
            yield from run.frames()
        finally:
            run.stop()
            process.stop()
            self._process = None

    def timings_of(self, version: int) -> list[VertexTiming]:
        """Takes the timings of a frame, and lets go of those of frames before it."""
        with self._timings_lock:
            taken = self._timings.pop(version, [])
            for old in [v for v in self._timings if v < version]:
                del self._timings[old]
            return taken

    def close(self) -> None:
        """Stops what runs."""
        if self._process is not None:
            self._process.stop()
            self._process = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()


def profile_modules(
    profile: ConfigFile[Profile], changes: Mapping[tuple[str, ...], Any]
) -> list[ConfigFile[ModuleSpec]]:
    """The modules of a profile with its settings, and with changes that come before those.

    Raises:
        ConfigError: A module is not there, or bad, or a setting is for none of their components.
    """
    settings = {tuple(key.split(".")): value for key, value in profile.content.settings.items()}
    files = []
    for index, name in enumerate(profile.content.modules):
        try:
            path = _find_module(profile, name)
        except ConfigError as error:
            raise profile.error(["modules", index], str(error)) from None
        files.append(load_module(path, {**settings, **changes}, profile.content.sensor_names))
    known = {component.name for file in files for component in file.content.components}
    for key in profile.content.settings:
        if key.split(".")[0] not in known:
            raise profile.error(["settings", key], f"no component {key.split('.')[0]!r}; {nearest(key, known)}")
    return files


def refuse_unknown(settings: Iterable[tuple[str, ...]], modules: Iterable[ConfigFile[ModuleSpec]]) -> None:
    """Refuses settings for components that none of the modules has.

    Args:
        settings: Their dotted keys, in parts.
        modules: The modules that they are for.

    Raises:
        ConfigError: There is such a setting.
    """
    known = {component.name for module in modules for component in module.content.components}
    for keys in settings:
        if keys[0] not in known:
            raise ConfigError(
                f"setting {'.'.join(keys)}: no component {keys[0]!r}; {nearest(keys[0], {*known, 'profile'})}"
            )


def _find_module(profile: ConfigFile[Profile], name: str) -> Path:
    """A module file: beside the profile, or wherever configuration lies."""
    beside = profile.path.parent / name
    return beside if beside.suffix in (".yaml", ".yml") and beside.is_file() else find_config(name, "modules", CONF)


class _Run:
    """One pass over a source: a thread commits its frames, the caller's thread collects what comes of them."""

    def __init__(
        self,
        pipeline: Pipeline,
        process: Process,
        source: Iterable[SensorFrame],
        topics: tuple[str, ...],
        realtime: bool,
    ) -> None:
        self._topics = dict.fromkeys((OBSTACLES_TOPIC, POINTS_TOPIC, *topics))
        self._pipeline = pipeline
        self._process = process
        self._source = source
        self._realtime = realtime
        self._lidar, self._cameras, self._radars = Output(), Output(), Output()
        for output, topic in (
            (self._lidar, LIDAR_TOPIC), (self._cameras, CAMERAS_TOPIC), (self._radars, RADARS_TOPIC),
        ):  # fmt: skip
            output.bind("lidar", process.mesh.window(topic))
        self._events: queue.Queue[tuple[str, Any]] = queue.Queue()
        # As many frames as the modules let into their graphs at once: a frame that is fed does not wait behind others,
        # so its latency is its own; and a caller who is slow to take frames holds up the source.
        self._room = threading.Semaphore(_REALTIME_FRAMES if realtime else process.in_flight)
        self._stopping = threading.Event()
        for topic in self._topics:
            process.mesh.window(topic).subscribe(
                lambda entry, topic=topic: self._events.put((topic, entry)),
                lambda version, epoch, topic=topic: self._events.put((topic, version)),
            )

    def frames(self) -> Iterator[PerceptionFrame]:
        """Starts the process and the source, and gives the frames as they are complete."""
        self._process.start()
        feeder = threading.Thread(target=self._feed, name="source", daemon=True)
        feeder.start()
        pending: dict[int, dict[str, Any]] = {}
        exhausted, failure = False, None
        while not exhausted or pending:
            kind, event = self._events.get()
            if kind == "frame":
                pending.setdefault(event.version, {})["sensor"] = event
            elif kind == "end":
                exhausted, failure = True, event
            else:
                version = event.version if isinstance(event, Entry) else event
                pending.setdefault(version, {})[kind] = event if isinstance(event, Entry) else None
            while pending and (first := min(pending)) is not None and self._complete(pending[first]):
                frame = self._assemble(pending.pop(first))
                self._room.release()
                if not (self._realtime and frame.failed):
                    yield frame
        feeder.join()
        if failure is not None:
            raise failure

    def _complete(self, parts: dict[str, Any]) -> bool:
        return "sensor" in parts and all(topic in parts for topic in self._topics)

    def _feed(self) -> None:
        """Commits the source's frames; the last event says how it ended."""
        failure: BaseException | None = None
        try:
            start_ns: tuple[int, int] | None = None
            last = -1
            frames = iter(self._source)
            while not self._stopping.is_set():
                # Offline the source works between frames: what it computes does not slow down what is being timed.
                if not self._realtime:
                    self._room.acquire()
                frame = None if self._stopping.is_set() else next(frames, None)
                if frame is None:
                    break
                if frame.version <= last:
                    raise SourceError(
                        f"frame {frame.index} has version {frame.version} ns, not above {last} ns "
                        "of the frame before it; a source must give rising versions"
                    )
                last = frame.version
                if self._realtime:
                    start_ns = start_ns or (frame.version, time.perf_counter_ns())
                    due = start_ns[1] + frame.version - start_ns[0]
                    self._stopping.wait(max(0.0, (due - time.perf_counter_ns()) / 1e9))
                    if not self._room.acquire(blocking=False):
                        self._process.mesh.losses.count("source", "frames_not_taken", frame.version)
                        continue
                for output, others in ((self._cameras, frame.cameras), (self._radars, frame.radars)):
                    if others is not None:
                        self._commit(output, others)
                self._events.put(("frame", frame))
                self._commit(self._lidar, frame)
        except BaseException as error:
            failure = error
        self._events.put(("end", failure))

    @staticmethod
    def _commit(output: Output, value: SensorFrame | CameraSet | RadarSet) -> None:
        with output.allocate_change() as change:
            change.set_version(value.version)
            change.value = value
            output.commit(CommitPolicy.DISCARD_OUT_OF_ORDER, change)

    def _assemble(self, parts: dict[str, Any]) -> PerceptionFrame:
        sensor: SensorFrame = parts["sensor"]
        obstacles, points = parts[OBSTACLES_TOPIC], parts[POINTS_TOPIC]
        n = len(sensor.points)
        stages = {
            f"{timing.component}.{timing.vertex}": StageLatency(timing.wait_ms, timing.run_ms)
            for timing in self._pipeline.timings_of(sensor.version)
        }
        total = (obstacles.committed_ns - obstacles.received_ns) / 1e6 if obstacles is not None else float("nan")
        labels = points.value if points is not None else PointLabels.unknown(n)
        return PerceptionFrame(
            sensor=sensor,
            objects=obstacles.value if obstacles is not None else Obstacles.lost(sensor),
            ground=labels.ground,
            height=labels.height,
            clusters=labels.clusters,
            latency=Latency(total, stages),
            dropped=labels.dropped,
            compensated=labels.compensated,
            data={topic: parts[topic].value for topic in self._topics if parts[topic] is not None},
            failed=obstacles is None,
        )

    def stop(self) -> None:
        """Lets the feeder end, also when it waits for room."""
        self._stopping.set()
        self._room.release()
